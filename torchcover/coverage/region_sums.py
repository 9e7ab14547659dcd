"""Sums over regions: a region in a height band is one large cell of the points in it, whose sums are kept in blocks."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.aggregations import Aggregation, BinnedStep, State
from torchcover.coverage.binning import mean_per_cell
from torchcover.coverage.regions import Places
from torchcover.estimation import Estimate, Quantity

# The states that are about regions begin with it.
IN_REGIONS = "regions"


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


class RegionSums:
    """The states over regions: sums by area, and those of aggregations; for numbers there, and their errors.

    A point belongs to a region by its own place, whatever the cells are. An aggregation is asked as for a map, but for
    one cell a region and band: its number is what it makes of all points there. States that are added up are kept in
    blocks; of a largest value no error is known, for it is the same whichever block is left out but one.

    Args:
        aggregations: Whose numbers.
        places: Regions and bands.
        blocks: Blocks of contiguous steps.
        by_area: In how many fine blocks how many values of each point are summed up with its square metres; None
            without these.
    """

    def __init__(
        self, aggregations: Sequence[Aggregation], places: Places, blocks: int, by_area: tuple[int, int] | None
    ) -> None:
        self.aggregations = tuple(aggregations) if places.count else ()
        self.places = places
        self.blocks = blocks
        self.by_area = by_area if places.count else None

    def states(self) -> dict[str, State]:
        """The empty sums, by name.

        By area `m2` (B, P) and `sums` (B, V, P), as in `PlaceSums`. With aggregations `probed` (B, P), steps of a block
        with a point in the place, and those of each, (B, ..., P).
        """
        zero, states = torch.zeros((), dtype=torch.float64), dict[str, State]()
        if self.by_area:
            blocks, values = self.by_area
            states["m2"] = State(zero.expand(blocks, self.places.count), in_blocks=True, fine=True)
            states["sums"] = State(zero.expand(blocks, values, self.places.count), in_blocks=True, fine=True)
        if self.aggregations:
            states["probed"] = self._in_blocks(State(zero.long().expand(self.places.count)))
        for aggregation in self.aggregations:
            for name, state in aggregation.states(self.places.count).items():
                states[f"{aggregation.name}_{name}"] = self._in_blocks(state)
        return states

    def _in_blocks(self, state: State) -> State:
        added = state.reduction == "sum"
        shape = (self.blocks if added else 1, *state.initial.shape)
        return State(state.initial.expand(shape), state.reduction, in_blocks=added)

    def update(self, sums: Mapping[str, Tensor], step: BinnedStep, fine: int, points: Tensor) -> None:
        """Add the points of a step of a fine block, (N, 3) in metres, to all regions that they lie in."""
        if not sums:
            return
        place, point = self.places.of_points(points, step.cell)
        values = step.values[:, point]
        weight = None if step.weight is None else step.weight[point]
        means = mean_per_cell(place, values, self.places.count, weight)
        if self.by_area:
            sums["m2"][fine, means.cell] += means.weight
            sums["sums"][fine][:, means.cell] += means.mean * means.weight
        if not self.aggregations:
            return
        sums["probed"][step.block, means.cell] += 1
        there = BinnedStep(place, values, weight, means, 0, self.places.count)
        for aggregation in self.aggregations:
            own = self._of(aggregation, sums)
            aggregation.update({name: state[min(step.block, len(state) - 1)] for name, state in own.items()}, there)

    def area(self, sums: Mapping[str, Tensor], steps: Tensor) -> PlaceSums | None:
        """A copy of the sums by area; None without them."""
        return PlaceSums(steps.clone(), sums["m2"].clone(), sums["sums"].clone()) if self.by_area else None

    def numbers(self, sums: Mapping[str, Tensor], max_radius: float) -> PlaceNumbers | None:
        """What the sums say; None without aggregations."""
        if not self.aggregations:
            return None
        every = list(range(self.blocks))
        choices = [every, *(every[:block] + every[block + 1 :] for block in every if self.blocks > 1)]
        values = []
        for aggregation in self.aggregations:
            own = self._of(aggregation, sums)
            in_blocks = all(len(state) == self.blocks for state in own.values())
            each = []
            for blocks in choices if in_blocks else choices[:1]:
                chosen = {name: state[blocks].sum(dim=0) if len(state) > 1 else state[0] for name, state in own.items()}
                layers = aggregation.layers(chosen, sums["probed"][blocks].sum(dim=0), max_radius)
                each.append(torch.stack([layer.values for layer in layers], dim=1))
            unknown = torch.full_like(each[0], math.nan)
            values.append(torch.stack(each if in_blocks else [*each, *[unknown] * (len(choices) - 1)]))
        found = torch.cat(values, dim=2)
        quantities = tuple(quantity for one in self.aggregations for quantity in one.quantities)
        return PlaceNumbers(quantities, found[0], found[1:])

    def _of(self, aggregation: Aggregation, sums: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: sums[f"{aggregation.name}_{name}"] for name in aggregation.states(self.places.count)}
