"""Quantiles over points and over steps, from histograms, whose size does not grow with the steps."""

import math
import re
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedFrame, Layer, SumState
from torchcover.coverage.quantities import make_radius_quantity
from torchcover.estimation import Quantity

# A sum of weights that misses its target by rounding has reached it: 0.1 + 0.2 + 0.3 is half of 1.2.
ROUNDED_DOWN = 1 - 1e-9
# Bins of radii: 20 a decade from 1 cm to 100 m, and one beyond each end.
RADIUS_EDGES_M = torch.cat(
    [torch.tensor([0.0], device="cpu"), torch.logspace(-2, 2, 81, device="cpu"), torch.tensor([math.inf], device="cpu")]
).double()


def find_bins(values: Tensor, edges: Tensor) -> Tensor:
    """(N,) int64 which half-open bin [edges[i], edges[i + 1]) each value is in, -1 outside; of equal edges none is."""
    index = torch.bucketize(values, edges.to(values.device), right=True) - 1
    return index.where(index < len(edges) - 1, -1)


def compute_histogram_quantiles(histogram: Tensor, edges: Tensor, levels: Sequence[float]) -> Tensor:
    """(Q, C) quantiles from (B, C) weights in bins between (B + 1,) ascending edges, linear within a bin.

    The last edge may be infinite, and then are the quantiles in that bin; NaN in a column without weight.
    """
    edges, cumulative = edges.to(histogram.device), histogram.cumsum(dim=0)
    total = cumulative[-1]
    rows = []
    for level in levels:
        target = total * level
        # The second condition matters at level 0: the least value lies in the first bin that has any weight.
        at = ((cumulative < target * ROUNDED_DOWN) | (cumulative == 0)).sum(dim=0).clamp(max=len(histogram) - 1)
        weight = histogram.gather(0, at[None])[0]
        below = cumulative.gather(0, at[None])[0] - weight
        share = ((target - below) / weight).nan_to_num(0.0).clamp(0, 1)
        low, high = edges[at], edges[at + 1]
        value = torch.where(high.isinf(), high, low + share * (high - low))
        rows.append(value.where(total > 0, math.nan))
    return torch.stack(rows)


def check_levels(levels: Sequence[float]) -> tuple[float, ...]:
    """The levels of quantiles as plain floats."""
    checked = tuple(float(level) for level in levels)
    distinct = {f"{level:g}" for level in checked}  # as the keys of their layers tell them apart
    if not checked or len(distinct) != len(checked) or not all(0 <= level <= 1 for level in checked):
        raise ValueError(f"levels: different numbers in [0, 1] are needed; got {tuple(levels)}")
    return checked


@dataclass(frozen=True)
class QuantileAggregation(Aggregation):
    """Quantiles at some levels, from a `histogram` (bins, C)."""

    example: ClassVar[str] = "0.5,0.9"
    # Of the keys and titles: what stands before a level, and behind it.
    key_prefix: ClassVar[str]
    title_prefix: ClassVar[str]

    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", check_levels(self.levels))

    @classmethod
    def parse(cls, text: str) -> Self:
        """That at levels with commas between them."""
        try:
            return cls(tuple(map(float, text.split(","))))
        except ValueError as error:
            raise ValueError(f"levels are needed, as in {cls.name}:{cls.example} ({error})") from error

    @classmethod
    def from_keys(cls, keys: AbstractSet[str]) -> Self | None:
        """That at the levels of the keys."""
        found = (re.fullmatch(rf"radius_{cls.key_prefix}(0(?:\.\d+)?|1)_m", key) for key in keys)
        levels = sorted({float(each[1]) for each in found if each})
        return cls(tuple(levels)) if levels else None

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """One for each level."""
        return tuple(
            make_radius_quantity(f"{self.key_prefix}{level:g}", f"{level:g} {self.title_prefix}")
            for level in self.levels
        )

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """A map for each level."""
        values = compute_histogram_quantiles(sums["histogram"], RADIUS_EDGES_M, self.levels).clamp(max=max_radius_m)
        return list(map(Layer, self.quantities, values))


@dataclass(frozen=True)
class Quantiles(QuantileAggregation):
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
    description: ClassVar[str] = "quantiles"
    key_prefix: ClassVar[str] = "q"
    title_prefix: ClassVar[str] = "quantile of the"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`histogram` (bins, C): for each step that has probed the cell, shares that add up to 1."""
        return {
            "histogram": SumState(torch.zeros(len(RADIUS_EDGES_M) - 1, num_cells, dtype=torch.float64, device="cpu"))
        }

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a step, each with its share of its cell."""
        share = torch.ones_like(frame.radius) if frame.weights is None else frame.weights.double()
        share = share / frame.cell_means.weight_sums[frame.cell_indices]
        bin_and_cell = (
            find_bins(frame.radius.clamp(max=1e300), RADIUS_EDGES_M) * len(frame.cell_means.cell_indices)
            + frame.cell_indices
        )
        sums["histogram"].view(-1).index_add_(0, bin_and_cell, share)


@dataclass(frozen=True)
class FrameQuantiles(QuantileAggregation):
    """Quantiles over the steps that have probed a cell of the mean radius of its points in the step.

    Where `Quantiles` asks for the bad points of a cell, this asks for its bad moments: at level 0.9, one step in ten
    is worse. The histogram is that of `Quantiles`, and so is the error.

    Args:
        levels: Which, in [0, 1].

    Raises:
        ValueError: No level, or one outside [0, 1].
    """

    name: ClassVar[str] = "frame_quantiles"
    description: ClassVar[str] = "quantiles over frames"
    key_prefix: ClassVar[str] = "frame_q"
    title_prefix: ClassVar[str] = "quantile over frames of the mean"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """`histogram` (bins, C): in how many steps the mean radius of the cell fell into each bin."""
        return {"histogram": SumState(torch.zeros(len(RADIUS_EDGES_M) - 1, num_cells, dtype=torch.int64, device="cpu"))}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Count the step in every cell that it has probed."""
        bins = find_bins(frame.cell_means.means[0].clamp(max=1e300), RADIUS_EDGES_M)
        sums["histogram"].scatter_(0, bins[None], 1)
