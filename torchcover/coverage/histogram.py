"""Quantiles from a histogram, whose size does not grow with the steps."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# A sum of weights that misses its target by rounding has reached it: 0.1 + 0.2 + 0.3 is half of 1.2.
ROUNDED_DOWN = 1 - 1e-9
# Bins of radii: 20 a decade from 1 cm to 100 m, and one beyond each end.
RADIUS_EDGES_M = torch.cat([torch.tensor([0.0]), torch.logspace(-2, 2, 81), torch.tensor([math.inf])]).double()


def bin_of(values: Tensor, edges: Tensor) -> Tensor:
    """Index of the half-open bin [edges[i], edges[i + 1]) of each value.

    Args:
        values: (N,) float64.
        edges: (B + 1,) float64, ascending; a bin between equal edges is empty.

    Returns:
        (N,) int64 bin indices in [0, B), -1 outside.

    Example:
        >>> bin_of(torch.tensor([-0.1, 0.0, 0.9, 2.0]).double(), torch.tensor([0.0, 1.0, 2.0]).double())
        tensor([-1,  0,  0, -1])
    """
    index = torch.bucketize(values, edges.to(values.device), right=True) - 1
    return index.where(index < len(edges) - 1, -1)


def histogram_quantiles(histogram: Tensor, edges: Tensor, levels: Sequence[float]) -> Tensor:
    """Quantiles from weights in bins, linear within a bin.

    Args:
        histogram: (B, C) weight in each bin, one column a cell.
        edges: (B + 1,) bin edges, ascending; the last may be infinite.
        levels: Q levels in [0, 1].

    Returns:
        (Q, C) quantiles; infinite in the last bin if its upper edge is; NaN in a column without weight.
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
    """The levels of quantiles as plain floats.

    Raises:
        ValueError: None, one given twice, or one outside [0, 1].
    """
    checked = tuple(float(level) for level in levels)
    distinct = {f"{level:g}" for level in checked}  # as the keys of their layers tell them apart
    if not checked or len(distinct) != len(checked) or not all(0 <= level <= 1 for level in checked):
        raise ValueError(f"levels: different numbers in [0, 1] are needed; got {tuple(levels)}")
    return checked
