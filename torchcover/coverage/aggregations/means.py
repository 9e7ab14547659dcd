"""Means: over frames of means over points, over the visible surface, and over all points."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedFrame, Layer, SumState
from torchcover.coverage.quantities import RADIUS, make_area_quantity, make_detection_quantity, make_radius_quantity
from torchcover.estimation import Quantity


def _list_mean_quantities(thresholds_m: tuple[float, ...]) -> tuple[Quantity, ...]:
    """List the radius, then the detection at each threshold."""
    return (RADIUS, *(make_detection_quantity(threshold_m) for threshold_m in thresholds_m))


@dataclass(frozen=True)
class MeanOfMeans(Aggregation):
    """Mean over frames with a reference point in the cell, of the mean over the points of the frame.

        radius[cell]    = E_t[ E_q in cell [ r(q) ] ]
        detection[cell] = E_t[ E_q in cell [ 1(r(q) <= threshold) ] ]       (Uecker & Zöllner 2024)

    A frame with one point in a cell weighs as much as a frame with a thousand. Every `CoverageMetric` has it.

    Args:
        thresholds_m: Detection thresholds in meters.
    """

    name: ClassVar[str] = "mean"
    description: ClassVar[str] = "means of means"

    thresholds_m: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Radius, then the detection at each threshold."""
        return _list_mean_quantities(self.thresholds_m)

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `sums` (Q, C): sum over frames of the mean of each quantity in the cell."""
        initial = torch.zeros(len(self.quantities), num_cells, dtype=torch.float64, device="cpu")
        return {"sums": SumState(initial)}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the means of a frame."""
        sums["sums"].add_(frame.cell_means.means[: len(self.quantities)])

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute the layers of the radius and of the detection at each threshold."""
        frame_counts = observed_frames.double().where(observed_frames > 0, math.nan)
        values = sums["sums"] / frame_counts
        return [Layer(quantity, row) for quantity, row in zip(self.quantities, values, strict=True)]


@dataclass(frozen=True)
class AreaAverage(Aggregation):
    """Mean over the surface that the reference sensor observes; the weight w of a point is its area in square meters.

        radius[cell]    = sum of w r(q) / sum of w,    over all points q of all frames
        detection[cell] = sum of w 1(r(q) <= threshold) / sum of w

    The mean over a region is the ratio of sums over its cells and all frames. A `CoverageMetric` with
    `has_area_weights=True` has it.

    Args:
        thresholds_m: Detection thresholds in meters.
    """

    name: ClassVar[str] = "area"
    description: ClassVar[str] = "means over the visible surface"

    thresholds_m: tuple[float, ...]

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Radius, then the detection at each threshold, by area."""
        return tuple(make_area_quantity(quantity) for quantity in _list_mean_quantities(self.thresholds_m))

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `m2` (C,): area in square meters; `sums` (Q, C): each quantity times area."""
        return {
            "m2": SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu")),
            "sums": SumState(torch.zeros(len(self.thresholds_m) + 1, num_cells, dtype=torch.float64, device="cpu")),
        }

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a frame."""
        sums["m2"].add_(frame.cell_means.weight_sums)
        sums["sums"].add_(frame.cell_means.means[: len(self.quantities)] * frame.cell_means.weight_sums)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute the layers of the radius and of the detection at each threshold; NaN (0 / 0) in unobserved cells."""
        values = sums["sums"] / sums["m2"]
        return [Layer(quantity, row) for quantity, row in zip(self.quantities, values, strict=True)]


@dataclass(frozen=True)
class PooledMean(Aggregation):
    """Mean radius over all points of all frames; a frame with many points in a cell weighs more.

    Example:
        >>> PooledMean().create_states(num_cells=3)["weight"].initial
        tensor([0., 0., 0.], dtype=torch.float64)
    """

    name: ClassVar[str] = "pooled"
    description: ClassVar[str] = "pooled means"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `sum` (C,) of weighted radii, and `weight` (C,) of the points."""
        return {name: SumState(torch.zeros(num_cells, dtype=torch.float64, device="cpu")) for name in ("sum", "weight")}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a frame."""
        sums["sum"].add_(frame.cell_means.means[0] * frame.cell_means.weight_sums)
        sums["weight"].add_(frame.cell_means.weight_sums)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute the layer of the pooled mean radius."""
        weight = sums["weight"].where(observed_frames > 0, math.nan)
        return [Layer(make_radius_quantity("pooled", "pooled mean"), sums["sum"] / weight)]
