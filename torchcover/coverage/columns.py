"""What a step adds to each cell that it touches: the columns of a table."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedFrame, Layer
from torchcover.coverage.binning import compute_cell_means


class CellSums(NamedTuple):
    """The columns by what they are.

    `observed_frames`: (...) float64 steps that had a reference point in the cell; `point_counts`: (...) float64 reference points
    in the cell; `sums_by_aggregation`: name of each aggregation -> its sums by name, each (*its own shape but for the cells, ...).
    """

    observed_frames: Tensor
    point_counts: Tensor
    sums_by_aggregation: dict[str, dict[str, Tensor]]

    def compute_layers(self, aggregation: Aggregation, max_radius_m: float) -> list[Layer]:
        """What one aggregation says of (C,) cells."""
        return aggregation.compute_layers(
            self.sums_by_aggregation[aggregation.name], self.observed_frames.long(), max_radius_m
        )


class SumColumns:
    """Steps and points, then the sums of aggregations: `num_columns` columns, of which the last `num_maxima` keep the largest."""

    def __init__(self, aggregations: Sequence[Aggregation]) -> None:
        self.aggregations = tuple(aggregations)
        named = [(one.name, name, state) for one in aggregations for name, state in one.create_states(1).items()]
        named.sort(key=lambda each: each[2].reduction == "max")
        self._shapes = {(owner, name): tuple(state.initial.shape[:-1]) for owner, name, state in named}
        self.num_columns = 2 + sum(state.initial.numel() for *_, state in named)
        self.num_maxima = sum(state.initial.numel() for *_, state in named if state.reduction == "max")

    def compute_columns(self, cell_indices: Tensor, values: Tensor, weights: Tensor | None) -> Tensor:
        """(1 + count, K) float64: the cells that the points of a step lie in, ascending, and what it adds to them.

        The cell of each point, (N,), its values (V, N) and weights (N,) are as in `BinnedFrame`.
        """
        means = compute_cell_means(cell_indices, values, weights)
        step, columns = BinnedFrame(means.point_cells, values, weights, means), dict[tuple[str, str], Tensor]()
        for one in self.aggregations:
            sums = {
                name: state.initial.to(values.device)
                for name, state in one.create_states(len(means.cell_indices)).items()
            }
            one.update(sums, step)
            columns |= {
                (one.name, name): each.flatten(0, -2) if each.dim() > 1 else each[None] for name, each in sums.items()
            }
        counts = torch.stack([means.cell_indices, torch.ones_like(means.cell_indices), means.point_counts])
        return torch.cat([counts.double(), *(columns[key].double() for key in self._shapes)])

    def split_columns(self, columns: Tensor) -> CellSums:
        """Tell (count, ...) columns apart."""
        sums = CellSums(columns[0], columns[1], {one.name: {} for one in self.aggregations})
        start = 2
        for (owner, name), shape in self._shapes.items():
            end = start + torch.Size(shape).numel()
            sums.sums_by_aggregation[owner][name] = columns[start:end].view(*shape, *columns.shape[1:])
            start = end
        return sums
