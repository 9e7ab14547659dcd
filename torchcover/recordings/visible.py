"""What of a cloud can be seen from beside the vehicle, and how many square metres each point stands for."""

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.recordings.seen_past import compiled_or

Float64 = NDArray[np.float64]

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


def seen_share(points_m: Float64, body: BoundingBox, voxel_m: float, seed: int) -> Float64:
    """(N,) share of places around the vehicle, which hides what is behind it, that see each of (N, 3) points.

    Where the points are near each other, it is by `voxel_m`. They are in the vehicle frame; the seed is of the places.
    """
    seen, corners_m = np.zeros(len(points_m)), np.array([body.lower_m, body.upper_m])
    reach_m = np.append(np.inf, FILLED * voxel_m / (BINS_RAD[1:] / 2))
    for place_m in _places_m(body, seed):
        hidden = np.zeros(len(points_m), np.bool_)
        compiled_or(hide_by_arrays)(points_m, place_m, corners_m, BINS_RAD, reach_m, hidden)
        seen += ~hidden
    return seen / PLACES


def square_metres(points_m: Float64) -> Float64:
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


def hide_by_arrays(
    points_m: Float64, place_m: Float64, body_m: Float64, bins_rad: Float64, reach_m: Float64, hidden: NDArray[np.bool_]
) -> None:
    """Mark the points that a body, or others at any size of bins, hide from a place, where numba is missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (body_m - place_m)[:, None] / (points_m - place_m)
    enters, leaves = np.fmin(one, other).max(axis=1), np.fmax(one, other).min(axis=1)
    hidden |= (enters < leaves) & (leaves > 0) & (enters < 1)
    x, y, z = (points_m - place_m).T
    flat_m = np.sqrt(x * x + y * y)
    range_m = np.sqrt(flat_m * flat_m + z * z)
    up, over = _angle_rad(z, flat_m) + np.pi / 2, _angle_rad(z + OVER_M, flat_m) + np.pi / 2
    across = _angle_rad(y, x) + np.pi
    for bin_rad, near_m in zip(bins_rad, reach_m, strict=True):
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
