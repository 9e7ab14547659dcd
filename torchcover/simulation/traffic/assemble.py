"""From places on lanes to a world: poses, the tilt of the ego vehicle, and people who cross a carriageway."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import CATEGORIES, DRAWS, EGO, REAR_OF, Fleet, compute_trailer_poses
from torchcover.simulation.traffic.flow import Agent, Lane, TrafficHistory
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import PAVEMENT_M
from torchcover.simulation.world import Actor

# Probability to take the first chance after a stay, instead of waiting for another.
EAGERNESS = 0.8
MAX_STAY_S = 12.0


@dataclass(frozen=True, eq=False)
class Footpath:
    """A straight way from one (2,) waiting place to another, with a kerb `curb_distance_m` behind both, or none."""

    start_m: Float64
    end_m: Float64
    curb_distance_m: float | None = None

    @property
    def length_m(self) -> float:
        """From one waiting place to the other."""
        return float(np.linalg.norm(self.end_m - self.start_m))

    def compute_poses(self, fractions: Float64, is_returning: Bools, body_radius_m: float) -> tuple[Float64, Float64]:
        """(T, 3) positions and (T,) headings in degrees of who has gone (T,) shares of the way, forth or back.

        The body steps down when all of it, so far from its middle, is past the kerb.
        """
        way = self.end_m - self.start_m
        yaw = np.rad2deg(np.arctan2(way[1], way[0])) + 180.0 * is_returning
        position = self.start_m + fractions[:, None] * way
        if self.curb_distance_m is None:
            height = np.zeros(len(fractions))
        else:
            height = compute_step_height_m(
                np.minimum(fractions, 1 - fractions) * self.length_m - self.curb_distance_m, body_radius_m
            )
        return np.column_stack([position, height]), yaw


def simulate_walking(
    path: Footpath,
    can_start: Bools,
    traversal_s: float,
    times_s: Float64,
    body_radius_m: float,
    generator: np.random.Generator,
) -> tuple[Float64, Float64]:
    """Go to and fro on a path, `traversal_s` each way: (T, 3) positions and (T,) headings in degrees at even times.

    One sets off only when one may, (T,), as who does then finds the way free until the end.
    """
    count, step_s = len(can_start), float(times_s[1] - times_s[0])
    chances = np.flatnonzero(can_start)
    steps = int(np.ceil(traversal_s / step_s))
    back = bool(generator.random() < 0.5)
    share, faces_start = np.full(count, float(back)), np.full(count, back)
    now = 0
    while True:
        now += round(generator.uniform(0.0, MAX_STAY_S) / step_s)
        ahead = chances[np.searchsorted(chances, now) :]
        if len(ahead) == 0:
            return path.compute_poses(share, faces_start, body_radius_m)
        set_off = int(ahead[0])
        now = set_off + 1
        if generator.random() < EAGERNESS:
            gone = np.clip((np.arange(count) - set_off) / steps, 0.0, 1.0)[set_off:]
            share[set_off:] = 1.0 - gone if back else gone
            arrived = set_off + steps
            faces_start[arrived:] = not back
            back, now = not back, arrived


def compute_step_height_m(beyond_curb_m: Float64, body_radius_m: float | Float64) -> Float64:
    """Height of the feet of somebody whose middle is so far beyond the kerb, on the carriageway's side."""
    stepping = (beyond_curb_m - body_radius_m) / PAVEMENT_M
    return PAVEMENT_M * (1.0 - np.clip(stepping, 0.0, 1.0))


def is_free_for(blocked: Bools, duration_s: float, step_s: float) -> Bools:
    """(T,) whether nothing is blocked from each time on for a duration; what is after the last time counts as free."""
    steps = int(np.ceil(duration_s / step_s))
    before = np.concatenate([[0], np.cumsum(blocked)])
    here = np.arange(len(blocked))
    return np.asarray(before[np.minimum(here + steps + 1, len(blocked))] == before[here])


