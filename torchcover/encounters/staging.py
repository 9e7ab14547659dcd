"""Encounters with a vehicle that carries the rig: poses at any time, and the time of contact."""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from operator import attrgetter

import numpy as np

from torchcover.encounters.encounter import Encounter, EncounterPath, Obstacle
from torchcover.geometry import BoundingBox, compute_contact_time_s, find_overlaps, invert, transform_outline
from torchcover.geometry.arrays import Bools, Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.bodies import Shape, build_actor_mesh, get_shape_name
from torchcover.simulation.moving_bodies import BodyGeometry, BodyGeometryCache
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Plane
from torchcover.targets.placing import build_poses

# Frames of an encounter; scans start in whole frames.
FRAME_INTERVAL_S = 0.001


@dataclass(frozen=True)
class StagingParams:
    """Parameters of the staging of an encounter.

    Args:
        refinement: Steps per frame in which the contact in a bend is searched.
        pose_interval_s: Interval of the poses between which bends are straight.
        max_contact_delay_s: Time after the meeting of the paths until which the outlines may touch first, as where a
            vehicle drives into the side of the rear end of another.
        ground_size_m: Side of the square ground.
        contact_tolerance_m: Depth up to which overlapping boxes only touch, so that a gap may be 0.
    """

    refinement: int = 1000
    pose_interval_s: float = 0.01
    max_contact_delay_s: float = 2.0
    ground_size_m: float = 2000.0
    contact_tolerance_m: float = 1e-6


@lru_cache(maxsize=64)
def get_solid(shape: Shape) -> BodyGeometry:
    """Get the geometry of a road user or an obstacle, built once for all encounters."""
    return BodyGeometry(build_actor_mesh(f"body {get_shape_name(shape)!r}", shape, "other", keep_height=True))


