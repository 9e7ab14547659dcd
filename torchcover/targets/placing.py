"""Positions of test targets: cells around the vehicle, poses on the ground, and free space at these poses."""

import math
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.scene_snapshot import SceneSnapshot

SIDES = ("front", "rear", "left", "right")
# "narrow" turns the narrower side of a target's box to the vehicle, "wide" the wider one; numbers are yaws in degrees.
Heading = Literal["narrow", "wide"] | float

# Default side of a cell: less than half of the width of a person.
CELL_M = 0.2
# A run with this number of target positions takes minutes and less than 1 GB.
MAX_POSITIONS = 1_000_000


@dataclass(frozen=True)
class CollisionParams:
    """Tolerances of the test whether a target position is free.

    Args:
        max_step_m: Obstacles below this height do not block a target: curbs, rising ground.
        contact_share: Obstacles may enter the outermost part of a target by this share of the distance to its center,
            so that a wall may touch it.
    """

    max_step_m: float = 0.2
    contact_share: float = 0.05


@dataclass(frozen=True)
class Raster:
    """Grid of equal square cells in the vehicle frame; the center of each cell is a target position.

    Args:
        x_bounds_m: Lower and upper bound forward.
        y_bounds_m: Lower and upper bound to the left.
        cell_m: Side of a cell; the extent in x and y is a whole number of cells.

    Raises:
        ValueError: Invalid bounds or cell size, or more than a million cells.

    Example:
        >>> raster = Raster((-1.0, 1.0), (0.0, 1.0), 0.5)
        >>> raster.shape, raster.x_m.tolist()
        ((2, 4), [-0.75, -0.25, 0.25, 0.75])
    """

    x_bounds_m: tuple[float, float]
    y_bounds_m: tuple[float, float]
    cell_m: float = CELL_M

    def __post_init__(self) -> None:
        if not 0 < self.cell_m < math.inf:
            raise ValueError(f"raster: a cell size above 0 m is needed; got {self.cell_m}")
        extents_m = []
        for name, (low, high) in (("x", self.x_bounds_m), ("y", self.y_bounds_m)):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"raster: {name} needs finite bounds, low < high; got {low} and {high}")
            extents_m.append(high - low)
        if extents_m[0] * extents_m[1] > (MAX_POSITIONS + 0.5) * self.cell_m**2:
            num_cells = extents_m[0] / self.cell_m * extents_m[1] / self.cell_m
            raise ValueError(
                f"raster: {num_cells:,.0f} cells exceed the limit of {MAX_POSITIONS:,} per run; use larger cells "
                "or a smaller area"
            )
        for name, (low, high) in (("x", self.x_bounds_m), ("y", self.y_bounds_m)):
            num_cells = (high - low) / self.cell_m
            if round(num_cells) < 1 or abs(num_cells - round(num_cells)) > 1e-6:
                raise ValueError(
                    f"raster: {name} from {low:g} to {high:g} m is no whole number of cells of {self.cell_m:g} m; "
                    "change the bounds or the cell size"
                )

    @classmethod
    def from_vehicle(cls, vehicle_box: BoundingBox, margin_m: float = 5.0, cell_m: float = CELL_M) -> Self:
        """Create the raster that covers a vehicle and a margin around it, aligned with the vehicle's origin.

        Args:
            vehicle_box: Bounding box of the vehicle in the vehicle frame.
            margin_m: Distance from the box that is covered at least.
            cell_m: Side of a cell.

        Returns:
            The raster; its bounds are multiples of `cell_m`.

        Example:
            >>> Raster.from_vehicle(BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), 1.0, 0.5).x_bounds_m
            (-3.0, 3.0)
        """
        bounds_m = []
        for low, high in zip(vehicle_box.lower_m[:2], vehicle_box.upper_m[:2], strict=True):
            first, last = math.floor((low - margin_m) / cell_m + 1e-9), math.ceil((high + margin_m) / cell_m - 1e-9)
            bounds_m.append((first * cell_m, last * cell_m))
        return cls(bounds_m[0], bounds_m[1], cell_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows along y and of columns along x."""
        (x_low, x_high), (y_low, y_high) = self.x_bounds_m, self.y_bounds_m
        return round((y_high - y_low) / self.cell_m), round((x_high - x_low) / self.cell_m)

    @property
    def x_m(self) -> Float64:
        """(X,) centers of the columns."""
        return compute_cell_centers_m(self.x_bounds_m[0], self.cell_m, self.shape[1])

    @property
    def y_m(self) -> Float64:
        """(Y,) centers of the rows."""
        return compute_cell_centers_m(self.y_bounds_m[0], self.cell_m, self.shape[0])

    @property
    def positions_m(self) -> Float64:
        """(Y * X, 2) centers of the cells, row by row."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        return np.stack([x.ravel(), y.ravel()], axis=1)


def compute_cell_centers_m(low_m: float, cell_m: float, num_cells: int) -> Float64:
    """Compute the (num_cells,) centers of cells along one axis, from its lower bound and the side of a cell."""
    centers_m: Float64 = low_m + cell_m * (np.arange(num_cells, dtype=np.float64) + 0.5)
    return centers_m.round(9)  # 0.1 instead of 0.09999999999999998


def find_sides(box: BoundingBox, positions_m: Float64) -> Int64:
    """Find the side of a vehicle on which positions lie; the sides are separated by lines of 45 degrees at the corners.

    Args:
        box: Bounding box of the vehicle.
        positions_m: (P, 2) positions in the vehicle frame.

    Returns:
        (P,) index in `SIDES`; -1 within the box.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> [SIDES[index] for index in find_sides(box, np.array([[3.0, 1.5], [0.0, -2.0]]))]
        ['front', 'right']
    """
    x, y = compute_outline_offsets_m(box, positions_m).T
    side = np.where(np.abs(x) >= np.abs(y), np.where(x > 0, 0, 1), np.where(y > 0, 2, 3))
    side[(x == 0) & (y == 0)] = -1
    return side


def compute_outline_offsets_m(box: BoundingBox, positions_m: Float64) -> Float64:
    """Compute the offsets of positions from the nearest point of a box in bird's-eye view.

    Args:
        box: The box.
        positions_m: (P, 2) positions in the frame of the box.

    Returns:
        (P, 2) offsets along x and y; 0 within the box.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> compute_outline_offsets_m(box, np.array([[3.0, 0.5], [-2.5, -1.25]])).tolist()
        [[1.0, 0.0], [-0.5, -0.25]]
    """
    nearest_m = np.clip(positions_m, box.lower_m[:2], box.upper_m[:2])
    return np.asarray(positions_m - nearest_m)


def compute_yaws_rad(
    heading: Heading, target_box: BoundingBox, vehicle_box: BoundingBox, positions_m: Float64
) -> Float64:
    """Compute the yaw of a target at positions around a vehicle.

    Args:
        heading: "narrow" or "wide" turns this side of the target to the nearest point of the vehicle; a number is the
            yaw in degrees, 0 for the heading of the vehicle.
        target_box: Bounding box of the target in its own frame.
        vehicle_box: Bounding box of the vehicle in the vehicle frame.
        positions_m: (P, 2) positions of the target in the vehicle frame.

    Returns:
        (P,) yaw in radians.

    Raises:
        ValueError: `heading` is neither "narrow", "wide" nor a finite number.
    """
    if heading in ("narrow", "wide"):
        # 0.0 - x instead of -x: the arctangent of -0.0 is another angle.
        towards_vehicle_m = 0.0 - compute_outline_offsets_m(vehicle_box, positions_m)
        length_m, width_m, _ = target_box.size_m
        # The narrow side faces a viewer who looks along the longer side.
        is_along_x = (length_m >= width_m) == (heading == "narrow")
        offset_rad = 0.0 if is_along_x else math.pi / 2
        return np.asarray(np.arctan2(towards_vehicle_m[:, 1], towards_vehicle_m[:, 0]) - offset_rad)
    if isinstance(heading, str) or not math.isfinite(heading):
        raise ValueError(f"heading: narrow, wide or degrees are needed; got {heading!r}")
    return np.full(len(positions_m), math.radians(heading))


def build_poses(positions_m: Float64, yaw_rad: Float64) -> Float64:
    """Build poses on the plane z = 0 of the vehicle frame.

    Args:
        positions_m: (P, 2) positions.
        yaw_rad: (P,) yaw angles.

    Returns:
        (P, 4, 4) poses.
    """
    matrices = np.tile(np.eye(4), (len(positions_m), 1, 1))
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = cos, -sin, sin, cos
    matrices[:, :2, 3] = positions_m
    return matrices


def set_pose_heights(vehicle_T_target: Float64, z_m: Float64) -> Float64:
    """Set the heights of poses.

    Args:
        vehicle_T_target: (P, 4, 4) poses.
        z_m: (P,) heights in the vehicle frame.

    Returns:
        (P, 4, 4) copies of the poses at these heights.
    """
    poses = vehicle_T_target.copy()
    poses[:, 2, 3] = z_m
    return poses


def compute_ground_heights_m(snapshot: SceneSnapshot, positions_m: Float64) -> Float64:
    """Compute the height of the ground at positions around the vehicle.

    Where several road levels lie above each other, the level is used that can be reached on foot from the vehicle: the
    highest that is at most 1 m plus 15 % of the distance above the plane of the vehicle.

    Args:
        snapshot: Scene at one time.
        positions_m: (P, 2) positions in the vehicle frame.

    Returns:
        (P,) z of the ground in the vehicle frame; NaN where there is none.
    """
    distance_m = np.linalg.norm(positions_m, axis=1)
    z_m = 1.0 + 0.15 * distance_m
    # The vertical axes of the world and of the vehicle differ: the second iteration starts where the first one ended.
    for _ in range(2):
        z_m = z_m - snapshot.compute_heights_m(np.column_stack([positions_m, z_m]))
    return np.where(np.abs(z_m) < 1e-3, 0.0, z_m)  # rounding is no slope


def is_point_inside(box: BoundingBox, vehicle_T_target: Float64, point_m: Float64) -> Bools:
    """Test whether a point lies inside the bounding box of a target at several poses.

    Args:
        box: Bounding box of the target in its own frame.
        vehicle_T_target: (P, 4, 4) poses of the target.
        point_m: (3,) point in the vehicle frame.

    Returns:
        (P,) True where the box contains the point.
    """
    point_in_target_m = np.einsum("pji,pj->pi", vehicle_T_target[:, :3, :3], point_m - vehicle_T_target[:, :3, 3])
    return np.asarray(((point_in_target_m > box.lower_m) & (point_in_target_m < box.upper_m)).all(axis=1))


def is_blocked(
    snapshot: SceneSnapshot,
    box: BoundingBox,
    surface_points_m: Float64,
    vehicle_T_target: Float64,
    params: CollisionParams = CollisionParams(),
) -> Bools:
    """Test whether other bodies than the ego vehicle occupy the space of a target.

    Moving bodies block a target if their bounding boxes overlap. Static bodies block it if one of their faces lies
    between its center and a point of its surface, or if its center is inside one of them.

    Args:
        snapshot: Scene at one time, without the target.
        box: Bounding box of the target in its own frame.
        surface_points_m: (M, 3) points of the target's surface in its own frame.
        vehicle_T_target: (P, 4, 4) poses of the target.
        params: Tolerances.

    Returns:
        (P,) True where the target has no room.
    """
    is_occupied = find_static_collisions(snapshot, box, surface_points_m, vehicle_T_target, params)
    moving = snapshot.moving_bodies
    radius_m = float(np.linalg.norm(box.corners_m, axis=1).max())
    distance_m = np.linalg.norm(vehicle_T_target[:, None, :3, 3] - moving.center_m, axis=2)
    is_near = (distance_m <= moving.radius_m + radius_m) & (moving.body_indices != snapshot.ego_index)
    for index in np.flatnonzero(is_near.any(axis=0)).tolist():
        nearby = is_near[:, index]
        is_occupied[nearby] |= find_overlaps(box, vehicle_T_target[nearby], moving.box_corners_m[index])
    return is_occupied


def find_static_collisions(
    snapshot: SceneSnapshot,
    box: BoundingBox,
    surface_points_m: Float64,
    vehicle_T_target: Float64,
    params: CollisionParams,
) -> Bools:
    """Test whether static bodies occupy the space of a target; arguments and result as in `is_blocked`."""
    center_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    min_height_m = min(params.max_step_m, box.upper_m[2] / 2)
    ends_m = np.column_stack([surface_points_m[:, :2], np.maximum(surface_points_m[:, 2], min_height_m)])
    rays_m = (ends_m - center_m) * (1 - params.contact_share)
    rays_m = rays_m[np.linalg.norm(rays_m, axis=1) > 0]
    static_T_target = snapshot.static_T_vehicle @ vehicle_T_target
    centers_m = static_T_target[:, :3, :3] @ center_m + static_T_target[:, :3, 3]
    static_rays_m = np.einsum("pij,mj->pmi", static_T_target[:, :3, :3], rays_m).reshape(-1, 3)
    length_m = np.tile(np.linalg.norm(rays_m, axis=1), len(centers_m))
    hits = snapshot.static_caster.cast_from_each(
        centers_m.astype(np.float32).repeat(len(rays_m), axis=0),
        (static_rays_m / length_m[:, None]).T.astype(np.float32),
        length_m.astype(np.float32),
    )
    is_hit: Bools = (hits.body_indices >= 0) & (hits.body_indices != snapshot.ego_index)
    up = np.zeros((3, len(centers_m)), dtype=np.float32)
    up[:] = (snapshot.static_T_vehicle[:3, 2])[:, None]
    hits_above = snapshot.static_caster.cast_from_each(
        centers_m.astype(np.float32), up, np.full(len(centers_m), np.inf, dtype=np.float32)
    )
    # Only a center with a face above it can be inside a body; the exact test is slow.
    is_inside = hits_above.body_indices >= 0
    for index in np.flatnonzero(is_inside).tolist():
        enclosing = snapshot.static_caster.find_enclosing_bodies(centers_m[index])
        is_inside[index] = (enclosing != snapshot.ego_index).any()
    return np.asarray(is_hit.reshape(len(centers_m), -1).any(axis=1) | is_inside)
