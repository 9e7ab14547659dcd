"""Radar sensor without radar physics: each cell of range and azimuth gives one point."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.documents import Pose
from torchcover.simulation.rays import compute_unit_directions
from torchcover.simulation.sensor import Elevation, RangeSensor, RayHits, Returns, SensorNoise

Resolution = Annotated[float, Field(ge=1e-3)]


class Radar(RangeSensor):
    """Radar that resolves range and azimuth but not elevation. The sensor frame is x forward, y left, z up.

    The horizontal field of view is split into equal azimuth cells of at most `azimuth_cell_deg`, the range into cells
    of `range_cell_m`. Rays form an even raster over each azimuth cell and the vertical field of view; neighboring rays
    are at most `ray_spacing_m` apart at the maximum range, so that larger objects are hit. The point of a cell is the
    median of its hits by range (the closer of two): it lies on the surface that fills most of the cell, not on the
    patch of road in front of that surface.

    Radar cross section, incidence, multipath, Doppler and side lobes are not simulated. Every surface that is hit gives
    a point, also the road, which reflects little to a real radar; rays pass neither through bumpers nor below cars.

    Args:
        name: Name in maps and messages.
        mount: Extrinsics `vehicle_T_radar`.
        horizontal_fov_deg: Azimuth range, centered at the x axis.
        vertical_fov_deg: Lowest and highest elevation.
        azimuth_cell_deg: Largest width of an azimuth cell.
        range_cell_m: Depth of a range cell.
        ray_spacing_m: Largest distance between neighboring rays at `max_range_m`.
        min_range_m, max_range_m, range_noise_m, dropout: See `RangeSensor`; noise and drop-out apply to points, not to
            rays.

    Example:
        >>> radar = Radar(
        ...     name="front", horizontal_fov_deg=90, vertical_fov_deg=(-10, 10), azimuth_cell_deg=4.5, range_cell_m=0.4,
        ...     max_range_m=70,
        ... )
        >>> radar.num_azimuth_cells, radar.compute_directions().shape
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
        for key, cell, limit_key, limit in (
            ("azimuth_cell_deg", self.azimuth_cell_deg, "horizontal_fov_deg", self.horizontal_fov_deg),
            ("range_cell_m", self.range_cell_m, "max_range_m", self.max_range_m),
        ):
            if cell > limit:
                raise ValueError(
                    f"{key}: a cell within the opening is needed, at most {limit_key} ({limit:g}) wide; got {cell:g}"
                )
        return self

    @property
    def num_azimuth_cells(self) -> int:
        """Number of azimuth cells."""
        return _count_cells(self.horizontal_fov_deg / self.azimuth_cell_deg)

    @property
    def num_rays(self) -> int:
        """Number of rays of all cells."""
        num_rows, columns_per_cell = self._compute_raster_size()
        return num_rows * self.num_azimuth_cells * columns_per_cell

    def _compute_raster_size(self) -> tuple[int, int]:
        """Compute the rows of rays, and the columns of rays per azimuth cell."""
        spacing_deg = math.degrees(self.ray_spacing_m / self.max_range_m)
        low_deg, high_deg = self.vertical_fov_deg
        cell_deg = self.horizontal_fov_deg / self.num_azimuth_cells
        return max(_count_cells((high_deg - low_deg) / spacing_deg), 1), max(_count_cells(cell_deg / spacing_deg), 1)

    def compute_directions(self) -> Float64:
        """Compute (3, rows, columns) unit directions in the radar frame."""
        num_rows, columns_per_cell = self._compute_raster_size()
        num_columns = self.num_azimuth_cells * columns_per_cell
        low_deg, high_deg = self.vertical_fov_deg
        row_shares = (np.arange(num_rows) + 0.5) / num_rows
        column_shares = (np.arange(num_columns) + 0.5) / num_columns
        return compute_unit_directions(
            low_deg + (high_deg - low_deg) * row_shares[:, None], self.horizontal_fov_deg * (column_shares - 0.5)[None]
        )

    def compute_beam_indices(self) -> Int64:
        """Compute (rows, columns) azimuth cell of each ray; rays of one azimuth cell share its range cells."""
        num_rows, columns_per_cell = self._compute_raster_size()
        return np.tile(np.arange(self.num_azimuth_cells).repeat(columns_per_cell), (num_rows, 1))

    def measure(self, hits: RayHits, noise: SensorNoise) -> Returns:
        """Measure a point in each cell that has a hit beyond the minimum range, unless it drops out.

        Args:
            hits: Hits of the rays.
            noise: Source of all random numbers.

        Returns:
            Hits that give a point, and their range errors.
        """
        _, columns_per_cell = self._compute_raster_size()
        beam = hits.pixel_indices // columns_per_cell % self.num_azimuth_cells
        if hits.position_indices is not None:
            beam = beam + self.num_azimuth_cells * hits.position_indices
        in_range = np.flatnonzero(hits.range_m >= self.min_range_m)
        # Sorted by beam, then by range, hits of one cell are consecutive; the sort is stable.
        in_range = in_range[np.lexsort((hits.range_m[in_range], beam[in_range]))]
        range_cell = np.floor(hits.range_m[in_range] / np.float64(self.range_cell_m)).astype(np.int64)
        is_first = (np.diff(range_cell, prepend=-1) != 0) | (np.diff(beam[in_range], prepend=-1) != 0)
        first = np.flatnonzero(is_first)
        last = np.append(first[1:], len(in_range)) - 1
        median = in_range[(first + last) // 2]
        return self.sample_returns(hits, np.sort(median), noise)


def _count_cells(ratio: float) -> int:
    """Round a ratio up to an integer; a ratio of 5 + 1e-10 counts as 5, since rounding must not add a cell."""
    return math.ceil(ratio - 1e-9)
