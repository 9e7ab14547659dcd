"""What the rays of scans say of a place: one that sees something far beyond it has found it free.

Removert (Kim and Kim, 2020) compares range images, too; DUFOMap (Duberg et al., 2024) walks through voxels, and asks
that those around were crossed. Here a bin is free up to the nearest return in it and in the eight around it, so that a
ray that passes an edge, or over the road at a flat angle, refutes neither.
"""

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform
from torchcover.geometry.rigid import Matrix

Float64 = NDArray[np.float64]
# The sensor and the instant of a scan.
Key = tuple[str, int]
Kernel = Callable[..., None]

# Bins of a fine image: 0.2 degrees across, and 0.25 degrees up at the horizon, even in the sine of the elevation. Of a
# sensor with wider gaps they are so many times as large that most have one beneath and one beside them that is hit.
COLUMNS, ROWS = 1800, 480
COARSER, NEIGHBOURED = (1, 2, 4, 8), 0.8
# So much farther, and by such a share, lies what is seen past a place.
BEYOND_M, BEYOND = 0.4, 0.12


class RangeImage(NamedTuple):
    """How far a scan has seen: (rows, columns) float32 ranges up to which directions are free; 0 without return.

    Below are `first_row` rows that nothing hit; `sensor_T_local` is from the frame in which places are given.
    """

    free_m: NDArray[np.float32]
    first_row: int
    sensor_T_local: Matrix
    farthest_m: float

    @classmethod
    def of(cls, points_m: NDArray[np.floating], sensor_T_local: Matrix) -> "RangeImage":
        """Of the (N, 3) points that a scan has returned, in the frame of its sensor."""
        row, column, range_m = _bins(points_m.astype(np.float64), 1)
        if not len(row):
            return cls(np.zeros((0, COLUMNS), np.float32), 0, sensor_T_local, 0.0)
        for times in COARSER:
            low, rows, columns = row.min() // times, row.max() // times - row.min() // times + 1, COLUMNS // times
            nearest_m = np.full((rows + 2, columns + 2), np.inf)
            np.minimum.at(nearest_m, (row // times - low + 1, column // times + 1), range_m)
            hit = np.isfinite(nearest_m)
            if min((hit[:-1] & hit[1:]).sum(), (hit[:, :-1] & hit[:, 1:]).sum()) >= NEIGHBOURED * hit.sum():
                break
        nearest_m[:, 0], nearest_m[:, -1] = nearest_m[:, -2], nearest_m[:, 1]
        around_m = np.minimum(np.minimum(nearest_m[:-2], nearest_m[1:-1]), nearest_m[2:])
        around_m = np.minimum(np.minimum(around_m[:, :-2], around_m[:, 1:-1]), around_m[:, 2:])
        free_m = np.where(hit[1:-1, 1:-1], np.maximum((around_m - BEYOND_M) / (1 + BEYOND), 0.0), 0.0)
        return cls(free_m.astype(np.float32), int(low), sensor_T_local, float(free_m.max()))

    def vote(self, points_m: Float64, votes: NDArray[np.int16], vote: int = 1) -> None:
        """Add to the (N,) votes of the (N, 3) places that lie in free space."""
        compiled_or(vote_by_arrays)(points_m, *self, votes, vote)


class Votes:
    """How many scans see past each point of others; only scans that come or go are looked through again."""

    def __init__(self) -> None:
        self._counted: dict[Key, tuple[NDArray[np.int16], frozenset[Key]]] = {}
        self._images: dict[Key, RangeImage] = {}

    def of(self, scans: Mapping[Key, Float64], images: Mapping[Key, RangeImage]) -> dict[Key, NDArray[np.int16]]:
        """(N,) votes of the (N, 3) places of each scan."""
        known = {**self._images, **images}
        counted: dict[Key, tuple[NDArray[np.int16], frozenset[Key]]] = {}
        wanted = frozenset(images)
        for key, points_m in scans.items():
            votes, given = self._counted.get(key, (np.zeros(len(points_m), np.int16), frozenset[Key]()))
            if len(given ^ wanted) > len(wanted):
                votes, given = np.zeros(len(points_m), np.int16), frozenset[Key]()
            for other in given ^ wanted:
                known[other].vote(points_m, votes, 1 if other in wanted else -1)
            counted[key] = votes, wanted
        self._counted, self._images = counted, dict(images)
        return {key: votes for key, (votes, _) in counted.items()}


def _bins(points_m: Float64, times: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64]:
    """(N,) row, column and range of places in the frame of a sensor, of bins so many times as large."""
    x, y, z = points_m.T
    range_m = np.sqrt(x * x + y * y + z * z)
    row = ((1 + z / np.maximum(range_m, 1e-9)) * (ROWS / 2)).astype(np.int64)
    # An angle from 0 to 4 in quarters, by a parabola within 0.3 degrees: it only has to be the same for all.
    low, high = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.maximum(np.abs(x), np.abs(y)), 1e-9)
    eighth = low / high * (0.64 - 0.14 * (low / high))
    quarter = np.where(np.abs(y) > np.abs(x), 1 - eighth, eighth)
    half = np.where(x < 0, 2 - quarter, quarter)
    column = (np.where(y < 0, 4 - half, half) * (COLUMNS / 4)).astype(np.int64)
    return np.minimum(row, ROWS - 1) // times, column % COLUMNS // times, range_m


def vote_by_arrays(
    points_m: Float64,
    free_m: NDArray[np.float32],
    first_row: int,
    sensor_T_local: Matrix,
    farthest_m: float,
    votes: NDArray[np.int16],
    vote: int,
) -> None:
    """`RangeImage.vote` where numba is missing."""
    row, column, range_m = _bins(transform(sensor_T_local, points_m), COLUMNS // free_m.shape[1])
    inside = np.flatnonzero((range_m < farthest_m) & (row >= first_row) & (row < first_row + len(free_m)))
    votes[inside[range_m[inside] < free_m[row[inside] - first_row, column[inside]]]] += vote


@cache
def compiled_or(by_arrays: Kernel) -> Kernel:
    """The compiled loop that does what a function over arrays does; the function where numba is missing."""
    try:
        from torchcover.recordings import loops
    except ImportError:
        return by_arrays
    loop: Kernel = getattr(loops, by_arrays.__name__.replace("arrays", "loop"))
    return loop
