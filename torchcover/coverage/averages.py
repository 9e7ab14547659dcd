"""Averages over regions, by area or over observed cells, and standard errors of maps."""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from torchcover.coverage.regions import Region
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import MIN_BLOCKS, Estimate, Quantity, estimate_ratio_errors

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage

# The number of a region averages its visible surface, its observed cells, or the positions of a test target.
Average = Literal["area", "cells", "target_positions"]


def estimate_cell_average(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """Estimate the unweighted mean over the observed cells of a region (the average of the paper).

    Args:
        coverage: Result with maps, and with sums in blocks for errors.
        region: Region within the grid.
        band: Name of the height band.

    Returns:
        Radius and detection rates; NaN without observed cells.
    """
    cell_mask, band_index = coverage.get_cell_mask(region), coverage.get_band_index(band)
    observed = coverage.observed_cells.mask_cells(cell_mask, band_index)
    frame_counts = coverage.observed_cells.observed_frames[observed]
    layers = [coverage.sparse_layers[quantity.key].values[observed] for quantity in coverage.quantities]
    sums = frame_counts * torch.stack(layers)
    value = compute_cell_average(frame_counts, sums)
    blocks = coverage.block_sums
    if blocks is None:
        return Estimate.from_values(coverage.quantities, value)
    used_blocks = blocks.frame_counts.nonzero().flatten().tolist()
    block_frame_counts, block_sums = blocks.extract_cells(cell_mask, band_index)
    jackknife_values = [value.new_empty((0, len(value)))]
    for block in used_blocks:
        value_without = compute_cell_average(frame_counts - block_frame_counts[block], sums - block_sums[:, block])
        jackknife_values.append(value_without[None])
    recompute = partial(_recompute_cell_average, blocks, band_index, cell_mask)
    used_frame_counts = blocks.frame_counts[used_blocks]
    return Estimate(coverage.quantities, value, torch.cat(jackknife_values), used_frame_counts, recompute)


def estimate_area_average(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """Estimate the mean over the visible surface of a region from the sums of `sum_area_by_block`.

    Args:
        coverage: Result with area weights.
        region: As in `sum_area_by_block`.
        band: Name of the height band.

    Returns:
        Radius and detection rates; NaN without visible surface.
    """
    frame_counts, sums = sum_area_by_block(coverage, region, band)
    return Estimate.from_ratios(coverage.quantities, sums[:, 0], sums[:, 1:], frame_counts)


def sum_area_by_block(coverage: "Coverage", region: Region, band: str) -> tuple[Tensor, Tensor]:
    """Sum area and area-weighted quantities over the observed surface of a region, per block of frames.

    The mean R = E[ sum of r dA ] / E[ sum of dA ] of a quantity r is a ratio of additive sums. It does not depend on the
    number of points, the cell size or the share of observed cells. Either the metric assigned the points to the region
    by their position, or the bounds of the region are cell edges, so that its cells contain the same points.

    Args:
        coverage: Result with area weights.
        region: Region of the result, or one whose bounds are cell edges.
        band: Name of the height band.

    Returns:
        (B,) int64 number of frames in each block, and (B, 1 + Q) float64 sums: area in square meters, then area times
        each of `coverage.quantities`.

    Raises:
        ValueError: The reference points have no area weights, or the region has other bounds than cells.
    """
    if coverage.area_sums is None:
        raise ValueError(
            "no average over area: the reference points have no area weights; take them from a SurfaceReference and "
            "set has_area_weights=True"
        )
    region_band_index, region_sums = coverage.find_region_band(region, band), coverage.region_sums
    if region_sums is not None and region_band_index is not None:
        sums = region_sums.sums[:, : len(coverage.quantities), region_band_index]
        return region_sums.frame_counts, torch.cat([region_sums.areas_m2[:, region_band_index, None], sums], dim=1)
    if not region.has_whole_cells(coverage.grid):
        raise ValueError(
            f"region {region.name!r}: its points were not summed, and its bounds are not edges of the cells of "
            f"{coverage.grid.cell_m:g} m; give the region to the metric, or move its bounds to cell edges"
        )
    cell_mask, band_index = coverage.get_cell_mask(region), coverage.get_band_index(band)
    return coverage.area_sums.frame_counts, coverage.area_sums.sum_cells(cell_mask, band_index)


def estimate_redundancy(coverage: "Coverage", region: Region, band: str) -> Estimate:
    """Estimate the numbers of a region with all sensors, followed by its redundancy (`list_redundancy_quantities`).

    Args:
        coverage: Result of a metric with `sensor_names`.
        region: Region within the grid.
        band: Name of the height band.

    Returns:
        By area, numbers are NaN for regions that the metric did not sum. Over cells, numbers have no errors.
    """
    assert coverage.redundancy is not None
    layers = coverage.redundancy.sparse_layers.values()
    quantities = (*coverage.quantities, *(layer.quantity for layer in layers))
    region_band_index = coverage.find_region_band(region, band)
    if coverage.region_sums is not None and region_band_index is not None:
        return coverage.region_sums.estimate(quantities, region_band_index)
    if coverage.average == "area":
        unknown = torch.full((len(quantities),), math.nan, dtype=torch.float64, device="cpu")
        return Estimate.from_values(quantities, unknown)
    observed = coverage.mask_observed_cells(region, band)
    means = torch.stack([layer.values[observed].mean() for layer in layers])
    return Estimate.from_values(quantities, torch.cat([coverage.estimate(region, band).value, means]))


def estimate_cell_errors(
    quantities: Sequence[Quantity], observed_cells: ObservedCells, block_sums: BlockSums
) -> dict[str, Tensor]:
    """Estimate the standard errors of maps.

    Args:
        quantities: Q quantities of the sums.
        observed_cells: K observed cells.
        block_sums: Sums over these cells in blocks.

    Returns:
        (K,) standard errors by the key of each quantity; NaN where fewer than 8 blocks observed the cell.
    """
    cells, denominators, sums = block_sums.extract_common_cells(MIN_BLOCKS)
    positions = torch.searchsorted(observed_cells.cell_indices, cells)
    errors = {}
    for quantity, numerators in zip(quantities, sums, strict=True):
        values = sums.new_full((len(observed_cells.cell_indices),), math.nan)
        values[positions] = estimate_ratio_errors(denominators, numerators, quantity.unit)
        errors[quantity.key] = values
    return errors


def compute_cell_average(frame_counts: Tensor, sums: Tensor) -> Tensor:
    """Compute the unweighted mean over observed cells.

    Args:
        frame_counts: (K,) frames that observed each cell; cells with 0 do not count.
        sums: (Q, K) sums over these frames.

    Returns:
        (Q,) means; NaN without observed cells.
    """
    observed = frame_counts > 0
    return (sums[:, observed] / frame_counts[observed]).mean(dim=1)


def _recompute_cell_average(blocks: BlockSums, band_index: int, cell_mask: Tensor, weights: Tensor) -> Tensor:
    """Recompute the (R, Q) means for (R, g) weights of the used blocks."""
    used_blocks = blocks.frame_counts > 0
    # Extracted on each call, since for all regions together it would be as large as the sums of the run.
    block_frame_counts, block_sums = blocks.extract_cells(cell_mask, band_index)
    frame_counts = weights @ block_frame_counts[used_blocks].double()
    observed = frame_counts > 0
    means = (weights @ block_sums[:, used_blocks]) / frame_counts.where(observed, 1.0)
    return (means.sum(dim=2) / observed.sum(dim=1)).T
