"""Simulation of all road users that follow lanes: car following, traffic signals and priority at junctions.

Two rules keep a junction free of conflicts. No agent enters it without green, unless it is too close to stop when
yellow begins. No agent enters it while an agent of the other phase is inside or committed to enter, so that green does
not let anyone drive into vehicles that are held up on the junction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.memory import check_memory_fits
from torchcover.simulation.traffic.alignment import OffsetPath, Polyline
from torchcover.simulation.traffic.idm import (
    Driver,
    FloatOrArray,
    compute_acceleration_mps2,
    compute_gap_ratio,
    integrate_motion,
)
from torchcover.simulation.traffic.junctions import JunctionPassage, JunctionPassageTable, TrafficSignals

# Longest step of a simulation; frames that are farther apart are divided into several steps.
MAX_STEP_S = 0.1
# Distance of the entries of `Lane.speed_limits_mps`.
SPEED_LIMIT_SPACING_M = 2.0


@dataclass(frozen=True)
class JunctionParams:
    """Behavior at junctions.

    Args:
        max_braking_mps2: Agents that would have to brake harder for a signal go on; harder than comfortable, softer
            than in an emergency.
        stop_distance_m: Distance of a stopped front to the stop line.
        queue_speed_share: A vehicle behind the junction is a queue, for which no agent enters, if it is slower than
            this share of the desired speed of the agent.
    """

    max_braking_mps2: float = 2.5
    stop_distance_m: float = 0.5
    queue_speed_share: float = 0.15


@dataclass(frozen=True, eq=False)
class Lane:
    """Line that agents follow in one direction.

    Args:
        centerline: The line.
        passages: Junctions on the line, in order.
        speed_limits_mps: (K,) speeds at which curves can be driven, every `SPEED_LIMIT_SPACING_M` from 0 m; None
            without limits.
    """

    centerline: Polyline | OffsetPath
    passages: tuple[JunctionPassage, ...] = ()
    speed_limits_mps: Float64 | None = None


@dataclass(frozen=True, eq=False)
class Agent:
    """Road user on a lane, at the start of a simulation.

    Args:
        kind: Body.
        length_m: Length from bumper to bumper.
        lane_index: Index of the lane.
        lane_position_m: Position of the center along the lane.
        driver: Driver.
    """

    kind: str
    length_m: float
    lane_index: int
    lane_position_m: float
    driver: Driver


class TrafficHistory(NamedTuple):
    """Result of a simulation of N agents at T times, with J junctions.

    Args:
        lane_positions_m: (T, N) positions of the centers along the lanes.
        speeds_mps: (T, N) speeds.
        occupied_phases: (T, J, 2) whether agents of a phase are on a junction or committed to enter.
    """

    lane_positions_m: Float64
    speeds_mps: Float64
    occupied_phases: Bools


class LaneSimulation:
    """Simulation of N agents on L lanes without lane changes.

    Args:
        lanes: Lanes.
        agents: Agents, which must neither overlap nor stand on a junction.
        signals: Traffic signals.
        params: Behavior at junctions.
    """

    def __init__(
        self,
        lanes: Sequence[Lane],
        agents: Sequence[Agent],
        signals: TrafficSignals,
        params: JunctionParams = JunctionParams(),
    ) -> None:
        self.lane_positions_m = np.array([agent.lane_position_m for agent in agents], dtype=np.float64)
        self._params = params
        self._length_m = np.array([agent.length_m for agent in agents], dtype=np.float64)
        lane_indices = np.array([agent.lane_index for agent in agents])
        self._driver = Driver.stack([agent.driver for agent in agents])
        self._leader, self._lap_m = find_leaders(lanes, lane_indices, self.lane_positions_m)
        leader_length_m = self._length_m[self._leader]
        self._half_length_m, self._leader_half_length_m = self._length_m / 2, leader_length_m / 2
        self._min_spacing_m = (self._length_m + leader_length_m) / 2
        self._queue_speed_mps = params.queue_speed_share * self._driver.desired_speed_mps
        self._signals = signals
        self._passages = JunctionPassageTable.from_lanes([lane.passages for lane in lanes])
        self._speed_limits = SpeedLimitTable(lanes, lane_indices)
        # For each agent the passage that it is on, or else the next one ahead, and its positions.
        self._passage = np.empty(len(agents), dtype=np.int64)
        self._stop_line_m, self._exit_m, self._clear_position_m = np.empty((3, len(agents)))
        for lane_index in np.unique(lane_indices):
            members = np.flatnonzero(lane_indices == lane_index)
            rear_m = self.lane_positions_m[members] - self._half_length_m[members]
            self._set_passages(members, self._passages.find_next(int(lane_index), rear_m))
        self.speeds_mps = self._compute_initial_speeds_mps()
        self._update_junctions()

    def run(self, times_s: Float64, warm_up_s: float = 0.0) -> TrafficHistory:
        """Simulate and record the state at each time.

        Args:
            times_s: (T,) ascending times of the frames.
            warm_up_s: Duration that is simulated before the first frame.
        """
        positions_m, speeds_mps = np.empty((2, len(times_s), len(self.lane_positions_m)))
        is_occupied = np.empty((len(times_s), len(self._signals.offset_s), 2), dtype=bool)
        starts_s = [float(times_s[0]) - warm_up_s, *times_s[:-1].tolist()]
        durations_s = [warm_up_s, *np.diff(times_s).tolist()]
        step_counts = [int(np.ceil(duration_s / MAX_STEP_S - 1e-9)) for duration_s in durations_s]
        # Signals depend on the time alone: their state at all steps is computed at once.
        step_times_s = []
        for start_s, duration_s, count in zip(starts_s, durations_s, step_counts, strict=True):
            step_times_s += [start_s + step * duration_s / count for step in range(count)]
        has_red_by_step = iter(self._find_red_passages(step_times_s))
        for frame_index, count in enumerate(step_counts):
            for _ in range(count):
                self._simulate_step(next(has_red_by_step), durations_s[frame_index] / count)
            positions_m[frame_index], speeds_mps[frame_index] = self.lane_positions_m, self.speeds_mps
            is_occupied[frame_index] = self._is_occupied.reshape(-1, 2)
        return TrafficHistory(positions_m, speeds_mps, is_occupied)

    def _find_red_passages(self, times_s: Sequence[float]) -> Bools:
        """Find passages (T, K) without green, or with too little of it."""
        remaining_s = self._signals.compute_remaining_green_s(times_s).reshape(len(times_s), -1)
        return ~(remaining_s[:, self._passages.phase_indices] > self._passages.min_green_s)

    def _simulate_step(self, has_red: Bools, step_s: float) -> None:
        """Simulate one step with the given red passages (K,)."""
        driver, speed_mps = self._driver, self.speeds_mps
        leader_m, leader_mps = self._compute_leader_positions_m(), speed_mps.take(self._leader)
        gap_m = self._compute_gaps_m(leader_m)
        must_stop = (has_red | self._is_occupied[self._passages.conflicting_phase_indices])[self._passage]
        # A queue behind the junction would force the agent to stop on it.
        leader_rear_m = leader_m - self._leader_half_length_m
        is_leader_behind_junction = (leader_rear_m > self._stop_line_m) & (leader_rear_m < self._clear_position_m)
        must_stop |= is_leader_behind_junction & (leader_mps < self._queue_speed_mps)
        must_stop &= ~self._is_committed
        # Stop lines that may be crossed count as infinitely far away.
        free_distance_m = np.where(must_stop, self._distance_to_line_m, np.inf)
        stop_gap_m = free_distance_m + driver.standstill_gap_m
        stop_gap_m -= self._params.stop_distance_m
        gap_ratio = compute_gap_ratio(driver, speed_mps, gap_m, speed_mps - leader_mps)
        np.maximum(gap_ratio, compute_gap_ratio(driver, speed_mps, stop_gap_m, speed_mps), out=gap_ratio)
        desired_mps = self._speed_limits.limit_speeds_mps(self.lane_positions_m, driver.desired_speed_mps)
        acceleration_mps2 = compute_acceleration_mps2(driver, speed_mps, gap_ratio, desired_mps)
        distance_m, self.speeds_mps = integrate_motion(
            speed_mps, acceleration_mps2, np.minimum(gap_m, free_distance_m), step_s
        )
        self.lane_positions_m += distance_m
        (passed,) = (self.lane_positions_m - self._half_length_m > self._exit_m).nonzero()
        if len(passed):
            self._set_passages(passed, self._passage[passed] + 1)
        self._update_junctions()

    def _set_passages(self, agents: Int64, passages: Int64) -> None:
        """Set the current passages of agents."""
        self._passage[agents] = passages
        self._stop_line_m[agents] = self._passages.stop_lines_m[passages]
        self._exit_m[agents] = self._passages.exits_m[passages]
        # Behind the junction, an agent needs room for its length and the gap to the vehicle ahead.
        standstill_gap_m = np.asarray(self._driver.standstill_gap_m)[agents]
        self._clear_position_m[agents] = self._exit_m[agents] + self._length_m[agents] + standstill_gap_m

    def _compute_leader_positions_m(self) -> Float64:
        """Compute the position (N,) of the agent ahead; infinite for the first on a lane."""
        leader_m = self.lane_positions_m.take(self._leader)
        leader_m += self._lap_m
        return leader_m

    def _compute_gaps_m(self, leader_m: Float64) -> Float64:
        """Compute the gap (N,) to the agent ahead, bumper to bumper."""
        gap_m = leader_m - self.lane_positions_m
        gap_m -= self._min_spacing_m
        return gap_m

    def _update_junctions(self) -> None:
        """Update distances to stop lines (N,), agents committed to a junction (N,), and occupied phases (2 J,)."""
        self._distance_to_line_m = self._stop_line_m - self.lane_positions_m
        self._distance_to_line_m -= self._half_length_m
        self._is_committed = self.speeds_mps**2 > 2 * self._params.max_braking_mps2 * self._distance_to_line_m
        self._is_occupied = np.zeros(2 * len(self._signals.offset_s), dtype=bool)
        self._is_occupied[self._passages.phase_indices[self._passage[self._is_committed]]] = True

    def _compute_initial_speeds_mps(self) -> Float64:
        """Compute high speeds (N,) from which agents can still stop at the next line and keep their gaps."""
        distance_to_line_m = np.maximum(self._stop_line_m - self.lane_positions_m - self._half_length_m, 0.0)
        stopping_mps = np.sqrt(self._driver.deceleration_mps2 * distance_to_line_m)
        gap_m = self._compute_gaps_m(self._compute_leader_positions_m()) - self._driver.standstill_gap_m
        following_mps = np.maximum(gap_m, 0.0) / self._driver.headway_s
        desired_mps = self._speed_limits.limit_speeds_mps(self.lane_positions_m, self._driver.desired_speed_mps)
        return np.asarray(np.minimum(0.95 * desired_mps, np.minimum(stopping_mps, following_mps)))


class SpeedLimitTable:
    """Speed limits on the lanes of N agents.

    Args:
        lanes: Lanes.
        lane_indices: (N,) lane of each agent.
    """

    def __init__(self, lanes: Sequence[Lane], lane_indices: Int64) -> None:
        no_limit = np.array([np.inf])
        tables = [no_limit if lane.speed_limits_mps is None else lane.speed_limits_mps for lane in lanes]
        # Tables of all lanes in one array; positions beyond the ends use the first or last entry of the lane.
        first_entries = np.cumsum([0, *(len(table) for table in tables)])
        self._limits_mps = np.concatenate(tables)
        self._has_limits = any(lane.speed_limits_mps is not None for lane in lanes)
        self._first, self._last = first_entries[lane_indices], first_entries[lane_indices + 1] - 1

    def limit_speeds_mps(self, lane_positions_m: Float64, desired_mps: FloatOrArray) -> FloatOrArray:
        """Limit desired speeds (N,) to the speed limits at positions (N,)."""
        if not self._has_limits:
            return desired_mps
        entry = (lane_positions_m / SPEED_LIMIT_SPACING_M).astype(np.int64)
        entry += self._first
        np.minimum(entry, self._last, out=entry)
        np.maximum(entry, self._first, out=entry)
        return np.asarray(np.minimum(self._limits_mps.take(entry), desired_mps))


def check_traffic_memory(num_agents: float, num_frames: int) -> None:
    """Check that a simulation fits into memory, before its agents are created.

    Args:
        num_agents: Expected number of agents.
        num_frames: Number of frames.

    Raises:
        ValueError: It does not fit.
    """
    bytes_per_state = 128  # position, speed, pose and yaw, and their copies
    check_memory_fits(
        f"traffic of about {num_agents:,.0f} for {num_frames:,} time steps",
        bytes_per_state * num_agents * num_frames,
        "shorten the duration, or lower the density of the traffic",
    )


def find_leaders(lanes: Sequence[Lane], lane_indices: Int64, lane_positions_m: Float64) -> tuple[Int64, Float64]:
    """Find the agent ahead of each of N agents on the same lane.

    Args:
        lanes: Lanes.
        lane_indices: (N,) lane of each agent.
        lane_positions_m: (N,) positions along the lanes.

    Returns:
        (N,) indices of the agents ahead, and (N,) offsets of their positions in meters: the length of a loop if the
        agent ahead is the last one on it, infinite if there is none, else 0.
    """
    leader, offset_m = np.zeros(len(lane_indices), dtype=np.int64), np.zeros(len(lane_indices))
    for lane_index in np.unique(lane_indices):
        members = np.flatnonzero(lane_indices == lane_index)
        members = members[np.argsort(-lane_positions_m[members], kind="stable")]
        leader[members[1:]] = members[:-1]
        centerline = lanes[lane_index].centerline
        offset_m[members[0]] = np.inf
        if centerline.is_closed and len(members) > 1:
            leader[members[0]] = members[-1]
            offset_m[members[0]] = centerline.length_m
    return leader, offset_m
