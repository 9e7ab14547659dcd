"""The numbers of one region, over its visible surface or over its known cells; and the errors of maps."""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from torchcover.coverage.regions import Region
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import MIN_BLOCKS_OF_A_CELL, Estimate, Quantity, estimate_ratio_errors

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage

# What the number of a region is a mean over: its visible surface, its known cells, or places of a body.
Average = Literal["area", "cells", "target_positions"]


def estimate_cell_average(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """Unweighted means over the known cells of a region, NaN without any, and what they become without each block."""
    cells, band_index, blocks = coverage.get_cell_mask(region), coverage.get_band_index(band), coverage.block_sums
    known = coverage.observed_cells.mask_cells(cells, band_index)
    probed = coverage.observed_cells.observed_frames[known]
    sums = probed * torch.stack([coverage.sparse_layers[one.key].values[known] for one in coverage.quantities])
    whole = compute_cell_average(probed, sums)
    if blocks is None:
        return Estimate.from_values(coverage.quantities, whole)
    used = blocks.frame_counts.nonzero().flatten().tolist()
    own_probed, own_sums = blocks.extract_cells(cells, band_index)
    left_out = [compute_cell_average(probed - own_probed[block], sums - own_sums[:, block]) for block in used]
    without = torch.stack(left_out) if left_out else whole[None][:0]
    return Estimate(
        coverage.quantities, whole, without, blocks.frame_counts[used], partial(_known_again, blocks, band_index, cells)
    )


def estimate_area_average(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """The ratios of `sum_area_by_block`; NaN where no square metre was seen."""
    steps, sums = sum_area_by_block(coverage, region, band)
    return Estimate.from_ratios(coverage.quantities, sums[:, 0], sums[:, 1:], steps)


def sum_area_by_block(coverage: "Coverage", region: Region, band: str) -> tuple[Tensor, Tensor]:
    """The sums over the visible surface of one region in one band, in blocks.

    R = E[ sum of r dA ] / E[ sum of dA ]: a ratio of additive sums, so that the number of points, the size of cells and
    the share of known ones do not move it. Points were summed up by their own place, or the region's bounds are edges
    of cells, which have the same points.

    Returns (B,) int64 steps of each block; (B, 1 + Q) float64 its square metres, then those times each of the
    quantities.
    """
    if coverage.area_sums is None:
        raise ValueError(
            "no estimate by area: the reference points had no square metres; take them from a SurfaceReference and "
            "give the metric square_metres=True"
        )
    place, places = coverage.find_region_band(region, band), coverage.region_sums
    if places is not None and place is not None:
        own = places.sums[:, : len(coverage.quantities), place]
        return places.frame_counts, torch.cat([places.areas_m2[:, place, None], own], dim=1)
    if not region.has_whole_cells(coverage.grid):
        raise ValueError(
            f"region {region.name!r}: no points were summed up over it, and cells of {coverage.grid.cell_m:g} m cannot "
            "tell, for its edges are not theirs; ask for it when measuring, or move its edges"
        )
    return coverage.area_sums.frame_counts, coverage.area_sums.sum_cells(
        coverage.get_cell_mask(region), coverage.get_band_index(band)
    )


def estimate_redundancy(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """The numbers of a region with all sensors, then those of `list_redundancy_quantities`.

    By area they are unknown where the metric was not told of the region. Over known cells they have no errors.
    """
    assert coverage.redundancy is not None
    layers = coverage.redundancy.sparse_layers.values()
    quantities = (*coverage.quantities, *(layer.quantity for layer in layers))
    place = coverage.find_region_band(region, band)
    if coverage.region_sums is not None and place is not None:
        return coverage.region_sums.estimate(quantities, place)
    if coverage.average == "area":
        return Estimate.from_values(
            quantities, torch.full((len(quantities),), math.nan, dtype=torch.float64, device="cpu")
        )
    known = coverage.mask_observed_cells(region, band)
    own = torch.stack([layer.values[known].mean() for layer in layers])
    return Estimate.from_values(quantities, torch.cat([coverage.estimate(region, band).value, own]))


def estimate_cell_errors(
    quantities: Sequence[Quantity], observed_cells: ObservedCells, block_sums: BlockSums
) -> dict[str, Tensor]:
    """Key of each quantity -> (K,) standard errors in the known cells; NaN where too few blocks probed."""
    cells, base, sums = block_sums.extract_common_cells(MIN_BLOCKS_OF_A_CELL)
    where, errors = torch.searchsorted(observed_cells.cell_indices, cells), {}
    for quantity, own in zip(quantities, sums, strict=True):
        errors[quantity.key] = sums.new_full((len(observed_cells.cell_indices),), math.nan)
        errors[quantity.key][where] = estimate_ratio_errors(base, own, quantity.unit)
    return errors


def compute_cell_average(frame_counts: Tensor, sums: Tensor) -> Tensor:
    """(Q,) unweighted means over K known cells of sums (Q, K) over the (K,) steps that probed them; NaN without any."""
    known = frame_counts > 0
    return (sums[:, known] / frame_counts[known]).mean(dim=1)


def _known_again(blocks: BlockSums, band: int, cells: Tensor, weights: Tensor) -> Tensor:
    """(R, Q) the same if the blocks in use come as often as (R, g) they are weighted."""
    used = blocks.frame_counts > 0
    # Not kept with the estimate: for all regions it is as large as the sums of the run.
    probed, sums = blocks.extract_cells(cells, band)
    steps = weights @ probed[used].double()
    known = steps > 0
    means = (weights @ sums[:, used]) / steps.where(known, 1.0)
    return (means.sum(dim=2) / known.sum(dim=1)).T
