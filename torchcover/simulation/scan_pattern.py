"""Scan pattern: a table of rows, turned through its columns."""

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from torchcover.simulation.rays import unit_directions
from torchcover.simulation.sensor import Ranging

# A hundred times what there is on the market.
MAX_ROWS, MAX_COLUMNS = 100_000, 1_000_000

Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]


class ScanPattern(Ranging):
    """Where the rays of a LiDAR point, and which of their hits become points.

    The ray of row i in column j points to elevation `E[i]` and azimuth `A[j] + D[i]`, where the rows' elevations E are
    a table or evenly spaced over the field of view, both ends included; the columns' azimuths A are evenly spaced over
    the field of view, in the middle of `columns` equal sectors; and D are offsets of the rows.

    Args:
        channels: Number of rows, when they are evenly spaced.
        vertical_fov_deg: Lowest and highest elevation of evenly spaced rows.
        elevations_deg: Elevation of each row instead, in any order.
        azimuth_offsets_deg: Offset of each row; positive is left. None if not given.
        horizontal_fov_deg: Field of view about the x axis, 360 for a full turn.
        columns: Number of columns.
        min_range_m, max_range_m, range_noise_m, dropout: As in `Ranging`.
    """

    channels: Annotated[int, Field(gt=0, le=MAX_ROWS)] | None = None
    vertical_fov_deg: tuple[Elevation, Elevation] | None = None
    elevations_deg: tuple[Elevation, ...] | None = Field(default=None, min_length=1)
    azimuth_offsets_deg: tuple[float, ...] | None = None
    horizontal_fov_deg: Annotated[float, Field(gt=0.0, le=360.0)]
    columns: Annotated[int, Field(gt=0, le=MAX_COLUMNS)]

    @model_validator(mode="after")
    def _check_rows(self) -> Self:
        spaced = (self.channels is not None, self.vertical_fov_deg is not None)
        if self.elevations_deg is not None and any(spaced):
            raise ValueError("give the rows as elevations_deg, or as channels and vertical_fov_deg, not both")
        if self.elevations_deg is None and not all(spaced):
            raise ValueError("the rows are missing: give channels and vertical_fov_deg, or elevations_deg")
        if self.vertical_fov_deg is not None and self.vertical_fov_deg[0] > self.vertical_fov_deg[1]:
            raise ValueError(f"vertical_fov_deg: the lower elevation comes first; got {self.vertical_fov_deg}")
        rows, offsets = len(self.rows_deg()), self.azimuth_offsets_deg
        if offsets is not None and len(offsets) != rows:
            raise ValueError(f"azimuth_offsets_deg: one for each of the {rows} rows is needed; got {len(offsets)}")
        return self

    @property
    def rays(self) -> int:
        """How many rays there are: rows times columns."""
        return (self.channels or len(self.elevations_deg or ())) * self.columns

    def rows_deg(self) -> NDArray[np.float64]:
        """(rows,) elevation of each row."""
        if self.elevations_deg is not None:
            return np.array(self.elevations_deg)
        assert self.channels is not None  # checked in _check_rows
        assert self.vertical_fov_deg is not None
        return np.linspace(*self.vertical_fov_deg, self.channels)

    def directions(self) -> NDArray[np.float64]:
        """(3, rows, columns) unit directions in the LiDAR's frame."""
        middle = (np.arange(self.columns) + 0.5) / self.columns - 0.5
        offsets = np.zeros(len(self.rows_deg())) if self.azimuth_offsets_deg is None else self.azimuth_offsets_deg
        azimuths_deg = np.add.outer(offsets, self.horizontal_fov_deg * middle)
        return unit_directions(self.rows_deg()[:, None], azimuths_deg)
