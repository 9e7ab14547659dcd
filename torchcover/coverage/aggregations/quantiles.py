"""Quantiles over points and over frames, from histograms of fixed size."""

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

# Bins of radii: 20 per decade from 1 cm to 100 m, and one beyond each end.
RADIUS_EDGES_M = torch.cat(
    [torch.tensor([0.0], device="cpu"), torch.logspace(-2, 2, 81, device="cpu"), torch.tensor([math.inf], device="cpu")]
).double()


def find_bins(values: Tensor, edges: Tensor) -> Tensor:
    """Find the half-open bin [edges[i], edges[i + 1]) of each value.

    Args:
        values: (N,) values.
        edges: (B + 1,) ascending edges; a bin between equal edges is always empty.

    Returns:
        (N,) int64 bins, -1 outside.
    """
    index = torch.bucketize(values, edges.to(values.device), right=True) - 1
    return index.where(index < len(edges) - 1, -1)


def compute_histogram_quantiles(histogram: Tensor, edges: Tensor, levels: Sequence[float]) -> Tensor:
    """Compute quantiles from histograms, interpolated linearly within a bin.

    Args:
        histogram: (B, C) weights in B bins of C cells.
        edges: (B + 1,) ascending edges; the last may be infinite, and then so are quantiles in the last bin.
        levels: Q levels in [0, 1].

    Returns:
        (Q, C) quantiles; NaN in cells without weight.
    """
    edges, cumulative = edges.to(histogram.device), histogram.cumsum(dim=0)
    total = cumulative[-1]
    quantiles = []
    for level in levels:
        target = total * level
        # A sum of weights that misses its target by rounding has reached it: 0.1 + 0.2 + 0.3 is half of 1.2.
        is_below = cumulative < target * (1 - 1e-9)
        # Level 0 needs the second condition: the smallest value lies in the first bin with any weight.
        bin_index = (is_below | (cumulative == 0)).sum(dim=0).clamp(max=len(histogram) - 1)
        weight = histogram.gather(0, bin_index[None])[0]
        weight_below = cumulative.gather(0, bin_index[None])[0] - weight
        share = ((target - weight_below) / weight).nan_to_num(0.0).clamp(0, 1)
        low, high = edges[bin_index], edges[bin_index + 1]
        value = torch.where(high.isinf(), high, low + share * (high - low))
        quantiles.append(value.where(total > 0, math.nan))
    return torch.stack(quantiles)


def check_levels(levels: Sequence[float]) -> tuple[float, ...]:
    """Check the levels of quantiles and convert them to plain floats.

    Args:
        levels: Levels in [0, 1], different in the format of keys.

    Raises:
        ValueError: There is no level, one is outside [0, 1], or two are equal.
    """
    checked = tuple(float(level) for level in levels)
    key_parts = {f"{level:g}" for level in checked}
    if not checked or len(key_parts) != len(checked) or not all(0 <= level <= 1 for level in checked):
        raise ValueError(f"levels: different numbers in [0, 1] are needed; got {tuple(levels)}")
    return checked


