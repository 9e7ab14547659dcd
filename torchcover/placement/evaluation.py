"""A candidate of a search, and what became of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import torch

from torchcover.estimation import Estimate, Quantity
from torchcover.geometry.arrays import Float64
from torchcover.placement.racing import Prefix
from torchcover.placement.variables import Value
from torchcover.simulation import Rig

START, OPTIMISER, RANDOM = "start", "optimiser", "random"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A candidate that a search asks for, and what is known of it.

    Args:
        number: Of the evaluation; 0 is the start.
        arm: Who asks: "start", "optimiser", or "random", the control.
        unit: (variables,) where it is in the unit cube; None for a start outside of the space.
        values: Of the variables.
        rig: It, while it is asked for.
        prefixes: What it scored after more and more instants; empty if it was not scored.
        infeasible: Why it cannot be; empty if it can.
        lacks: What is required of bodies and in encounters -> what it lacks of that, as a share; nothing is known where
            others are better.
        seconds: What it took.
    """

    number: int
    arm: str
    unit: Float64 | None
    values: dict[str, Value]
    rig: Rig | None = None
    prefixes: tuple[Prefix, ...] = ()
    infeasible: str = ""
    lacks: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def instants(self) -> int:
        """How many it was scored at."""
        return self.prefixes[-1].instants if self.prefixes else 0

    @property
    def charge(self) -> int:
        """What it counts in a budget: its instants, one at least, or arms would look for places that are none."""
        return max(self.instants, 1)

    def record(self) -> dict[str, Any]:
        """All of it, for a checkpoint."""
        return {
            **{name: getattr(self, name) for name in ("number", "arm", "values", "infeasible", "lacks", "seconds")},
            "unit": None if self.unit is None else self.unit.tolist(),
            "quantities": [list(one) for one in self.prefixes[-1].estimate.quantities] if self.prefixes else [],
            "prefixes": [
                [one.instants, one.self_hit_share, *(each.tolist() for each in _numbers(one.estimate))]
                for one in self.prefixes
            ],
        }

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> Self:
        """What `record` wrote."""
        given, quantities = dict(record), tuple(Quantity(*each) for each in record["quantities"])
        del given["quantities"]
        given["unit"] = None if given["unit"] is None else np.array(given["unit"], dtype=np.float64)
        given["prefixes"] = tuple(_prefix(quantities, *each) for each in given["prefixes"])
        return cls(**given)


def _numbers(estimate: Estimate) -> tuple[torch.Tensor, ...]:
    return estimate.value, estimate.left_out, estimate.steps


def _prefix(
    quantities: tuple[Quantity, ...],
    instants: int,
    self_hit_share: float,
    value: Sequence[float],
    left_out: Sequence[Sequence[float]],
    steps: Sequence[int],
) -> Prefix:
    each = torch.tensor(left_out, dtype=torch.float64, device="cpu").view(-1, len(value))
    numbers = Estimate(
        quantities, torch.tensor(value, dtype=torch.float64, device="cpu"), each, torch.tensor(steps, device="cpu")
    )
    return Prefix(instants, numbers, self_hit_share)
