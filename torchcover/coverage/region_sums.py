"""Sums over regions: a region in a height band acts as one large cell that contains points by their position."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation
from torchcover.coverage.sum_columns import CellSums
from torchcover.estimation import Estimate, Quantity


class AggregatedNumbers(NamedTuple):
    """Numbers of aggregations for P pairs of region and band, ordered by region, then by band.

    Args:
        quantities: Q quantities of all aggregations.
        values: (P, Q) float64; NaN where unknown.
        jackknife_values: (B, P, Q) numbers without each block; NaN for aggregations without errors; B = 0 for one
            block.
    """

    quantities: tuple[Quantity, ...]
    values: Tensor
    jackknife_values: Tensor

    def estimate(self, region_band_index: int | None, frame_counts: Tensor | None) -> Estimate:
        """Estimate the numbers of one region and band; NaN without an index.

        Args:
            region_band_index: Index of the pair.
            frame_counts: (B,) frames in each block; 0 in unused blocks, None without blocks.
        """
        if region_band_index is None:
            return Estimate.from_values(self.quantities, torch.full_like(self.values[0], math.nan))
        values = self.values[region_band_index]
        if frame_counts is None:
            return Estimate.from_values(self.quantities, values)
        used = frame_counts > 0
        return Estimate(self.quantities, values, self.jackknife_values[used, region_band_index], frame_counts[used])


class RegionSums(NamedTuple):
    """Sums over the visible surface of P pairs of region and band, in B fine blocks of frames.

    Args:
        frame_counts: (B,) int64 frames in each block.
        areas_m2: (B, P) float64 area in square meters.
        sums: (B, V, P) area times the radius and the detections, followed by area times each quantity of
            `list_redundancy_quantities` if the metric distinguishes sensors.
    """

    frame_counts: Tensor
    areas_m2: Tensor
    sums: Tensor

    def estimate(self, quantities: Sequence[Quantity], region_band_index: int) -> Estimate:
        """Estimate the ratios of sums for one region and band.

        Args:
            quantities: Quantities of the first rows of `sums`.
            region_band_index: Index of the pair.
        """
        denominators = self.areas_m2[:, region_band_index]
        numerators = self.sums[:, : len(quantities), region_band_index]
        return Estimate.from_ratios(quantities, denominators, numerators, self.frame_counts)


def compute_aggregated_numbers(
    sums: CellSums, aggregations: Sequence[Aggregation], max_radius_m: float
) -> AggregatedNumbers:
    """Compute the numbers of aggregations for regions, as for a map with one cell per region and band.

    Largest values have no errors, since they are equal without any block except one.

    Args:
        sums: Sums of shape (..., B, P) in blocks.
        aggregations: Aggregations of these sums.
        max_radius_m: Radius in meters at which r saturates.
    """
    all_blocks = list(range(len(sums.observed_frames)))
    selections = [all_blocks]
    if len(all_blocks) > 1:
        selections += [all_blocks[:block] + all_blocks[block + 1 :] for block in all_blocks]
    values: list[Tensor] = []
    quantities: list[Quantity] = []
    for aggregation in aggregations:
        quantities += aggregation.quantities
        states = aggregation.create_states(1)
        is_additive = all(state.reduction == "sum" for state in states.values())
        selection_values = []
        for blocks in selections if is_additive else selections[:1]:
            reduced_sums = {}
            for name, block_sums in sums.sums_by_aggregation[aggregation.name].items():
                is_sum = states[name].reduction == "sum"
                reduced_sums[name] = block_sums[..., blocks, :].sum(dim=-2) if is_sum else block_sums.amax(dim=-2)
            observed_frames = sums.observed_frames[blocks].sum(dim=0).long()
            layers = aggregation.compute_layers(reduced_sums, observed_frames, max_radius_m)
            selection_values.append(torch.stack([layer.values for layer in layers], dim=1))
        unknown = torch.full_like(selection_values[0], math.nan)
        selection_values += [unknown] * (len(selections) - len(selection_values))
        values.append(torch.stack(selection_values))
    all_values = torch.cat(values, dim=2)
    return AggregatedNumbers(tuple(quantities), all_values[0], all_values[1:])
