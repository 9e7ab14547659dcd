"""Binning: between which borders coordinates lie, half-open, whatever the rounding; and the mean of each cell."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

# A cell that is smaller than this share of the coordinates is not found by a division.
MIN_CELL_SHARE = 1e-14
# More borders than this are searched.
MAX_BORDERS_COMPARED = 32


class CellMeans(NamedTuple):
    """Means over the points of one step in those K cells that have points, ascending.

    `point_cells` (N,) is which of these each point lies in, `weight_sums` (K,) the sum of their weights, or their number where
    there are none, `means` (V, K) that of each of the V values.
    """

    cell_indices: Tensor
    point_cells: Tensor
    point_counts: Tensor
    weight_sums: Tensor
    means: Tensor


def compute_cell_means(cell_indices: Tensor, values: Tensor, weights: Tensor | None = None) -> CellMeans:
    """Mean of each of (V, N) values over the points of each cell, summed in float64; all weigh alike if not told."""
    touched, of_point, points = torch.unique(cell_indices, return_inverse=True, return_counts=True)
    if weights is None:
        weight, weighted = points.double(), values.double()
    else:
        weights = weights.double()
        weight, weighted = _sum_per_cell(of_point, weights, len(touched)), values.double() * weights
    sums = [_sum_per_cell(of_point, row, len(touched)) for row in weighted]
    mean = torch.stack(sums) / weight if sums else values.new_empty((0, len(touched)), dtype=torch.float64)
    return CellMeans(touched, of_point, points, weight, mean)


def _sum_per_cell(cell: Tensor, values: Tensor, cells: int) -> Tensor:
    # Of no points at all, torch makes an int64 count, whatever the weights.
    return torch.bincount(cell, weights=values, minlength=cells).double()


def count_edges_below(values: Tensor, bounds: Tensor, low: float, high: float) -> Tensor:
    """How many edges at equal distances are not above each value: what `torch.bucketize` gives, sooner.

    Divided by their distance first, then compared with, so that no rounding moves a point over a border. `bounds` are
    (B + 3,) float64 edges between two NaN, which are never less, nor more. `low` and `high`, the first and the last
    edge, are numbers, for which a GPU need not be waited for. The counts are (N,) int32.
    """
    cells = len(bounds) - 3
    fine = high - low <= MIN_CELL_SHARE * cells * max(abs(low), abs(high))  # the quotient would be off by more than one
    if fine or not math.isfinite(cells / (high - low)):
        return torch.bucketize(values.contiguous(), bounds[1:-1], right=True, out_int32=True)
    below = values.sub(low).mul_(cells / (high - low)).add_(1.0).clamp_(0, cells + 1).nan_to_num_().int()
    too_few, too_many = values >= bounds[1:].index_select(0, below), values < bounds.index_select(0, below)
    return below.add_(too_few).sub_(too_many.int())


def count_borders_below(values: Tensor, borders: Sequence[float]) -> Tensor:
    """The same for borders at any distances; a few are sooner compared with than searched."""
    if len(borders) > MAX_BORDERS_COMPARED:
        return torch.bucketize(values.contiguous(), values.new_tensor(borders), right=True)
    return torch.stack([values >= border for border in borders]).sum(dim=0)


def pad_ends(values: Tensor, end_value: float) -> Tensor:
    """The values between two ends."""
    ends = values.new_tensor([end_value])
    return torch.cat([ends, values, ends])
