"""The numbers of one region, over its visible surface or over its known cells; and the errors of maps."""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from torchcover.coverage.blocks import BlockSums, KnownCells
from torchcover.coverage.regions import Region
from torchcover.estimation import MIN_BLOCKS_OF_A_CELL, Estimate, Quantity, ratio_errors

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage

# What the number of a region is a mean over: its visible surface, its known cells, or places of a body.
Measure = Literal["area", "cells", "target_positions"]


def estimate_known(coverage: "Coverage", region: Region, height: str) -> Estimate:
    """Unweighted means over the known cells of a region, NaN without any, and what they become without each block."""
    cells, band, blocks = coverage.cells_of(region), coverage.band_of(height), coverage.blocks
    known = coverage.known.within(cells, band)
    probed = coverage.known.probed_steps[known]
    sums = probed * torch.stack([coverage.listed[one.key].values[known] for one in coverage.quantities])
    whole = known_mean(probed, sums)
    if blocks is None:
        return Estimate.of(coverage.quantities, whole)
    used = blocks.steps.nonzero().flatten().tolist()
    own_probed, own_sums = blocks.spread_over(cells, band)
    left_out = [known_mean(probed - own_probed[block], sums - own_sums[:, block]) for block in used]
    without = torch.stack(left_out) if left_out else whole[None][:0]
    return Estimate(coverage.quantities, whole, without, blocks.steps[used], partial(_known_again, blocks, band, cells))


def estimate_area(coverage: "Coverage", region: Region, height: str) -> Estimate:
    """The ratios of `area_in_blocks`; NaN where no square metre was seen."""
    steps, sums = area_in_blocks(coverage, region, height)
    return Estimate.of_ratios(coverage.quantities, sums[:, 0], sums[:, 1:], steps)


def area_in_blocks(coverage: "Coverage", region: Region, height: str) -> tuple[Tensor, Tensor]:
    """The sums over the visible surface of one region in one band, in blocks.

    R = E[ sum of r dA ] / E[ sum of dA ]: a ratio of additive sums, so that the number of points, the size of cells and
    the share of known ones do not move it. Points were summed up by their own place, or the region's bounds are edges
    of cells, which have the same points.

    Returns (B,) int64 steps of each block; (B, 1 + Q) float64 its square metres, then those times each of the
    quantities.
    """
    if coverage.area is None:
        raise ValueError(
            "no estimate by area: the reference points had no square metres; take them from a SurfaceReference and "
            "give the metric square_metres=True"
        )
    place, places = coverage.place_of(region, height), coverage.places
    if places is not None and place is not None:
        own = places.sums[:, : len(coverage.quantities), place]
        return places.steps, torch.cat([places.m2[:, place, None], own], dim=1)
    if not region.has_whole_cells(coverage.grid):
        raise ValueError(
            f"region {region.name!r}: no points were summed up over it, and cells of {coverage.grid.cell:g} m cannot "
            "tell, for its edges are not theirs; ask for it when measuring, or move its edges"
        )
    return coverage.area.steps, coverage.area.over(coverage.cells_of(region), coverage.band_of(height))


def estimate_redundancy(coverage: "Coverage", region: Region, height: str) -> Estimate:
    """The numbers of a region with all sensors, then those of `redundancy_quantities`.

    By area they are unknown where the metric was not told of the region. Over known cells they have no errors.
    """
    assert coverage.redundancy is not None
    layers = coverage.redundancy.listed.values()
    quantities = (*coverage.quantities, *(layer.quantity for layer in layers))
    place = coverage.place_of(region, height)
    if coverage.places is not None and place is not None:
        return coverage.places.estimate(quantities, place)
    if coverage.measure == "area":
        return Estimate.of(quantities, torch.full((len(quantities),), math.nan, dtype=torch.float64, device="cpu"))
    known = coverage.known_in(region, height)
    own = torch.stack([layer.values[known].mean() for layer in layers])
    return Estimate.of(quantities, torch.cat([coverage.estimate(region, height).value, own]))


def errors_of_cells(quantities: Sequence[Quantity], known: KnownCells, blocks: BlockSums) -> dict[str, Tensor]:
    """Key of each quantity -> (K,) standard errors in the known cells; NaN where too few blocks probed."""
    cells, base, sums = blocks.spread_where(MIN_BLOCKS_OF_A_CELL)
    where, errors = torch.searchsorted(known.at, cells), {}
    for quantity, own in zip(quantities, sums, strict=True):
        errors[quantity.key] = sums.new_full((len(known.at),), math.nan)
        errors[quantity.key][where] = ratio_errors(base, own, quantity.unit)
    return errors


def known_mean(probed: Tensor, sums: Tensor) -> Tensor:
    """(Q,) unweighted means over K known cells of sums (Q, K) over the (K,) steps that probed them; NaN without any."""
    known = probed > 0
    return (sums[:, known] / probed[known]).mean(dim=1)


def _known_again(blocks: BlockSums, band: int, cells: Tensor, weights: Tensor) -> Tensor:
    """(R, Q) the same if the blocks in use come as often as (R, g) they are weighted."""
    used = blocks.steps > 0
    # Not kept with the estimate: for all regions it is as large as the sums of the run.
    probed, sums = blocks.spread_over(cells, band)
    steps = weights @ probed[used].double()
    known = steps > 0
    means = (weights @ sums[:, used]) / steps.where(known, 1.0)
    return (means.sum(dim=2) / known.sum(dim=1)).T
