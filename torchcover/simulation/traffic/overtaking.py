"""Traffic on the parallel lanes of a motorway: behind one another by the driver model, and from lane to lane.

Who changes is decided by MOBIL, in its form for countries in which one keeps to the right and overtakes on the left
(Kesting, Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation Research
Record 1999, 2007): a change has to be worth it, and must not make anybody brake hard. While one changes, one is in both
lanes: those behind in either keep their distance, and so does one oneself from those ahead in either.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.traffic.fleet import KIND_OF
from torchcover.simulation.traffic.flow import MAX_STEP_S, Agent, TrafficHistory
from torchcover.simulation.traffic.idm import (
    Driver,
    compute_acceleration_mps2,
    compute_gap_ratio,
    compute_max_truck_acceleration_mps2,
    integrate_motion,
)

# Of a direction, from the median outwards; on the last one enters and exits.
LANES = 4
SIDE_LANE = LANES - 1
# MOBIL: what a change has to gain, how much more of it to the left than to the right, what nobody has to brake harder
# than, the weight of what others gain, and from which speed on one does not pass on the right.
WORTH_MPS2, TO_THE_RIGHT_MPS2, SAFE_MPS2, POLITENESS, FLOWS_MPS = 0.2, 0.3, 2.0, 0.2, 16.7
# Nor is a gap big enough, however fast it grows, that is shorter than the one behind drives in this time.
SHORTEST_HEADWAY_S = 0.6
# Who has to enter or exit does so where it is safe, gain or not.
HAS_TO_MPS2 = 100.0
# Each driver looks every two seconds, half of them at a time; of those who want the same gap, one goes.
LOOKS_EVERY_S, TURNS, APART_M = 1.0, 2, 120.0
# How long a change takes, and which share of it one is still in the way of those in the old lane.
CHANGE_S, SHORTEST_CHANGE_M, IN_BOTH = (4.5, 6.5), 30.0, 0.7
# Whose power tells on slopes.
LADEN = ("truck", "lorry")
# On ramps; who exits slows down before.
RAMP_MPS, EXIT_BRAKING_MPS2 = 22.0, 1.2
# So far before its end a side lane is too short for a change.
NOT_BEFORE_END_M = 160.0
# Nobody holds a speed: what they want goes up and down by such a share, over such a time.
UNEVEN, UNEVEN_S = 0.03, (15.0, 40.0)
# Farther than any place on a lane.
NEXT_LANE_M = 1e7


class LaneChange(NamedTuple):
    """Agent number `agent_index` goes from lane `old_lane_index` to lane `new_lane_index`, from a place on over a way."""

    agent_index: int
    old_lane_index: int
    new_lane_index: int
    start_m: float
    length_m: float

    def compute_progress(self, lane_positions_m: Float64) -> tuple[Float64, Float64]:
        """(...) how much of it is done at places, from 0 to 1, and how much more after each metre."""
        part = np.clip((lane_positions_m - self.start_m) / self.length_m, 0.0, 1.0)
        return part**3 * (10 - 15 * part + 6 * part**2), 30 * (part * (1 - part)) ** 2 / self.length_m


class LaneChangeSimulation:
    """N agents on the lanes of both directions: 0 to 3 of the first, 4 to 7 of the other. They must not overlap.

    Who is `heavy` keeps out of the lane at the median; who `exits` takes the exit, from the lane beside it. The side
    lane of each direction lies beside the others between two places of `side_m` (2, 2): before, it is an entry, behind,
    an exit. `climb` are (2, K) ascending places of the first direction, and the slopes there.
    """

    def __init__(
        self,
        agents: Sequence[Agent],
        is_heavy: Bools,
        is_exiting: Bools,
        auxiliary_spans_m: Float64,
        generator: np.random.Generator,
        slope_profile: Float64,
    ) -> None:
        self.lane_positions_m = np.array([agent.lane_position_m for agent in agents], dtype=np.float64)
        self.lane_indices = np.array([agent.lane_index for agent in agents], dtype=np.int64)
        self.lane_changes: list[LaneChange] = []
        self._length_m = np.array([agent.length_m for agent in agents], dtype=np.float64)
        self._driver = Driver.stack([agent.driver for agent in agents])
        self._heavy, self._exits, self._side_m, self._climb = is_heavy, is_exiting, auxiliary_spans_m, slope_profile
        self._laden = np.array([number for number, a in enumerate(agents) if KIND_OF.get(a.kind) in LADEN], np.int64)
        # Places of the other direction are those of the first with the sign turned, and slopes, too.
        self._way = np.where(self.lane_indices[self._laden] < LANES, 1.0, -1.0)
        self._change_s = generator.uniform(*CHANGE_S, len(agents))
        self._waves = (
            2 * np.pi / generator.uniform(*UNEVEN_S, len(agents)),
            generator.uniform(0, 2 * np.pi, len(agents)),
        )
        self._may_change_m = np.full(len(agents), -np.inf)
        self._leaving: list[LaneChange] = []
        self._turn, self._looks_s, self._time_s = 0, LOOKS_EVERY_S, 0.0
        self.speeds_mps = np.zeros(len(agents))
        self._line_up()
        room_m = np.maximum(self._gaps_m()[: len(agents)] - self._driver.standstill_gap_m, 0.0)
        self._desired_mps = self._desired()
        self.speeds_mps = np.minimum(0.95 * self._desired_mps, room_m / self._driver.headway_s)
        self._wanted_mps2 = np.zeros(len(agents))

    def run(self, times_s: Float64, warm_up_s: float) -> TrafficHistory:
        """Simulate, first the warm-up before the first time, and keep the state at each time."""
        place_m, speed_mps = np.empty((2, len(times_s), len(self.lane_positions_m)))
        spans_s = [warm_up_s, *(after - before for before, after in pairwise(times_s.tolist()))]
        for number, span_s in enumerate(spans_s):
            steps = int(np.ceil(span_s / MAX_STEP_S - 1e-9))
            for _ in range(steps):
                self._step(span_s / steps)
            place_m[number], speed_mps[number] = self.lane_positions_m, self.speeds_mps
        return TrafficHistory(place_m, speed_mps, np.zeros((len(times_s), 0, 2), dtype=bool))

    def _step(self, step_s: float) -> None:
        count, speed_mps = len(self.lane_positions_m), self.speeds_mps
        gap_m, own_mps = self._gaps_m(), speed_mps.take(self._who)
        tight = compute_gap_ratio(self._drivers, own_mps, gap_m, own_mps - speed_mps.take(self._leader))
        twice = self._who[count:]
        tight[twice] = np.maximum(tight[twice], tight[count:])
        gap_m[twice] = np.minimum(gap_m[twice], gap_m[count:])
        self._wanted_mps2 = compute_acceleration_mps2(self._driver, speed_mps, tight[:count], self._desired_mps)
        slope = self._way * np.interp(self._way * self.lane_positions_m[self._laden], *self._climb)
        most_mps2 = compute_max_truck_acceleration_mps2(speed_mps[self._laden], slope)
        self._wanted_mps2[self._laden] = np.minimum(self._wanted_mps2[self._laden], most_mps2)
        way_m, self.speeds_mps = integrate_motion(speed_mps, self._wanted_mps2, gap_m[:count], step_s)
        self.lane_positions_m += way_m
        self._time_s += step_s
        if self._time_s > self._looks_s - 1e-9:
            self._looks_s += LOOKS_EVERY_S
            self._look()

    def _look(self) -> None:
        """Let some change lanes, and those who have changed be in one lane."""
        self._turn = (self._turn + 1) % TURNS
        begun = self._begin(np.arange(self._turn, len(self.lane_positions_m), TURNS))
        leaving = [
            change
            for change in self._leaving
            if self.lane_positions_m[change.agent_index] < change.start_m + IN_BOTH * change.length_m
        ]
        if begun or len(leaving) < len(self._leaving):
            self._leaving = leaving + begun
            self._line_up()
        self._desired_mps = self._desired()

    def _line_up(self) -> None:
        """Find out who is ahead of whom; nobody passes anybody in a lane, so it stays so until somebody changes.

        `_who` (P,) are all agents, and once more those in two lanes, with their `_drivers`; `_leader` (P,) who is ahead
        of them, `_no_leader_m` (P,) infinite where nobody is; `_queue` (P,) those of `_who` lane by lane and one after
        the other, in the lanes `_queue_lane`, and `_rank` (N,) where everybody stands in it.
        """
        count = len(self.lane_positions_m)
        who = np.append(np.arange(count), np.array([change.agent_index for change in self._leaving], dtype=np.int64))
        lane = np.append(
            self.lane_indices, np.array([change.old_lane_index for change in self._leaving], dtype=np.int64)
        )
        order = np.lexsort((self.lane_positions_m[who], lane))
        self._who, self._queue, self._queue_lane = who, who[order], lane[order]
        is_first = np.append(np.diff(self._queue_lane) != 0, True)
        rank = np.argsort(order)
        self._leader = np.where(is_first, self._queue, np.roll(self._queue, -1))[rank]
        self._no_leader_m = np.where(is_first, np.inf, 0.0)[rank]
        self._rank = rank[:count]
        self._between_m = (self._length_m[who] + self._length_m[self._leader]) / 2
        self._drivers = self._some(who)

    def _some(self, who: Int64) -> Driver:
        return Driver(*(getattr(self._driver, name)[who] for name in Driver.__dataclass_fields__))

    def _gaps_m(self) -> Float64:
        """(P,) free road to the one ahead, bumper to bumper."""
        gap_m = self.lane_positions_m.take(self._leader)
        gap_m += self._no_leader_m
        gap_m -= self.lane_positions_m.take(self._who)
        gap_m -= self._between_m
        return gap_m

    def _desired(self) -> Float64:
        """(N,) what everybody wants to drive now and here: on ramps less."""
        per_s, phase = self._waves
        desired_mps = self._driver.desired_speed_mps * (1 + UNEVEN * np.sin(per_s * self._time_s + phase))
        beside = np.flatnonzero(self.lane_indices % LANES == SIDE_LANE)
        begin_m, end_m = self._side_m[self.lane_indices[beside] // LANES].T
        to_end_m = np.where(self.lane_positions_m[beside] < begin_m, 0.0, end_m - self.lane_positions_m[beside])
        ramp_mps = np.sqrt(RAMP_MPS**2 + 2 * EXIT_BRAKING_MPS2 * np.maximum(to_end_m, 0.0))
        desired_mps[beside] = np.minimum(desired_mps[beside], ramp_mps)
        return desired_mps

    def _begin(self, who: Int64) -> list[LaneChange]:
        """Let those of some agents change lanes who want to and may."""
        who = who[self.lane_positions_m[who] >= self._may_change_m[who]]
        left, right = who[self._may(who, -1)], who[self._may(who, 1)]
        who, side = np.append(left, right), np.repeat([-1, 1], [len(left), len(right)])
        gain = self._gains(who, side)
        begun: list[LaneChange] = []
        for at in np.argsort(-gain)[: np.count_nonzero(gain > 0.0)].tolist():
            agent = int(who[at])
            place_m, old = float(self.lane_positions_m[agent]), int(self.lane_indices[agent])
            if all(abs(place_m - other.start_m) > APART_M for other in begun):
                way_m = max(float(self.speeds_mps[agent] * self._change_s[agent]), SHORTEST_CHANGE_M)
                begun.append(LaneChange(agent, old, old + int(side[at]), place_m, way_m))
                self.lane_indices[agent], self._may_change_m[agent] = begun[-1].new_lane_index, place_m + way_m
        self.lane_changes += begun
        return begun

    def _may(self, who: Int64, side: int) -> Bools:
        """(K,) who of them has a lane on their left (-1) or right (1) that is for them."""
        lane, exits = self.lane_indices[who] % LANES, self._exits[who]
        begin_m, end_m = self._side_m[self.lane_indices[who] // LANES].T
        beside = (self.lane_positions_m[who] > begin_m) & (self.lane_positions_m[who] < end_m - NOT_BEFORE_END_M)
        if side < 0:
            to_the_median = (lane == 1) & ~self._heavy[who]
            return np.asarray(~exits & (to_the_median | (lane == 2) | (beside & (lane == SIDE_LANE))))
        return np.asarray((lane < SIDE_LANE - 1) | (beside & exits & (lane == SIDE_LANE - 1)))

    def _gains(self, who: Int64, side: Int64) -> Float64:
        """(K,) what agents gain by changes to their left (-1) or right (1), in m/s²; below 0 where it is not safe."""
        lane, speed_mps = self.lane_indices[who], self.speeds_mps
        queue_m = NEXT_LANE_M * self._queue_lane + self.lane_positions_m[self._queue]
        at = np.searchsorted(queue_m, NEXT_LANE_M * (lane + side) + self.lane_positions_m[who])
        ahead, has_ahead = self._of_queue(at, lane + side)
        behind, has_behind = self._of_queue(at - 1, lane + side)
        left_behind, has_left = self._of_queue(self._rank[who] - 1, lane)
        leader, has_leader = self._leader[who], self._no_leader_m[who] == 0.0
        now, (then, has_room) = self._wanted_mps2[who], self._behind(who, ahead, has_ahead)
        (theirs, have_room), (freed, _) = (
            self._behind(behind, who, has_behind),
            self._behind(left_behind, leader, has_leader),
        )
        others = np.where(has_behind, theirs - self._wanted_mps2[behind], 0.0)
        others += np.where(has_left, freed - self._wanted_mps2[left_behind], 0.0)
        # Nothing is gained, nor to be gained, by passing on the right.
        to_left = side < 0
        on_left_mps = np.where(to_left, speed_mps[ahead], speed_mps[leader])
        passes = np.where(to_left, has_ahead, has_leader) & (speed_mps[who] > on_left_mps) & (on_left_mps > FLOWS_MPS)
        slower = np.minimum(now, then)
        gain = np.where(passes & ~to_left, slower, then) - np.where(passes & to_left, slower, now)
        gain += POLITENESS * others + np.where(passes & ~to_left, 0.0, side * TO_THE_RIGHT_MPS2) - WORTH_MPS2
        gain += np.where(np.maximum(lane, lane + side) % LANES == SIDE_LANE, HAS_TO_MPS2, 0.0)
        is_safe = has_room & (then > -SAFE_MPS2) & (~has_behind | (have_room & (theirs > -SAFE_MPS2)))
        return np.where(is_safe, gain, -1.0)

    def _of_queue(self, at: Int64, lane: Int64) -> tuple[Int64, Bools]:
        """(K,) who stands at places of the queue, and whether anybody of these lanes does."""
        inside = np.clip(at, 0, len(self._queue) - 1)
        return self._queue[inside], (inside == at) & (self._queue_lane[inside] == lane)

    def _behind(self, who: Int64, leader: Int64, has_leader: Bools) -> tuple[Float64, Bools]:
        """(K,) how hard agents would accelerate behind others, and whether their gap is long enough."""
        gap_m = (
            self.lane_positions_m[leader]
            - self.lane_positions_m[who]
            - (self._length_m[leader] + self._length_m[who]) / 2
        )
        gap_m[~has_leader] = np.inf
        driver, speed_mps = self._some(who), self.speeds_mps[who]
        tight = compute_gap_ratio(driver, speed_mps, gap_m, speed_mps - self.speeds_mps[leader])
        wanted = compute_acceleration_mps2(driver, speed_mps, tight, driver.desired_speed_mps)
        return wanted, gap_m > SHORTEST_HEADWAY_S * speed_mps
