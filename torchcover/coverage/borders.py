"""How many borders lie below coordinates: half-open, [lo, hi), whatever the rounding."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

# A cell that is smaller than this share of the coordinates is not found by a division.
MIN_CELL_SHARE = 1e-14
# More borders than this are searched.
MAX_BORDERS_COMPARED = 32


def edges_below(values: Tensor, bounds: Tensor, low: float, high: float) -> Tensor:
    """How many edges at equal distances are not above each value: what `torch.bucketize` gives, sooner.

    Divided by their distance first, then compared with, so that no rounding moves a point over a border.

    Args:
        values: (N,) float64.
        bounds: (B + 3,) float64 edges between two NaN, which are never less, nor more.
        low: The first edge; as a number, for which a GPU need not be waited for.
        high: The last edge.

    Returns:
        (N,) int32.
    """
    cells = len(bounds) - 3
    fine = high - low <= MIN_CELL_SHARE * cells * max(abs(low), abs(high))  # the quotient would be off by more than one
    if fine or not math.isfinite(cells / (high - low)):
        return torch.bucketize(values.contiguous(), bounds[1:-1], right=True, out_int32=True)
    below = values.sub(low).mul_(cells / (high - low)).add_(1.0).clamp_(0, cells + 1).nan_to_num_().int()
    too_few, too_many = values >= bounds[1:].index_select(0, below), values < bounds.index_select(0, below)
    return below.add_(too_few).sub_(too_many.int())


def borders_below(values: Tensor, borders: Sequence[float]) -> Tensor:
    """The same for borders at any distances; a few are sooner compared with than searched."""
    if len(borders) > MAX_BORDERS_COMPARED:
        return torch.bucketize(values.contiguous(), values.new_tensor(borders), right=True)
    return torch.stack([values >= border for border in borders]).sum(dim=0)


def with_ends(values: Tensor, end: float) -> Tensor:
    """The values between two ends."""
    ends = values.new_tensor([end])
    return torch.cat([ends, values, ends])
