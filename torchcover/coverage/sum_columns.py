"""Columns of the table of sums: the increments that a frame adds to each touched cell."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedFrame, Layer
from torchcover.coverage.binning import compute_cell_means


class CellSums(NamedTuple):
    """Columns of the table, split by meaning.

    Args:
        observed_frames: (...) float64 number of frames with a reference point in the cell.
        point_counts: (...) float64 number of reference points in the cell.
        sums_by_aggregation: Sums by name for each aggregation, each of shape (*shape without cells, ...).
    """

    observed_frames: Tensor
    point_counts: Tensor
    sums_by_aggregation: dict[str, dict[str, Tensor]]

    def compute_layers(self, aggregation: Aggregation, max_radius_m: float) -> list[Layer]:
        """Compute the layers of one aggregation over (C,) cells.

        Args:
            aggregation: Aggregation whose sums are included.
            max_radius_m: Radius in meters at which r saturates.
        """
        return aggregation.compute_layers(
            self.sums_by_aggregation[aggregation.name], self.observed_frames.long(), max_radius_m
        )


class SumColumns:
    """Order of the columns: frames and points, then sums of aggregations; the last `num_maxima` keep the largest value.

    Args:
        aggregations: Aggregations whose sums are stored.
    """

    def __init__(self, aggregations: Sequence[Aggregation]) -> None:
        self.aggregations = tuple(aggregations)
        sum_shapes: dict[tuple[str, str], tuple[int, ...]] = {}
        maximum_shapes: dict[tuple[str, str], tuple[int, ...]] = {}
        for aggregation in aggregations:
            for name, state in aggregation.create_states(1).items():
                shapes = maximum_shapes if state.reduction == "max" else sum_shapes
                shapes[aggregation.name, name] = tuple(state.initial.shape[:-1])
        self._shapes = sum_shapes | maximum_shapes
        self.num_maxima = sum(map(math.prod, maximum_shapes.values()))
        self.num_columns = 2 + sum(map(math.prod, self._shapes.values()))

    def compute_columns(self, cell_indices: Tensor, values: Tensor, weights: Tensor | None) -> Tensor:
        """Compute the increments of one frame.

        Args:
            cell_indices: (N,) int64 cell of each point.
            values: (V, N) values of each point, as in `BinnedFrame`.
            weights: (N,) weights, or None.

        Returns:
            (1 + C, K) float64 touched cells, ascending, and their increments.
        """
        means = compute_cell_means(cell_indices, values, weights)
        frame, columns = BinnedFrame(means.point_cells, values, weights, means), dict[tuple[str, str], Tensor]()
        for aggregation in self.aggregations:
            states = aggregation.create_states(len(means.cell_indices))
            sums = {name: state.initial.to(values.device) for name, state in states.items()}
            aggregation.update(sums, frame)
            for name, state_sums in sums.items():
                is_multiple = state_sums.dim() > 1
                columns[aggregation.name, name] = state_sums.flatten(0, -2) if is_multiple else state_sums[None]
        counts = torch.stack([means.cell_indices, torch.ones_like(means.cell_indices), means.point_counts])
        return torch.cat([counts.double(), *(columns[key].double() for key in self._shapes)])

    def split_columns(self, columns: Tensor) -> CellSums:
        """Split the columns of a table by meaning.

        Args:
            columns: (C, ...) columns.
        """
        sums = CellSums(columns[0], columns[1], {aggregation.name: {} for aggregation in self.aggregations})
        start = 2
        for (owner, name), shape in self._shapes.items():
            end = start + torch.Size(shape).numel()
            sums.sums_by_aggregation[owner][name] = columns[start:end].view(*shape, *columns.shape[1:])
            start = end
        return sums
