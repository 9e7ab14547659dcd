"""Means: over steps and points, over the visible surface, and over all points."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedFrame, Layer, SumState
from torchcover.coverage.quantities import RADIUS, make_area_quantity, make_detection_quantity, make_radius_quantity
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class MeanOfMeans(Aggregation):
    """Means over the steps that had a reference point in the cell of the means over the points of the step.

        radius[cell]    = E_t[ E_q in cell [ r(q) ] ]
        detection[cell] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]       (Uecker & Zöllner 2024)

    A step with one point in a cell weighs as much as one with a thousand. Every `CoverageMetric` has it.

    Args:
        thresholds_m: Detection thresholds in metres.
    """

    name: ClassVar[str] = "mean"
    description: ClassVar[str] = "means of means"

    thresholds_m: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return (RADIUS, *map(make_detection_quantity, self.thresholds_m))

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`sums` (Q, C): sums over the steps of the cell's mean of each quantity."""
        return {"sums": SumState(torch.zeros(len(self.quantities), num_cells, dtype=torch.float64, device="cpu"))}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the means of a step."""
        sums["sums"].add_(frame.cell_means.means[: len(self.quantities)])

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """The radius, then the detection at each threshold."""
        steps = observed_frames.double().where(observed_frames > 0, math.nan)
        return list(map(Layer, self.quantities, sums["sums"] / steps))


@dataclass(frozen=True)
class AreaAverage(Aggregation):
    """Means over the surface that the reference sees, from points whose weights w are square metres.

        radius[cell]    = sum of w r(q) / sum of w,    over all points q of all steps
        detection[cell] = sum of w 1(r(q) <= threshold) / sum of w

    Sums over cells and steps are as good: the mean over a region is the ratio of its sums. A `CoverageMetric` with
    `square_metres=True` has it.

    `thresholds_m`: detection thresholds in metres.
    """

    name: ClassVar[str] = "area"
    description: ClassVar[str] = "means over the visible surface"

    thresholds_m: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The radius, then the detection at each threshold."""
        return tuple(map(make_area_quantity, (RADIUS, *map(make_detection_quantity, self.thresholds_m))))

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`m2` (C,): square metres; `sums` (Q, C): each quantity times them."""
        return {
            "m2": SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu")),
            "sums": SumState(torch.zeros(len(self.thresholds_m) + 1, num_cells, dtype=torch.float64, device="cpu")),
        }

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a step."""
        sums["m2"].add_(frame.cell_means.weight_sums)
        sums["sums"].add_(frame.cell_means.means[: len(self.quantities)] * frame.cell_means.weight_sums)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """The radius, then the detection at each threshold; 0 / 0, which is NaN, where nothing was seen."""
        return list(map(Layer, self.quantities, sums["sums"] / sums["m2"]))


@dataclass(frozen=True)
class PooledMean(Aggregation):
    """The mean radius over all points of all steps; a step with many points in a cell weighs more.

    Example:
        >>> PooledMean().create_states(num_cells=3)["weight"].initial
        tensor([0., 0., 0.], dtype=torch.float64)
    """

    name: ClassVar[str] = "pooled"
    description: ClassVar[str] = "pooled means"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`sum` (C,) of weighted radii and `weight` (C,) of the points."""
        return {name: SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu")) for name in ("sum", "weight")}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a step."""
        sums["sum"].add_(frame.cell_means.means[0] * frame.cell_means.weight_sums)
        sums["weight"].add_(frame.cell_means.weight_sums)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """The pooled mean radius."""
        weight = sums["weight"].where(observed_frames > 0, math.nan)
        return [Layer(make_radius_quantity("pooled", "pooled mean"), sums["sum"] / weight)]
