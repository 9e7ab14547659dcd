"""The numbers of one region, over its visible surface or over its known cells; and the errors of maps."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from torchcover.coverage.blocks import AreaSums, Blocks, BlockSums
from torchcover.estimation import MIN_BLOCKS_OF_A_CELL, Estimate, Quantity, ratio_errors

# What the number of a region is a mean over: its visible surface, or its known cells.
Measure = Literal["area", "known"]


def estimate_known(
    quantities: Sequence[Quantity], probed: Tensor, sums: Tensor, blocks: Blocks | None, band: int, cells: Tensor
) -> Estimate:
    """The unweighted means over the known cells of a region, and what they become without each block.

    Args:
        quantities: What the numbers are: the mean radius, then the detection at each threshold.
        probed: (K,) steps that had a reference point in each cell of the region; cells without may be left out.
        sums: (Q, K) sums over these steps of the radius and of the detection at each threshold.
        blocks: The same in blocks, over the whole grid, if there are any.
        band: Number of the height band.
        cells: (Y, X) bool, the K cells of the region.

    Returns:
        NaN where no cell is known.
    """
    whole = known_mean(probed, sums)
    if blocks is None:
        return Estimate.of(quantities, whole)
    used = blocks.steps.nonzero().flatten().tolist()
    own_probed, own_sums = blocks.spread_over(_in_band(blocks, band, cells))
    left_out = [known_mean(probed - own_probed[block], sums - own_sums[:, block]) for block in used]
    without = torch.stack(left_out) if left_out else whole[None][:0]
    return Estimate(tuple(quantities), whole, without, blocks.steps[used], partial(_known_again, blocks, band, cells))


def estimate_area(quantities: Sequence[Quantity], area: AreaSums | None, band: int, cells: Tensor) -> Estimate:
    """The ratio of sums over the visible surface of a region, and what it becomes without each block.

    R = E[ sum of r dA ] / E[ sum of dA ]: a ratio of additive sums, so that the number of points, the size of cells and
    the share of known ones do not move it.

    Args:
        quantities: What the numbers are, as in `estimate_known`.
        area: The sums over the whole grid, if there are any.
        band: Number of the height band.
        cells: (Y, X) bool, the cells of the region.

    Returns:
        NaN where no square metre was seen.

    Raises:
        ValueError: There are no such sums.
    """
    if area is None:
        raise ValueError(
            "no estimate by area: the reference points had no square metres; take them from a SurfaceReference and "
            "give the metric square_metres=True"
        )
    each = area_in_blocks(area, band, cells)
    return Estimate.of_ratios(quantities, each[:, 0], each[:, 1:], area.steps)


def errors_of_cells(quantities: Sequence[Quantity], blocks: BlockSums) -> dict[str, Tensor]:
    """Key of each quantity -> (H, Y, X) standard errors of its map; NaN where too few blocks probed."""
    where = blocks.known_in() >= MIN_BLOCKS_OF_A_CELL
    base, sums = blocks.spread_over(where)
    errors = {}
    for quantity, own in zip(quantities, sums, strict=True):
        errors[quantity.key] = sums.new_full(blocks.shape[1:], math.nan)
        errors[quantity.key][where] = ratio_errors(base, own, quantity.unit)
    return errors


def area_in_blocks(area: AreaSums, band: int, cells: Tensor) -> Tensor:
    """(B, 1 + Q) the square metres of a region in each block, then those times each quantity; as `estimate_area`."""
    return area.over(_in_band(area, band, cells))


def _in_band(blocks: BlockSums, band: int, cells: Tensor) -> Tensor:
    """(H, Y, X) bool: these cells in this band."""
    chosen = torch.zeros(blocks.shape[1:], dtype=torch.bool, device=cells.device)
    chosen[band] = cells
    return chosen


def known_mean(probed: Tensor, sums: Tensor) -> Tensor:
    """(Q,) unweighted means over the known cells; NaN if none is known.

    Args:
        probed: (K,) steps that had a reference point in each cell.
        sums: (Q, K) sums over these steps.
    """
    known = probed > 0
    return (sums[:, known] / probed[known]).mean(dim=1)


def _known_again(blocks: Blocks, band: int, cells: Tensor, weights: Tensor) -> Tensor:
    """(R, Q) the same if the blocks in use come as often as (R, g) they are weighted."""
    used = blocks.steps > 0
    # Not kept with the estimate: for all regions it is as large as the sums of the run.
    probed, sums = blocks.spread_over(_in_band(blocks, band, cells))
    steps = weights @ probed[used].double()
    known = steps > 0
    means = (weights @ sums[:, used]) / steps.where(known, 1.0)
    return (means.sum(dim=2) / known.sum(dim=1)).T
