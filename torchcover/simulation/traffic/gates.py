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
    """Gates of many: tables (L, G + 1) for lanes, or (N,) for agents. What a `Gate` says, one array for each word."""

    enter_m: Numbers
    exit_m: Numbers
    junction: Indices
    phase: Indices
    green_needed_s: Numbers

    @classmethod
    def from_lanes(cls, lanes: Sequence[tuple[Gate, ...]]) -> "Gates":
        """The tables of lanes, each with its gates in order; behind its last gate a lane has one never reached."""
        never = Gate(np.inf, np.inf, 0, 0)
        columns = max(len(gates) for gates in lanes) + 1
        rows = [[*gates, *[never] * (columns - len(gates))] for gates in lanes]
        return cls(
            np.array([[gate.enter_m for gate in row] for row in rows]),
            np.array([[gate.exit_m for gate in row] for row in rows]),
            np.array([[gate.junction for gate in row] for row in rows]),
            np.array([[gate.phase for gate in row] for row in rows]),
            np.array([[gate.green_needed_s for gate in row] for row in rows]),
        )

    def take(self, lane: Indices, index: Indices) -> "Gates":
        """One gate for each of N agents: the one of that index on their lane."""
        at = (lane, index)
        return Gates(self.enter_m[at], self.exit_m[at], self.junction[at], self.phase[at], self.green_needed_s[at])
