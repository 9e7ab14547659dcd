"""The ground of a recording: what sweeps have seen of it as a height field, and where nobody knows.

*Low surfaces.* In each upright column, `CELL_M` wide, the lowest point that another confirms within `THICK_M` begins
the low surface; a lone one counts where there is no other. Its place is the mean of all points within `THICK_M` above
that, so that noise cancels. Where something goes on above it (`STANDS_M`), it may be the lower end of a thing whose
foot nobody sees, as of a lorry far away: such a column says nothing about the ground, nor does at first one beside it.

*Height field.* In every square of `NODE_M` the column that a fifth lie below stands for all: below roofs, and above a
few reflections. Through these goes a height field, from coarse to fine (`geometry.fitted`): what lies too high counts a
ninth of what lies too low, and what lies farther off than 15 % of a scale counts for nothing.

*What is connected.* Only such squares count as one gets to from beside the vehicle: from each to all others within
`REACH`, unless they are higher or lower by more than a kerb and a steep slope, or by a metre. A bridge above the own
road is higher, a road below the own bridge lower. Those whose column lies on the field are connected and fitted once
more; then, with squares of 1.25 m, all columns there: kerbs stay.

*What is unknown.* Farther than `REACH` from all such squares there is no height, and no band. Of surfaces above each
other it is the one that is connected with the vehicle's; stairs lead nowhere.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import HeightField, fit_height_field

Bools = NDArray[np.bool_]
Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

CELL_M = 0.5
THICK_M = 0.15
STANDS_M = (0.3, 1.2)
NODE_M = 2.0
FIFTH = 0.2
COARSE_M, FINE_M = (80.0, 40.0, 20.0, 10.0, 5.0, 2.5), (1.25,)
BENEATH = 0.1
# So near to the field lies what is part of it: a kerb beside the road, and what the field smooths. Where less than this
# share of what is connected lies on it, as in the crowns of trees, it is no ground.
ON_FIELD_M, SMOOTH = 0.2, 0.4
# Squares from the one to the other in any direction, as far as one may look for ground, and know it.
REACH = 5
# A kerb, the steepest slope, and the most that the ground rises between two squares.
KERB_M, STEEPEST, RISE_M = 0.1, 0.25, 1.0
# The vehicle stands on most of the squares that are hardly farther away than the nearest; no ground is so high above
# the origin of its frame. Of fewer squares there is no ground.
START_M, HIGHEST_M, FEWEST = 8.0, 3.0, 25
# Nothing is asked about what lies farther away, or so much higher or lower.
AROUND_M = 200.0
SIDE = int(2 * AROUND_M / NODE_M) + 2 * REACH + 1


class GroundModel(NamedTuple):
    """The ground around a place, made as this module says: a `height_field` of heights from `corner_m` (2,) on.

    In the frame of the points that it was made of. In the `observed` (SIDE^2,) squares, row after row along y, there is a
    height; they begin `REACH` before that.
    """

    corner_m: Float64
    height_field: HeightField
    observed: Bools

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Float64], vehicle_position_m: Float64) -> "GroundModel | None":
        """The ground that sweeps have seen around a place.

        `surfaces`: `low_surfaces` of each sweep; `vehicle_position_m`: (3,) where the vehicle is. Returns it; None where none of
        it is near the vehicle.
        """
        low, above_m = _columns(np.concatenate([np.empty((0, 4)), *surfaces]), vehicle_position_m)
        if not len(low):
            return None
        lower_m = vehicle_position_m[:2] - AROUND_M
        stands = above_m - low[:, 2] < STANDS_M[1]
        clear = np.flatnonzero(~_beside_what_stands(low, stands, lower_m)[~stands])
        across_m, heights_m = low[~stands, :2] - lower_m, low[~stands, 2]
        square = _squares(across_m)
        # The rasters begin where others do, and reach no farther than points.
        first_m = COARSE_M[0] * np.floor((low[:, :2].min(axis=0) - lower_m) / COARSE_M[0])
        across_m -= first_m
        size_m = low[:, :2].max(axis=0) - lower_m - first_m
        chosen = clear[_a_fifth_below(square[clear], heights_m[clear])]
        for _ in range(2):
            found = _connected(square[chosen], heights_m[chosen] - vehicle_position_m[2])
            chosen = chosen[found[square[chosen]]]
            if len(chosen) < FEWEST:
                return None
            field = fit_height_field(across_m[chosen], heights_m[chosen], size_m, COARSE_M, above_weight=BENEATH)
            on_field = np.abs(heights_m[chosen] - field.compute_heights_m(across_m[chosen])) < ON_FIELD_M
            if on_field.mean() < SMOOTH:
                return None
            chosen = chosen[on_field]
        own = found[square]
        field = fit_height_field(across_m[own], heights_m[own], size_m, FINE_M, base_field=field)
        known = np.zeros(SIDE**2, dtype=np.bool_)
        known[square[chosen][:, None] + _around()[0]] = True
        return cls(lower_m, field._replace(origin_m=field.origin_m + first_m), known)

    def compute_heights_m(self, points_m: NDArray[np.floating]) -> Float64:
        """(N,) how high above the ground (N, 3) points are, below it less than 0; NaN where that is unknown."""
        across_m = points_m[:, :2] - self.corner_m
        heights_m = np.full(len(points_m), np.nan)
        inside = np.flatnonzero(((across_m >= 0) & (across_m < 2 * AROUND_M)).all(axis=1))
        inside = inside[self.observed[_squares(across_m[inside])]]
        heights_m[inside] = points_m[inside, 2] - self.height_field.compute_heights_m(across_m[inside])
        return heights_m


def extract_low_surfaces(points_m: Float64, vehicle_position_m: Float64) -> Float64:
    """What a sweep says about the ground: much less than all of its points, (N, 3) of nothing that moves.

    The vehicle was at `vehicle_position_m` (3,) in the same frame, whose z points up. Returns (K, 4) places of the low surfaces of
    columns with the number of their points, and the lowest of what stands or hangs above each, as one point.
    """
    low, above_m = _columns(np.column_stack([points_m, np.ones(len(points_m))]), vehicle_position_m)
    below = np.isfinite(above_m)
    above = np.column_stack([low[below, :2], above_m[below], np.ones(np.count_nonzero(below))])
    return np.concatenate([low, above])


def _columns(points: Float64, place_m: Float64) -> tuple[Float64, Float64]:
    """(K, 4) low surfaces of the columns of (N, 4) places with counts; (K,) what is lowest above each, or infinite."""
    points = points[(np.abs(points[:, :3] - place_m) < AROUND_M).all(axis=1)]
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64) - np.floor((place_m[:2] - AROUND_M) / CELL_M).astype(int)
    key = (cells[:, 1] << 10) + cells[:, 0]
    above_um = (1e6 * (points[:, 2] - place_m[2] + AROUND_M)).astype(np.int64)
    order = np.argsort((key << 29) + above_um, kind="stable")
    key, points = key[order], points[order]
    if not len(key):
        return points, np.empty(0)
    same = np.diff(key) == 0
    first = np.append(0, np.flatnonzero(~same) + 1)
    column = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(key))))
    z, count = points[:, 2:].T
    confirmed = count > 1
    confirmed[:-1] |= same & (np.diff(z) <= THICK_M)
    bottom = np.minimum.reduceat(np.where(confirmed, np.arange(len(z)), len(z)), first)
    over_m = z - z[np.where(bottom < len(z), bottom, first)][column]
    weights = count * ((over_m >= 0) & (over_m <= THICK_M))
    sums = [np.bincount(column, weights * values) for values in (*points[:, :3].T, 1.0)]
    low = np.stack([*(total / sums[3] for total in sums[:3]), sums[3]], axis=1)
    return low, np.minimum.reduceat(np.where(z > low[column, 2] + STANDS_M[0], z, np.inf), first)


def _beside_what_stands(low: Float64, stands: Bools, lower_m: Float64) -> Bools:
    """(K,) whether something stands in a column, or in one beside it that begins no higher."""
    x, y = (np.floor(low[:, :2] / CELL_M) - np.floor(lower_m / CELL_M)).astype(np.int64).T + 1
    bottom_m = np.full(np.full(2, int(2 * AROUND_M / CELL_M) + 3), np.inf)
    bottom_m[y[stands], x[stands]] = low[stands, 2]
    around_m = np.min([bottom_m[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=0)
    return np.asarray(low[:, 2] > around_m - THICK_M)


def _squares(across_m: Float64) -> Numbers:
    """(N,) numbers of the squares of (N, 2) places from the first corner."""
    x, y = (across_m / NODE_M).astype(np.int64).T + REACH
    return np.asarray(y * SIDE + x)


def _a_fifth_below(square: Numbers, heights_m: Float64) -> Numbers:
    """(K,) numbers of the places that stand for their squares."""
    order = np.lexsort((heights_m, square))
    first = np.flatnonzero(np.diff(square[order], prepend=-1))
    count = np.diff(np.append(first, len(order)))
    return np.asarray(order[first + (FIFTH * count).astype(np.int64)])


def _around() -> tuple[Numbers, Float64]:
    """Steps from one square to all that are near, and how far each is."""
    y, x = np.indices((2 * REACH + 1, 2 * REACH + 1)).reshape(2, -1) - REACH
    near = np.hypot(x, y) <= REACH
    return (y * SIDE + x)[near], NODE_M * np.hypot(x, y)[near]


def _connected(square: Numbers, heights_m: Float64) -> Bools:
    """(SIDE^2,) squares that one gets to from the middle, of those with heights above the vehicle's origin."""
    height_m, found = np.full(SIDE**2, np.nan), np.zeros(SIDE**2, dtype=np.bool_)
    height_m[square] = heights_m
    away_m = NODE_M * np.hypot(*(np.array(np.divmod(square, SIDE)) - SIDE // 2))
    near = (away_m <= away_m.min(initial=2 * START_M) + START_M) & (heights_m < HIGHEST_M)
    front = square[near][np.abs(heights_m[near] - np.median(heights_m[near])) < RISE_M] if near.any() else square[:0]
    step, step_m = _around()
    rise_m = np.minimum(KERB_M + STEEPEST * step_m, RISE_M)
    while len(front):
        found[front] = True
        others = front[:, None] + step
        # A square without a height is NaN, which is near to nothing.
        reached = others[(np.abs(height_m[others] - height_m[front, None]) <= rise_m) & ~found[others]]
        front = np.unique(reached)
    return found
