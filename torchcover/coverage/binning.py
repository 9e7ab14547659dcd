"""Scatter-mean binning: one value a reference point in, one mean a cell out."""

from typing import NamedTuple

import torch
from torch import Tensor


class CellMeans(NamedTuple):
    """Means over the points of one step.

    Args:
        cell: (K,) int64 numbers of the cells that have points, ascending.
        points: (K,) int64 points in each of them.
        weight: (K,) float64 sum of their weights; the number of points where there are none.
        mean: (V, K) float64 mean of each of the V values.
    """

    cell: Tensor
    points: Tensor
    weight: Tensor
    mean: Tensor


def mean_per_cell(cell: Tensor, values: Tensor, cells: int, weights: Tensor | None = None) -> CellMeans:
    """Mean of each value over the points of each cell, summed in float64.

    Args:
        cell: (N,) int64 cell numbers in [0, cells).
        values: (V, N) one row a value, one column a point.
        cells: Number of cells of the grid.
        weights: (N,) positive weight of each point; all the same if not given.

    Returns:
        `CellMeans(cell, points, weight, mean)` over the cells with at least one point.

    Example:
        >>> means = mean_per_cell(torch.tensor([4, 4, 7]), torch.tensor([[1.0, 3.0, 5.0]]), cells=9)
        >>> means.cell, means.points, means.mean
        (tensor([4, 7]), tensor([2, 1]), tensor([[2., 5.]], dtype=torch.float64))
    """
    count = torch.bincount(cell, minlength=cells)
    touched = count.nonzero().squeeze(1)
    points = count[touched]
    if weights is None:
        weight, weighted = points.double(), values.double()
    else:
        weights = weights.double()
        weight, weighted = _sum_per_cell(cell, weights, cells)[touched], values.double() * weights
    sums = [_sum_per_cell(cell, row, cells)[touched] for row in weighted]
    mean = torch.stack(sums) / weight if sums else values.new_empty((0, len(touched)), dtype=torch.float64)
    return CellMeans(touched, points, weight, mean)


def _sum_per_cell(cell: Tensor, values: Tensor, cells: int) -> Tensor:
    # Of no points at all, torch makes an int64 count, whatever the weights.
    return torch.bincount(cell, weights=values, minlength=cells).double()
