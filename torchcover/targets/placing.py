"""Where a target is put: cells around the vehicle, how it stands in each, and whether there is room for it."""

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.instant import SceneSnapshot

MARGIN_M = 5.0
SIDES = ("front", "rear", "left", "right")
STEP_M = 0.2
# Takes minutes, and less than 1 GB.
MAX_POSITIONS = 1_000_000


@dataclass(frozen=True)
class Raster:
    """Equal cells in the vehicle frame; a target stands in the middle of one.

    Args:
        x_bounds_m: Bounds forward in metres, low and high.
        y_bounds_m: Bounds to the left.
        cell_m: Side of a cell; the bounds are a whole number of them apart.

    Raises:
        ValueError: Bounds or a step that are none, or more than a million cells.

    Example:
        >>> raster = Raster((-1.0, 1.0), (0.0, 1.0), 0.5)
        >>> raster.shape, raster.x_m.tolist()
        ((2, 4), [-0.75, -0.25, 0.25, 0.75])
    """

    x_bounds_m: tuple[float, float]
    y_bounds_m: tuple[float, float]
    cell_m: float = STEP_M

    def __post_init__(self) -> None:
        if not 0 < self.cell_m < math.inf:
            raise ValueError(f"raster: a step above 0 m is needed; got {self.cell_m}")
        for name, (low, high) in (("x", self.x_bounds_m), ("y", self.y_bounds_m)):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"raster: {name} needs finite bounds, low < high; got {low} and {high}")
        if (self.x_bounds_m[1] - self.x_bounds_m[0]) * (self.y_bounds_m[1] - self.y_bounds_m[0]) > (
            MAX_POSITIONS + 0.5
        ) * self.cell_m**2:
            cells = (
                (self.x_bounds_m[1] - self.x_bounds_m[0])
                / self.cell_m
                * (self.y_bounds_m[1] - self.y_bounds_m[0])
                / self.cell_m
            )
            raise ValueError(
                f"raster: {cells:,.0f} cells; at most {MAX_POSITIONS:,} are placed in one run: take a larger step or "
                "a smaller area"
            )
        for name, (low, high) in (("x", self.x_bounds_m), ("y", self.y_bounds_m)):
            cells = (high - low) / self.cell_m
            if round(cells) < 1 or abs(cells - round(cells)) > 1e-6:
                raise ValueError(
                    f"raster: {name} from {low:g} to {high:g} m is no whole number of steps of {self.cell_m:g} m; "
                    "change the bounds or the step"
                )

    @classmethod
    def from_vehicle(cls, vehicle_box: BoundingBox, margin_m: float = MARGIN_M, cell_m: float = STEP_M) -> Self:
        """All that is within a margin of a vehicle, in whole steps from its origin.

        Example:
            >>> Raster.from_vehicle(BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), 1.0, 0.5).x_bounds_m
            (-3.0, 3.0)
        """
        (x0, y0, _), (x1, y1, _) = vehicle_box.lower_m, vehicle_box.upper_m

        def bounds(low: float, high: float) -> tuple[float, float]:
            first, last = math.floor((low - margin_m) / cell_m + 1e-9), math.ceil((high + margin_m) / cell_m - 1e-9)
            return first * cell_m, last * cell_m

        return cls(bounds(x0, x1), bounds(y0, y1), cell_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows along y and columns along x."""
        return round((self.y_bounds_m[1] - self.y_bounds_m[0]) / self.cell_m), round(
            (self.x_bounds_m[1] - self.x_bounds_m[0]) / self.cell_m
        )

    @property
    def x_m(self) -> Float64:
        """(X,) middles of the columns."""
        return _middles_m(self.x_bounds_m[0], self.cell_m, self.shape[1])

    @property
    def y_m(self) -> Float64:
        """(Y,) middles of the rows."""
        return _middles_m(self.y_bounds_m[0], self.cell_m, self.shape[0])

    @property
    def positions_m(self) -> Float64:
        """(Y * X, 2) middles of the cells, row by row."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        return np.stack([x.ravel(), y.ravel()], axis=1)


def _middles_m(low_m: float, step_m: float, count: int) -> Float64:
    middles_m: Float64 = low_m + step_m * (np.arange(count, dtype=np.float64) + 0.5)
    # A cell that was meant to be at 0.1 is not at 0.09999999999999998.
    return middles_m.round(9)


def find_sides(box: BoundingBox, positions_m: Float64) -> Int64:
    """(P,) number in `SIDES` of the side of a box that each of (P, 2) places is on; -1 within it.

    Sides meet at 45 degrees from the corners.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> [SIDES[side] for side in find_sides(box, np.array([[3.0, 1.5], [0.0, -2.0]]))]
        ['front', 'right']
    """
    x, y = compute_outline_offsets_m(box, positions_m).T
    side = np.where(np.abs(x) >= np.abs(y), np.where(x > 0, 0, 1), np.where(y > 0, 2, 3))
    side[(x == 0) & (y == 0)] = -1
    return side


def compute_outline_offsets_m(box: BoundingBox, positions_m: Float64) -> Float64:
    """(P, 2) how far along x and y each of (P, 2) places is from the nearest point of a box, seen from above.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> compute_outline_offsets_m(box, np.array([[3.0, 0.5], [-2.5, -1.25]])).tolist()
        [[1.0, 0.0], [-0.5, -0.25]]
    """
    nearest_m = np.clip(positions_m, box.lower_m[:2], box.upper_m[:2])
    return np.asarray(positions_m - nearest_m)


# "narrow" turns the narrower side of the target's box to the vehicle, "wide" the wider one; degrees are its yaw.
Heading = Literal["narrow", "wide"] | float

# Where a target may stand above the plane of the vehicle: near it, and at the end of a slope that leads there.
NEAR_M, STEEPEST_WAY = 1.0, 0.15
LEVEL_M = 1e-3
# A kerb, and ground that rises: what is lower than this under a target takes no room from it.
STEP_UP_M = 0.2
# A wall may touch the outermost of a target: by this share of the way from its middle.
TOUCHING_SHARE = 0.05


def compute_yaws_rad(
    heading: Heading, target_box: BoundingBox, vehicle_box: BoundingBox, positions_m: Float64
) -> Float64:
    """(P,) yaw of a target in radians at (P, 2) places, by the boxes of both.

    The "narrow" or "wide" side is turned to the nearest point of the vehicle; degrees are about z, 0 as the vehicle.
    """
    if heading in ("narrow", "wide"):
        towards_m = 0.0 - compute_outline_offsets_m(vehicle_box, positions_m)  # no -0.0, which is another angle
        length_m, width_m, _ = target_box.size_m
        # Whoever looks along the longer side sees the narrow one.
        along_x = (length_m >= width_m) == (heading == "narrow")
        return np.asarray(np.arctan2(towards_m[:, 1], towards_m[:, 0]) - (0.0 if along_x else math.pi / 2))
    if isinstance(heading, str) or not math.isfinite(heading):
        raise ValueError(f"heading: narrow, wide or degrees are needed; got {heading!r}")
    return np.full(len(positions_m), math.radians(heading))


def build_poses(positions_m: Float64, yaw_rad: Float64) -> Float64:
    """(P, 4, 4) `vehicle_T_target` of targets on the plane z = 0 of the vehicle frame, until the ground is known."""
    matrices = np.tile(np.eye(4), (len(positions_m), 1, 1))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = cos, -sin, sin, cos
    matrices[:, :2, 3] = positions_m
    return matrices


def compute_ground_heights_m(instant: SceneSnapshot, positions_m: Float64) -> Float64:
    """(P,) z of the ground in the vehicle frame at (P, 2) places; NaN where there is none.

    Of several grounds above each other that counts which somebody walks on who comes from the vehicle: the highest that
    is no farther above its plane than a metre and a slope of 15 %.
    """
    away_m = np.linalg.norm(positions_m, axis=1)
    z_m = NEAR_M + STEEPEST_WAY * away_m
    # The vertical of the world is not that of the vehicle: where the first look ends, a second one looks down.
    for _ in range(2):
        z_m = z_m - instant.compute_heights_m(np.column_stack([positions_m, z_m]))
    # Rounding makes no slope.
    return np.where(np.abs(z_m) < LEVEL_M, 0.0, z_m)


def set_pose_heights(vehicle_T_target: Float64, z_m: Float64) -> Float64:
    """(P, 4, 4) the same poses at other heights, (P,)."""
    poses = vehicle_T_target.copy()
    poses[:, 2, 3] = z_m
    return poses


def is_point_inside(box: BoundingBox, vehicle_T_target: Float64, point_m: Float64) -> Bools:
    """(P,) whether a target's box holds a (3,) place of the vehicle frame."""
    there_m = np.einsum("pji,pj->pi", vehicle_T_target[:, :3, :3], point_m - vehicle_T_target[:, :3, 3])
    return np.asarray(((there_m > box.lower_m) & (there_m < box.upper_m)).all(axis=1))


def is_blocked(instant: SceneSnapshot, box: BoundingBox, surface_points_m: Float64, vehicle_T_target: Float64) -> Bools:
    """(P,) whether anything but the ego takes a target's room, (P, 4, 4) poses of its box.

    What moves does so with its box. Of what rests, its faces are asked: whether one lies between the middle of the
    target and one of (M, 3) points of its surface, or the middle is behind one. Kerbs of up to 0.2 m do not count.
    """
    taken = np.zeros(len(vehicle_T_target), dtype=bool)
    moving, reach_m = instant.moving_bodies, float(np.linalg.norm(box.corners_m, axis=1).max())
    away_m = np.linalg.norm(vehicle_T_target[:, None, :3, 3] - moving.center_m, axis=2)
    near = (away_m <= moving.radius_m + reach_m) & (moving.body_indices != instant.ego_index)
    for k in np.flatnonzero(near.any(axis=0)).tolist():
        taken[near[:, k]] |= find_overlaps(box, vehicle_T_target[near[:, k]], moving.box_corners_m[k])
    return taken | _meets_static(instant, box, surface_points_m, vehicle_T_target)


def _meets_static(instant: SceneSnapshot, box: BoundingBox, samples_m: Float64, vehicle_T_target: Float64) -> Bools:
    height_m = box.upper_m[2]
    middle_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    low_m = min(STEP_UP_M, height_m / 2)
    ends_m = np.column_stack([samples_m[:, :2], np.maximum(samples_m[:, 2], low_m)])
    ways_m = (ends_m - middle_m) * (1 - TOUCHING_SHARE)
    ways_m = ways_m[np.linalg.norm(ways_m, axis=1) > 0]
    static_T_target = instant.static_T_vehicle @ vehicle_T_target
    starts_m = static_T_target[:, :3, :3] @ middle_m + static_T_target[:, :3, 3]
    towards_m = np.einsum("pij,mj->pmi", static_T_target[:, :3, :3], ways_m).reshape(-1, 3)
    length_m = np.tile(np.linalg.norm(ways_m, axis=1), len(starts_m))
    directions = (towards_m / length_m[:, None]).T.astype(np.float32)
    origins_m = starts_m.astype(np.float32).repeat(len(ways_m), axis=0)
    hits = instant.static_caster.cast_from_each(origins_m, directions, length_m.astype(np.float32))
    met: Bools = (hits.body_indices >= 0) & (hits.body_indices != instant.ego_index)
    up = np.zeros((3, len(starts_m)), dtype=np.float32)
    up[:] = (instant.static_T_vehicle[:3, 2])[:, None]
    above = instant.static_caster.cast_from_each(
        starts_m.astype(np.float32), up, np.full(len(starts_m), np.inf, dtype=np.float32)
    )
    inside = above.body_indices >= 0  # of something, perhaps
    inside[inside] = [
        (instant.static_caster.find_enclosing_bodies(place_m) != instant.ego_index).any()
        for place_m in starts_m[inside]
    ]
    return np.asarray(met.reshape(len(starts_m), -1).any(axis=1) | inside)
