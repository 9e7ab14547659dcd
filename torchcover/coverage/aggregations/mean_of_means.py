"""The mean over steps of the mean over points: the paper's aggregation, and the one that has errors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import RADIUS, detection
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class MeanOfMeans(Aggregation):
    """Means over the steps that had a reference point in the cell of the means over the points of the step.

        radius[cell]    = E_t[ E_q in cell [ r(q) ] ]
        detection[cell] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]       (Uecker & Zöllner 2024)

    A step with one point in a cell weighs as much as one with a thousand. Every `CoverageMetric` has it.

    Args:
        thresholds: Detection thresholds in metres.
        blocks: Blocks of contiguous steps that the sums are kept in.
    """

    name: ClassVar[str] = "mean"
    words: ClassVar[str] = "means of means"

    thresholds: tuple[float, ...]
    blocks: int = 1

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return (RADIUS, *map(detection, self.thresholds))

    def states(self, cells: int) -> dict[str, State]:
        """`sums` (B, Q, C): sums over the steps of a block of the cell's mean of each quantity."""
        shape = (self.blocks, len(self.quantities), cells)
        return {"sums": State(torch.zeros((), dtype=torch.float64).expand(shape), in_blocks=True)}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the means of a step."""
        sums["sums"][step.block][:, step.means.cell] += step.means.mean

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The radius, then the detection at each threshold."""
        steps = probed_steps.double().where(probed_steps > 0, math.nan)
        means = sums["sums"].sum(dim=0) / steps
        return list(map(Layer, self.quantities, means))
