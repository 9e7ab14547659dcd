"""Junctions: lights with fixed cycles, two phases to each, and where lanes pass them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Float64, Int64

# Whoever follows the main street, on wheels or on foot, goes in one phase; whoever crosses it goes in the other.
MAIN, CROSS = 0, 1


@dataclass(frozen=True, eq=False)
class Signals:
    """The lights of J junctions: main green, amber, all red, cross green, amber, all red, and again.

    `offset_s` (J,) is how far into its cycle each is at time 0. In amber those still enter who cannot stop any more;
    then for `clear_s` all have red.
    """

    offset_s: Float64
    green_s: tuple[float, float] = (26.0, 18.0)
    amber_s: float = 3.0
    clear_s: float = 3.0

    @classmethod
    def none(cls) -> "Signals":
        """For lanes without junctions: the lights of one that no lane leads to."""
        return cls(np.zeros(1))

    @property
    def cycle_s(self) -> float:
        """Time after which the lights repeat."""
        return sum(self.green_s) + 2 * (self.amber_s + self.clear_s)

    def green_left_s(self, time_s: ArrayLike) -> Float64:
        """(..., J, 2) seconds of green left to the main and the cross phase at (...) times; negative without green."""
        now = np.mod(np.asarray(time_s)[..., None] + self.offset_s, self.cycle_s)
        cross_start = self.green_s[MAIN] + self.amber_s + self.clear_s
        left = np.empty((*now.shape, 2))
        left[..., MAIN] = self.green_s[MAIN] - now
        left[..., CROSS] = np.where(now < cross_start, -np.inf, cross_start + self.green_s[CROSS] - now)
        return left


@dataclass(frozen=True)
class Gate:
    """Where a lane passes a junction in a phase: from its stop line to where a rear end has left the junction.

    Who enters must have so much green left; people on foot are slow to cross.
    """

    enter_m: float
    exit_m: float
    junction: int
    phase: int
    green_needed_s: float = 0.0


class Gates(NamedTuple):
    """The gates of all lanes, one lane after the other; behind the last gate of each lane is one that is never reached.

    What a `Gate` says, one array (K,) for each word. `light` counts the phases of all junctions, two to a junction, and
    `other_light` is the other one there. `first` (L,) is the number of the first gate of each lane.
    """

    enter_m: Float64
    exit_m: Float64
    light: Int64
    other_light: Int64
    green_needed_s: Float64
    first: Int64

    @classmethod
    def from_lanes(cls, lanes: Sequence[tuple[Gate, ...]]) -> "Gates":
        """Those of lanes, each with its gates in order."""
        never = Gate(np.inf, np.inf, 0, 0)
        gates = [gate for of_lane in lanes for gate in (*of_lane, never)]
        return cls(
            np.array([gate.enter_m for gate in gates]),
            np.array([gate.exit_m for gate in gates]),
            np.array([2 * gate.junction + gate.phase for gate in gates]),
            np.array([2 * gate.junction + 1 - gate.phase for gate in gates]),
            np.array([gate.green_needed_s for gate in gates]),
            np.cumsum([0, *(len(of_lane) + 1 for of_lane in lanes[:-1])]),
        )

    def next_on(self, lane: int, rear_m: Float64) -> Int64:
        """(N,) numbers of the first gate of a lane that each of N rear ends has not left."""
        first = self.first[lane]
        last = first + int(np.argmax(np.isinf(self.exit_m[first:])))
        return np.asarray(first + np.searchsorted(self.exit_m[first:last], rear_m))
