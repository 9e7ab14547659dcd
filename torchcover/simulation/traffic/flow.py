"""Everybody who follows a lane, moved together: queues by the driver model, junctions by lights and by looking.

Two rules keep a junction free of conflicts. Nobody enters it outside their phase unless too close to stop when amber
comes. And nobody enters it while somebody of the other phase is still inside or is one of those, so a vehicle that is
held up on a junction is waited for, in spite of green.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

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

# Whoever follows the main street, on wheels or on foot, goes in one phase; whoever crosses it goes in the other.
MAIN, CROSS = 0, 1


@dataclass(frozen=True, eq=False)
class TrafficSignals:
    """The lights of J junctions: main green, amber, all red, cross green, amber, all red, and again.

    `offset_s` (J,) is how far into its cycle each is at time 0. In amber those still enter who cannot stop any more;
    then for `all_red_s` all have red.
    """

    offset_s: Float64
    green_s: tuple[float, float] = (26.0, 18.0)
    yellow_s: float = 3.0
    all_red_s: float = 3.0

    @classmethod
    def create_empty(cls) -> "TrafficSignals":
        """For lanes without junctions: the lights of one that no lane leads to."""
        return cls(np.zeros(1))

    @property
    def cycle_s(self) -> float:
        """Time after which the lights repeat."""
        return sum(self.green_s) + 2 * (self.yellow_s + self.all_red_s)

    def compute_remaining_green_s(self, times_s: ArrayLike) -> Float64:
        """(..., J, 2) seconds of green left to the main and the cross phase at (...) times; negative without green."""
        now = np.mod(np.asarray(times_s)[..., None] + self.offset_s, self.cycle_s)
        cross_start = self.green_s[MAIN] + self.yellow_s + self.all_red_s
        left = np.empty((*now.shape, 2))
        left[..., MAIN] = self.green_s[MAIN] - now
        left[..., CROSS] = np.where(now < cross_start, -np.inf, cross_start + self.green_s[CROSS] - now)
        return left


@dataclass(frozen=True)
class JunctionPassage:
    """Where a lane passes a junction in a phase: from its stop line to where a rear end has left the junction.

    Who enters must have so much green left; people on foot are slow to cross.
    """

    stop_line_m: float
    exit_m: float
    junction_index: int
    phase: int
    min_green_s: float = 0.0


class JunctionPassageTable(NamedTuple):
    """The gates of all lanes, one lane after the other; behind the last gate of each lane is one that is never reached.

    What a `Gate` says, one array (K,) for each word. `phase_indices` counts the phases of all junctions, two to a junction, and
    `conflicting_phase_indices` is the other one there. `first_passages` (L,) is the number of the first gate of each lane.
    """

    stop_lines_m: Float64
    exits_m: Float64
    phase_indices: Int64
    conflicting_phase_indices: Int64
    min_green_s: Float64
    first_passages: Int64

    @classmethod
    def from_lanes(cls, passages_by_lane: Sequence[tuple[JunctionPassage, ...]]) -> "JunctionPassageTable":
        """Those of lanes, each with its gates in order."""
        never = JunctionPassage(np.inf, np.inf, 0, 0)
        gates = [gate for of_lane in passages_by_lane for gate in (*of_lane, never)]
        return cls(
            np.array([gate.stop_line_m for gate in gates]),
            np.array([gate.exit_m for gate in gates]),
            np.array([2 * gate.junction_index + gate.phase for gate in gates]),
            np.array([2 * gate.junction_index + 1 - gate.phase for gate in gates]),
            np.array([gate.min_green_s for gate in gates]),
            np.cumsum([0, *(len(of_lane) + 1 for of_lane in passages_by_lane[:-1])]),
        )

    def find_next(self, lane_index: int, rear_positions_m: Float64) -> Int64:
        """(N,) numbers of the first gate of a lane that each of N rear ends has not left."""
        first = self.first_passages[lane_index]
        last = first + int(np.argmax(np.isinf(self.exits_m[first:])))
        return np.asarray(first + np.searchsorted(self.exits_m[first:last], rear_positions_m))


MAX_STEP_S = 0.1
# Harder than comfortable, softer than an emergency: who would have to brake harder for a light goes on.
BRAKING_FOR_A_LIGHT_MPS2 = 2.5
STOP_BEFORE_LINE_M = 0.5
# A vehicle ahead that is slower than this share of one's own desired speed is a queue, not a flow.
QUEUE_SPEED = 0.15

LIMIT_EVERY_M = 2.0

# Place and speed, pose and yaw, and their copies.
BYTES_PER_STATE = 128


@dataclass(frozen=True, eq=False)
class Lane:
    """A line that is followed in one direction, and the junctions on it, in their order.

    `speed_limits_mps` (K,) is how fast its curves may be driven, at 0 m, `LIMIT_EVERY_M`, ...; any speed if not given.
    """

    centerline: Polyline | OffsetPath
    passages: tuple[JunctionPassage, ...] = ()
    speed_limits_mps: Float64 | None = None


@dataclass(frozen=True, eq=False)
class Agent:
    """Somebody of a kind, so long bumper to bumper, whose centre is at a place on a lane at first; their driver."""

    kind: str
    length_m: float
    lane_index: int
    lane_position_m: float
    driver: Driver


class TrafficHistory(NamedTuple):
    """What happened: `lane_positions_m` and `speeds_mps` (T, N); `occupied_phases` (T, J, 2), whether a phase is on a junction."""

    lane_positions_m: Float64
    speeds_mps: Float64
    occupied_phases: Bools


class LaneSimulation:
    """N agents, who must not overlap, nor stand on a junction, on L lanes."""

    def __init__(self, lanes: Sequence[Lane], agents: Sequence[Agent], signals: TrafficSignals) -> None:
        self.lane_positions_m = np.array([agent.lane_position_m for agent in agents], dtype=np.float64)
        length = np.array([agent.length_m for agent in agents], dtype=np.float64)
        lane = np.array([agent.lane_index for agent in agents])
        self._driver = Driver.stack([agent.driver for agent in agents])
        self._leader, self._lap = _leaders(lanes, lane, self.lane_positions_m)
        self._half_m, self._leaders_half_m = length / 2, length[self._leader] / 2
        self._between_middles_m = (length + length[self._leader]) / 2
        # Whoever stops behind a junction needs so much room there.
        self._room_m = length, np.asarray(self._driver.standstill_gap_m)
        self._queue_mps = QUEUE_SPEED * self._driver.desired_speed_mps
        self._signals = signals
        self._gates = JunctionPassageTable.from_lanes([lane.passages for lane in lanes])
        self._limits = _Limits(lanes, lane)
        # The number of the gate that each agent is in, or else of the next one ahead, and where that is.
        self._gate = np.empty(len(agents), dtype=np.int64)
        self._enter_m, self._exit_m, self._clear_m = np.empty((3, len(agents)))
        for index in np.unique(lane):
            members = np.flatnonzero(lane == index)
            rear_m = self.lane_positions_m[members] - self._half_m[members]
            self._face(members, self._gates.find_next(int(index), rear_m))
        self.speeds_mps = self._first_speed()
        self._look()

    def run(self, times_s: Float64, warm_up_s: float = 0.0) -> TrafficHistory:
        """Simulate, first the warm-up before the first time, and keep the state at each time."""
        place_m, speed_mps = np.empty((2, len(times_s), len(self.lane_positions_m)))
        occupied = np.empty((len(times_s), len(self._signals.offset_s), 2), dtype=bool)
        drives = [(float(times_s[0]) - warm_up_s, warm_up_s)]
        drives += [(float(before), float(after - before)) for before, after in pairwise(times_s)]
        steps = [int(np.ceil(duration_s / MAX_STEP_S - 1e-9)) for _, duration_s in drives]
        red = iter(self._red([start_s + step * duration_s / count
                              for (start_s, duration_s), count in zip(drives, steps, strict=True)
                              for step in range(count)]))  # fmt: skip
        for number, count in enumerate(steps):
            for _ in range(count):
                self._step(next(red), drives[number][1] / count)
            place_m[number], speed_mps[number] = self.lane_positions_m, self.speeds_mps
            occupied[number] = self._occupied.reshape(-1, 2)
        return TrafficHistory(place_m, speed_mps, occupied)

    def _red(self, times_s: Sequence[float]) -> Bools:
        """(T, K) whether each gate has no green, or too little of it; lights heed nobody."""
        left_s = self._signals.compute_remaining_green_s(times_s).reshape(len(times_s), -1)
        return ~(left_s[:, self._gates.phase_indices] > self._gates.min_green_s)

    def _step(self, red: Bools, step_s: float) -> None:
        driver, speed_mps = self._driver, self.speeds_mps
        leader_m, leader_mps = self._leader_m(), speed_mps.take(self._leader)
        gap_m = self._gap_m(leader_m)
        held = (red | self._occupied[self._gates.conflicting_phase_indices])[self._gate]
        # A queue behind the junction would force one to stop on it.
        rear_m = leader_m - self._leaders_half_m
        held |= (rear_m > self._enter_m) & (rear_m < self._clear_m) & (leader_mps < self._queue_mps)
        held &= ~self._committed
        # Lines that may be crossed are as far away as can be.
        line_m = np.where(held, self._to_line_m, np.inf)
        stop_m = line_m + driver.standstill_gap_m
        stop_m -= STOP_BEFORE_LINE_M
        tight = compute_gap_ratio(driver, speed_mps, gap_m, speed_mps - leader_mps)
        np.maximum(tight, compute_gap_ratio(driver, speed_mps, stop_m, speed_mps), out=tight)
        wanted = compute_acceleration_mps2(
            driver, speed_mps, tight, self._limits.at(self.lane_positions_m, driver.desired_speed_mps)
        )
        way, self.speeds_mps = integrate_motion(speed_mps, wanted, np.minimum(gap_m, line_m), step_s)
        self.lane_positions_m += way
        (passed,) = (self.lane_positions_m - self._half_m > self._exit_m).nonzero()
        if len(passed):
            self._face(passed, self._gate[passed] + 1)
        self._look()

    def _face(self, agents: Int64, gates: Int64) -> None:
        """Let some agents have these gates before them."""
        self._gate[agents] = gates
        self._enter_m[agents], self._exit_m[agents] = self._gates.stop_lines_m[gates], self._gates.exits_m[gates]
        length_m, standstill_m = self._room_m
        self._clear_m[agents] = self._exit_m[agents] + length_m[agents] + standstill_m[agents]

    def _leader_m(self) -> Float64:
        """(N,) place of the one ahead; infinite for the first on a lane."""
        leader_m = self.lane_positions_m.take(self._leader)
        leader_m += self._lap
        return leader_m

    def _gap_m(self, leader_m: Float64) -> Float64:
        """(N,) free road to the one ahead, bumper to bumper."""
        gap_m = leader_m - self.lane_positions_m
        gap_m -= self._between_middles_m
        return gap_m

    def _look(self) -> None:
        """See where everybody is before the next stop line, and whom the junctions belong to.

        `_to_line_m` (N,) is the way from the front to the line; `_committed` (N,), whether one is on a junction, or
        will be because it is too late to stop; `_occupied` (2 J,), whether somebody of each phase is.
        """
        self._to_line_m = self._enter_m - self.lane_positions_m
        self._to_line_m -= self._half_m
        self._committed = self.speeds_mps**2 > 2 * BRAKING_FOR_A_LIGHT_MPS2 * self._to_line_m
        self._occupied = np.zeros(2 * len(self._signals.offset_s), dtype=bool)
        self._occupied[self._gates.phase_indices[self._gate[self._committed]]] = True

    def _first_speed(self) -> Float64:
        """(N,) fast, but slow enough to stop at the next line, and for the gap to the one ahead."""
        stoppable = np.sqrt(
            self._driver.deceleration_mps2 * np.maximum(self._enter_m - self.lane_positions_m - self._half_m, 0.0)
        )
        to_leader = np.maximum(self._gap_m(self._leader_m()) - self._driver.standstill_gap_m, 0.0)
        bearable = to_leader / self._driver.headway_s
        desired_mps = self._limits.at(self.lane_positions_m, self._driver.desired_speed_mps)
        return np.asarray(np.minimum(0.95 * desired_mps, np.minimum(stoppable, bearable)))


class _Limits:
    """What N agents may drive, on the lanes with these numbers, (N,)."""

    def __init__(self, lanes: Sequence[Lane], lane: Int64) -> None:
        tables = [np.array([np.inf]) if each.speed_limits_mps is None else each.speed_limits_mps for each in lanes]
        first = np.cumsum([0, *(len(table) for table in tables)])
        self._none = all(each.speed_limits_mps is None for each in lanes)
        self._table = np.concatenate(tables)
        self._first, self._last = first[lane], first[lane + 1] - 1

    def at(self, place_m: Float64, desired_mps: FloatOrArray) -> FloatOrArray:
        """(N,) what they want to drive at (N,) places, if that is allowed there."""
        if self._none:
            return desired_mps
        entry = (place_m / LIMIT_EVERY_M).astype(np.int64)
        entry += self._first
        np.minimum(entry, self._last, out=entry)
        np.maximum(entry, self._first, out=entry)
        return np.asarray(np.minimum(self._table.take(entry), desired_mps))


def check_traffic_memory(num_agents: float, num_frames: int) -> None:
    """Refuse more agents than a simulation has memory for, before any of them is made."""
    check_memory_fits(
        f"traffic of about {num_agents:,.0f} for {num_frames:,} time steps",
        BYTES_PER_STATE * num_agents * num_frames,
        "shorten the duration, or let there be fewer to a kilometre",
    )


def _leaders(lanes: Sequence[Lane], lane: Int64, place_m: Float64) -> tuple[Int64, Float64]:
    """(N,) who is ahead, anybody for the first on a lane; and (N,) how much farther than their place that is.

    0; the length of a lap where the one ahead is the last one of a loop; infinite where there is nobody.
    """
    leader, lap = np.zeros(len(lane), dtype=np.int64), np.zeros(len(lane))
    for index in np.unique(lane):
        members = np.flatnonzero(lane == index)
        members = members[np.argsort(-place_m[members], kind="stable")]
        leader[members[1:]] = members[:-1]
        if lanes[index].centerline.is_closed and len(members) > 1:
            leader[members[0]] = members[-1]
            lap[members[0]] = lanes[index].centerline.length_m
        else:
            lap[members[0]] = np.inf
    return leader, lap
