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
from numpy.typing import NDArray

from torchcover.simulation.memory import check_fits
from torchcover.simulation.traffic.gates import Gate, Gates
from torchcover.simulation.traffic.idm import Driver, acceleration, advance
from torchcover.simulation.traffic.roads import Line
from torchcover.simulation.traffic.signals import Signals

Numbers = NDArray[np.float64]

MAX_STEP_S = 0.1
# Harder than comfortable, softer than an emergency: who would have to brake harder for a light goes on.
BRAKING_FOR_A_LIGHT_MPS2 = 2.5
STOP_BEFORE_LINE_M = 0.5
# A vehicle ahead that is slower than this share of one's own desired speed is a queue, not a flow.
QUEUE_SPEED = 0.15

# Place and speed, pose and yaw, and their copies.
BYTES_PER_STATE = 128


@dataclass(frozen=True, eq=False)
class Lane:
    """A line that is followed in one direction, with the junctions on it in their order."""

    line: Line
    gates: tuple[Gate, ...] = ()


@dataclass(frozen=True, eq=False)
class Agent:
    """Somebody who follows a lane.

    Args:
        kind: Which body.
        length_m: Of the body, bumper to bumper.
        lane: Index of the lane.
        place_m: Where the centre is on it when the simulation begins.
        driver: How they drive or walk.
    """

    kind: str
    length_m: float
    lane: int
    place_m: float
    driver: Driver


class Flow(NamedTuple):
    """What happened: `place_m` and `speed_mps` (T, N); `occupied` (T, J, 2), whether a phase is on a junction."""

    place_m: Numbers
    speed_mps: Numbers
    occupied: NDArray[np.bool_]


