"""A candidate of a search, and what became of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.placement.scores import Scores
from torchcover.placement.variables import Value
from torchcover.simulation import Rig

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

START, OPTIMISER, RANDOM = "start", "optimiser", "random"
# What of the scores differs between two rigs at the same instants.
OWN_SCORES = ("seen_m2", "known_share")


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
        scores: What it scored, at the instants that it was given; None if it was not scored.
        infeasible: Why it cannot be; empty if it can.
        seconds: What it took.
    """

    number: int
    arm: str
    unit: Float64 | None
    values: dict[str, Value]
    scores: Scores | None
    infeasible: str = ""
    seconds: float = 0.0

    @property
    def instants(self) -> int:
        """How many it was scored at."""
        return 0 if self.scores is None else len(self.scores.instants)

    @property
    def charge(self) -> int:
        """What it counts in a budget: its instants, one at least, or arms would look for places that are none."""
        return max(self.instants, 1)

    def record(self) -> dict[str, Any]:
        """What it has of its own, for JSON; every float comes back as it was."""
        scores = self.scores
        return {
            "number": self.number,
            "arm": self.arm,
            "unit": None if self.unit is None else self.unit.tolist(),
            "values": self.values,
            "infeasible": self.infeasible,
            "seconds": self.seconds,
            "scores": None
            if scores is None
            else {
                "instants": scores.instants.tolist(),
                "self_hit_share": scores.self_hit_share,
                "rays": scores.rays,
                **{name: _nulled(getattr(scores, name)) for name in OWN_SCORES},
            },
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any], like: Scores) -> Self:
        """What `record` wrote.

        Args:
            record: It.
            like: What any rig scored at all instants: the square metres that there are to see are the same.

        Raises:
            ValueError, KeyError, TypeError: It did not.
        """
        unit, own = record["unit"], record["scores"]
        scores = None
        if own is not None:
            seen_m2, known_share = (
                np.array(own[name], dtype=np.float64).reshape(-1, like.seen_m2.shape[1]) for name in OWN_SCORES
            )
            scores = replace(
                like.at(own["instants"]),
                self_hit_share=float(own["self_hit_share"]),
                rays=int(own["rays"]),
                seen_m2=seen_m2,
                known_share=known_share,
            )
        return cls(
            number=int(record["number"]),
            arm=str(record["arm"]),
            unit=None if unit is None else np.array(unit, dtype=np.float64),
            values=dict(record["values"]),
            scores=scores,
            infeasible=str(record["infeasible"]),
            seconds=float(record["seconds"]),
        )


def _nulled(values: Float64) -> list[list[float | None]]:
    return [[None if np.isnan(value) else value for value in row] for row in values.tolist()]
