"""Standard errors from blocks of contiguous steps: the block jackknife."""

import math

import torch
from torch import Tensor

from torchcover.coverage.blocks import MIN_BLOCKS, Blocks

# Errors below come from rounding in sums of float64: the estimate is the same whichever block is left out.
ROUND_OFF = 1e-12
# A cell has an error if it was probed in at least as many blocks.
MIN_BLOCKS_OF_A_CELL = 4


def jackknife_error(left_out: Tensor, whole: Tensor, steps: Tensor) -> Tensor:
    """Standard error of an estimate from what it becomes as one block after the other is left out.

    The delete-m_j jackknife for blocks of unequal size (Busing, Meijer & van der Leeden 1999, Statistics and Computing
    9, 3-8): with h_j = n / m_j and the pseudo-values p_j = h_j whole - (h_j - 1) left_out_j,

        error^2 = 1/g sum_j (p_j - mean of the estimates)^2 / (h_j - 1).

    Args:
        left_out: (g, ...) estimates without block j.
        whole: (...) estimate from all blocks.
        steps: (g,) steps m_j of each block, all above 0.

    Returns:
        (...) standard errors; NaN for fewer than 8 blocks, and where an estimate is not finite.

    Example:
        >>> values = torch.arange(10.0, dtype=torch.float64)           # one step a block: the error of a mean
        >>> left_out = (values.sum() - values) / 9
        >>> error = jackknife_error(left_out, values.mean(), torch.ones(10))
        >>> torch.isclose(error, values.std() / 10**0.5)
        tensor(True)
    """
    blocks = len(steps)
    if blocks < MIN_BLOCKS:
        return torch.full_like(whole, math.nan)
    ratio = (steps.sum() / steps.double()).view(-1, *[1] * whole.dim())
    pseudo = ratio * whole - (ratio - 1) * left_out
    centre = blocks * whole - ((1 - 1 / ratio) * left_out).sum(dim=0)
    error = (((pseudo - centre) ** 2 / (ratio - 1)).mean(dim=0)).sqrt()
    return error.where(whole.isfinite(), math.nan)


def cell_errors(sums: Tensor, blocks: Blocks) -> Tensor:
    """Standard error of the mean over steps in each cell.

    The mean is a ratio, R = S / N, of sums over the blocks; to first order its variance is that of the sum of
    s_j - R n_j over the blocks, divided by N^2 (Cochran 1977, Sampling Techniques, section 6.4).

    Args:
        sums: (B, H, Y, X) sum of each block, as in `blocks`.
        blocks: The blocks.

    Returns:
        (H, Y, X) standard errors; NaN in cells that were probed in fewer than 4 blocks.
    """
    probed_steps = blocks.probed_steps.double()
    steps = probed_steps.sum(dim=0)
    residual = sums - sums.sum(dim=0) / steps.clamp(min=1) * probed_steps
    probed = (blocks.probed_steps > 0).sum(dim=0)
    variance = residual.square().sum(dim=0) * probed / (probed - 1).clamp(min=1) / steps.clamp(min=1) ** 2
    return variance.sqrt().where((probed >= MIN_BLOCKS_OF_A_CELL) & variance.isfinite(), math.nan)
