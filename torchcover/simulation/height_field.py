"""Ground with a height everywhere, for traffic that follows recorded or simulated trajectories."""

from typing import NamedTuple

import numpy as np

from torchcover.geometry import HeightField
from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.scenery import build_ground_plane

# Size of a grid cell.
CELL_M = 5.0
# Ground beyond the visible area, so that no ray passes its border.
MARGIN_M = 40.0


class FlatGround(NamedTuple):
    """Horizontal rectangle.

    Args:
        height_m: Height.
        lower_m: (2,) lower corner x, y.
        upper_m: (2,) upper corner.
    """

    height_m: float
    lower_m: Float64
    upper_m: Float64

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """Return the (N,) constant height at (N, 2) positions."""
        return np.full(len(positions_m), self.height_m)

    def build_mesh(self) -> Mesh:
        """Build two triangles."""
        plane = build_ground_plane(self.lower_m, self.upper_m)
        return plane._replace(vertices_m=plane.vertices_m + np.array([0.0, 0.0, self.height_m]))


class GroundHeightField(NamedTuple):
    """Grid of heights with two triangles per cell.

    Args:
        origin_m: (2,) position of the first corner.
        corner_heights_m: (rows, columns) heights of the corners, rows along y.
        cell_mask: (rows - 1, columns - 1) True for cells that are part of the mesh.
        cell_m: Size of a cell.
    """

    origin_m: Float64
    corner_heights_m: Float64
    cell_mask: Bools
    cell_m: float = CELL_M

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """Interpolate the (N,) heights at (N, 2) positions."""
        return HeightField(self.origin_m, self.corner_heights_m, self.cell_m).compute_heights_m(positions_m)

    def build_mesh(self) -> Mesh:
        """Build the mesh of the masked cells, of the material `road`."""
        columns = self.corner_heights_m.shape[1]
        row, column = np.nonzero(self.cell_mask)
        corner = row * columns + column
        right, above, opposite = corner + 1, corner + columns, corner + columns + 1
        lower_triangles = np.stack([corner, right, opposite], axis=1)
        upper_triangles = np.stack([corner, opposite, above], axis=1)
        used_corners, faces = np.unique(np.concatenate([lower_triangles, upper_triangles]), return_inverse=True)
        positions_m = self.origin_m + self.cell_m * np.stack([used_corners % columns, used_corners // columns], axis=1)
        vertices_m = np.column_stack([positions_m, self.corner_heights_m.reshape(-1)[used_corners]])
        return Mesh(vertices_m, faces.reshape(-1, 3)).assign_material("road")


Ground = FlatGround | GroundHeightField


def count_corners(lower_m: Float64, upper_m: Float64) -> tuple[int, int]:
    """Count the rows and columns of corners of a grid that covers a rectangle.

    Args:
        lower_m: (2,) lower corner of the rectangle.
        upper_m: (2,) upper corner.

    Raises:
        ValueError: More than four million corners.
    """
    max_corners = 4_000_000
    columns, rows = (np.ceil((upper_m - lower_m) / CELL_M).astype(np.int64) + 1).tolist()
    if columns * rows > max_corners:
        raise ValueError(
            f"the ground of {columns * CELL_M / 1000:.1f} x {rows * CELL_M / 1000:.1f} km around the path of the ego "
            "has too many squares; shorten the duration"
        )
    return rows, columns


def compute_cell_centers_m(origin_m: Float64, num_rows: int, num_columns: int) -> Float64:
    """Compute the centers of the cells of a grid.

    Args:
        origin_m: (2,) position of the first corner.
        num_rows: Number of rows of corners.
        num_columns: Number of columns of corners.

    Returns:
        (cells, 2) centers, row by row.
    """
    column_row = np.indices((num_rows - 1, num_columns - 1))[::-1].reshape(2, -1).T
    return origin_m + CELL_M * (column_row + 0.5)
