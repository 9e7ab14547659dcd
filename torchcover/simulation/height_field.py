"""Ground that has a height everywhere: plain, or a raster, which the heights of places become."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.scenery import ground

Numbers = NDArray[np.float64]

CELL_M = 5.0
# Beyond what may be seen, so that nobody looks past its end.
MARGIN_M = 40.0
MAX_CORNERS = 4_000_000
VERGE_SHARE = 1e-3


class Ground(Protocol):
    """Has a height everywhere."""

    def heights_m(self, places_m: Numbers) -> Numbers:
        """(N,) at (N, 2) places."""

    def mesh(self) -> Mesh:
        """What rays hit of it."""


class Plain(NamedTuple):
    """Ground of one height between two corners, (2,) each."""

    height_m: float
    lower_m: Numbers
    upper_m: Numbers

    def heights_m(self, places_m: Numbers) -> Numbers:
        """(N,) at (N, 2) places."""
        return np.full(len(places_m), self.height_m)

    def mesh(self) -> Mesh:
        """Two triangles."""
        sheet = ground(self.lower_m, self.upper_m)
        return sheet._replace(vertices_m=sheet.vertices_m + np.array([0.0, 0.0, self.height_m]))


class Slopes(NamedTuple):
    """Ground with a height at each corner of a raster; two triangles are between four of them.

    Args:
        lower_m: (2,) the first corner.
        corners_m: (rows, columns) heights, rows along y.
        wanted: (rows - 1, columns - 1) which squares rays may hit.
        cell_m: Side of a square.
    """

    lower_m: Numbers
    corners_m: Numbers
    wanted: NDArray[np.bool_]
    cell_m: float = CELL_M

    def heights_m(self, places_m: Numbers) -> Numbers:
        """(N,) at (N, 2) places."""
        cells = (places_m - self.lower_m) / self.cell_m
        rows, columns = self.corners_m.shape
        column, row = np.clip(cells.astype(np.int64), 0, [columns - 2, rows - 2]).T
        x, y = np.clip(cells.T - [column, row], 0.0, 1.0)
        here, across = self.corners_m[row, column], self.corners_m[row + 1, column + 1]
        right, above = self.corners_m[row, column + 1], self.corners_m[row + 1, column]
        # The triangles share the diagonal from here to across.
        lower = here + x * (right - here) + y * (across - right)
        upper = here + y * (above - here) + x * (across - above)
        heights_m: Numbers = np.where(x >= y, lower, upper)
        return heights_m

    def mesh(self) -> Mesh:
        """The squares that are wanted, as one sheet."""
        columns = self.corners_m.shape[1]
        row, column = np.nonzero(self.wanted)
        here = row * columns + column
        right, above, across = here + 1, here + columns, here + columns + 1
        faces = np.concatenate([np.stack([here, right, across], axis=1), np.stack([here, across, above], axis=1)])
        used, faces = np.unique(faces, return_inverse=True)
        places_m = self.lower_m + self.cell_m * np.stack([used % columns, used // columns], axis=1)
        return Mesh(np.column_stack([places_m, self.corners_m.reshape(-1)[used]]), faces.reshape(-1, 3)).made_of("road")


def corners_of(lower_m: Numbers, upper_m: Numbers) -> tuple[int, int]:
    """Rows and columns of the corners of a raster between two of them.

    Raises:
        ValueError: More than four million.
    """
    columns, rows = (np.ceil((upper_m - lower_m) / CELL_M).astype(np.int64) + 1).tolist()
    if columns * rows > MAX_CORNERS:
        raise ValueError(
            f"the ground of {columns * CELL_M / 1000:.1f} x {rows * CELL_M / 1000:.1f} km around the ego's way has too "
            "many squares; shorten the duration"
        )
    return rows, columns


def middles_m(lower_m: Numbers, rows: int, columns: int) -> Numbers:
    """(squares, 2) the middles of the squares of a raster, row after row."""
    return lower_m + CELL_M * (np.indices((rows - 1, columns - 1))[::-1].reshape(2, -1).T + 0.5)


def spread(
    cells: Numbers, heights_m: Numbers, rows: int, columns: int, weights: Numbers | float = 1.0
) -> tuple[Numbers, Numbers]:
    """(rows, columns) sums of weighted heights, and of weights, of (N, 2) places for the corners around each.

    The next but one have a share, too, that counts for nothing where anything else does: the verges of a street.

    Args:
        cells: (N, 2) the places, counted in squares from the first corner.
        heights_m: (N,) their heights.
        rows: Of the raster's corners.
        columns: Likewise.
        weights: (N,) of each place, or of all.
    """
    low = np.floor(cells).astype(np.int64)
    inside = ((low >= 1) & (low < [columns - 2, rows - 2])).all(axis=1)
    counts = np.broadcast_to(weights, len(cells))[inside]
    low, (x, y), heights_m = low[inside], (cells[inside] - low[inside]).T, heights_m[inside]
    total, weight = np.zeros(rows * columns), np.zeros(rows * columns)
    for right in (-1, 0, 1, 2):
        for above in (-1, 0, 1, 2):
            across, along = np.abs(x - right), np.abs(y - above)
            share = np.clip(1 - across, 0, 1) * np.clip(1 - along, 0, 1)
            share += VERGE_SHARE * np.clip(2 - across, 0, 1) * np.clip(2 - along, 0, 1)
            share *= counts
            corner = (low[:, 1] + above) * columns + low[:, 0] + right
            total += np.bincount(corner, share * heights_m, rows * columns)
            weight += np.bincount(corner, share, rows * columns)
    return total.reshape(rows, columns), weight.reshape(rows, columns)
