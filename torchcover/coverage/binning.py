"""Assignment of values to half-open bins that is exact despite rounding, and means over the points of each cell."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class CellMeans(NamedTuple):
    """Means over the points of one frame in the K cells that contain points.

    Args:
        cell_indices: (K,) int64 indices of these cells, ascending.
        point_cells: (N,) int64 position of the cell of each point in `cell_indices`.
        point_counts: (K,) int64 number of points.
        weight_sums: (K,) float64 sum of the weights, or the number of points without weights.
        means: (V, K) float64 mean of each of the V values.
    """

    cell_indices: Tensor
    point_cells: Tensor
    point_counts: Tensor
    weight_sums: Tensor
    means: Tensor


def compute_cell_means(cell_indices: Tensor, values: Tensor, weights: Tensor | None = None) -> CellMeans:
    """Compute the mean of values over the points of each cell, summed in float64.

    Args:
        cell_indices: (N,) int64 cell of each point.
        values: (V, N) values.
        weights: (N,) weight of each point; by default all points weigh the same.
    """
    touched, point_cells, point_counts = torch.unique(cell_indices, return_inverse=True, return_counts=True)
    if weights is None:
        weight_sums, weighted_values = point_counts.double(), values.double()
    else:
        weights = weights.double()
        weight_sums = _sum_per_cell(point_cells, weights, len(touched))
        weighted_values = values.double() * weights
    sums = [_sum_per_cell(point_cells, row, len(touched)) for row in weighted_values]
    means = torch.stack(sums) / weight_sums if sums else values.new_empty((0, len(touched)), dtype=torch.float64)
    return CellMeans(touched, point_cells, point_counts, weight_sums, means)


def _sum_per_cell(cells: Tensor, values: Tensor, num_cells: int) -> Tensor:
    """Sum (N,) values over the points of each of K cells."""
    # Without any points, torch returns int64 counts even with weights.
    return torch.bincount(cells, weights=values, minlength=num_cells).double()


def count_edges_below(values: Tensor, bounds: Tensor, low: float, high: float) -> Tensor:
    """Count the equidistant edges that are not above each value; equal to `torch.bucketize`, but faster.

    A division gives the bin up to rounding; comparisons with both of its edges correct it, so that no point crosses a
    border.

    Args:
        values: (N,) float64 values.
        bounds: (B + 3,) float64 edges between two NaN, which compare as false.
        low: First edge; a plain number, so that no GPU has to be synchronized.
        high: Last edge, likewise.

    Returns:
        (N,) int32 counts.
    """
    num_cells = len(bounds) - 3
    # The quotient is off by more than one bin if bins are smaller than this share of the coordinates.
    is_too_fine = high - low <= 1e-14 * num_cells * max(abs(low), abs(high))
    if is_too_fine or not math.isfinite(num_cells / (high - low)):
        return torch.bucketize(values.contiguous(), bounds[1:-1], right=True, out_int32=True)
    below = values.sub(low).mul_(num_cells / (high - low)).add_(1.0).clamp_(0, num_cells + 1).nan_to_num_().int()
    too_few, too_many = values >= bounds[1:].index_select(0, below), values < bounds.index_select(0, below)
    return below.add_(too_few).sub_(too_many.int())


def count_borders_below(values: Tensor, borders: Sequence[float]) -> Tensor:
    """Count the borders that are not above each value.

    Args:
        values: (N,) values.
        borders: Ascending borders at any distances.

    Returns:
        (N,) counts.
    """
    if len(borders) > 32:  # comparing with each of a few borders is faster than a search
        return torch.bucketize(values.contiguous(), values.new_tensor(borders), right=True)
    return torch.stack([values >= border for border in borders]).sum(dim=0)


def pad_ends(values: Tensor, end_value: float) -> Tensor:
    """Pad values with one entry at both ends.

    Args:
        values: (N,) values.
        end_value: Value of both new entries.
    """
    ends = values.new_tensor([end_value])
    return torch.cat([ends, values, ends])
