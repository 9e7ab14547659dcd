"""Junctions of lanes: traffic signals, and the parts of lanes on junctions."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Float64, Int64

# Phases of a junction: agents along the main street, driving or walking, and agents across it.
MAIN = 0
CROSS = 1


@dataclass(frozen=True, eq=False)
class TrafficSignals:
    """Fixed-time signals of J junctions: main green, yellow, all red, cross green, yellow, all red, and so on.

    Args:
        offset_s: (J,) times into the cycle at time 0.
        green_s: Duration of green for the main and the cross phase.
        yellow_s: Duration of yellow, in which agents enter that cannot stop any more.
        all_red_s: Duration of red for both phases after yellow.
    """

    offset_s: Float64
    green_s: tuple[float, float] = (26.0, 18.0)
    yellow_s: float = 3.0
    all_red_s: float = 3.0

    @classmethod
    def create_empty(cls) -> "TrafficSignals":
        """Create signals for lanes without junctions: one junction to which no lane leads."""
        return cls(np.zeros(1))

    @property
    def cycle_s(self) -> float:
        """Duration of a cycle."""
        return sum(self.green_s) + 2 * (self.yellow_s + self.all_red_s)

    def compute_remaining_green_s(self, times_s: ArrayLike) -> Float64:
        """Compute the remaining green of each phase.

        Args:
            times_s: (...) times.

        Returns:
            (..., J, 2) seconds for the main and the cross phase; negative without green.
        """
        cycle_time_s = np.mod(np.asarray(times_s)[..., None] + self.offset_s, self.cycle_s)
        cross_start_s = self.green_s[MAIN] + self.yellow_s + self.all_red_s
        remaining_s = np.empty((*cycle_time_s.shape, 2))
        remaining_s[..., MAIN] = self.green_s[MAIN] - cycle_time_s
        cross_remaining_s = cross_start_s + self.green_s[CROSS] - cycle_time_s
        remaining_s[..., CROSS] = np.where(cycle_time_s < cross_start_s, -np.inf, cross_remaining_s)
        return remaining_s


@dataclass(frozen=True)
class JunctionPassage:
    """Part of a lane on a junction.

    Args:
        stop_line_m: Position of the stop line along the lane.
        exit_m: Position at which a rear end has left the junction.
        junction_index: Index of the junction.
        phase: `MAIN` or `CROSS`.
        min_green_s: Remaining green that an agent needs to enter; people on foot are slow to cross.
    """

    stop_line_m: float
    exit_m: float
    junction_index: int
    phase: int
    min_green_s: float = 0.0


class JunctionPassageTable(NamedTuple):
    """Passages of L lanes in one table of K rows, lane by lane; each lane ends with a passage at infinity.

    Args:
        stop_lines_m: (K,) stop lines.
        exits_m: (K,) exits.
        phase_indices: (K,) twice the index of the junction plus the phase.
        conflicting_phase_indices: (K,) index of the other phase of the junction.
        min_green_s: (K,) remaining green that an agent needs to enter.
        first_passages: (L,) row of the first passage of each lane.
    """

    stop_lines_m: Float64
    exits_m: Float64
    phase_indices: Int64
    conflicting_phase_indices: Int64
    min_green_s: Float64
    first_passages: Int64

    @classmethod
    def from_lanes(cls, passages_by_lane: Sequence[tuple[JunctionPassage, ...]]) -> "JunctionPassageTable":
        """Build the table from the passages of each lane, in order."""
        passages: list[JunctionPassage] = []
        for lane_passages in passages_by_lane:
            passages += [*lane_passages, JunctionPassage(np.inf, np.inf, 0, 0)]
        first_passages = np.cumsum([0, *(len(lane_passages) + 1 for lane_passages in passages_by_lane[:-1])])
        junctions = np.array([passage.junction_index for passage in passages])
        phases = np.array([passage.phase for passage in passages])
        return cls(
            stop_lines_m=np.array([passage.stop_line_m for passage in passages]),
            exits_m=np.array([passage.exit_m for passage in passages]),
            phase_indices=2 * junctions + phases,
            conflicting_phase_indices=2 * junctions + 1 - phases,
            min_green_s=np.array([passage.min_green_s for passage in passages]),
            first_passages=first_passages,
        )

    def find_next(self, lane_index: int, rear_positions_m: Float64) -> Int64:
        """Find the first passage of a lane that rear ends at positions (N,) have not left: rows (N,)."""
        first = self.first_passages[lane_index]
        last = first + int(np.argmax(np.isinf(self.exits_m[first:])))
        return np.asarray(first + np.searchsorted(self.exits_m[first:last], rear_positions_m))
