"""Ground that has a height everywhere: plain, or a raster, which the heights of places become."""

from typing import NamedTuple

import numpy as np

from torchcover.geometry import HeightField
from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.scenery import build_ground_plane

CELL_M = 5.0
# Beyond what may be seen, so that nobody looks past its end.
MARGIN_M = 40.0
MAX_CORNERS = 4_000_000


class FlatGround(NamedTuple):
    """Ground of one height between two corners, (2,) each."""

    height_m: float
    lower_m: Float64
    upper_m: Float64

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """(N,) at (N, 2) places."""
        return np.full(len(positions_m), self.height_m)

    def build_mesh(self) -> Mesh:
        """Two triangles."""
        sheet = build_ground_plane(self.lower_m, self.upper_m)
        return sheet._replace(vertices_m=sheet.vertices_m + np.array([0.0, 0.0, self.height_m]))


class GroundHeightField(NamedTuple):
    """Ground with a height at each corner of a raster; two triangles are between four of them.

    `origin_m` (2,) is the first corner; `corner_heights_m` (rows, columns) are heights, rows along y; `cell_mask` (rows - 1,
    columns - 1) which squares rays may hit, of sides `cell_m`.
    """

    origin_m: Float64
    corner_heights_m: Float64
    cell_mask: Bools
    cell_m: float = CELL_M

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """(N,) at (N, 2) places."""
        return HeightField(self.origin_m, self.corner_heights_m, self.cell_m).compute_heights_m(positions_m)

    def build_mesh(self) -> Mesh:
        """The squares that are wanted, as one sheet."""
        columns = self.corner_heights_m.shape[1]
        row, column = np.nonzero(self.cell_mask)
        here = row * columns + column
        right, above, across = here + 1, here + columns, here + columns + 1
        faces = np.concatenate([np.stack([here, right, across], axis=1), np.stack([here, across, above], axis=1)])
        used, faces = np.unique(faces, return_inverse=True)
        places_m = self.origin_m + self.cell_m * np.stack([used % columns, used // columns], axis=1)
        return Mesh(
            np.column_stack([places_m, self.corner_heights_m.reshape(-1)[used]]), faces.reshape(-1, 3)
        ).assign_material("road")


# What has a height everywhere.
Ground = FlatGround | GroundHeightField


def count_corners(lower_m: Float64, upper_m: Float64) -> tuple[int, int]:
    """Rows and columns of the corners of a raster between two of them. ValueError: more than four million."""
    columns, rows = (np.ceil((upper_m - lower_m) / CELL_M).astype(np.int64) + 1).tolist()
    if columns * rows > MAX_CORNERS:
        raise ValueError(
            f"the ground of {columns * CELL_M / 1000:.1f} x {rows * CELL_M / 1000:.1f} km around the ego's way has too "
            "many squares; shorten the duration"
        )
    return rows, columns


def compute_cell_centers_m(origin_m: Float64, num_rows: int, num_columns: int) -> Float64:
    """(squares, 2) the middles of the squares of a raster, row after row."""
    return origin_m + CELL_M * (np.indices((num_rows - 1, num_columns - 1))[::-1].reshape(2, -1).T + 0.5)
