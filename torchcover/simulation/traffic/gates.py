"""Where lanes pass junctions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class Gate:
    """Where a lane passes a junction.

    Args:
        enter_m: Place of the stop line.
        exit_m: Place after which a rear end has left the junction.
        junction: Index of the junction.
        phase: `signals.MAIN` or `signals.CROSS`.
        green_needed_s: Who enters must have this much green left (people on foot, who are slow to cross).
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

    enter_m: Numbers
    exit_m: Numbers
    light: Indices
    other_light: Indices
    green_needed_s: Numbers
    first: Indices

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

    def next_on(self, lane: int, rear_m: Numbers) -> Indices:
        """(N,) numbers of the first gate of a lane that each of N rear ends has not left."""
        first = self.first[lane]
        last = first + int(np.argmax(np.isinf(self.exit_m[first:])))
        numbers: Indices = first + np.searchsorted(self.exit_m[first:last], rear_m)
        return numbers
