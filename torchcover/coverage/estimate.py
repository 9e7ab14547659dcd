"""The numbers of one region: over its visible surface, or over its known cells."""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.blocks import AreaSums, Blocks, BlockSums
from torchcover.coverage.errors import jackknife_error

# What the number of a region is a mean over: its visible surface, or its known cells.
Measure = Literal["area", "known"]


class RegionEstimate(NamedTuple):
    """Numbers of one region in one band: the mean radius in metres, then the detection at each threshold.

    Args:
        value: (Q,) from all steps.
        left_out: (g, Q) without one of the blocks after the other.
        steps: (g,) steps in these blocks.
    """

    value: Tensor
    left_out: Tensor
    steps: Tensor

    @property
    def error(self) -> Tensor:
        """(Q,) standard errors; NaN if there are not enough blocks."""
        return jackknife_error(self.left_out, self.value, self.steps)

    def minus(self, other: "RegionEstimate") -> "RegionEstimate":
        """The difference to another rig over the same steps: what both share cancels out, block by block."""
        return RegionEstimate(self.value - other.value, self.left_out - other.left_out, self.steps)


def estimate_known(probed: Tensor, sums: Tensor, blocks: Blocks | None, band: int, cells: Tensor) -> RegionEstimate:
    """The unweighted means over the known cells of a region, and what they become without each block.

    Args:
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
        return RegionEstimate(whole, whole.new_empty((0, len(whole))), whole.new_empty(0))
    used = blocks.steps.nonzero().flatten().tolist()
    own_probed, own_sums = blocks.spread_over(_in_band(blocks, band, cells))
    left_out = [known_mean(probed - own_probed[block], sums - own_sums[:, block]) for block in used]
    return RegionEstimate(whole, torch.stack(left_out) if left_out else whole[None][:0], blocks.steps[used])


def estimate_area(area: AreaSums, band: int, cells: Tensor) -> RegionEstimate:
    """The ratio of sums over the visible surface of a region, and what it becomes without each block.

    R = E[ sum of r dA ] / E[ sum of dA ]: a ratio of additive sums, so that the number of points, the size of cells and
    the share of known ones do not move it.

    Args:
        area: The sums over the whole grid.
        band: Number of the height band.
        cells: (Y, X) bool, the cells of the region.

    Returns:
        NaN where no square metre was seen.
    """
    each = area_in_blocks(area, band, cells)
    return estimate_ratio(each[:, 0], each[:, 1:], area.steps)


def estimate_ratio(m2: Tensor, sums: Tensor, steps: Tensor) -> RegionEstimate:
    """Ratios of sums in blocks, and what they become without each block.

    Args:
        m2: (B,) what is divided by.
        sums: (B, Q) sums.
        steps: (B,) steps in each block.
    """
    whole = sums.sum(dim=0) / m2.sum()
    used = steps.nonzero().flatten().tolist() if len(steps) > 1 else []
    left_out = [_without(sums, block).sum(dim=0) / _without(m2, block).sum() for block in used]
    return RegionEstimate(whole, torch.stack(left_out) if left_out else whole[None][:0], steps[used])


def area_in_blocks(area: AreaSums, band: int, cells: Tensor) -> Tensor:
    """(B, 1 + Q) the square metres of a region in each block, then those times each quantity; as `estimate_area`."""
    return area.over(_in_band(area, band, cells))


def _in_band(blocks: BlockSums, band: int, cells: Tensor) -> Tensor:
    """(H, Y, X) bool: these cells in this band."""
    chosen = torch.zeros(blocks.shape[1:], dtype=torch.bool, device=cells.device)
    chosen[band] = cells
    return chosen


def _without(sums: Tensor, block: int) -> Tensor:
    # Not by a difference: infinite radii, and what is left of nearly everything, would not survive it.
    return torch.cat([sums[:block], sums[block + 1 :]])


def known_mean(probed: Tensor, sums: Tensor) -> Tensor:
    """(Q,) unweighted means over the known cells; NaN if none is known.

    Args:
        probed: (K,) steps that had a reference point in each cell.
        sums: (Q, K) sums over these steps.
    """
    known = probed > 0
    return (sums[:, known] / probed[known]).mean(dim=1)
