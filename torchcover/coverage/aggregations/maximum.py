"""The maximum: the worst case of a cell."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, Layer, State
from torchcover.coverage.quantity import radius


@dataclass(frozen=True)
class Maximum(Aggregation):
    """The largest radius of any point of any step."""

    name: ClassVar[str] = "maximum"
    words: ClassVar[str] = "maxima"

    def states(self, cells: int) -> dict[str, State]:
        """`radius` (C,): the largest so far, minus infinity before the first."""
        return {"radius": State(torch.full((cells,), -math.inf, dtype=torch.float64, device="cpu"), reduction="max")}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Keep what is larger."""
        sums["radius"].scatter_reduce_(0, step.cell, step.radius, "amax")

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The largest radius."""
        return [Layer(radius("maximum", "largest"), sums["radius"].where(probed_steps > 0, math.nan))]
