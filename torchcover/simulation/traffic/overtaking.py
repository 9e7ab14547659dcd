"""Simulation of a motorway with lane changes.

Drivers decide by MOBIL in its form for countries in which one keeps to the right and overtakes on the left (Kesting,
Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation Research Record 1999,
2007): a change must be worth it and must not force anyone to brake hard. During a change an agent occupies both lanes:
agents behind in either lane keep their distance, and the agent keeps its distance from those ahead in either lane.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.traffic.fleet import BODY_KINDS
from torchcover.simulation.traffic.flow import MAX_STEP_S, Agent, TrafficHistory
from torchcover.simulation.traffic.idm import (
    Driver,
    compute_acceleration_mps2,
    compute_gap_ratio,
    compute_max_truck_acceleration_mps2,
    integrate_motion,
)

# Lanes of a direction, from the median outwards; the last one is the auxiliary lane, for entering and exiting.
LANES = 4
SIDE_LANE = LANES - 1
RAMP_MPS = 22.0  # speed on ramps


@dataclass(frozen=True)
class LaneChangeParams:
    """Parameters of MOBIL and of the drivers on a motorway.

    Args:
        min_gain_mps2: Acceleration that a change must gain (MOBIL's threshold).
        keep_right_mps2: Bias of the gain to the right (MOBIL's bias).
        max_braking_mps2: Braking that a change may force on an agent (MOBIL's safe deceleration).
        politeness: Weight of the gain of other agents (MOBIL's politeness factor).
        min_flow_speed_mps: Speed on the left lane above which agents do not pass on the right.
        min_headway_s: Shortest gap that is large enough for a change, however fast it grows.
        mandatory_gain_mps2: Gain of entering and exiting, which is above all others: such a change only must be safe.
        decision_interval_s: Time between decisions; at each one a part of the agents decides.
        num_turns: Number of parts into which agents are divided.
        min_start_distance_m: Distance of changes that begin at the same time, so that two never take the same gap.
        duration_s: Shortest and longest duration of a change.
        min_length_m: Shortest length of a change.
        occupied_share: Share of a change during which the agent occupies both lanes.
        exit_braking_mps2: Braking before the exit ramp.
        min_exit_distance_m: Distance to the end of an auxiliary lane below which no change to it or from it begins.
        speed_variation: Relative amplitude of the desired speed, since no driver holds a speed.
        variation_period_s: Shortest and longest period of this variation.
    """

    min_gain_mps2: float = 0.2
    keep_right_mps2: float = 0.3
    max_braking_mps2: float = 2.0
    politeness: float = 0.2
    min_flow_speed_mps: float = 16.7
    min_headway_s: float = 0.6
    mandatory_gain_mps2: float = 100.0
    decision_interval_s: float = 1.0
    num_turns: int = 2
    min_start_distance_m: float = 120.0
    duration_s: tuple[float, float] = (4.5, 6.5)
    min_length_m: float = 30.0
    occupied_share: float = 0.7
    exit_braking_mps2: float = 1.2
    min_exit_distance_m: float = 160.0
    speed_variation: float = 0.03
    variation_period_s: tuple[float, float] = (15.0, 40.0)


class LaneChange(NamedTuple):
    """Lane change of an agent.

    Args:
        agent_index: Index of the agent.
        old_lane_index: Lane before the change.
        new_lane_index: Lane after the change.
        start_m: Position along the lane at which the change begins.
        length_m: Length of the change along the lane.
    """

    agent_index: int
    old_lane_index: int
    new_lane_index: int
    start_m: float
    length_m: float

    def compute_progress(self, lane_positions_m: Float64) -> tuple[Float64, Float64]:
        """Compute the progress of the change at positions (...): fractions (...) and their derivatives in 1/m."""
        part = np.clip((lane_positions_m - self.start_m) / self.length_m, 0.0, 1.0)
        return part**3 * (10 - 15 * part + 6 * part**2), 30 * (part * (1 - part)) ** 2 / self.length_m


class LaneChangeSimulation:
    """Simulation of N agents on both directions of a motorway: lanes 0 to 3 of the first, 4 to 7 of the second.

    Args:
        agents: Agents, which must not overlap.
        is_heavy: (N,) agents that keep out of the lane at the median.
        is_exiting: (N,) agents that take the exit, from the lane next to the auxiliary lane.
        auxiliary_spans_m: (2, 2) positions between which the auxiliary lane of each direction lies next to the other
            lanes; it is an entry ramp before and an exit ramp behind.
        generator: Random generator of durations and speed variations.
        slope_profile: (2, K) ascending positions along the first direction, and the slopes there.
        params: Behavior of drivers.
    """

    def __init__(
        self,
        agents: Sequence[Agent],
        is_heavy: Bools,
        is_exiting: Bools,
        auxiliary_spans_m: Float64,
        generator: np.random.Generator,
        slope_profile: Float64,
        params: LaneChangeParams = LaneChangeParams(),
    ) -> None:
        num_agents = len(agents)
        self.lane_positions_m = np.array([agent.lane_position_m for agent in agents], dtype=np.float64)
        self.lane_indices = np.array([agent.lane_index for agent in agents], dtype=np.int64)
        self.lane_changes: list[LaneChange] = []
        self._params = params
        self._length_m = np.array([agent.length_m for agent in agents], dtype=np.float64)
        self._driver = Driver.stack([agent.driver for agent in agents])
        self._is_heavy, self._is_exiting = is_heavy, is_exiting
        self._auxiliary_spans_m, self._slope_profile = auxiliary_spans_m, slope_profile
        is_truck = np.array([BODY_KINDS.get(agent.kind) in ("truck", "lorry") for agent in agents], dtype=bool)
        self._trucks = np.flatnonzero(is_truck)
        # In the second direction, positions and slopes have the opposite sign.
        self._truck_directions = np.where(self.lane_indices[self._trucks] < LANES, 1.0, -1.0)
        self._change_duration_s = generator.uniform(*params.duration_s, num_agents)
        self._variation_rad_per_s = 2 * np.pi / generator.uniform(*params.variation_period_s, num_agents)
        self._variation_phase_rad = generator.uniform(0, 2 * np.pi, num_agents)
        self._next_change_m = np.full(num_agents, -np.inf)
        self._active_changes: list[LaneChange] = []
        self._turn = 0
        self._next_decision_s = params.decision_interval_s
        self._time_s = 0.0
        self.speeds_mps = np.zeros(num_agents)
        self._update_order()
        free_gap_m = np.maximum(self._compute_gaps_m()[:num_agents] - self._driver.standstill_gap_m, 0.0)
        self._desired_mps = self._compute_desired_speeds_mps()
        self.speeds_mps = np.minimum(0.95 * self._desired_mps, free_gap_m / self._driver.headway_s)
        self._acceleration_mps2 = np.zeros(num_agents)

    def run(self, times_s: Float64, warm_up_s: float) -> TrafficHistory:
        """Simulate and record the state at each time.

        Args:
            times_s: (T,) ascending times of the frames.
            warm_up_s: Duration that is simulated before the first frame.
        """
        positions_m, speeds_mps = np.empty((2, len(times_s), len(self.lane_positions_m)))
        durations_s = [warm_up_s, *np.diff(times_s).tolist()]
        for frame_index, duration_s in enumerate(durations_s):
            num_steps = int(np.ceil(duration_s / MAX_STEP_S - 1e-9))
            for _ in range(num_steps):
                self._simulate_step(duration_s / num_steps)
            positions_m[frame_index], speeds_mps[frame_index] = self.lane_positions_m, self.speeds_mps
        return TrafficHistory(positions_m, speeds_mps, np.zeros((len(times_s), 0, 2), dtype=bool))

    def _simulate_step(self, step_s: float) -> None:
        """Simulate one step."""
        num_agents, speed_mps = len(self.lane_positions_m), self.speeds_mps
        gap_m, member_speed_mps = self._compute_gaps_m(), speed_mps.take(self._members)
        closing_mps = member_speed_mps - speed_mps.take(self._leader)
        gap_ratio = compute_gap_ratio(self._member_drivers, member_speed_mps, gap_m, closing_mps)
        # Agents in two lanes obey the stricter of both.
        changing = self._members[num_agents:]
        gap_ratio[changing] = np.maximum(gap_ratio[changing], gap_ratio[num_agents:])
        gap_m[changing] = np.minimum(gap_m[changing], gap_m[num_agents:])
        acceleration_mps2 = compute_acceleration_mps2(
            self._driver, speed_mps, gap_ratio[:num_agents], self._desired_mps
        )
        # Laden trucks are limited by their power.
        stations_m = self._truck_directions * self.lane_positions_m[self._trucks]
        slope = self._truck_directions * np.interp(stations_m, *self._slope_profile)
        max_truck_mps2 = compute_max_truck_acceleration_mps2(speed_mps[self._trucks], slope)
        acceleration_mps2[self._trucks] = np.minimum(acceleration_mps2[self._trucks], max_truck_mps2)
        self._acceleration_mps2 = acceleration_mps2
        distance_m, self.speeds_mps = integrate_motion(speed_mps, acceleration_mps2, gap_m[:num_agents], step_s)
        self.lane_positions_m += distance_m
        self._time_s += step_s
        if self._time_s > self._next_decision_s - 1e-9:
            self._next_decision_s += self._params.decision_interval_s
            self._decide()

    def _decide(self) -> None:
        """Begin and finish lane changes."""
        params = self._params
        self._turn = (self._turn + 1) % params.num_turns
        new_changes = self._begin_changes(np.arange(self._turn, len(self.lane_positions_m), params.num_turns))
        continued = []
        for change in self._active_changes:
            if self.lane_positions_m[change.agent_index] < change.start_m + params.occupied_share * change.length_m:
                continued.append(change)
        if new_changes or len(continued) < len(self._active_changes):
            self._active_changes = continued + new_changes
            self._update_order()
        self._desired_mps = self._compute_desired_speeds_mps()

    def _update_order(self) -> None:
        """Update the order of agents in the lanes, which stays the same until the next lane change begins or ends.

        Members (P,) are all agents, followed by those that occupy a second lane, in that lane. `_leader` (P,) is the
        agent ahead of each member, `_leader_offset_m` (P,) infinite without one. `_queue` (P,) are the agents lane by
        lane from the last to the first, `_queue_lanes` (P,) their lanes, and `_rank` (N,) their index in the queue.
        """
        num_agents = len(self.lane_positions_m)
        changing = np.array([change.agent_index for change in self._active_changes], dtype=np.int64)
        old_lanes = np.array([change.old_lane_index for change in self._active_changes], dtype=np.int64)
        members, lanes = np.append(np.arange(num_agents), changing), np.append(self.lane_indices, old_lanes)
        order = np.lexsort((self.lane_positions_m[members], lanes))
        self._members, self._queue, self._queue_lanes = members, members[order], lanes[order]
        is_first_on_lane = np.append(np.diff(self._queue_lanes) != 0, True)
        rank = np.argsort(order)
        self._leader = np.where(is_first_on_lane, self._queue, np.roll(self._queue, -1))[rank]
        self._leader_offset_m = np.where(is_first_on_lane, np.inf, 0.0)[rank]
        self._rank = rank[:num_agents]
        self._min_spacing_m = (self._length_m[members] + self._length_m[self._leader]) / 2
        self._member_drivers = self._select_drivers(members)

    def _select_drivers(self, agents: Int64) -> Driver:
        """Select the parameters of drivers (K,)."""
        return Driver(*(getattr(self._driver, name)[agents] for name in Driver.__dataclass_fields__))

    def _compute_gaps_m(self) -> Float64:
        """Compute the gap (P,) of each member to the agent ahead, bumper to bumper."""
        gap_m = self.lane_positions_m.take(self._leader)
        gap_m += self._leader_offset_m
        gap_m -= self.lane_positions_m.take(self._members)
        gap_m -= self._min_spacing_m
        return gap_m

    def _compute_desired_speeds_mps(self) -> Float64:
        """Compute the current desired speeds (N,), which are lower on ramps."""
        params = self._params
        variation = np.sin(self._variation_rad_per_s * self._time_s + self._variation_phase_rad)
        desired_mps = self._driver.desired_speed_mps * (1 + params.speed_variation * variation)
        on_auxiliary_lane = np.flatnonzero(self.lane_indices % LANES == SIDE_LANE)
        positions_m = self.lane_positions_m[on_auxiliary_lane]
        begin_m, end_m = self._auxiliary_spans_m[self.lane_indices[on_auxiliary_lane] // LANES].T
        distance_to_ramp_m = np.where(positions_m < begin_m, 0.0, end_m - positions_m)
        ramp_mps = np.sqrt(RAMP_MPS**2 + 2 * params.exit_braking_mps2 * np.maximum(distance_to_ramp_m, 0.0))
        desired_mps[on_auxiliary_lane] = np.minimum(desired_mps[on_auxiliary_lane], ramp_mps)
        return desired_mps

    def _begin_changes(self, agents: Int64) -> list[LaneChange]:
        """Begin the lane changes of agents (K,) that want to and can, from the largest gain down."""
        params = self._params
        agents = agents[self.lane_positions_m[agents] >= self._next_change_m[agents]]
        to_left, to_right = agents[self._has_lane(agents, -1)], agents[self._has_lane(agents, 1)]
        agents, sides = np.append(to_left, to_right), np.repeat([-1, 1], [len(to_left), len(to_right)])
        incentives_mps2 = self._compute_incentives_mps2(agents, sides)
        new_changes: list[LaneChange] = []
        for candidate in np.argsort(-incentives_mps2)[: np.count_nonzero(incentives_mps2 > 0.0)].tolist():
            agent = int(agents[candidate])
            start_m, old_lane = float(self.lane_positions_m[agent]), int(self.lane_indices[agent])
            distances_m = [abs(start_m - change.start_m) for change in new_changes]
            if min(distances_m, default=np.inf) > params.min_start_distance_m:
                length_m = float(self.speeds_mps[agent] * self._change_duration_s[agent])
                length_m = max(length_m, params.min_length_m)
                new_lane = old_lane + int(sides[candidate])
                new_changes.append(LaneChange(agent, old_lane, new_lane, start_m, length_m))
                self.lane_indices[agent], self._next_change_m[agent] = new_lane, start_m + length_m
        self.lane_changes += new_changes
        return new_changes

    def _has_lane(self, agents: Int64, side: int) -> Bools:
        """Test which agents (K,) have a lane to their left (-1) or right (1) that they may use."""
        lane, is_exiting = self.lane_indices[agents] % LANES, self._is_exiting[agents]
        positions_m = self.lane_positions_m[agents]
        begin_m, end_m = self._auxiliary_spans_m[self.lane_indices[agents] // LANES].T
        is_alongside = (positions_m > begin_m) & (positions_m < end_m - self._params.min_exit_distance_m)
        if side < 0:
            has_left_lane = (lane == 2) | ((lane == 1) & ~self._is_heavy[agents])
            return np.asarray(~is_exiting & (has_left_lane | (is_alongside & (lane == SIDE_LANE))))
        return np.asarray((lane < SIDE_LANE - 1) | (is_alongside & is_exiting & (lane == SIDE_LANE - 1)))

    def _compute_incentives_mps2(self, agents: Int64, sides: Int64) -> Float64:
        """Compute the incentives (K,) in m/s² of changes to the left (-1) or right (1); negative if unsafe."""
        params = self._params
        lane, speed_mps = self.lane_indices[agents], self.speeds_mps
        lane_stride_m = 1e7  # beyond any position along a lane
        queue_m = lane_stride_m * self._queue_lanes + self.lane_positions_m[self._queue]
        queue_index = np.searchsorted(queue_m, lane_stride_m * (lane + sides) + self.lane_positions_m[agents])
        new_leader, has_new_leader = self._look_up_queue(queue_index, lane + sides)
        new_follower, has_new_follower = self._look_up_queue(queue_index - 1, lane + sides)
        old_follower, has_old_follower = self._look_up_queue(self._rank[agents] - 1, lane)
        old_leader, has_old_leader = self._leader[agents], self._leader_offset_m[agents] == 0.0
        # Accelerations without and with the change, of the agent and of both followers.
        before_mps2 = self._acceleration_mps2[agents]
        after_mps2, has_room = self._follow(agents, new_leader, has_new_leader)
        follower_mps2, follower_has_room = self._follow(new_follower, agents, has_new_follower)
        relieved_mps2, _ = self._follow(old_follower, old_leader, has_old_leader)
        others_gain_mps2 = np.where(has_new_follower, follower_mps2 - self._acceleration_mps2[new_follower], 0.0)
        others_gain_mps2 += np.where(has_old_follower, relieved_mps2 - self._acceleration_mps2[old_follower], 0.0)
        # A vehicle on the left that must not be passed on the right limits both lanes.
        is_to_left = sides < 0
        left_speed_mps = np.where(is_to_left, speed_mps[new_leader], speed_mps[old_leader])
        has_left = np.where(is_to_left, has_new_leader, has_old_leader)
        would_pass = has_left & (speed_mps[agents] > left_speed_mps) & (left_speed_mps > params.min_flow_speed_mps)
        would_pass_on_right, would_be_passed = would_pass & ~is_to_left, would_pass & is_to_left
        slower_mps2 = np.minimum(before_mps2, after_mps2)
        gain_mps2 = np.where(would_pass_on_right, slower_mps2, after_mps2)
        gain_mps2 -= np.where(would_be_passed, slower_mps2, before_mps2)
        bias_mps2 = np.where(would_pass_on_right, 0.0, sides * params.keep_right_mps2)
        gain_mps2 += params.politeness * others_gain_mps2 + bias_mps2 - params.min_gain_mps2
        # Entering and exiting only need a safe gap.
        is_mandatory = np.maximum(lane, lane + sides) % LANES == SIDE_LANE
        gain_mps2 += np.where(is_mandatory, params.mandatory_gain_mps2, 0.0)
        is_follower_safe = ~has_new_follower | (follower_has_room & (follower_mps2 > -params.max_braking_mps2))
        is_safe = has_room & (after_mps2 > -params.max_braking_mps2) & is_follower_safe
        return np.where(is_safe, gain_mps2, -1.0)

    def _look_up_queue(self, indices: Int64, lanes: Int64) -> tuple[Int64, Bools]:
        """Look up agents (K,) at indices of the queue, and test whether they exist on lanes (K,)."""
        clipped = np.clip(indices, 0, len(self._queue) - 1)
        return self._queue[clipped], (clipped == indices) & (self._queue_lanes[clipped] == lanes)

    def _follow(self, agents: Int64, leaders: Int64, has_leader: Bools) -> tuple[Float64, Bools]:
        """Compute the accelerations (K,) of agents behind leaders, and test whether the gaps are long enough."""
        spacing_m = self.lane_positions_m[leaders] - self.lane_positions_m[agents]
        gap_m = spacing_m - (self._length_m[leaders] + self._length_m[agents]) / 2
        gap_m[~has_leader] = np.inf
        driver, speed_mps = self._select_drivers(agents), self.speeds_mps[agents]
        gap_ratio = compute_gap_ratio(driver, speed_mps, gap_m, speed_mps - self.speeds_mps[leaders])
        acceleration_mps2 = compute_acceleration_mps2(driver, speed_mps, gap_ratio, driver.desired_speed_mps)
        return acceleration_mps2, gap_m > self._params.min_headway_s * speed_mps
