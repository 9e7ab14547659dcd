"""The mean over the visible surface: every square metre weighs the same, whatever its cell and step."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import RADIUS, by_area, detection
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class VisibleArea(Aggregation):
    """Means over the surface that the reference sees, from points whose weights w are square metres.

        radius[cell]    = sum of w r(q) / sum of w,    over all points q of all steps
        detection[cell] = sum of w 1(r(q) <= threshold) / sum of w

    Sums over cells and steps are as good: the mean over a region is the ratio of its sums. A `CoverageMetric` with
    `square_metres=True` has it.

    Args:
        thresholds: Detection thresholds in metres.
        blocks: Blocks of contiguous steps that the sums are kept in.
    """

    name: ClassVar[str] = "area"
    words: ClassVar[str] = "means over the visible surface"

    thresholds: tuple[float, ...]
    blocks: int = 1

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return tuple(map(by_area, (RADIUS, *map(detection, self.thresholds))))

    def states(self, cells: int) -> dict[str, State]:
        """`m2` (B, C): square metres in the steps of a block; `sums` (B, Q, C): each quantity times them."""
        shape = (self.blocks, len(self.thresholds) + 1, cells)
        return {
            "m2": State(torch.zeros((), dtype=torch.float64).expand(self.blocks, cells), in_blocks=True),
            "sums": State(torch.zeros((), dtype=torch.float64).expand(shape), in_blocks=True),
        }

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step."""
        sums["m2"][step.block, step.means.cell] += step.means.weight
        sums["sums"][step.block][:, step.means.cell] += step.means.mean * step.means.weight

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The radius, then the detection at each threshold; 0 / 0, which is NaN, where nothing was seen."""
        return list(map(Layer, self.quantities, sums["sums"].sum(dim=0) / sums["m2"].sum(dim=0)))
