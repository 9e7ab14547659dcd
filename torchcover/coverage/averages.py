"""Average over observed cells, and standard errors of maps."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import MIN_BLOCKS, Estimate, Quantity, estimate_ratio_errors

# The number of a region averages its visible surface, its observed cells, or the positions of a test target.
Average = Literal["area", "cells", "target_positions"]


def estimate_cell_average(
    quantities: Sequence[Quantity],
    observed_cells: ObservedCells,
    values: Tensor,
    blocks: BlockSums | None,
    cell_mask: Tensor,
    band_index: int,
) -> Estimate:
    """Estimate the unweighted mean over the observed cells of a region (the average of the paper).

    Args:
        quantities: Q quantities of the sums.
        observed_cells: K observed cells.
        values: (Q, K) means over frames.
        blocks: Sums over these cells in blocks, for errors; None without blocks.
        cell_mask: (Y, X) bool cells of the region.
        band_index: Index of the height band.

    Returns:
        Radius and detection rates; NaN without observed cells.
    """
    observed = observed_cells.mask_cells(cell_mask, band_index)
    frame_counts = observed_cells.observed_frames[observed]
    sums = frame_counts * values[:, observed]
    value = compute_cell_average(frame_counts, sums)
    if blocks is None:
        return Estimate.from_values(quantities, value)
    used_blocks = blocks.frame_counts.nonzero().flatten().tolist()
    block_frame_counts, block_sums = blocks.extract_cells(cell_mask, band_index)
    jackknife_values = [value.new_empty((0, len(value)))]
    for block in used_blocks:
        value_without = compute_cell_average(frame_counts - block_frame_counts[block], sums - block_sums[:, block])
        jackknife_values.append(value_without[None])
    recompute = partial(_recompute_cell_average, blocks, band_index, cell_mask)
    used_frame_counts = blocks.frame_counts[used_blocks]
    return Estimate(tuple(quantities), value, torch.cat(jackknife_values), used_frame_counts, recompute)


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
