"""The ground: one sheet without seams through all streets, and how whoever stands on it is tilted."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.scenery import ground

Numbers = NDArray[np.float64]

CELL_M = 5.0
# Beyond what may be seen, so that nobody looks past its end.
MARGIN_M = 40.0
MAX_CORNERS = 4_000_000
VERGE_SHARE = 1e-3
# Rounds of smoothing between the streets, at each scale; the streets' own heights stay.
SMOOTHINGS = 4


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
        return Mesh(sheet.vertices_m + np.array([0.0, 0.0, self.height_m]), sheet.faces)


class Slopes(NamedTuple):
    """Ground with a height at each corner of a raster; two triangles are between four of them.

    Args:
        lower_m: (2,) the first corner.
        corners_m: (rows, columns) heights, rows along y.
        wanted: (rows - 1, columns - 1) which squares rays may hit.
    """

    lower_m: Numbers
    corners_m: Numbers
    wanted: NDArray[np.bool_]

    def heights_m(self, places_m: Numbers) -> Numbers:
        """(N,) at (N, 2) places."""
        cells = (places_m - self.lower_m) / CELL_M
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
        places_m = self.lower_m + CELL_M * np.stack([used % columns, used // columns], axis=1)
        return Mesh(np.column_stack([places_m, self.corners_m.reshape(-1)[used]]), faces.reshape(-1, 3))


def ground_of(vicinity: Vicinity) -> Plain | Slopes:
    """The ground around the ego's way: plain if all lanes are of one height, else through all that are no bridges.

    Raises:
        ValueError: The way is so long that the ground would have more than four million corners.
    """
    lower_m, upper_m = vicinity.lower_m - MARGIN_M, vicinity.upper_m + MARGIN_M
    places_m = vicinity.samples_m[~vicinity.on_deck]
    if np.ptp(vicinity.samples_m[:, 2]) == 0.0:
        return Plain(float(places_m[0, 2]), lower_m, upper_m)
    columns, rows = (np.ceil((upper_m - lower_m) / CELL_M).astype(np.int64) + 1).tolist()
    if columns * rows > MAX_CORNERS:
        raise ValueError(
            f"the ground of {columns * CELL_M / 1000:.1f} x {rows * CELL_M / 1000:.1f} km around the ego's way has too "
            "many squares; shorten the duration"
        )
    total, weight = _spread((places_m[:, :2] - lower_m) / CELL_M, places_m[:, 2], rows, columns)
    middles_m = lower_m + CELL_M * (np.indices((rows - 1, columns - 1))[::-1].reshape(2, -1).T + 0.5)
    wanted = vicinity.sees(middles_m).reshape(rows - 1, columns - 1)
    return Slopes(lower_m, _filled(total, weight), wanted)


def _spread(cells: Numbers, heights_m: Numbers, rows: int, columns: int) -> tuple[Numbers, Numbers]:
    """(rows, columns) sums of heights, and of weights, of (N, 2) places for the corners around each.

    The next but one have a share, too, that counts for nothing where anything else does: the verges of a street.
    """
    low = np.floor(cells).astype(np.int64)
    inside = ((low >= 1) & (low < [columns - 2, rows - 2])).all(axis=1)
    low, (x, y), heights_m = low[inside], (cells[inside] - low[inside]).T, heights_m[inside]
    total, weight = np.zeros(rows * columns), np.zeros(rows * columns)
    for right in (-1, 0, 1, 2):
        for above in (-1, 0, 1, 2):
            across, along = np.abs(x - right), np.abs(y - above)
            share = np.clip(1 - across, 0, 1) * np.clip(1 - along, 0, 1)
            share += VERGE_SHARE * np.clip(2 - across, 0, 1) * np.clip(2 - along, 0, 1)
            corner = (low[:, 1] + above) * columns + low[:, 0] + right
            total += np.bincount(corner, share * heights_m, rows * columns)
            weight += np.bincount(corner, share, rows * columns)
    return total.reshape(rows, columns), weight.reshape(rows, columns)


def _filled(total: Numbers, weight: Numbers) -> Numbers:
    """Means where there is a weight; elsewhere what a raster of half the size has, smoothed."""
    known = weight > 0
    means: Numbers = total / np.where(known, weight, 1.0)
    if known.all() or min(means.shape) < 2:
        return means if known.any() else np.zeros_like(means)
    padding = [(0, size % 2) for size in means.shape]
    halves = []
    for raster in (total, weight):
        even = np.pad(raster, padding)
        halves.append(even.reshape(even.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)))
    coarse = _filled(halves[0], halves[1])
    found = np.where(known, means, coarse.repeat(2, axis=0).repeat(2, axis=1)[: means.shape[0], : means.shape[1]])
    for _ in range(SMOOTHINGS):
        around = np.pad(found, 1, mode="edge")
        mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
        found = np.where(known, found, mean)
    return found


def tilts_deg(ground: Ground, places_m: Numbers, yaw_deg: Numbers, size_m: tuple[float, float]) -> Numbers:
    """(N, 2) pitch and roll of bodies of a length and width, with the middle at (N, 2) places, on the ground."""
    yaw = np.deg2rad(yaw_deg)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    rises = [
        ground.heights_m(places_m + half * way) - ground.heights_m(places_m - half * way)
        for way, half in ((forward, size_m[0] / 3), (left, size_m[1] / 2))
    ]
    # Up at the front is a negative pitch; up at the left lowers the right side.
    pitch, roll = np.arctan2(-rises[0], 2 * size_m[0] / 3), np.arctan2(rises[1], size_m[1])
    tilts: Numbers = np.rad2deg(np.stack([pitch, roll], axis=1))
    return tilts