# Beyond the farthest range of a sensor: who never comes this close to the ego is left out of the world.
HORIZON_M = 250.0
# Where it is found out at first who may come so close, trailers are behind who draws them.
SLACK_M = 12.0
LOOKS_EVERY = 20
# A soft-sprung passenger car: it dives by some 3 degrees at 1 g, and leans a little more in a curve.
PITCH_DEG_PER_MPS2 = 0.3
ROLL_DEG_PER_MPS2 = 0.4
# The springs do not go farther, and bumpers sit on the axles behind them.
MAX_SPRING_PITCH_DEG, MAX_SPRING_ROLL_DEG = 1.5, 1.1
SPRING_TIME_S = 0.35
# Unevenness of a road: shares of one bump's angle at wavelengths from a patch to a long swell.
WAVELENGTHS_M = np.array([9.0, 17.0, 37.0, 71.0])
PITCH_WAVES_DEG = np.array([0.08, 0.10, 0.10, 0.10])
ROLL_WAVES_DEG = np.array([0.06, 0.08, 0.10, 0.14])


class BodyTrajectories(NamedTuple):
    """Where N bodies are at T times: `positions_m` (T, N, 3), `yaw_deg` (T, N), and the N `kinds`.

    The last of them are drawn along, by those whose numbers are `towing_indices`.
    """

    positions_m: Float64
    yaw_deg: Float64
    kinds: tuple[str, ...]
    towing_indices: tuple[int, ...] = ()

    @classmethod
    def from_bodies(cls, bodies: Sequence[tuple[Float64, Float64, str]]) -> "BodyTrajectories":
        """Those of bodies with (T, 3) positions, (T,) headings in degrees and a kind each."""
        positions_m, yaw_deg, kinds = zip(*bodies, strict=True)
        return cls(np.stack(positions_m, axis=1), np.stack(yaw_deg, axis=1), kinds)

    def add_trailers(self, initial_yaw_rad: Sequence[float] | None = None) -> "BodyTrajectories":
        """And all that these bodies draw along, with headings in radians at first; straight behind if not given."""
        fronts = tuple(number for number, kind in enumerate(self.kinds) if kind in DRAWS)
        own = [np.column_stack([self.positions_m[:, k, :2], np.deg2rad(self.yaw_deg[:, k])]) for k in fronts]
        if not fronts:
            return self
        poses = np.stack(compute_trailer_poses([self.kinds[front] for front in fronts], own, initial_yaw_rad), axis=1)
        positions_m = np.concatenate([self.positions_m, poses * [1.0, 1.0, 0.0]], axis=1)
        yaw_deg = np.concatenate([self.yaw_deg, np.rad2deg(poses[..., 2])], axis=1)
        return BodyTrajectories(
            positions_m, yaw_deg, (*self.kinds, *(DRAWS[self.kinds[front]].trailer_kind for front in fronts)), fronts
        )


def compute_body_trajectories(
    lanes: Sequence[Lane], agents: Sequence[Agent], lane_positions_m: Float64
) -> BodyTrajectories:
    """Follow the lanes, on the ground, to (T, N) places on them; what is drawn along comes behind."""
    positions_m, yaw_deg = np.zeros((*lane_positions_m.shape, 3)), np.empty(lane_positions_m.shape)
    lane_of, kinds = np.array([agent.lane_index for agent in agents]), tuple(agent.kind for agent in agents)
    lane_positions_m = lane_positions_m + get_center_offsets_m(kinds)
    for on_lane, poses in _along(lanes, lane_of, lane_positions_m):
        positions_m[:, on_lane, :2], yaw_deg[:, on_lane] = poses[..., :2], poses[..., 2]
    start = []
    for number in [number for number, kind in enumerate(kinds) if kind in DRAWS]:
        # At first the axles are on the lane, too.
        back_m = DRAWS[kinds[number]].hitch_to_axle_m - DRAWS[kinds[number]].hitch_offset_m
        (axles_m,) = lanes[lane_of[number]].centerline.compute_poses(lane_positions_m[:1, number] - back_m)[:, :2]
        start.append(float(np.arctan2(*(positions_m[0, number, :2] - axles_m)[::-1])))
    return BodyTrajectories(positions_m, yaw_deg, kinds).add_trailers(start)


