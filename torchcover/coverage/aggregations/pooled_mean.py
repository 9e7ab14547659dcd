"""The pooled mean: every point weighs the same, whatever its step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import radius


@dataclass(frozen=True)
class PooledMean(Aggregation):
    """The mean radius over all points of all steps; a step with many points in a cell weighs more.

    Example:
        >>> PooledMean().states(cells=3)["weight"].initial
        tensor([0., 0., 0.], dtype=torch.float64)
    """

    name: ClassVar[str] = "pooled"
    words: ClassVar[str] = "pooled means"

    def states(self, cells: int) -> dict[str, State]:
        """`sum` (C,) of weighted radii and `weight` (C,) of the points."""
        return {name: State(torch.zeros((), dtype=torch.float64).expand(cells)) for name in ("sum", "weight")}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step."""
        sums["sum"][step.means.cell] += step.means.mean[0] * step.means.weight
        sums["weight"][step.means.cell] += step.means.weight

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The pooled mean radius."""
        weight = sums["weight"].where(probed_steps > 0, math.nan)
        return [Layer(radius("pooled", "pooled mean"), sums["sum"] / weight)]
