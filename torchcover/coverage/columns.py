"""What a step adds to each cell that it touches: the columns of a table."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedStep, Layer
from torchcover.coverage.binning import mean_per_cell


class CellSums(NamedTuple):
    """The columns by what they are.

    `probed_steps`: (...) float64 steps that had a reference point in the cell; `points`: (...) float64 reference points
    in the cell; `of`: name of each aggregation -> its sums by name, each (*its own shape but for the cells, ...).
    """

    probed_steps: Tensor
    points: Tensor
    of: dict[str, dict[str, Tensor]]

    def layers(self, aggregation: Aggregation, max_radius: float) -> list[Layer]:
        """What one aggregation says of (C,) cells."""
        return aggregation.layers(self.of[aggregation.name], self.probed_steps.long(), max_radius)


class Columns:
    """Steps and points, then the sums of aggregations: `count` columns, of which the last `maxima` keep the largest."""

    def __init__(self, aggregations: Sequence[Aggregation]) -> None:
        self.aggregations = tuple(aggregations)
        named = [(one.name, name, state) for one in aggregations for name, state in one.states(1).items()]
        named.sort(key=lambda each: each[2].reduction == "max")
        self._shapes = {(owner, name): tuple(state.initial.shape[:-1]) for owner, name, state in named}
        self.count = 2 + sum(state.initial.numel() for *_, state in named)
        self.maxima = sum(state.initial.numel() for *_, state in named if state.reduction == "max")

    def of_step(self, cell: Tensor, values: Tensor, weight: Tensor | None) -> Tensor:
        """(1 + count, K) float64: the cells that the points of a step lie in, ascending, and what it adds to them.

        The cell of each point, (N,), its values (V, N) and weights (N,) are as in `BinnedStep`.
        """
        means = mean_per_cell(cell, values, weight)
        step, columns = BinnedStep(means.of_point, values, weight, means), dict[tuple[str, str], Tensor]()
        for one in self.aggregations:
            sums = {name: state.initial.to(values.device) for name, state in one.states(len(means.cell)).items()}
            one.update(sums, step)
            columns |= {
                (one.name, name): each.flatten(0, -2) if each.dim() > 1 else each[None] for name, each in sums.items()
            }
        counts = torch.stack([means.cell, torch.ones_like(means.cell), means.points])
        return torch.cat([counts.double(), *(columns[key].double() for key in self._shapes)])

    def read(self, columns: Tensor) -> CellSums:
        """Tell (count, ...) columns apart."""
        sums = CellSums(columns[0], columns[1], {one.name: {} for one in self.aggregations})
        start = 2
        for (owner, name), shape in self._shapes.items():
            end = start + torch.Size(shape).numel()
            sums.of[owner][name] = columns[start:end].view(*shape, *columns.shape[1:])
            start = end
        return sums