def _along(lanes: Sequence[Lane], lane_of: Int64, place_m: Float64) -> Iterator[tuple[slice | Int64, Float64]]:
    """Those on the same lane, and their (T, N, 3) poses. Mostly they are numbered in turn, and taken without a copy."""
    order = np.argsort(lane_of, kind="stable")
    for on_lane in np.split(order, np.flatnonzero(np.diff(lane_of[order])) + 1):
        first, last = int(on_lane[0]), int(on_lane[-1])
        some = slice(first, last + 1) if last - first == len(on_lane) - 1 else on_lane
        yield some, lanes[lane_of[first]].centerline.compute_poses(place_m[:, some])


def get_center_offsets_m(kinds: Sequence[str]) -> Float64:
    """(N,) how far the middles of bodies are before those of all that belongs to them."""
    return np.array([DRAWS[kind].center_offset_m if kind in DRAWS else 0.0 for kind in kinds])


def find_nearby_agents(lanes: Sequence[Lane], agents: Sequence[Agent], lane_positions_m: Float64) -> Int64:
    """Numbers of those who may come near the first one, who is among them; they are looked at now and then only."""
    looks = np.unique(np.append(np.arange(0, len(lane_positions_m), LOOKS_EVERY), len(lane_positions_m) - 1))
    seen_m = lane_positions_m[looks]
    positions_m, lane_of = np.empty((*seen_m.shape, 2)), np.array([agent.lane_index for agent in agents])
    for on_lane, poses in _along(lanes, lane_of, seen_m + get_center_offsets_m([agent.kind for agent in agents])):
        positions_m[:, on_lane] = poses[..., :2]
    distance_m = np.linalg.norm(positions_m - positions_m[:, :1], axis=2)
    # Nobody drives back: between two looks, the two come closer by the ways of both at most.
    ways_m = np.diff(seen_m, axis=0, append=seen_m[-1:])
    nearest_m = (distance_m - ways_m - ways_m[:, :1]).min(axis=0)
    return np.flatnonzero(nearest_m < HORIZON_M + SLACK_M)


def build_ego_actor(
    times_s: Float64,
    trajectories: BodyTrajectories,
    flow: TrafficHistory,
    ego_index: int,
    mesh: Mesh,
    generator: np.random.Generator,
    hills: Hills | None = None,
) -> Actor:
    """The ego, one of those who follow lanes, with a body that tilts; on a plain if there are no hills."""
    way, speed = flow.lane_positions_m[:, ego_index], flow.speeds_mps[:, ego_index]
    angles = compute_attitude_deg(times_s, way, speed, trajectories.yaw_deg[:, ego_index], generator)
    positions_m = trajectories.positions_m[:, ego_index].copy()
    if hills is not None:
        stances = hills.compute_heights_and_tilts(positions_m[:, :2], trajectories.yaw_deg[:, ego_index])
        positions_m[:, 2] += stances[:, 0]
        angles[:, 1:] += stances[:, 1:]
    return Actor(EGO, "car", mesh, Trajectory(times_s, positions_m, angles))