class StagedEncounter:
    """Poses of an encounter. Time 0 is its begin; `contact_time_s` is when the outlines touch without any reaction.

    The outlines are the upright bounding boxes of the ego vehicle and of the road user.

    Args:
        encounter: The encounter.
        ego: Geometry of the vehicle that carries the rig, in the vehicle frame.
        params: Accuracy of the contact, and size of the ground.

    Raises:
        ValueError: The outlines never touch, or touch from the beginning, or an obstacle is on a path.
    """

    def __init__(self, encounter: Encounter, ego: BodyGeometry, params: StagingParams = StagingParams()) -> None:
        self.encounter, self.ego_solid, self._params = encounter, ego, params
        self.road_user_solid = get_solid(encounter.road_user.body)
        self.obstacles = self._place_obstacles()
        self.contact_time_s = self._find_contact_time_s()
        self._check_obstacles()

    def compute_world_T_ego(self, times_s: Float64) -> Float64:
        """Compute the pose of the ego vehicle; the paths meet at the origin, where it heads along x.

        Args:
            times_s: (T,) times since the begin.

        Returns:
            (T, 4, 4) poses.
        """
        path, box = self.encounter.ego, self.ego_solid.bounding_box
        front_m = box.upper_m[0] if path.speed_kmh >= 0 else box.lower_m[0]
        return compute_path_poses(path, times_s - self.encounter.lead_time_s, (-front_m, 0.0), 0.0)

    def compute_world_T_road_user(self, times_s: Float64) -> Float64:
        """Compute the pose of the road user.

        Args:
            times_s: (T,) times since the begin.

        Returns:
            (T, 4, 4) poses.
        """
        path, box = self.encounter.road_user, self.ego_solid.bounding_box
        y_m = box.lower_m[1] + path.impact_location * box.size_m[1]
        yaw_rad = math.radians(path.yaw_deg)
        return compute_path_poses(path, times_s - self.encounter.lead_time_s, (0.0, y_m), yaw_rad)

    def compute_vehicle_T_road_user(self, times_s: Float64) -> Float64:
        """Compute the pose of the road user in the vehicle frame.

        Args:
            times_s: (T,) times since the begin.

        Returns:
            (T, 4, 4) poses.
        """
        return np.asarray(invert(self.compute_world_T_ego(times_s)) @ self.compute_world_T_road_user(times_s))

    def build_scene(self, solids: BodyGeometryCache, *, includes_road_user: bool = False) -> SceneGeometry:
        """Build the scene with a time step of a millisecond.

        Args:
            solids: Cache of geometries.
            includes_road_user: Whether the road user is in the scene; points on it are counted without it.

        Returns:
            The scene.
        """
        num_frames = math.ceil(self.contact_time_s / FRAME_INTERVAL_S)
        duration_s = num_frames * FRAME_INTERVAL_S
        times_s = np.linspace(0.0, duration_s, 1 + math.ceil(duration_s / self._params.pose_interval_s))
        path = Trajectory.from_poses(times_s, self.compute_world_T_ego(times_s))
        # Transient, so that even an ego vehicle at rest is not merged with static bodies, as in all other encounters.
        trajectory = Trajectory(path.times_s, path.positions_m, path.angles_deg, is_transient=True)
        ego = Actor("ego", "ego", self.ego_solid.mesh, trajectory)
        size_m = self._params.ground_size_m
        static_meshes = [Plane(type="plane", size_m=(size_m, size_m)).build_mesh().assign_material("road")]
        static_meshes += [get_solid(obstacle.body).mesh.transform(pose) for obstacle, pose in self.obstacles]
        actors = []
        if includes_road_user:
            trajectory = Trajectory.from_poses(times_s, self.compute_world_T_road_user(times_s))
            name = get_shape_name(self.encounter.road_user.body)
            actors.append(Actor("other", name, self.road_user_solid.mesh, trajectory))
        scene = Scene(tuple(static_meshes), ego, tuple(actors), FRAME_INTERVAL_S, duration_s, ground_mesh_indices=(0,))
        return SceneGeometry(scene, solids)

    def _place_obstacles(self) -> list[tuple[Obstacle, Float64]]:
        """Compute the (4, 4) pose of each obstacle, row by row: left and right, before and beyond the road user."""
        road_user = self.encounter.road_user
        lower_m, upper_m = compute_extent_m(self.road_user_solid.bounding_box, math.radians(road_user.yaw_deg))
        ego_box, is_reversing = self.ego_solid.bounding_box, self.encounter.ego.speed_kmh < 0
        placed_obstacles = []
        row_ends_m: dict[tuple[str, str], float] = {}
        rows = sorted(self.encounter.obstacles, key=attrgetter("side", "position"))
        for obstacle in rows:
            row = obstacle.side, obstacle.position
            # The ego vehicle comes from -x, in reverse from x.
            is_ahead = (obstacle.position == "beyond") != is_reversing
            row_end_m = row_ends_m.get(row, upper_m[0] if is_ahead else -lower_m[0]) + obstacle.longitudinal_gap_m
            yaw_rad = math.radians(obstacle.yaw_deg)
            low_m, high_m = compute_extent_m(get_solid(obstacle.body).bounding_box, yaw_rad)
            x_m = row_end_m - low_m[0] if is_ahead else -row_end_m - high_m[0]
            row_ends_m[row] = row_end_m + (high_m[0] - low_m[0])
            if obstacle.side == "left":
                y_m = ego_box.upper_m[1] + obstacle.lateral_gap_m - low_m[1]
            else:
                y_m = ego_box.lower_m[1] - obstacle.lateral_gap_m - high_m[1]
            placed_obstacles.append((obstacle, build_poses(np.array([[x_m, y_m]]), np.array([yaw_rad]))[0]))
        return placed_obstacles

    def _find_contact_time_s(self) -> float:
        """Find the first time at which the outlines touch."""
        end_s, description = self.encounter.lead_time_s + self._params.max_contact_delay_s, self.encounter.description
        times_s = FRAME_INTERVAL_S * np.arange(math.ceil(end_s / FRAME_INTERVAL_S) + 1, dtype=np.float64)
        delays_s = self._compute_contact_delays_s(times_s)
        for frame_index in np.flatnonzero(delays_s < FRAME_INTERVAL_S).tolist():
            # A vehicle in a bend turns within a frame: search in smaller steps around the frame.
            nearby_s = times_s[max(frame_index - 1, 0) : frame_index + 3]
            fine_s = np.linspace(nearby_s[0], nearby_s[-1], self._params.refinement * (len(nearby_s) - 1) + 1)
            fine_delays_s = self._compute_contact_delays_s(fine_s)
            contacts = np.flatnonzero(fine_delays_s < np.diff(fine_s))
            if len(contacts) == 0:
                continue
            contact_s = float(fine_s[contacts[0]] + fine_delays_s[contacts[0]])
            if contact_s == 0:
                raise ValueError(
                    f"{description}: the outlines overlap from the beginning; let it begin earlier (max_lead_time_s, "
                    "approach_distance_m), or change a speed"
                )
            return contact_s
        raise ValueError(
            f"{description}: the outlines never touch, up to {self._params.max_contact_delay_s:g} s after the paths "
            "meet; change road_user.impact_location, yaw_deg or a speed"
        )

    def _compute_contact_delays_s(self, times_s: Float64) -> Float64:
        """Compute the (T - 1,) time from each frame to the contact at the velocity up to the next frame."""
        poses = self.compute_vehicle_T_road_user(times_s)
        velocity_mps = np.diff(poses[:, :2, 3], axis=0) / np.diff(times_s)[:, None]
        return compute_contact_time_s(
            self.ego_solid.bounding_box.outline_m,
            transform_outline(self.road_user_solid.bounding_box.outline_m, poses[:-1]),
            velocity_mps,
        )

    def _check_obstacles(self) -> None:
        """Check that no obstacle is on a path before the contact, or inside another obstacle."""
        description = self.encounter.description
        for (first, first_pose), (second, second_pose) in combinations(self.obstacles, 2):
            first_T_second = np.linalg.inv(first_pose) @ second_pose
            if self._find_penetrations(get_solid(second.body), first_T_second[None], get_solid(first.body)).any():
                raise ValueError(
                    f"{description}: the obstacles {get_shape_name(first.body)!r} and "
                    f"{get_shape_name(second.body)!r} are inside one another; change their longitudinal_gap_m or "
                    "lateral_gap_m"
                )
        times_s = np.append(np.arange(0.0, self.contact_time_s, self._params.pose_interval_s), self.contact_time_s)
        paths = (
            ("the ego vehicle", self.ego_solid, self.compute_world_T_ego),
            ("the road user", self.road_user_solid, self.compute_world_T_road_user),
        )
        for obstacle, pose in self.obstacles:
            for vehicle, solid, compute_world_T_solid in paths:
                solid_T_obstacle = np.linalg.inv(compute_world_T_solid(times_s)) @ pose
                is_on_path = self._find_penetrations(get_solid(obstacle.body), solid_T_obstacle, solid)
                if is_on_path.any():
                    before_contact_s = self.contact_time_s - times_s[is_on_path.argmax()]
                    raise ValueError(
                        f"{description}: the obstacle {get_shape_name(obstacle.body)!r} is in the path of {vehicle}, "
                        f"{before_contact_s:.2f} s before the contact; change its lateral_gap_m or longitudinal_gap_m, "
                        "or let the encounter begin later (approach_distance_m, max_lead_time_s)"
                    )

    def _find_penetrations(self, solid: BodyGeometry, base_T_solid: Float64, base: BodyGeometry) -> Bools:
        """Test at which (P, 4, 4) poses two bodies overlap by more than the tolerance: (P,)."""
        corners_m = base.bounding_box.corners_m
        offsets_m = self._params.contact_tolerance_m * np.sign(corners_m - corners_m.mean(axis=0))
        return find_overlaps(solid.bounding_box, base_T_solid, corners_m - offsets_m)


