"""Sums over regions: a region in a height band is one large cell of the points in it, by their own places."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation
from torchcover.coverage.sum_columns import CellSums
from torchcover.estimation import Estimate, Quantity


class AggregatedNumbers(NamedTuple):
    """What aggregations say of P regions and bands, region by region.

    `values` (P, Q) float64, NaN where unknown; `jackknife_values` (B, P, Q) without each of the blocks, NaN of an aggregation
    that no error is known of; no row where there is one block.
    """

    quantities: tuple[Quantity, ...]
    values: Tensor
    jackknife_values: Tensor


class RegionSums(NamedTuple):
    """Sums over the visible surface of P regions and bands, region by region, in B fine blocks of steps.

    `frame_counts` (B,) int64 steps in each block; `areas_m2` (B, P) float64 square metres; `sums` (B, V, P) those times the radius
    and the detections, then, of a metric that knows the sensors, times each of `list_redundancy_quantities`.
    """

    frame_counts: Tensor
    areas_m2: Tensor
    sums: Tensor

    def estimate(self, quantities: Sequence[Quantity], region_band_index: int) -> Estimate:
        """The ratios of one place: the first of the V, as many as there are quantities."""
        return Estimate.from_ratios(
            quantities,
            self.areas_m2[:, region_band_index],
            self.sums[:, : len(quantities), region_band_index],
            self.frame_counts,
        )


def compute_aggregated_numbers(
    sums: CellSums, aggregations: Sequence[Aggregation], max_radius_m: float
) -> AggregatedNumbers:
    """What aggregations say of P places, from (..., B, P) sums in blocks: as of maps, of one cell a region and band.

    Of a largest value no error is known, for it is the same whichever block is left out but one.
    """
    every = list(range(len(sums.observed_frames)))
    choices = [every, *(every[:block] + every[block + 1 :] for block in every if len(every) > 1)]
    values = []
    for aggregation in aggregations:
        reductions = {name: state.reduction for name, state in aggregation.create_states(1).items()}
        added = "max" not in reductions.values()
        each = []
        for blocks in choices if added else choices[:1]:
            own = {
                name: state[..., blocks, :].sum(dim=-2) if reductions[name] == "sum" else state.amax(dim=-2)
                for name, state in sums.sums_by_aggregation[aggregation.name].items()
            }
            layers = aggregation.compute_layers(own, sums.observed_frames[blocks].sum(dim=0).long(), max_radius_m)
            each.append(torch.stack([layer.values for layer in layers], dim=1))
        unknown = torch.full_like(each[0], math.nan)
        values.append(torch.stack(each if added else [*each, *[unknown] * (len(choices) - 1)]))
    found = torch.cat(values, dim=2)
    quantities = tuple(quantity for one in aggregations for quantity in one.quantities)
    return AggregatedNumbers(quantities, found[0], found[1:])