def build_nearby_actors(
    times_s: Float64,
    trajectory_groups: Sequence[BodyTrajectories],
    ego: Actor,
    fleet: Fleet,
    hills: Hills | None = None,
) -> tuple[Actor, ...]:
    """All who ever come near the ego, in groups; the ego itself is left out. NaN where somebody is not there."""
    near: list[Actor] = []
    for group in trajectory_groups:
        # On the level, and one axis after the other: hills come later, and this is done for very many.
        x_m, y_m = ((group.positions_m[..., k] - ego.trajectory.positions_m[:, None, k]) ** 2 for k in (0, 1))
        distance = np.sqrt(np.fmin.reduce(x_m + y_m, axis=0))
        numbers = np.flatnonzero((distance < HORIZON_M) & (np.array(group.kinds) != EGO))
        # One body after the other: each has its own piece of both.
        positions_m = np.ascontiguousarray(group.positions_m[:, numbers].swapaxes(0, 1))
        angles_deg = np.zeros_like(positions_m)
        angles_deg[..., 0] = group.yaw_deg[:, numbers].T
        if hills is not None:
            on_foot = np.array([CATEGORIES[group.kinds[number]] == "pedestrian" for number in numbers], dtype=bool)
            positions_m[on_foot, :, 2] += hills.compute_heights_m(positions_m[on_foot, :, :2])
            stances = hills.compute_heights_and_tilts(positions_m[~on_foot, :, :2], angles_deg[~on_foot, :, 0])
            positions_m[~on_foot, :, 2] += stances[..., 0]
            angles_deg[~on_foot, :, 1:] = stances[..., 1:]
        there = ~np.isnan(positions_m[..., 0])
        always = np.array([all_along.all() for all_along in there], dtype=bool)
        names = dict[int, str]()
        for row, number in enumerate(numbers.tolist()):
            kind, some = group.kinds[number], slice(None) if always[row] else there[row]
            if np.count_nonzero(there[row]) < 2:
                continue
            trajectory = Trajectory(times_s[some], positions_m[row, some], angles_deg[row, some], not always[row])
            names[number] = f"{kind} {len(near)}"
            if number >= len(group.kinds) - len(group.towing_indices):
                front = group.towing_indices[number - len(group.kinds)]
                names[number] = REAR_OF + names.get(front, names[number])
            near.append(Actor(names[number], CATEGORIES[kind], fleet.meshes[kind], trajectory))
    return tuple(near)


def compute_attitude_deg(
    times_s: Float64, distance_m: Float64, speed_mps: Float64, yaw_deg: Float64, generator: np.random.Generator
) -> Float64:
    """(T, 3) yaw, pitch and roll in degrees of a car about the point on the road under its middle.

    The wheels of a car pivot about a point midway between the axles, so a pitch of 1 degree lifts or lowers them by
    under 3 cm: the springs' stroke, which a rigid body has to show at its wheels. |pitch| < 2 and |roll| < 1.5 degrees.
    Braking turns the nose down (positive pitch); in a left-hand curve the right side goes down (positive roll). The
    road's unevenness depends on the way alone, so a standing car does not rock. Times are evenly spaced.
    """
    forward = np.gradient(speed_mps, times_s)
    leftward = speed_mps * np.gradient(np.unwrap(np.deg2rad(yaw_deg)), times_s)
    pitch = _limit(-PITCH_DEG_PER_MPS2 * forward, MAX_SPRING_PITCH_DEG)
    roll = _limit(ROLL_DEG_PER_MPS2 * leftward, MAX_SPRING_ROLL_DEG)
    pitch = _settle(times_s, pitch) + _unevenness(distance_m, PITCH_WAVES_DEG, generator)
    roll = _settle(times_s, roll) + _unevenness(distance_m, ROLL_WAVES_DEG, generator)
    return np.stack([yaw_deg, pitch, roll], axis=1)


def _limit(angle_deg: Float64, largest_deg: float) -> Float64:
    return largest_deg * np.tanh(angle_deg / largest_deg)


def _settle(times_s: Float64, wanted_deg: Float64) -> Float64:
    """Follow the wanted angle with the delay of a damped spring (a first-order low pass, exact for each step)."""
    share = 1.0 - np.exp(-np.diff(times_s) / SPRING_TIME_S)
    settled = wanted_deg.copy()
    for step, part in enumerate(share):
        settled[step + 1] = settled[step] + part * (wanted_deg[step + 1] - settled[step])
    return settled


def _unevenness(way_m: Float64, waves_deg: Float64, generator: np.random.Generator) -> Float64:
    phase = generator.uniform(0, 2 * np.pi, size=len(WAVELENGTHS_M))
    return np.asarray(np.sin(2 * np.pi * way_m[:, None] / WAVELENGTHS_M + phase) @ waves_deg)