@dataclass(frozen=True)
class QuantileAggregation(Aggregation):
    """Quantiles at some levels, from a `histogram` (bins, C).

    Args:
        levels: Levels in [0, 1].

    Attributes:
        key_prefix: Text before the level in keys.
        title_prefix: Text after the level in titles.
    """

    example: ClassVar[str] = "0.5,0.9"
    key_prefix: ClassVar[str]
    title_prefix: ClassVar[str]

    levels: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "levels", check_levels(self.levels))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Create the aggregation from levels that are separated by commas."""
        try:
            return cls(tuple(float(level) for level in text.split(",")))
        except ValueError as error:
            raise ValueError(f"levels are needed, as in {cls.name}:{cls.example} ({error})") from error

    @classmethod
    def from_keys(cls, keys: AbstractSet[str]) -> Self | None:
        """Create the aggregation with the levels in the keys."""
        levels = set()
        for key in keys:
            if match := re.fullmatch(rf"radius_{cls.key_prefix}(0(?:\.\d+)?|1)_m", key):
                levels.add(float(match[1]))
        return cls(tuple(sorted(levels))) if levels else None

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Quantity of each level."""
        quantities = []
        for level in self.levels:
            quantities.append(make_radius_quantity(f"{self.key_prefix}{level:g}", f"{level:g} {self.title_prefix}"))
        return tuple(quantities)

    def compute_layers(self, sums: Mapping[str, Tensor], observed_frames: Tensor, max_radius_m: float) -> list[Layer]:
        """Compute a layer for each level."""
        values = compute_histogram_quantiles(sums["histogram"], RADIUS_EDGES_M, self.levels).clamp(max=max_radius_m)
        return [Layer(quantity, row) for quantity, row in zip(self.quantities, values, strict=True)]


@dataclass(frozen=True)
class Quantiles(QuantileAggregation):
    """Quantiles of r over the points of a cell, with equal weight of all frames, from a histogram of fixed size.

    The histogram has 20 bins per decade from 1 cm to 100 m. The error is at most one bin: 12 % of the value, or 1 cm; a
    quantile above 100 m is reported as `max_radius_m`.

    Args:
        levels: Levels in [0, 1].

    Raises:
        ValueError: There is no level, or one is outside [0, 1].

    Example:
        >>> [quantity.key for quantity in Quantiles((0.5, 0.9)).quantities]
        ['radius_q0.5_m', 'radius_q0.9_m']
    """

    name: ClassVar[str] = "quantiles"
    description: ClassVar[str] = "quantiles"
    key_prefix: ClassVar[str] = "q"
    title_prefix: ClassVar[str] = "quantile of the"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `histogram` (bins, C): shares that add up to 1 for each frame that observed the cell."""
        initial = torch.zeros(len(RADIUS_EDGES_M) - 1, num_cells, dtype=torch.float64, device="cpu")
        return {"histogram": SumState(initial)}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Add the points of a frame, each with its share of its cell."""
        share = torch.ones_like(frame.radius) if frame.weights is None else frame.weights.double()
        share = share / frame.cell_means.weight_sums[frame.cell_indices]
        bins = find_bins(frame.radius.clamp(max=1e300), RADIUS_EDGES_M)
        flat_indices = bins * len(frame.cell_means.cell_indices) + frame.cell_indices
        sums["histogram"].view(-1).index_add_(0, flat_indices, share)


@dataclass(frozen=True)
class FrameQuantiles(QuantileAggregation):
    """Quantiles over the frames that observed a cell, of the mean radius of its points in the frame.

    `Quantiles` describes the worst points of a cell, `FrameQuantiles` its worst frames: at level 0.9, one frame in ten
    is worse. Histogram and error are those of `Quantiles`.

    Args:
        levels: Levels in [0, 1].

    Raises:
        ValueError: There is no level, or one is outside [0, 1].
    """

    name: ClassVar[str] = "frame_quantiles"
    description: ClassVar[str] = "quantiles over frames"
    key_prefix: ClassVar[str] = "frame_q"
    title_prefix: ClassVar[str] = "quantile over frames of the mean"

    def create_states(self, num_cells: int) -> dict[str, SumState]:
        """Create `histogram` (bins, C): number of frames with the mean radius of the cell in each bin."""
        initial = torch.zeros(len(RADIUS_EDGES_M) - 1, num_cells, dtype=torch.int64, device="cpu")
        return {"histogram": SumState(initial)}

    def update(self, sums: Mapping[str, Tensor], frame: BinnedFrame) -> None:
        """Count the frame in every cell that it observed."""
        bins = find_bins(frame.cell_means.means[0].clamp(max=1e300), RADIUS_EDGES_M)
        sums["histogram"].scatter_(0, bins[None], 1)
