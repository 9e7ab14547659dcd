"""Sums over regions: a region in a height band is one large cell of the points in it, by their own places."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation
from torchcover.coverage.columns import CellSums
from torchcover.estimation import Estimate, Quantity


class PlaceNumbers(NamedTuple):
    """What aggregations say of P regions and bands, region by region.

    `value` (P, Q) float64, NaN where unknown; `left_out` (B, P, Q) without each of the blocks, NaN of an aggregation
    that no error is known of; no row where there is one block.
    """

    quantities: tuple[Quantity, ...]
    value: Tensor
    left_out: Tensor


class PlaceSums(NamedTuple):
    """Sums over the visible surface of P regions and bands, region by region, in B fine blocks of steps.

    `steps` (B,) int64 steps in each block; `m2` (B, P) float64 square metres; `sums` (B, V, P) those times the radius
    and the detections, then, of a metric that knows the sensors, times each of `redundancy_quantities`.
    """

    steps: Tensor
    m2: Tensor
    sums: Tensor

    def estimate(self, quantities: Sequence[Quantity], place: int) -> Estimate:
        """The ratios of one place: the first of the V, as many as there are quantities."""
        return Estimate.of_ratios(quantities, self.m2[:, place], self.sums[:, : len(quantities), place], self.steps)


def numbers_of_places(sums: CellSums, aggregations: Sequence[Aggregation], max_radius: float) -> PlaceNumbers:
    """What aggregations say of P places, from (..., B, P) sums in blocks: as of maps, of one cell a region and band.

    Of a largest value no error is known, for it is the same whichever block is left out but one.
    """
    every = list(range(len(sums.probed_steps)))
    choices = [every, *(every[:block] + every[block + 1 :] for block in every if len(every) > 1)]
    values = []
    for aggregation in aggregations:
        reductions = {name: state.reduction for name, state in aggregation.states(1).items()}
        added = "max" not in reductions.values()
        each = []
        for blocks in choices if added else choices[:1]:
            own = {
                name: state[..., blocks, :].sum(dim=-2) if reductions[name] == "sum" else state.amax(dim=-2)
                for name, state in sums.of[aggregation.name].items()
            }
            layers = aggregation.layers(own, sums.probed_steps[blocks].sum(dim=0).long(), max_radius)
            each.append(torch.stack([layer.values for layer in layers], dim=1))
        unknown = torch.full_like(each[0], math.nan)
        values.append(torch.stack(each if added else [*each, *[unknown] * (len(choices) - 1)]))
    found = torch.cat(values, dim=2)
    quantities = tuple(quantity for one in aggregations for quantity in one.quantities)
    return PlaceNumbers(quantities, found[0], found[1:])
