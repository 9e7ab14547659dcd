"""A reference cloud that says the same of every cell with fewer points."""

import torch


def thinned(points, grid, most, seed):
    """At most some points of each cell, drawn at random: the mean over a cell's points keeps its expectation.

    The paper's rays crowd around the vehicle: of a million, hundreds lie in one cell. Cells that have a point keep one.

    Args:
        points: (M, 3) reference points.
        grid: Cells; points outside all of them are left out.
        most: Points that a cell keeps.
        seed: Of the random numbers.

    Returns:
        (K, 3) some of the points.
    """
    cell = grid.cell_of(points)
    inside = (cell >= 0).nonzero().squeeze(1)
    shuffled = inside[torch.randperm(len(inside), generator=torch.Generator().manual_seed(seed))]
    ordered, order = cell[shuffled].sort(stable=True)
    rank = torch.arange(len(ordered)) - torch.searchsorted(ordered, ordered)  # among the points of its cell
    return points[shuffled[order[rank < most]]]
