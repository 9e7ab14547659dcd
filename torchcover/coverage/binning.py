"""Scatter-mean binning: one value a reference point in, one mean a cell out."""

from typing import NamedTuple

import torch
from torch import Tensor


class CellMeans(NamedTuple):
    """Means over the points of one step.

    Args:
        cell: (K,) int64 numbers of the cells that have points, ascending.
        points: (K,) int64 points in each of them.
        mean: (V, K) float64 mean of each of the V values.
    """

    cell: Tensor
    points: Tensor
    mean: Tensor


def mean_per_cell(cell: Tensor, values: Tensor, cells: int) -> CellMeans:
    """Mean of each value over the points of each cell, summed in float64.

    Args:
        cell: (N,) int64 cell numbers in [0, cells).
        values: (V, N) one row a value, one column a point.
        cells: Number of cells of the grid.

    Returns:
        `CellMeans(cell, points, mean)` over the cells with at least one point.

    Example:
        >>> mean_per_cell(torch.tensor([4, 4, 7]), torch.tensor([[1.0, 3.0, 5.0]]), cells=9)
        CellMeans(cell=tensor([4, 7]), points=tensor([2, 1]), mean=tensor([[2., 5.]], dtype=torch.float64))
    """
    count = torch.bincount(cell, minlength=cells)
    touched = count.nonzero().squeeze(1)
    count = count[touched]
    sums = [torch.bincount(cell, weights=row.double(), minlength=cells)[touched] for row in values]
    mean = torch.stack(sums) / count if sums else values.new_empty((0, len(touched)))
    return CellMeans(touched, count, mean.double())
