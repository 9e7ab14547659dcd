"""Quantiles of the points' radii, each step weighing the same."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.histogram import RADIUS_EDGES_M, bin_of, check_levels, histogram_quantiles
from torchcover.coverage.layer import Layer
from torchcover.coverage.quantity import radius
from torchcover.estimation import Quantity


@dataclass(frozen=True)
class Quantiles(Aggregation):
    """Quantiles of r over the points of a cell, steps weighing the same, from a histogram whose size is fixed.

    The histogram has 20 bins a decade from 1 cm to 100 m. The error is at most a bin: 12 % of the value, or 1 cm; a
    quantile over 100 m is given as `max_radius`.

    Args:
        levels: Which, in [0, 1].

    Raises:
        ValueError: No level, or one outside [0, 1].

    Example:
        >>> [quantity.key for quantity in Quantiles((0.5, 0.9)).quantities]
        ['radius_q0.5_m', 'radius_q0.9_m']
    """

    name: ClassVar[str] = "quantiles"
    words: ClassVar[str] = "quantiles"

    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", check_levels(self.levels))

    @property
    def quantities(self) -> list[Quantity]:
        """One for each level."""
        return [radius(f"q{level:g}", f"{level:g} quantile of the") for level in self.levels]

    def states(self, cells: int) -> dict[str, State]:
        """`histogram` (bins, C): for each step that has probed the cell, shares that add up to 1."""
        return {"histogram": State(torch.zeros((), dtype=torch.float64).expand(len(RADIUS_EDGES_M) - 1, cells))}

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep) -> None:
        """Add the points of a step, each with its share of its cell."""
        share = torch.ones_like(step.radius) if step.weight is None else step.weight.double()
        share = share / torch.bincount(step.cell, weights=share, minlength=step.cells)[step.cell]
        bin_and_cell = bin_of(step.radius.clamp(max=1e300), RADIUS_EDGES_M) * step.cells + step.cell
        sums["histogram"].view(-1).index_add_(0, bin_and_cell, share)

    def layers(self, sums: Mapping[str, Tensor], probed_steps: Tensor, max_radius: float) -> list[Layer]:
        """A map for each level."""
        values = histogram_quantiles(sums["histogram"], RADIUS_EDGES_M, self.levels).clamp(max=max_radius)
        return list(map(Layer, self.quantities, values))
