"""The numbers of one region: over its visible surface, over its known cells, or over those it would know in the end."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchcover.coverage.blocks import AreaSums, Blocks
from torchcover.coverage.errors import jackknife_error

CellEstimator = Literal["known", "completed"]
Estimator = Literal["known", "completed", "area"]
# Those that a result may be headed by: "area" where the reference points have square metres.
Measure = Literal["known", "area"]


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


def estimate_region(
    probed: Tensor, sums: Tensor, blocks: Blocks | None, band: int, cells: Tensor, estimator: CellEstimator
) -> RegionEstimate:
    """Estimate the numbers of a region, and what they become without each block.

    Args:
        probed: (K,) steps that had a reference point in each cell of the region.
        sums: (Q, K) sums over these steps of the radius and of the detection at each threshold.
        blocks: The same in blocks, over the whole grid, if there are any.
        band: Number of the height band.
        cells: (Y, X) bool, the K cells of the region.
        estimator: "known" for the unweighted mean over the known cells, "completed" for `completed_mean`.
    """
    mean = ESTIMATORS[estimator]
    whole = mean(probed, sums)
    if blocks is None:
        return RegionEstimate(whole, whole.new_empty((0, len(whole))), whole.new_empty(0))
    left_out = []
    used = blocks.steps.nonzero().flatten().tolist()
    for block in used:
        own = blocks.sums[block, :, band][:, cells]
        left_out.append(mean(probed - blocks.probed_steps[block, band][cells], sums - own))
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
    m2, sums = area.m2[:, band][:, cells].sum(dim=1), area.sums[:, :, band][:, :, cells].sum(dim=2)
    whole = sums.sum(dim=0) / m2.sum()
    used = area.steps.nonzero().flatten().tolist() if len(area.steps) > 1 else []
    left_out = [_without(sums, block).sum(dim=0) / _without(m2, block).sum() for block in used]
    return RegionEstimate(whole, torch.stack(left_out) if left_out else whole[None][:0], area.steps[used])


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


def completed_mean(probed: Tensor, sums: Tensor) -> Tensor:
    """Means over the known cells and those that more steps would make known, which are thought to be like the rarest.

    As long as cells that can be seen are unknown, the known ones are the easy ones. How many are missing is the
    question of how many species a sample has missed, and has its answer (Chao 1987, Biometrics 43, 783-791, in the
    form without bias for few cells): f1 (f1 - 1) / (2 (f2 + 1)), where f1 and f2 cells were seen in one and in two
    steps. They are given the mean of the cells that were seen in one step only, which are the likest to them.

    Args:
        probed: (K,) steps that had a reference point in each cell.
        sums: (Q, K) sums over these steps.

    Returns:
        (Q,) means; NaN if no cell is known.

    Example:
        >>> probed = torch.tensor([9, 9, 1, 1, 1, 1, 2, 0, 0, 0])  # 12 / 4 = 3 more cells are like the singles
        >>> radius = torch.where(probed == 1, 1.0, 0.0)
        >>> completed_mean(probed, (radius * probed)[None]), known_mean(probed, (radius * probed)[None])
        (tensor([0.7000]), tensor([0.5714]))
    """
    known, single = probed > 0, probed == 1
    unseen = unseen_cells(probed)
    if unseen == 0:
        return known_mean(probed, sums)
    total = (sums[:, known] / probed[known]).sum(dim=1) + unseen * sums[:, single].mean(dim=1)
    return total / (known.sum() + unseen)


def unseen_cells(probed: Tensor) -> float:
    """About how many cells would become known with more steps; at most those that are unknown."""
    once, twice = int((probed == 1).sum()), int((probed == 2).sum())
    return min(once * (once - 1) / (2 * (twice + 1)), int((probed == 0).sum()))


ESTIMATORS: Mapping[str, Callable[[Tensor, Tensor], Tensor]] = MappingProxyType(
    {"known": known_mean, "completed": completed_mean}
)
