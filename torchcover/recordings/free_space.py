"""Free space that scans have observed, and the points of a cloud that can be seen from beside the vehicle."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, transform_points
from torchcover.geometry.rigid import Matrix

Float64 = NDArray[np.float64]
# The sensor and the instant of a scan.
ScanKey = tuple[str, int]
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

    free_range_m: NDArray[np.float32]
    first_row: int
    sensor_T_local: Matrix
    max_free_range_m: float

    @classmethod
    def from_points(cls, points_m: NDArray[np.floating], sensor_T_local: Matrix) -> "RangeImage":
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

    def add_votes(self, points_m: Float64, votes: NDArray[np.int16], increment: int = 1) -> None:
        """Add to the (N,) votes of the (N, 3) places that lie in free space."""
        get_fastest_kernel(count_votes_by_arrays)(points_m, *self, votes, increment)


class FreeSpaceCounter:
    """How many scans see past each point of others; only scans that come or go are looked through again."""

    def __init__(self) -> None:
        self._counted: dict[ScanKey, tuple[NDArray[np.int16], frozenset[ScanKey]]] = {}
        self._images: dict[ScanKey, RangeImage] = {}

    def update(
        self, scans: Mapping[ScanKey, Float64], images: Mapping[ScanKey, RangeImage]
    ) -> dict[ScanKey, NDArray[np.int16]]:
        """(N,) votes of the (N, 3) places of each scan."""
        known = {**self._images, **images}
        counted: dict[ScanKey, tuple[NDArray[np.int16], frozenset[ScanKey]]] = {}
        wanted = frozenset(images)
        for key, points_m in scans.items():
            votes, given = self._counted.get(key, (np.zeros(len(points_m), np.int16), frozenset[ScanKey]()))
            if len(given ^ wanted) > len(wanted):
                votes, given = np.zeros(len(points_m), np.int16), frozenset[ScanKey]()
            for other in given ^ wanted:
                known[other].add_votes(points_m, votes, 1 if other in wanted else -1)
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


def count_votes_by_arrays(
    points_m: Float64,
    free_range_m: NDArray[np.float32],
    first_row: int,
    sensor_T_local: Matrix,
    max_free_range_m: float,
    votes: NDArray[np.int16],
    increment: int,
) -> None:
    """`RangeImage.vote` where numba is missing."""
    row, column, range_m = _bins(transform_points(sensor_T_local, points_m), COLUMNS // free_range_m.shape[1])
    inside = np.flatnonzero((range_m < max_free_range_m) & (row >= first_row) & (row < first_row + len(free_range_m)))
    votes[inside[range_m[inside] < free_range_m[row[inside] - first_row, column[inside]]]] += increment


@cache
def get_fastest_kernel(array_kernel: Kernel) -> Kernel:
    """The compiled loop that does what a function over arrays does; the function where numba is missing."""
    try:
        from torchcover.recordings import loops
    except ImportError:
        return array_kernel
    loop: Kernel = getattr(loops, array_kernel.__name__.replace("arrays", "loop"))
    return loop


# Places in the shell around the vehicle, as those of the reference sensors of simulations, but evenly spread: so few by
# chance would differ too much. Steps of Roberts' sequence in three dimensions.
PLACES, SHELL_M = 8, 0.5
ROBERTS = 1.2207440846057596 ** -np.arange(1.0, 4.0)
# Bins of the images in which near points hide far ones. Large ones close the gaps between near points only: a voxel
# fills a bin as far as it looks 1.2 times as wide as half of it.
BINS_RAD, FILLED = np.deg2rad([0.2, 0.4, 0.8, 1.6]), 1.2
# So much farther, and by such a share, lies what is hidden.
BEHIND_M, BEHIND = 0.4, 0.12
# What is so far above a point has to be hidden, too: ground that is rough, or noise of it, hides none.
OVER_M = 0.15
# An arctangent within 0.00002: Abramowitz and Stegun (1964), 4.4.49. Three of them would be most of the time.
A1, A3, A5, A7, A9, TINY = 0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351, 1e-30
# A point stands for the circle that holds so many others, but for no larger one.
NEIGHBOURS, WIDEST_M = 8, 3.0


def estimate_visible_share(points_m: Float64, ego_box: BoundingBox, voxel_m: float, seed: int) -> Float64:
    """(N,) share of places around the vehicle, which hides what is behind it, that see each of (N, 3) points.

    Where the points are near each other, it is by `voxel_m`. They are in the vehicle frame; the seed is of the places.
    """
    seen, corners_m = np.zeros(len(points_m)), np.array([ego_box.lower_m, ego_box.upper_m])
    reach_m = np.append(np.inf, FILLED * voxel_m / (BINS_RAD[1:] / 2))
    for place_m in _places_m(ego_box, seed):
        hidden = np.zeros(len(points_m), np.bool_)
        get_fastest_kernel(mark_hidden_by_arrays)(points_m, place_m, corners_m, BINS_RAD, reach_m, hidden)
        seen += ~hidden
    return seen / PLACES


def estimate_surface_areas_m2(points_m: Float64) -> Float64:
    """(N,) how much surface each of (N, 3) points stands for: the circle up to its eighth neighbour, shared by eight.

    Example:
        >>> lattice_m = np.stack([*np.indices((9, 9)).reshape(2, -1), np.zeros(81)], axis=1)
        >>> round(float(square_metres(lattice_m)[40]), 2)
        0.79
    """
    from pykdtree.kdtree import KDTree

    if len(points_m) <= NEIGHBOURS:
        return np.full(len(points_m), np.pi * WIDEST_M**2 / NEIGHBOURS)
    apart_m, _ = KDTree(points_m).query(points_m, k=NEIGHBOURS + 1)
    return np.asarray(np.pi * np.minimum(apart_m[:, -1], WIDEST_M) ** 2 / NEIGHBOURS)


def _places_m(body: BoundingBox, seed: int) -> Float64:
    """(PLACES, 3) between a box and that box grown sideways and upwards."""
    lower_m, upper_m = np.array(body.lower_m), np.array(body.upper_m)
    share = (np.random.default_rng(seed).random(3) + np.arange(100 * PLACES)[:, None] * ROBERTS) % 1
    places_m = lower_m - [SHELL_M, SHELL_M, 0.0] + share * (upper_m - lower_m + [2 * SHELL_M, 2 * SHELL_M, SHELL_M])
    outside = np.flatnonzero(((places_m < lower_m) | (places_m > upper_m)).any(axis=1))
    return np.asarray(places_m[outside[:PLACES]])


def mark_hidden_by_arrays(
    points_m: Float64,
    viewpoint_m: Float64,
    box_corners_m: Float64,
    bin_sizes_rad: Float64,
    max_occluder_ranges_m: Float64,
    hidden: NDArray[np.bool_],
) -> None:
    """Mark the points that a body, or others at any size of bins, hide from a place, where numba is missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (box_corners_m - viewpoint_m)[:, None] / (points_m - viewpoint_m)
    enters, leaves = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
    hidden |= (enters < leaves) & (leaves > 0) & (enters < 1)
    x, y, z = (points_m - viewpoint_m).T
    flat_m = np.sqrt(x * x + y * y)
    range_m = np.sqrt(flat_m * flat_m + z * z)
    up, over = _angle_rad(z, flat_m) + np.pi / 2, _angle_rad(z + OVER_M, flat_m) + np.pi / 2
    across = _angle_rad(y, x) + np.pi
    for bin_rad, near_m in zip(bin_sizes_rad, max_occluder_ranges_m, strict=True):
        columns = int(2 * np.pi / bin_rad) + 1
        column = (across / bin_rad).astype(np.int64)
        number, above = ((angle / bin_rad).astype(np.int64) * columns + column for angle in (up, over))
        nearest_m = np.full((int(np.pi / bin_rad) + 1) * columns, np.inf)
        near = range_m < near_m
        np.minimum.at(nearest_m, number[near], range_m[near])
        hidden |= nearest_m[above] * (1 + BEHIND) + BEHIND_M < range_m


def _angle_rad(y: Float64, x: Float64) -> Float64:
    """(N,) angles of directions."""
    low, high = np.minimum(np.abs(x), np.abs(y)), np.maximum(np.maximum(np.abs(x), np.abs(y)), TINY)
    share = low / high
    square = share * share
    angle = share * (A1 + square * (A3 + square * (A5 + square * (A7 + square * A9))))
    angle = np.where(np.abs(y) > np.abs(x), np.pi / 2 - angle, angle)
    angle = np.where(x < 0, np.pi - angle, angle)
    return np.where(y < 0, -angle, angle)
