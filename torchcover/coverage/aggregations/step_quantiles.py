"""Quantiles over steps of the step's mean: how bad the bad moments of a cell are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.histogram import RADIUS_EDGES_M, bin_of, check_levels, histogram_quantiles
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import radius


@dataclass(frozen=True)
class StepQuantiles(Aggregation):
    """Quantiles over the steps that have probed a cell of the mean radius of its points in the step.

    Where `Quantiles` asks for the bad points of a cell, this asks for its bad moments: at level 0.9, one step in ten
    is worse. The histogram is that of `Quantiles`, and so is the error.

    Args:
        levels: Which, in [0, 1].

    Raises:
        ValueError: No level, or one outside [0, 1].
    """

    name: ClassVar[str] = "step_quantiles"
    words: ClassVar[str] = "quantiles over steps"

    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", check_levels(self.levels))

    def states(self, cells: int) -> dict[str, State]:
        """`histogram` (bins, C): in how many steps the mean radius of the cell fell into each bin."""
        return {"histogram": State(torch.zeros((), dtype=torch.int64).expand(len(RADIUS_EDGES_M) - 1, cells))}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Count the step in every cell that it has probed; a cell comes once."""
        bins = bin_of(step.means.mean[0].clamp(max=1e300), RADIUS_EDGES_M)
        sums["histogram"][bins, step.means.cell] += 1

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """A map for each level."""
        values = histogram_quantiles(sums["histogram"].double(), RADIUS_EDGES_M, self.levels).clamp(max=max_radius)
        quantities = [radius(f"step_q{level:g}", f"{level:g} quantile over steps of the mean") for level in self.levels]
        return list(map(Layer, quantities, values))
