"""Means: over steps and points, over the visible surface, and over all points."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, Layer, State
from torchcover.coverage.quantity import RADIUS, by_area, detection, radius
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class MeanOfMeans(Aggregation):
    """Means over the steps that had a reference point in the cell of the means over the points of the step.

        radius[cell]    = E_t[ E_q in cell [ r(q) ] ]
        detection[cell] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]       (Uecker & Zöllner 2024)

    A step with one point in a cell weighs as much as one with a thousand. Every `CoverageMetric` has it.

    Args:
        thresholds: Detection thresholds in metres.
    """

    name: ClassVar[str] = "mean"
    words: ClassVar[str] = "means of means"

    thresholds: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return (RADIUS, *map(detection, self.thresholds))

    def states(self, cells: int) -> dict[str, State]:
        """`sums` (Q, C): sums over the steps of the cell's mean of each quantity."""
        return {"sums": State(torch.zeros(len(self.quantities), cells, dtype=torch.float64, device="cpu"))}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the means of a step."""
        sums["sums"].add_(step.means.mean[: len(self.quantities)])

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The radius, then the detection at each threshold."""
        steps = probed_steps.double().where(probed_steps > 0, math.nan)
        return list(map(Layer, self.quantities, sums["sums"] / steps))


@dataclass(frozen=True)
class VisibleArea(Aggregation):
    """Means over the surface that the reference sees, from points whose weights w are square metres.

        radius[cell]    = sum of w r(q) / sum of w,    over all points q of all steps
        detection[cell] = sum of w 1(r(q) <= threshold) / sum of w

    Sums over cells and steps are as good: the mean over a region is the ratio of its sums. A `CoverageMetric` with
    `square_metres=True` has it.

    `thresholds`: detection thresholds in metres.
    """

    name: ClassVar[str] = "area"
    words: ClassVar[str] = "means over the visible surface"

    thresholds: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return tuple(map(by_area, (RADIUS, *map(detection, self.thresholds))))

    def states(self, cells: int) -> dict[str, State]:
        """`m2` (C,): square metres; `sums` (Q, C): each quantity times them."""
        return {
            "m2": State(torch.zeros(cells, dtype=torch.float64, device="cpu")),
            "sums": State(torch.zeros(len(self.thresholds) + 1, cells, dtype=torch.float64, device="cpu")),
        }

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step."""
        sums["m2"].add_(step.means.weight)
        sums["sums"].add_(step.means.mean[: len(self.quantities)] * step.means.weight)

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The radius, then the detection at each threshold; 0 / 0, which is NaN, where nothing was seen."""
        return list(map(Layer, self.quantities, sums["sums"] / sums["m2"]))


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
        return {name: State(torch.zeros(cells, dtype=torch.float64, device="cpu")) for name in ("sum", "weight")}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step."""
        sums["sum"].add_(step.means.mean[0] * step.means.weight)
        sums["weight"].add_(step.means.weight)

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """The pooled mean radius."""
        weight = sums["weight"].where(probed_steps > 0, math.nan)
        return [Layer(radius("pooled", "pooled mean"), sums["sum"] / weight)]
