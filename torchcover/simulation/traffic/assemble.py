"""Conversion of lane positions to actors: poses, trailers, and the tilt of the ego vehicle."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.scene import Actor
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, REAR_OF, Fleet
from torchcover.simulation.traffic.flow import Agent, Lane, TrafficHistory
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.trailers import HITCHES, compute_trailer_poses

# Largest range of a sensor: road users that never come this close to the ego vehicle are omitted from the scene.
HORIZON_M = 250.0


class BodyTrajectories(NamedTuple):
    """Poses of N bodies at T times.

    Args:
        positions_m: (T, N, 3) positions; NaN where a body is absent.
        yaw_deg: (T, N) headings.
        kinds: N bodies; trailers come last.
        towing_indices: Index of the towing vehicle of each trailer.
    """

    positions_m: Float64
    yaw_deg: Float64
    kinds: tuple[str, ...]
    towing_indices: tuple[int, ...] = ()

    @classmethod
    def from_bodies(cls, bodies: Sequence[tuple[Float64, Float64, str]]) -> "BodyTrajectories":
        """Combine bodies with positions (T, 3) in meters, headings (T,) in degrees and a kind each."""
        positions_m, yaw_deg, kinds = zip(*bodies, strict=True)
        return cls(np.stack(positions_m, axis=1), np.stack(yaw_deg, axis=1), kinds)

    def add_trailers(self, initial_yaw_rad: Sequence[float] | None = None) -> "BodyTrajectories":
        """Append the trailers of these bodies.

        Args:
            initial_yaw_rad: Heading of each trailer at the start; straight behind the towing vehicle if None.
        """
        towing_indices = tuple(index for index, kind in enumerate(self.kinds) if kind in HITCHES)
        if not towing_indices:
            return self
        front_kinds = [self.kinds[index] for index in towing_indices]
        front_poses = []
        for index in towing_indices:
            yaw_rad = np.deg2rad(self.yaw_deg[:, index])
            front_poses.append(np.column_stack([self.positions_m[:, index, :2], yaw_rad]))
        poses = np.stack(compute_trailer_poses(front_kinds, front_poses, initial_yaw_rad), axis=1)
        positions_m = np.concatenate([self.positions_m, poses * [1.0, 1.0, 0.0]], axis=1)
        yaw_deg = np.concatenate([self.yaw_deg, np.rad2deg(poses[..., 2])], axis=1)
        trailer_kinds = [HITCHES[kind].trailer_kind for kind in front_kinds]
        return BodyTrajectories(positions_m, yaw_deg, (*self.kinds, *trailer_kinds), towing_indices)


def compute_body_trajectories(
    lanes: Sequence[Lane], agents: Sequence[Agent], lane_positions_m: Float64
) -> BodyTrajectories:
    """Compute the poses of agents and their trailers on the ground plane.

    Args:
        lanes: Lanes.
        agents: N agents.
        lane_positions_m: (T, N) positions along the lanes.
    """
    positions_m, yaw_deg = np.zeros((*lane_positions_m.shape, 3)), np.empty(lane_positions_m.shape)
    lane_indices = np.array([agent.lane_index for agent in agents])
    kinds = tuple(agent.kind for agent in agents)
    lane_positions_m = lane_positions_m + get_center_offsets_m(kinds)
    for on_lane, poses in _iterate_lane_poses(lanes, lane_indices, lane_positions_m):
        positions_m[:, on_lane, :2], yaw_deg[:, on_lane] = poses[..., :2], poses[..., 2]
    initial_yaw_rad = []
    for index, kind in enumerate(kinds):
        if kind in HITCHES:
            # At the start the axles of the trailer are on the lane.
            axle_distance_m = HITCHES[kind].hitch_to_axle_m - HITCHES[kind].hitch_offset_m
            centerline = lanes[lane_indices[index]].centerline
            (axle_m,) = centerline.compute_poses(lane_positions_m[:1, index] - axle_distance_m)[:, :2]
            x_m, y_m = positions_m[0, index, :2] - axle_m
            initial_yaw_rad.append(float(np.arctan2(y_m, x_m)))
    return BodyTrajectories(positions_m, yaw_deg, kinds).add_trailers(initial_yaw_rad)


def _iterate_lane_poses(
    lanes: Sequence[Lane], lane_indices: Int64, lane_positions_m: Float64
) -> Iterator[tuple[slice | Int64, Float64]]:
    """Iterate over the agents of each lane and their poses (T, N, 3); consecutive agents are sliced without a copy."""
    order = np.argsort(lane_indices, kind="stable")
    for on_lane in np.split(order, np.flatnonzero(np.diff(lane_indices[order])) + 1):
        first, last = int(on_lane[0]), int(on_lane[-1])
        selection = slice(first, last + 1) if last - first == len(on_lane) - 1 else on_lane
        yield selection, lanes[lane_indices[first]].centerline.compute_poses(lane_positions_m[:, selection])


def get_center_offsets_m(kinds: Sequence[str]) -> Float64:
    """Return the distances (N,) of bodies ahead of the centers of their vehicles: not 0 with a trailer."""
    return np.array([HITCHES[kind].center_offset_m if kind in HITCHES else 0.0 for kind in kinds])


def find_nearby_agents(
    lanes: Sequence[Lane],
    agents: Sequence[Agent],
    lane_positions_m: Float64,
    frame_stride: int = 20,
    margin_m: float = 12.0,
) -> Int64:
    """Find agents that may come within `HORIZON_M` of the first agent.

    Args:
        lanes: Lanes.
        agents: N agents.
        lane_positions_m: (T, N) positions along the lanes.
        frame_stride: Distances are computed every so many frames, to save time.
        margin_m: Addition to the horizon for trailers, which are behind their agents.

    Returns:
        Ascending indices of agents, with 0.
    """
    num_frames = len(lane_positions_m)
    frames = np.unique(np.append(np.arange(0, num_frames, frame_stride), num_frames - 1))
    lane_positions_m = lane_positions_m[frames]
    positions_m = np.empty((*lane_positions_m.shape, 2))
    lane_indices = np.array([agent.lane_index for agent in agents])
    center_positions_m = lane_positions_m + get_center_offsets_m([agent.kind for agent in agents])
    for on_lane, poses in _iterate_lane_poses(lanes, lane_indices, center_positions_m):
        positions_m[:, on_lane] = poses[..., :2]
    distances_m = np.linalg.norm(positions_m - positions_m[:, :1], axis=2)
    # Agents never drive backwards: between two of these frames, two agents approach at most by the ways of both.
    steps_m = np.diff(lane_positions_m, axis=0, append=lane_positions_m[-1:])
    min_distances_m = (distances_m - steps_m - steps_m[:, :1]).min(axis=0)
    return np.flatnonzero(min_distances_m < HORIZON_M + margin_m)


def build_ego_actor(
    times_s: Float64,
    trajectories: BodyTrajectories,
    flow: TrafficHistory,
    ego_index: int,
    mesh: Mesh,
    generator: np.random.Generator,
    hills: Hills | None = None,
) -> Actor:
    """Build the ego vehicle, whose body tilts with acceleration, curves and the road.

    Args:
        times_s: (T,) evenly spaced times.
        trajectories: Poses on the ground plane.
        flow: Positions and speeds along the lanes.
        ego_index: Index of the ego vehicle.
        mesh: Mesh of the ego vehicle.
        generator: Random generator of the unevenness of the road.
        hills: Ground heights; a plane if None.
    """
    distance_m, speed_mps = flow.lane_positions_m[:, ego_index], flow.speeds_mps[:, ego_index]
    yaw_deg = trajectories.yaw_deg[:, ego_index]
    angles_deg = compute_attitude_deg(times_s, distance_m, speed_mps, yaw_deg, generator)
    positions_m = trajectories.positions_m[:, ego_index].copy()
    if hills is not None:
        heights_and_tilts = hills.compute_heights_and_tilts(positions_m[:, :2], yaw_deg)
        positions_m[:, 2] += heights_and_tilts[:, 0]
        angles_deg[:, 1:] += heights_and_tilts[:, 1:]
    return Actor(EGO, "car", mesh, Trajectory(times_s, positions_m, angles_deg))


def build_nearby_actors(
    times_s: Float64,
    trajectory_groups: Sequence[BodyTrajectories],
    ego: Actor,
    fleet: Fleet,
    hills: Hills | None = None,
) -> tuple[Actor, ...]:
    """Build actors of all bodies that come within `HORIZON_M` of the ego vehicle, except the ego vehicle.

    Args:
        times_s: (T,) evenly spaced times.
        trajectory_groups: Poses on the ground plane or on sidewalks.
        ego: Ego vehicle.
        fleet: Meshes of the bodies.
        hills: Ground heights; a plane if None.

    Returns:
        Actors; their trajectories cover the frames in which they are present, at least two.
    """
    actors: list[Actor] = []
    for group in trajectory_groups:
        # Distances are computed without hills and axis by axis, because there are very many bodies.
        squared_x_m2 = (group.positions_m[..., 0] - ego.trajectory.positions_m[:, None, 0]) ** 2
        squared_y_m2 = (group.positions_m[..., 1] - ego.trajectory.positions_m[:, None, 1]) ** 2
        distances_m = np.sqrt(np.fmin.reduce(squared_x_m2 + squared_y_m2, axis=0))
        bodies = np.flatnonzero((distances_m < HORIZON_M) & (np.array(group.kinds) != EGO))
        # Body by body, so that each trajectory is contiguous.
        positions_m = np.ascontiguousarray(group.positions_m[:, bodies].swapaxes(0, 1))
        angles_deg = np.zeros_like(positions_m)
        angles_deg[..., 0] = group.yaw_deg[:, bodies].T
        if hills is not None:
            is_walking = np.array([CATEGORIES[group.kinds[body]] == "pedestrian" for body in bodies], dtype=bool)
            positions_m[is_walking, :, 2] += hills.compute_heights_m(positions_m[is_walking, :, :2])
            heights_and_tilts = hills.compute_heights_and_tilts(
                positions_m[~is_walking, :, :2], angles_deg[~is_walking, :, 0]
            )
            positions_m[~is_walking, :, 2] += heights_and_tilts[..., 0]
            angles_deg[~is_walking, :, 1:] = heights_and_tilts[..., 1:]
        is_present = ~np.isnan(positions_m[..., 0])
        is_always_present: Bools = np.asarray(is_present.all(axis=1))
        # Trailers come after their towing vehicles and are named after them.
        names: dict[int, str] = {}
        for row, body in enumerate(bodies.tolist()):
            if np.count_nonzero(is_present[row]) < 2:
                continue
            kind = group.kinds[body]
            names[body] = f"{kind} {len(actors)}"
            if body >= len(group.kinds) - len(group.towing_indices):
                towing_body = group.towing_indices[body - len(group.kinds)]
                names[body] = REAR_OF + names.get(towing_body, names[body])
            frames = slice(None) if is_always_present[row] else is_present[row]
            trajectory = Trajectory(
                times_s[frames], positions_m[row, frames], angles_deg[row, frames], not is_always_present[row]
            )
            actors.append(Actor(names[body], CATEGORIES[kind], fleet.meshes[kind], trajectory))
    return tuple(actors)


@dataclass(frozen=True)
class AttitudeParams:
    """Tilt of a passenger car with soft springs.

    Args:
        pitch_deg_per_mps2: Pitch per deceleration; about 3 degrees at 1 g.
        roll_deg_per_mps2: Roll per lateral acceleration.
        max_pitch_deg: Limit of the springs.
        max_roll_deg: Limit of the springs.
        spring_time_s: Time constant of the damped springs.
        wavelengths_m: Wavelengths of the unevenness of the road, from a patch to a long swell.
        pitch_waves_deg: Amplitude of the pitch at each wavelength.
        roll_waves_deg: Amplitude of the roll at each wavelength.
    """

    pitch_deg_per_mps2: float = 0.3
    roll_deg_per_mps2: float = 0.4
    max_pitch_deg: float = 1.5
    max_roll_deg: float = 1.1
    spring_time_s: float = 0.35
    wavelengths_m: tuple[float, ...] = (9.0, 17.0, 37.0, 71.0)
    pitch_waves_deg: tuple[float, ...] = (0.08, 0.10, 0.10, 0.10)
    roll_waves_deg: tuple[float, ...] = (0.06, 0.08, 0.10, 0.14)


def compute_attitude_deg(
    times_s: Float64,
    distance_m: Float64,
    speed_mps: Float64,
    yaw_deg: Float64,
    generator: np.random.Generator,
    params: AttitudeParams = AttitudeParams(),
) -> Float64:
    """Compute the attitude of a car about the point on the road below its center.

    Braking lowers the nose (positive pitch); in a left curve the right side goes down (positive roll). The unevenness
    of the road depends on the distance alone: a standing car does not rock. A rigid body shows the travel of its
    springs at the wheels: a pitch of 1 degree about the point midway between the axles moves them by less than 3 cm.

    Args:
        times_s: (T,) evenly spaced times.
        distance_m: (T,) distances along the path.
        speed_mps: (T,) speeds.
        yaw_deg: (T,) headings.
        generator: Random generator of the phases of the unevenness.
        params: Springs and road.

    Returns:
        (T, 3) yaw, pitch and roll in degrees, with |pitch| < 2 and |roll| < 1.5.
    """
    forward_mps2 = np.gradient(speed_mps, times_s)
    leftward_mps2 = speed_mps * np.gradient(np.unwrap(np.deg2rad(yaw_deg)), times_s)
    pitch_deg = params.max_pitch_deg * np.tanh(-params.pitch_deg_per_mps2 * forward_mps2 / params.max_pitch_deg)
    roll_deg = params.max_roll_deg * np.tanh(params.roll_deg_per_mps2 * leftward_mps2 / params.max_roll_deg)
    angles_deg = [yaw_deg]
    for angle_deg, waves_deg in ((pitch_deg, params.pitch_waves_deg), (roll_deg, params.roll_waves_deg)):
        phases = generator.uniform(0, 2 * np.pi, size=len(waves_deg))
        waves = np.sin(2 * np.pi * distance_m[:, None] / np.array(params.wavelengths_m) + phases)
        angles_deg.append(smooth_exponentially(times_s, angle_deg, params.spring_time_s) + waves @ np.array(waves_deg))
    return np.stack(angles_deg, axis=1)


def smooth_exponentially(times_s: Float64, values: Float64, time_constant_s: float) -> Float64:
    """Smooth values by a first-order low-pass filter that is exact for each step.

    Args:
        times_s: (T,) ascending times.
        values: (T,) values.
        time_constant_s: Time constant of the filter.

    Returns:
        (T,) smoothed values; the first one is unchanged.
    """
    weights = 1.0 - np.exp(-np.diff(times_s) / time_constant_s)
    smoothed = values.copy()
    for index, weight in enumerate(weights):
        smoothed[index + 1] = smoothed[index] + weight * (values[index + 1] - smoothed[index])
    return smoothed
