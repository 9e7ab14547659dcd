"""Radar: cells of range and azimuth, each of which gives one point. Geometry only."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.documents import Pose
from torchcover.simulation.rays import compute_unit_directions
from torchcover.simulation.sensor import Elevation, RangeSensor, RayHits, Returns, SensorNoise

# What rounding adds to a quotient makes no cell more.
ROUNDING = 1e-9

Resolution = Annotated[float, Field(ge=1e-3)]


class Radar(RangeSensor):
    """A radar that tells apart range and azimuth, and no elevation. Its frame is x forward, y left, z up.

    The opening is cut into equal cells of azimuth, none wider than `azimuth_cell_deg`, and the range into cells of
    `range_cell_m` from the sensor on. Rays point to the middles of an even raster over each cell of azimuth and all of
    the vertical opening, so fine that neighbours are at most `ray_spacing_m` apart at the largest range: what is larger
    is hit. The point of a cell is the hit in the middle of its hits by range, of two the nearer: it lies on a true
    surface, on that which fills most of the cell's view, and not on the bit of road in front of it.

    This is geometry only: without radar cross section, incidence, multipath, Doppler or side lobes. Whatever is hit
    gives a point, the road too, of which a real radar hears little; nothing is seen through a bumper, or below a car by
    way of the road.

    Args:
        name: What maps and messages call it.
        mount: `vehicle_T_radar`.
        horizontal_fov_deg: Opening about the x axis.
        vertical_fov_deg: Lowest and highest elevation of the opening.
        azimuth_cell_deg: Largest width of a cell.
        range_cell_m: Depth of a cell.
        ray_spacing_m: Largest distance of two neighbouring rays at `max_range_m`.
        min_range_m, max_range_m, range_noise_m, dropout: As in `Ranging`; of points, not of rays.

    Example:
        >>> radar = Radar(
        ...     name="front", horizontal_fov_deg=90, vertical_fov_deg=(-10, 10), azimuth_cell_deg=4.5, range_cell_m=0.4,
        ...     max_range_m=70,
        ... )
        >>> radar.azimuth_cells, radar.directions().shape
        (20, (3, 49, 220))
    """

    type: Literal["radar"] = "radar"
    name: str
    mount: Pose = Pose()
    horizontal_fov_deg: Annotated[float, Field(gt=0.0, le=360.0)]
    vertical_fov_deg: tuple[Elevation, Elevation]
    azimuth_cell_deg: Resolution
    range_cell_m: Resolution
    ray_spacing_m: Annotated[float, Field(ge=1e-2)] = 0.5

    @model_validator(mode="after")
    def _check_cells(self) -> Self:
        if self.vertical_fov_deg[0] > self.vertical_fov_deg[1]:
            raise ValueError(f"vertical_fov_deg: the lower elevation comes first; got {self.vertical_fov_deg}")
        for key, cell, opening, largest in (
            ("azimuth_cell_deg", self.azimuth_cell_deg, "horizontal_fov_deg", self.horizontal_fov_deg),
            ("range_cell_m", self.range_cell_m, "max_range_m", self.max_range_m),
        ):
            if cell > largest:
                raise ValueError(
                    f"{key}: a cell within the opening is needed, at most {opening} ({largest:g}) wide; got {cell:g}"
                )
        return self

    @property
    def num_azimuth_cells(self) -> int:
        """How many cells there are side by side."""
        return math.ceil(self.horizontal_fov_deg / self.azimuth_cell_deg - ROUNDING)

    @property
    def num_rays(self) -> int:
        """How many rays there are, of all cells."""
        rows, columns = self._raster()
        return rows * self.num_azimuth_cells * columns

    def _raster(self) -> tuple[int, int]:
        spacing_deg = math.degrees(self.ray_spacing_m / self.max_range_m)
        low_deg, high_deg = self.vertical_fov_deg
        cell_deg = self.horizontal_fov_deg / self.num_azimuth_cells
        rows, columns = (math.ceil(opening / spacing_deg - ROUNDING) for opening in (high_deg - low_deg, cell_deg))
        return max(rows, 1), max(columns, 1)

    def compute_directions(self) -> Float64:
        """(3, rows, columns) unit directions in the radar's frame."""
        rows, in_a_cell = self._raster()
        columns = self.num_azimuth_cells * in_a_cell
        (low_deg, high_deg), (up, left) = self.vertical_fov_deg, ((np.arange(n) + 0.5) / n for n in (rows, columns))
        return compute_unit_directions(
            low_deg + (high_deg - low_deg) * up[:, None], self.horizontal_fov_deg * (left - 0.5)[None]
        )

    def compute_beam_indices(self) -> Int64:
        """(rows, columns) the cell of azimuth of each ray: rays with the same share the cells behind each other."""
        rows, in_a_cell = self._raster()
        return np.tile(np.arange(self.num_azimuth_cells).repeat(in_a_cell), (rows, 1))

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """A point for each cell that has a hit which is not too close, unless it drops out."""
        _, in_a_cell = self._raster()
        beam = hits.pixel_indices // in_a_cell % self.num_azimuth_cells
        if hits.position_indices is not None:
            beam = beam + self.num_azimuth_cells * hits.position_indices
        seen = np.flatnonzero(hits.range_m >= self.min_range_m)
        # By beam, then by range, which lets the cells of a beam follow each other; of equals the first.
        seen = seen[np.lexsort((hits.range_m[seen], beam[seen]))]
        cell = np.floor(hits.range_m[seen] / np.float64(self.range_cell_m)).astype(np.int64)
        first = np.flatnonzero((np.diff(cell, prepend=-1) != 0) | (np.diff(beam[seen], prepend=-1) != 0))
        last = np.append(first[1:], len(seen)) - 1
        middle = seen[(first + last) // 2]
        return self.sample_returns(hits, np.sort(middle), noise)
