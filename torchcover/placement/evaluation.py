"""A candidate of a search, and what became of it."""

from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.placement.scores import Scores
from torchcover.placement.variables import Value
from torchcover.simulation import Rig

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

START, OPTIMISER, RANDOM = "start", "optimiser", "random"


class Instants(Protocol):
    """What rigs are scored on: `CommonInstants`, or anything else that knows worlds."""

    @property
    def world_of(self) -> Numbers:
        """(instants,) which world each is of."""
        ...

    def __len__(self) -> int: ...

    def score(self, rig: Rig, instants: Numbers | None = None) -> Scores:
        """What a rig scores at some instants; ValueError if it cannot be mounted."""
        ...


@dataclass(frozen=True, eq=False)
class Candidate:
    """What a search asks for.

    Args:
        number: Of the evaluation; 0 is the start.
        arm: Who asks: "start", "optimiser", or "random", the control.
        unit: (variables,) where it is in the unit cube; None for a start outside of the space.
        values: Of the variables.
        rig: It.
    """

    number: int
    arm: str
    unit: Float64 | None
    values: dict[str, Value]
    rig: Rig


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What is known of a candidate.

    Args:
        number: Of the evaluation; 0 is the start.
        arm: "start", "optimiser" or "random".
        unit: (variables,) where it is in the unit cube; None for a start outside of the space.
        values: Of the variables.
        instants: (n,) int64 numbers of the instants that it was scored at, in their order.
        scores: (n, objectives) its scores there; NaN where one is unknown.
        infeasible: Why it cannot be; empty if it can.
        self_hit_share: Share of its rays that the vehicle took; NaN where nobody knows.
        seconds: What it took.
    """

    number: int
    arm: str
    unit: Float64 | None
    values: dict[str, Value]
    instants: Numbers
    scores: Float64
    infeasible: str = ""
    self_hit_share: float = float("nan")
    seconds: float = 0.0

    @property
    def charge(self) -> int:
        """What it counts in a budget: its instants, one at least, or arms would look for places that are none."""
        return max(len(self.instants), 1)

    def spread(self, count: int) -> Float64:
        """(count, objectives) its scores by the number of the instant; NaN where it was not scored."""
        scores = np.full((count, self.scores.shape[1]), np.nan)
        scores[self.instants] = self.scores
        return scores

    def record(self) -> dict[str, Any]:
        """All of it, for JSON; every float comes back as it was."""
        return {
            "number": self.number,
            "arm": self.arm,
            "unit": None if self.unit is None else self.unit.tolist(),
            "values": self.values,
            "instants": self.instants.tolist(),
            "scores": [[None if np.isnan(value) else value for value in row] for row in self.scores.tolist()],
            "infeasible": self.infeasible,
            "self_hit_share": None if np.isnan(self.self_hit_share) else self.self_hit_share,
            "seconds": self.seconds,
        }

    @classmethod
    def of_record(cls, record: dict[str, Any], objectives: int) -> Self:
        """What `record` wrote.

        Raises:
            ValueError, KeyError, TypeError: It did not.
        """
        unit, hits = record["unit"], record["self_hit_share"]
        return cls(
            number=int(record["number"]),
            arm=str(record["arm"]),
            unit=None if unit is None else np.array(unit, dtype=np.float64),
            values=dict(record["values"]),
            instants=np.array(record["instants"], dtype=np.int64),
            scores=np.array(record["scores"], dtype=np.float64).reshape(-1, objectives),
            infeasible=str(record["infeasible"]),
            self_hit_share=float("nan") if hits is None else float(hits),
            seconds=float(record["seconds"]),
        )
