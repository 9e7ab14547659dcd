"""Motion of bodies along the tracks of SUMO: the front axle leads, the rear follows, and no body crosses a curb."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.sumo.floating import TIME_SLACK_S, SumoTrack
from torchcover.simulation.sumo.paths import (
    compute_arc_lengths_m,
    compute_lengths_m,
    follow_edges,
    interpolate_path,
    measure_evasions_m,
    shift_path_back,
    smooth_positions,
    spread_jumps,
)
from torchcover.simulation.traffic.trailers import HITCHES, compute_tractrix_yaw_rad, compute_trailer_poses, stack_paths


@dataclass(frozen=True)
class MotionParams:
    """Parameters of the motion of bodies.

    Args:
        time_step_s: Time between two poses.
        smoothing_s: Time before and after a position over which it is smoothed, at least.
        axle_share: Distance of the axles from the center, as a share of the length.
        pedestrian_pivot_m: Distance behind a pedestrian of the point about which the body turns.
        max_walking_mps: Largest speed of people; SUMO lets people jump where paths meet.
        jump_extra_mps: Additional speed with which people walk the distance of a jump.
        check_spacing_m: Distance along the path between two checks for overlaps with obstacles.
        max_swings: Number of corrections of a path.
        swing_m: Distance before and after an overlap over which the path is shifted.
        swing_lengths: Addition to this distance, in lengths of the body.
        swing_margin_m: Gap to the obstacle.
        max_overlap_m: Overlap with a curb from which a vehicle is omitted.
        batch_size: Number of bodies that are computed together.
    """

    time_step_s: float = 0.1
    smoothing_s: float = 1.0
    axle_share: float = 0.3
    pedestrian_pivot_m: float = 0.4
    max_walking_mps: float = 4.0
    jump_extra_mps: float = 0.8
    check_spacing_m: float = 1.0
    max_swings: int = 4
    swing_m: float = 8.0
    swing_lengths: float = 1.0
    swing_margin_m: float = 0.1
    max_overlap_m: float = 0.05
    batch_size: int = 256


PARAMS = MotionParams()


class RoadUser(NamedTuple):
    """Road user of a simulation and its body.

    Args:
        track: Positions of the front.
        kind: Body.
        length_m: Length in the simulation.
        part_sizes_m: Length and width of the body and, if it has one, of its trailer.
    """

    track: SumoTrack
    kind: str
    length_m: float
    part_sizes_m: tuple[tuple[float, float], ...]

    @property
    def lead_offset_m(self) -> float:
        """Distance of the leading point, the front axle of a vehicle, ahead of the center."""
        return 0.0 if self.track.is_pedestrian else PARAMS.axle_share * self.part_sizes_m[0][0]

    @property
    def trailing_distance_m(self) -> float:
        """Distance of the trailing point behind the leading point."""
        return PARAMS.pedestrian_pivot_m if self.track.is_pedestrian else 2 * self.lead_offset_m


class Motion(NamedTuple):
    """Poses of a road user at K evenly spaced times.

    Args:
        road_user: The road user.
        times_s: (K,) times; one array is shared by all that are always present.
        poses: (K, 3) x and y of the center of the body and unwrapped heading in radians.
        curb_overlap_m: Largest overlap of the outline with a curb.
        trailer_poses: (K, 3) the same of the trailer; None without one.
    """

    road_user: RoadUser
    times_s: Float64
    poses: Float64
    curb_overlap_m: float = 0.0
    trailer_poses: Float64 | None = None

    @property
    def parts(self) -> list[tuple[Float64, tuple[float, float]]]:
        """Poses, and length and width, of the body and its trailer."""
        poses = [self.poses] if self.trailer_poses is None else [self.poses, self.trailer_poses]
        return list(zip(poses, self.road_user.part_sizes_m, strict=True))

    @property
    def is_plausible(self) -> bool:
        """True for a pedestrian that walks as fast as people can, or a vehicle that stays off the curbs."""
        if self.road_user.track.is_pedestrian:
            steps_m = compute_lengths_m(np.diff(self.poses, axis=0))
            return bool((steps_m < PARAMS.max_walking_mps * np.diff(self.times_s)).all())
        return self.curb_overlap_m < PARAMS.max_overlap_m


def compute_motions(
    road_users: Sequence[RoadUser],
    duration_s: float,
    origin_m: Float64,
    obstacles: NDArray[np.object_] | None = None,
    walkable_area: shapely.Geometry | None = None,
) -> list[Motion]:
    """Compute the motion of bodies along their tracks.

    Args:
        road_users: Road users; those with fewer than two poses are left out.
        duration_s: Duration.
        origin_m: (2,) position that is subtracted from all positions.
        obstacles: Polygons in the ground plane of sidewalks and parked cars, which vehicles avoid if they can.
        walkable_area: Area along whose edge pedestrians go instead of leaving it, if there is time.
    """
    shapely.prepare(walkable_area)
    num_steps = int(np.ceil(duration_s / PARAMS.time_step_s - TIME_SLACK_S))
    times_s = np.linspace(0.0, duration_s, num_steps + 1)
    users: list[RoadUser] = []
    times_by_user: list[Float64] = []
    for user in road_users:
        # Times within the track, with a tolerance at both ends.
        bounds_s = user.track.times_s[[0, -1]] + [-TIME_SLACK_S, TIME_SLACK_S]
        first, end = np.searchsorted(times_s, bounds_s).tolist()
        if end - first > 1:
            users.append(user)
            times_by_user.append(times_s if end - first == len(times_s) else times_s[first:end])
    motions: list[Motion] = []
    for start in range(0, len(users), PARAMS.batch_size):
        batch = users[start : start + PARAMS.batch_size]
        batch_times_s = times_by_user[start : start + PARAMS.batch_size]
        paths_m = []
        for user, user_times_s in zip(batch, batch_times_s, strict=True):
            paths_m.append(compute_lead_path(user, user_times_s, origin_m, walkable_area))
        poses, overlaps_m = compute_poses(batch, paths_m), np.zeros(len(batch))
        if obstacles is not None:
            overlaps_m = avoid_obstacles(batch, paths_m, poses, obstacles)
        trailers = compute_trailers(batch, poses)
        for index, user in enumerate(batch):
            overlap_m = float(overlaps_m[index])
            motions.append(Motion(user, batch_times_s[index], poses[index], overlap_m, trailers.get(index)))
    return motions


def compute_lead_path(
    user: RoadUser, times_s: Float64, origin_m: Float64, walkable_area: shapely.Geometry | None
) -> Float64:
    """Compute the path of the leading point of a road user.

    Args:
        user: Road user.
        times_s: (K,) even times.
        origin_m: (2,) position that is subtracted from all positions.
        walkable_area: Area that pedestrians do not leave; None without one.

    Returns:
        (K, 2) positions.
    """
    track, time_step_s = user.track, times_s[1] - times_s[0]
    path_m = track.front_positions_m[:, :2]
    if track.is_pedestrian:
        path_m = spread_jumps(track.times_s, path_m, PARAMS.max_walking_mps, PARAMS.jump_extra_mps)
    even_m = interpolate_path(times_s, track.times_s, path_m - origin_m)
    if track.is_pedestrian and walkable_area is not None and not walkable_area.is_empty:
        even_m = follow_edges(even_m, time_step_s, walkable_area)
    # Between two positions of the track there may be several poses.
    half_window_s = max(PARAMS.smoothing_s, float(np.median(np.diff(track.times_s))))
    smooth_m = smooth_positions(even_m, int(np.ceil(half_window_s / time_step_s)))
    distance_m = 0.0
    if not track.is_pedestrian:
        # The simulation knows the front and the length of the vehicle with its trailer.
        center_offset_m = HITCHES[user.kind].center_offset_m if user.kind in HITCHES else 0.0
        distance_m = max(user.length_m / 2 - (user.lead_offset_m + center_offset_m), 0.0)
    return shift_path_back(smooth_m, distance_m, np.deg2rad(track.yaw_deg[0]))


def compute_poses(users: Sequence[RoadUser], paths_m: Sequence[Float64]) -> list[Float64]:
    """Compute the poses of road users.

    Args:
        users: Road users.
        paths_m: Path (K, 2) of the leading point of each one; K may differ.

    Returns:
        (K, 3) x, y and unwrapped heading in radians of each one.
    """
    lead_m = stack_paths(paths_m)
    initial_yaw_rad = np.deg2rad([user.track.yaw_deg[0] for user in users])
    rod_lengths_m = np.array([user.trailing_distance_m for user in users])
    yaw_rad = compute_tractrix_yaw_rad(lead_m, rod_lengths_m, initial_yaw_rad)
    forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=2)
    offsets_m = np.array([user.lead_offset_m for user in users])[:, None] * forward
    poses = np.concatenate([lead_m - offsets_m, yaw_rad[..., None]], axis=2)
    return [poses[: len(path_m), index].copy() for index, path_m in enumerate(paths_m)]


def compute_trailers(users: Sequence[RoadUser], poses: Sequence[Float64]) -> dict[int, Float64]:
    """Compute the poses of trailers.

    Args:
        users: Road users.
        poses: Poses (K, 3) of each one.

    Returns:
        Poses (K, 3) by the indices of the towing vehicles.
    """
    towing = [index for index, user in enumerate(users) if user.kind in HITCHES]
    trailers = compute_trailer_poses([users[index].kind for index in towing], [poses[index] for index in towing])
    return dict(zip(towing, trailers, strict=True))


class _ObstacleChecks(NamedTuple):
    """Poses that are checked for overlaps.

    Args:
        users: (N,) index of the road user.
        is_trailer: (N,) True for a trailer.
        frames: (N,) index of the pose.
        sizes_m: (N, 2) length and width.
        poses: (N, 3) poses.
    """

    users: Int64
    is_trailer: Bools
    frames: Int64
    sizes_m: Float64
    poses: Float64


def _collect_checks(
    users: Sequence[RoadUser],
    frames_by_user: Mapping[int, Int64],
    poses: Sequence[Float64],
    trailers: Mapping[int, Float64],
) -> _ObstacleChecks:
    """Collect the checked poses of bodies and trailers."""
    empty = np.empty(0, dtype=np.int64)
    columns = [_ObstacleChecks(empty, empty.astype(bool), empty, np.empty((0, 2)), np.empty((0, 3)))]
    for index, frames in frames_by_user.items():
        parts = [poses[index], trailers[index]] if index in trailers else [poses[index]]
        for part, part_poses in enumerate(parts):
            size_m = np.tile(users[index].part_sizes_m[part], (len(frames), 1))
            is_trailer = np.full(len(frames), part == 1)
            columns.append(_ObstacleChecks(np.full(len(frames), index), is_trailer, frames, size_m, part_poses[frames]))
    return _ObstacleChecks(*(np.concatenate(arrays) for arrays in zip(*columns, strict=True)))


def avoid_obstacles(
    users: Sequence[RoadUser], paths_m: Sequence[Float64], poses: list[Float64], obstacles: NDArray[np.object_]
) -> Float64:
    """Shift the paths of vehicles sideways where a body or trailer would cross a curb.

    Args:
        users: N road users.
        paths_m: Paths (K, 2) of their leading points.
        poses: Poses (K, 3); those of shifted vehicles are replaced.
        obstacles: Polygons in the ground plane.

    Returns:
        (N,) largest remaining overlap in meters.
    """
    overlaps_m = np.zeros(len(users))
    offsets_m = [np.zeros(len(path_m)) for path_m in paths_m]
    left = [np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], axis=1) for pose in poses]
    frames_by_user: dict[int, Int64] = {}
    for index, (user, path_m) in enumerate(zip(users, paths_m, strict=True)):
        if not user.track.is_pedestrian:
            # The first pose in each section of the path is checked.
            sections = (compute_arc_lengths_m(path_m) / PARAMS.check_spacing_m).astype(np.int64)
            frames_by_user[index] = np.flatnonzero(np.diff(sections, prepend=-1))
    # Each round measures the overlaps, and all but the last shift the paths of vehicles with overlaps.
    for swing in range(PARAMS.max_swings + 1):
        checks = _collect_checks(users, frames_by_user, poses, compute_trailers(users, poses))
        evasions_m = measure_evasions_m(obstacles, checks.poses, checks.sizes_m)
        overlaps_m[list(frames_by_user)] = 0.0
        np.maximum.at(overlaps_m, checks.users, np.abs(evasions_m).max(axis=0))
        evasion_m = evasions_m.sum(axis=0)
        shifted = np.unique(checks.users[evasion_m != 0.0]).tolist()
        if not shifted or swing == PARAMS.max_swings:
            break
        frames_by_user = {index: frames for index, frames in frames_by_user.items() if index in shifted}
        shifted_paths_m = []
        for index in shifted:
            selection = (checks.users == index) & (evasion_m != 0.0)
            offsets_m[index] += _compute_swing_m(users[index], paths_m[index], checks, selection, evasion_m)
            shifted_paths_m.append(paths_m[index] + offsets_m[index][:, None] * left[index])
        shifted_poses = compute_poses([users[index] for index in shifted], shifted_paths_m)
        for index, new_poses in zip(shifted, shifted_poses, strict=True):
            poses[index] = new_poses
    return overlaps_m


def _compute_swing_m(
    user: RoadUser, path_m: Float64, checks: _ObstacleChecks, selection: Bools, evasion_m: Float64
) -> Float64:
    """Compute offsets (K,) to the left of a path that lead around the overlaps of a selection of checks."""
    wanted_m = evasion_m[selection] + np.copysign(PARAMS.swing_margin_m, evasion_m[selection])
    arc_lengths_m = compute_arc_lengths_m(path_m)
    trailer_lag_m = np.where(checks.is_trailer[selection], user.trailing_distance_m, 0.0)
    centers_m = arc_lengths_m[checks.frames[selection]] - trailer_lag_m
    reach_m = PARAMS.swing_m + PARAMS.swing_lengths * user.part_sizes_m[0][0]
    distances = np.abs(arc_lengths_m[:, None] - centers_m) / reach_m
    # Each overlap needs a smooth bump; of several in one direction, the largest counts.
    bumps_m = wanted_m * np.where(distances < 1, (1 + np.cos(np.pi * distances)) / 2, 0.0)
    return np.asarray(bumps_m.max(axis=1).clip(min=0.0) + bumps_m.min(axis=1).clip(max=0.0))