def compute_path_poses(
    path: EncounterPath, times_s: Float64, meeting_point_m: tuple[float, float], yaw_rad: float
) -> Float64:
    """Compute the poses on a path.

    Args:
        path: The path.
        times_s: (T,) times after the path reaches the meeting point; negative before.
        meeting_point_m: (2,) position at time 0.
        yaw_rad: Heading at time 0.

    Returns:
        (T, 4, 4) poses.
    """
    distance_m = path.speed_mps * times_s
    if path.radius_m is None:
        turned_rad, x_m, y_m = np.zeros_like(distance_m), distance_m, np.zeros_like(distance_m)
    else:
        bend_m = abs(path.radius_m) * math.radians(path.turn_deg)
        turned_rad = np.clip(distance_m, -bend_m, bend_m) / path.radius_m
        straight_m = distance_m - turned_rad * path.radius_m
        x_m = path.radius_m * np.sin(turned_rad) + straight_m * np.cos(turned_rad)
        # 2 sin(a / 2)^2 instead of 1 - cos(a), which loses digits in wide bends.
        y_m = 2 * path.radius_m * np.sin(turned_rad / 2) ** 2 + straight_m * np.sin(turned_rad)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x_world_m = meeting_point_m[0] + cos * x_m - sin * y_m
    y_world_m = meeting_point_m[1] + sin * x_m + cos * y_m
    return build_poses(np.stack([x_world_m, y_world_m], axis=1), yaw_rad + turned_rad)


def compute_extent_m(box: BoundingBox, yaw_rad: float) -> tuple[Float64, Float64]:
    """Compute the extent of a rotated box.

    Args:
        box: The box.
        yaw_rad: Its rotation about z.

    Returns:
        (2,) smallest and (2,) largest x, y.
    """
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    corners_m = box.corners_m[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    return corners_m.min(axis=0), corners_m.max(axis=0)
