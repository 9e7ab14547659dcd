"""Ground of a recording: a height field through the low surfaces of sweeps, and where the ground is unknown.

*Low surfaces.* In each vertical column of `column_m` the lowest point that another one confirms within `thickness_m`
begins the low surface; an unconfirmed point counts if there is no other. Its position is the mean of all points within
`thickness_m` above, so that noise cancels. If something continues above it, it may be the lower end of an object whose
base is not observed, for example a distant truck: such a column says nothing about the ground, and its neighbors are
not used at first either.

*Height field.* In every square of `square_m` the column at the 20 % quantile represents all: below roofs, and above a
few reflections. A height field is fitted to these from coarse to fine (`geometry.fit_height_field`): points above it
have a ninth of the weight of points below it, and points farther off than 15 % of a scale have none.

*Connected squares.* Only squares that can be reached from the vehicle count: from each square to all others within
`reach_squares` unless they are higher or lower by more than a curb and a steep slope, or by a meter. A bridge above the
road of the vehicle is higher, a road below the bridge of the vehicle is lower. The squares whose column lies on the
field are connected and fitted a second time; then all columns there are fitted with squares of 1.25 m, so that curbs
stay.

*Unknown ground.* Farther than `reach_squares` from all connected squares there is no height, and no height band. Of
several surfaces above each other the one that is connected with that of the vehicle counts; stairs do not connect.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import HeightField, fit_height_field
from torchcover.geometry.arrays import Bools, Float64, Int64


@dataclass(frozen=True)
class GroundModelParams:
    """Parameters of the ground model.

    Args:
        column_m: Side of a vertical column.
        thickness_m: Thickness of a surface, mostly range noise.
        min_object_height_m: Points this high above a low surface belong to an object above it,
        max_object_height_m: which stands on the surface, or hides its base, if it begins lower than this.
        square_m: Side of a square of the ground.
        quantile: Quantile of the columns of a square that represents them.
        coarse_cells_m: Cells of the first height field; each is half of the one before.
        fine_cells_m: Cells that refine it.
        above_weight: Weight of a point above the field; one below has 1 minus this.
        max_residual_m: Columns this near to the field are part of it: a curb beside the road, and what the field
            smooths.
        min_fitted_share: There is no ground if fewer of the connected squares lie on the field, as in tree crowns.
        reach_squares: Squares are connected within this radius, and the ground is known within it.
        curb_m: Step between two connected squares, plus
        max_slope: this slope times their distance,
        max_step_m: but at most this.
        start_radius_m: The vehicle stands on most of the squares within this distance beyond the nearest one.
        max_start_height_m: Ground near the vehicle is at most this high above its origin.
        min_squares: There is no ground if fewer squares are connected.
        range_m: Points farther from the vehicle, along any axis, are ignored.
    """

    column_m: float = 0.5
    thickness_m: float = 0.15
    min_object_height_m: float = 0.3
    max_object_height_m: float = 1.2
    square_m: float = 2.0
    quantile: float = 0.2
    coarse_cells_m: tuple[float, ...] = (80.0, 40.0, 20.0, 10.0, 5.0, 2.5)
    fine_cells_m: tuple[float, ...] = (1.25,)
    above_weight: float = 0.1
    max_residual_m: float = 0.2
    min_fitted_share: float = 0.4
    reach_squares: int = 5
    curb_m: float = 0.1
    max_slope: float = 0.25
    max_step_m: float = 1.0
    start_radius_m: float = 8.0
    max_start_height_m: float = 3.0
    min_squares: int = 25
    range_m: float = 200.0

    @property
    def squares_per_side(self) -> int:
        """Squares along each side of the area, with a border of `reach_squares`."""
        return int(2 * self.range_m / self.square_m) + 2 * self.reach_squares + 1


PARAMS = GroundModelParams()


class GroundModel(NamedTuple):
    """Ground around a vehicle, in the frame of the points that it was made of.

    Args:
        corner_m: (2,) corner of the area with the smallest x and y.
        height_field: Heights from that corner on.
        observed: (S * S,) squares with a known height, rows along y; they begin `reach_squares` before the corner.
    """

    corner_m: Float64
    height_field: HeightField
    observed: Bools

    @classmethod
    def from_surfaces(cls, surfaces: Sequence[Float64], vehicle_position_m: Float64) -> "GroundModel | None":
        """Fit the ground that sweeps observed around a vehicle.

        Args:
            surfaces: (K, 4) result of `extract_low_surfaces` for each sweep.
            vehicle_position_m: (3,) position of the vehicle.

        Returns:
            The model; None if there is no ground near the vehicle.
        """
        low, object_bottom_m = _group_columns(np.concatenate([np.empty((0, 4)), *surfaces]), vehicle_position_m)
        if not len(low):
            return None
        corner_m = vehicle_position_m[:2] - PARAMS.range_m
        has_object = object_bottom_m - low[:, 2] < PARAMS.max_object_height_m
        is_clear = ~_mark_near_objects(low, has_object, corner_m)
        clear = np.flatnonzero(is_clear[~has_object])
        horizontal_m, heights_m = low[~has_object, :2] - corner_m, low[~has_object, 2]
        square = _number_squares(horizontal_m)
        # Cells begin at multiples of the coarsest one, so that results do not depend on where points begin.
        coarsest_m = PARAMS.coarse_cells_m[0]
        first_m = coarsest_m * np.floor((low[:, :2].min(axis=0) - corner_m) / coarsest_m)
        horizontal_m -= first_m
        extent_m = low[:, :2].max(axis=0) - corner_m - first_m
        chosen = clear[_choose_representatives(square[clear], heights_m[clear])]
        for _ in range(2):
            connected = _connect_squares(square[chosen], heights_m[chosen] - vehicle_position_m[2])
            chosen = chosen[connected[square[chosen]]]
            if len(chosen) < PARAMS.min_squares:
                return None
            cells_m, above_weight = PARAMS.coarse_cells_m, PARAMS.above_weight
            field = fit_height_field(
                horizontal_m[chosen], heights_m[chosen], extent_m, cells_m, above_weight=above_weight
            )
            residual_m = heights_m[chosen] - field.compute_heights_m(horizontal_m[chosen])
            on_field = np.abs(residual_m) < PARAMS.max_residual_m
            if on_field.mean() < PARAMS.min_fitted_share:
                return None
            chosen = chosen[on_field]
        inside = connected[square]
        field = fit_height_field(
            horizontal_m[inside], heights_m[inside], extent_m, PARAMS.fine_cells_m, base_field=field
        )
        observed = np.zeros(PARAMS.squares_per_side**2, dtype=np.bool_)
        observed[square[chosen][:, None] + _list_neighbors()[0]] = True
        return cls(corner_m, field._replace(origin_m=field.origin_m + first_m), observed)

    def compute_heights_m(self, points_m: NDArray[np.floating]) -> Float64:
        """Compute the height of points above the ground.

        Args:
            points_m: (N, 3) points in the frame of the model.

        Returns:
            (N,) heights in meters, negative below the ground; NaN where the ground is unknown.
        """
        horizontal_m = points_m[:, :2] - self.corner_m
        heights_m = np.full(len(points_m), np.nan)
        inside = np.flatnonzero(((horizontal_m >= 0) & (horizontal_m < 2 * PARAMS.range_m)).all(axis=1))
        inside = inside[self.observed[_number_squares(horizontal_m[inside])]]
        heights_m[inside] = points_m[inside, 2] - self.height_field.compute_heights_m(horizontal_m[inside])
        return heights_m


def extract_low_surfaces(points_m: Float64, vehicle_position_m: Float64) -> Float64:
    """Extract what a sweep says about the ground, much less than all of its points.

    Args:
        points_m: (N, 3) points of static surfaces; z points up.
        vehicle_position_m: (3,) position of the vehicle in the same frame.

    Returns:
        (K, 4) positions of the low surfaces of columns with their numbers of points, then the lowest point of what is
        above each, as one point.
    """
    weighted_points = np.column_stack([points_m, np.ones(len(points_m))])
    low, object_bottom_m = _group_columns(weighted_points, vehicle_position_m)
    has_object = np.isfinite(object_bottom_m)
    count = np.ones(np.count_nonzero(has_object))
    return np.concatenate([low, np.column_stack([low[has_object, :2], object_bottom_m[has_object], count])])


def _group_columns(points: Float64, vehicle_position_m: Float64) -> tuple[Float64, Float64]:
    """Group (N, 4) points with counts by column.

    Returns:
        (K, 4) low surfaces, and (K,) height at which an object above each begins, inf without one.
    """
    points = points[(np.abs(points[:, :3] - vehicle_position_m) < PARAMS.range_m).all(axis=1)]
    first_cell = np.floor((vehicle_position_m[:2] - PARAMS.range_m) / PARAMS.column_m).astype(int)
    cells = np.floor(points[:, :2] / PARAMS.column_m).astype(np.int64) - first_cell
    key = (cells[:, 1] << 10) + cells[:, 0]  # 10 bits hold the columns of 400 m, 29 bits its micrometers
    height_um = (1e6 * (points[:, 2] - vehicle_position_m[2] + PARAMS.range_m)).astype(np.int64)
    order = np.argsort((key << 29) + height_um, kind="stable")
    key, points = key[order], points[order]
    if not len(key):
        return points, np.empty(0)
    is_same_column = np.diff(key) == 0
    first = np.append(0, np.flatnonzero(~is_same_column) + 1)
    column = np.repeat(np.arange(len(first)), np.diff(np.append(first, len(key))))
    z, count = points[:, 2:].T
    is_confirmed = count > 1
    is_confirmed[:-1] |= is_same_column & (np.diff(z) <= PARAMS.thickness_m)
    bottom = np.minimum.reduceat(np.where(is_confirmed, np.arange(len(z)), len(z)), first)
    height_m = z - z[np.where(bottom < len(z), bottom, first)][column]
    weights = count * ((height_m >= 0) & (height_m <= PARAMS.thickness_m))
    total_weight = np.bincount(column, weights)
    means = [np.bincount(column, weights * coordinate_m) / total_weight for coordinate_m in points[:, :3].T]
    low = np.stack([*means, total_weight], axis=1)
    is_above = z > low[column, 2] + PARAMS.min_object_height_m
    return low, np.minimum.reduceat(np.where(is_above, z, np.inf), first)


def _mark_near_objects(low: Float64, has_object: Bools, corner_m: Float64) -> Bools:
    """Mark the (K,) columns with an object, or next to one that begins no higher."""
    first_cell = np.floor(corner_m / PARAMS.column_m)
    x, y = (np.floor(low[:, :2] / PARAMS.column_m) - first_cell).astype(np.int64).T + 1
    bottom_m = np.full(np.full(2, int(2 * PARAMS.range_m / PARAMS.column_m) + 3), np.inf)
    bottom_m[y[has_object], x[has_object]] = low[has_object, 2]
    dy, dx = np.indices((3, 3)).reshape(2, -1, 1) - 1
    lowest_m = bottom_m[y + dy, x + dx].min(axis=0)
    return np.asarray(low[:, 2] > lowest_m - PARAMS.thickness_m)


def _number_squares(horizontal_m: Float64) -> Int64:
    """Number the squares of (N, 2) positions relative to the corner."""
    x, y = (horizontal_m / PARAMS.square_m).astype(np.int64).T + PARAMS.reach_squares
    return np.asarray(y * PARAMS.squares_per_side + x)


def _choose_representatives(square: Int64, heights_m: Float64) -> Int64:
    """Choose the column of each square that represents it."""
    order = np.lexsort((heights_m, square))
    first = np.flatnonzero(np.diff(square[order], prepend=-1))
    count = np.diff(np.append(first, len(order)))
    return np.asarray(order[first + (PARAMS.quantile * count).astype(np.int64)])


def _list_neighbors() -> tuple[Int64, Float64]:
    """List the steps from a square to all within reach, and their distances in meters."""
    reach = PARAMS.reach_squares
    y, x = np.indices((2 * reach + 1, 2 * reach + 1)).reshape(2, -1) - reach
    is_near = np.hypot(x, y) <= reach
    return (y * PARAMS.squares_per_side + x)[is_near], PARAMS.square_m * np.hypot(x, y)[is_near]


def _connect_squares(square: Int64, heights_m: Float64) -> Bools:
    """Mark the (S * S,) squares that are connected with the vehicle; heights are above its origin."""
    side = PARAMS.squares_per_side
    height_m, connected = np.full(side**2, np.nan), np.zeros(side**2, dtype=np.bool_)
    height_m[square] = heights_m
    distance_m = PARAMS.square_m * np.hypot(*(np.array(np.divmod(square, side)) - side // 2))
    max_distance_m = distance_m.min(initial=2 * PARAMS.start_radius_m) + PARAMS.start_radius_m
    is_start = (distance_m <= max_distance_m) & (heights_m < PARAMS.max_start_height_m)
    front = square[is_start]
    if len(front):
        front = front[np.abs(heights_m[is_start] - np.median(heights_m[is_start])) < PARAMS.max_step_m]
    steps, step_m = _list_neighbors()
    max_rise_m = np.minimum(PARAMS.curb_m + PARAMS.max_slope * step_m, PARAMS.max_step_m)
    while len(front):
        connected[front] = True
        neighbors = front[:, None] + steps
        # A square without a column has the height NaN, which is never within the limit.
        is_level = np.abs(height_m[neighbors] - height_m[front, None]) <= max_rise_m
        front = np.unique(neighbors[is_level & ~connected[neighbors]])
    return connected