class Simulation:
    """N agents on L lanes.

    Args:
        lanes: The lanes.
        agents: Who follows them; they must not overlap, nor stand on a junction.
        signals: The lights of all junctions that gates name.
    """

    def __init__(self, lanes: Sequence[Lane], agents: Sequence[Agent], signals: Signals) -> None:
        self.place_m = np.array([agent.place_m for agent in agents])
        self._length = np.array([agent.length_m for agent in agents])
        self._lane = np.array([agent.lane for agent in agents])
        self._driver = Driver(
            *(np.array([getattr(a.driver, name) for a in agents]) for name in Driver.__dataclass_fields__)
        )
        self._leader, self._lap = _leaders(lanes, self._lane, self.place_m)
        self._signals = signals
        self._gates = Gates.from_lanes([lane.gates for lane in lanes])
        self._next = (self._gates.exit_m[self._lane] < (self.place_m - self._length / 2)[:, None]).sum(axis=1)
        # The gate that each agent is in, or else the next one ahead.
        self._gate = self._gates.take(self._lane, self._next)
        self.speed_mps = self._first_speed()

    def run(self, times_s: Numbers, warm_up_s: float = 0.0) -> Flow:
        """Simulate, first the warm-up before the first time, and keep the state at each time.

        Args:
            times_s: (T,) evenly spaced times.
            warm_up_s: How long before the first time the simulation begins.
        """
        states = [self._drive(float(times_s[0]) - warm_up_s, warm_up_s)]
        for before, after in pairwise(times_s):
            states.append(self._drive(float(before), float(after - before)))
        place, speed, occupied = zip(*states, strict=True)
        return Flow(np.stack(place), np.stack(speed), np.stack(occupied))

    def _drive(self, start_s: float, duration_s: float) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
        steps = int(np.ceil(duration_s / MAX_STEP_S - 1e-9))
        for step in range(steps):
            self._step(start_s + step * duration_s / steps, duration_s / steps)
        return self.place_m, self.speed_mps, self._occupied(self._gate)

    def _step(self, time_s: float, step_s: float) -> None:
        gap = self._gap_to_leader()
        closing = np.where(self._leader < 0, 0.0, self.speed_mps - self.speed_mps[self._leader])
        line = self._gap_to_closed_gate(time_s)
        stop = line + self._driver.standstill_gap_m - STOP_BEFORE_LINE_M
        wanted = np.minimum(
            acceleration(self._driver, self.speed_mps, gap, closing),
            acceleration(self._driver, self.speed_mps, stop, self.speed_mps),
        )
        way, self.speed_mps = advance(self.speed_mps, wanted, np.minimum(gap, line), step_s)
        self.place_m = self.place_m + way
        passed = self.place_m - self._length / 2 > self._gate.exit_m
        if passed.any():
            self._next = self._next + passed
            self._gate = self._gates.take(self._lane, self._next)

    def _gap_to_leader(self) -> Numbers:
        """(N,) free road to the one ahead, bumper to bumper."""
        distance = self.place_m[self._leader] + self._lap - self.place_m
        return np.where(self._leader < 0, np.inf, distance - (self._length + self._length[self._leader]) / 2)

    def _gap_to_closed_gate(self, time_s: float) -> Numbers:
        """(N,) way from the front to the next stop line that one may not and need not cross; else infinite."""
        gate = self._gate
        green = self._signals.green_left_s(time_s)[gate.junction, gate.phase] > gate.green_needed_s
        free = ~self._occupied(gate)[gate.junction, 1 - gate.phase]
        closed = (~(green & free) | self._jammed_behind(gate)) & ~self._committed(gate)
        return np.where(closed, self._gap_to(gate), np.inf)

    def _gap_to(self, gate: Gates) -> Numbers:
        return np.asarray(gate.enter_m - self.place_m - self._length / 2)

    def _committed(self, gate: Gates) -> NDArray[np.bool_]:
        """(N,) whether one is on a junction, or will be because it is too late to stop."""
        return np.asarray(self.speed_mps**2 > 2 * BRAKING_FOR_A_LIGHT_MPS2 * self._gap_to(gate))

    def _jammed_behind(self, gate: Gates) -> NDArray[np.bool_]:
        """(N,) whether a queue behind the junction would force one to stop on it."""
        rear = self.place_m[self._leader] + self._lap - self._length[self._leader] / 2
        too_short = (rear > gate.enter_m) & (rear < gate.exit_m + self._length + self._driver.standstill_gap_m)
        slow = self.speed_mps[self._leader] < QUEUE_SPEED * self._driver.desired_speed_mps
        return np.asarray((self._leader >= 0) & too_short & slow)

    def _occupied(self, gate: Gates) -> NDArray[np.bool_]:
        """(J, 2) whether somebody of a phase is on a junction or cannot be kept from it."""
        committed = self._committed(gate)
        occupied = np.zeros((len(self._signals.offset_s), 2), dtype=bool)
        occupied[gate.junction[committed], gate.phase[committed]] = True
        return occupied

    def _first_speed(self) -> Numbers:
        """(N,) fast, but slow enough to stop at the next line, and for the gap to the one ahead."""
        stoppable = np.sqrt(self._driver.deceleration_mps2 * np.maximum(self._gap_to(self._gate), 0.0))
        to_leader = np.maximum(self._gap_to_leader() - self._driver.standstill_gap_m, 0.0)
        bearable = to_leader / self._driver.headway_s
        return np.asarray(np.minimum(0.95 * self._driver.desired_speed_mps, np.minimum(stoppable, bearable)))


def check_crowd(agents: float, steps: int) -> None:
    """Refuse more agents than a simulation has memory for, before any of them is made.

    Args:
        agents: How many there are, about.
        steps: For how many times their state is kept.

    Raises:
        ValueError: There is not so much memory.
    """
    check_fits(
        f"traffic of about {agents:,.0f} for {steps:,} time steps",
        BYTES_PER_STATE * agents * steps,
        "shorten the duration, or let there be fewer to a kilometre",
    )


def _leaders(lanes: Sequence[Lane], lane: NDArray[np.int64], place_m: Numbers) -> tuple[NDArray[np.int64], Numbers]:
    """(N,) who is ahead, or -1; and (N,) the length of a lap where the one ahead is the last one of a loop."""
    leader, lap = np.full(len(lane), -1), np.zeros(len(lane))
    for index in np.unique(lane):
        members = np.flatnonzero(lane == index)
        members = members[np.argsort(-place_m[members], kind="stable")]
        leader[members[1:]] = members[:-1]
        if lanes[index].line.closed and len(members) > 1:
            leader[members[0]] = members[-1]
            lap[members[0]] = lanes[index].line.length_m
    return leader, lap
