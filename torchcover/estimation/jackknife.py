"""Standard errors from blocks of contiguous steps, the block jackknife, and what they become with more steps."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchcover.estimation.quantity import Unit

# With fewer, the error itself is off by more than a quarter: 1 / sqrt(2 (blocks - 1)).
MIN_BLOCKS = 8
# Errors below come from rounding in sums of float64: the estimate is the same whichever block is left out.
ROUND_OFF = 1e-12
# A cell has an error if it was probed in at least as many blocks.
MIN_BLOCKS_OF_A_CELL = 8
# The radius of a cell in a block that was not seen, over its mean radius in those that were.
IMAGINED_RADIUS = 5.0


def blocks_needed(blocks: int, effective: float, *, assumed: float = 1.25, margin: float = 1.1) -> int:
    """How many blocks give intervals, which need 8 effective ones, if further blocks are as unequal as those of a run.

    Args:
        blocks: Blocks of the run.
        effective: How many blocks of equal weight would say as much; see `Estimate.effective`.
        assumed: Least ratio of the two where fewer than 4 blocks show it; that of a city's streets.
        margin: Factor by which the advice exceeds the expected number: it has to hold for other blocks, too.

    Example:
        >>> blocks_needed(4, 4.0), blocks_needed(4, 3.5), blocks_needed(1, 1.0)
        (9, 11, 11)
    """
    ratio = blocks / effective if effective > 0 else 1.0
    return math.ceil(margin * MIN_BLOCKS * (max(ratio, assumed) if blocks < 4 else ratio))


def jackknife_error(left_out: Tensor, whole: Tensor, steps: Tensor, least: int = MIN_BLOCKS) -> Tensor:
    """Standard error of an estimate from what it becomes as one block after the other is left out.

    The delete-m_j jackknife for blocks of unequal size (Busing, Meijer & van der Leeden 1999, Statistics and Computing
    9, 3-8): with h_j = n / m_j and the pseudo-values p_j = h_j whole - (h_j - 1) left_out_j,

        error^2 = 1/g sum_j (p_j - mean of the estimates)^2 / (h_j - 1).

    Args:
        left_out: (g, ...) estimates without block j.
        whole: (...) estimate from all blocks.
        steps: (g,) steps m_j of each block, all above 0.
        least: Fewer blocks than these give no error; 2 at least.

    Returns:
        (...) standard errors; NaN for too few blocks, and where an estimate is not finite.

    Example:
        >>> values = torch.arange(10.0, dtype=torch.float64)           # one step a block: the error of a mean
        >>> left_out = (values.sum() - values) / 9
        >>> error = jackknife_error(left_out, values.mean(), torch.ones(10))
        >>> torch.isclose(error, values.std() / 10**0.5)
        tensor(True)
    """
    blocks = len(steps)
    if blocks < least:
        return torch.full_like(whole, math.nan)
    ratio = (steps.sum() / steps.double()).view(-1, *[1] * whole.dim())
    pseudo = pseudo_values(left_out, whole, steps)
    centre = blocks * whole - ((1 - 1 / ratio) * left_out).sum(dim=0)
    error = (((pseudo - centre) ** 2 / (ratio - 1)).mean(dim=0)).sqrt()
    return error.where(whole.isfinite(), math.nan)


def pseudo_values(left_out: Tensor, whole: Tensor, steps: Tensor) -> Tensor:
    """(g, ...) the p_j of `jackknife_error`: what each block says by itself, had it been as long as all of them."""
    ratio = (steps.sum() / steps.double()).view(-1, *[1] * whole.dim())
    return ratio * whole - (ratio - 1) * left_out


def ratio_errors(base: Tensor, sums: Tensor, unit: Unit) -> Tensor:
    """Standard error of a ratio of sums in each cell: of a mean over steps, or over square metres.

    For R = S / A, sums over blocks of s_j and of a_j, the variance is to first order that of the sum of s_j - R a_j,
    divided by A^2 (Cochran 1977, Sampling Techniques, section 6.4).

    A few blocks that all say the same do not prove that others would. Therefore two more are imagined, each with as
    much of A as the others have on average: in one the rig sees all of the cell, in the other next to nothing of it,
    as Agresti & Coull (1998, The American Statistician 52, 119-126) add successes and failures. No error is 0.

    Args:
        base: (B, ...) the a_j: steps that probed the cell in each block, or square metres that were seen in it.
        sums: (B, ...) the s_j.
        unit: "share", so that the imagined ratios are 1 and 0; or "m": 0 and five times R.

    Returns:
        (...) standard errors; NaN in cells that fewer than 8 blocks know, or that nothing is known of but a radius
        of 0.

    Example:
        >>> m2 = torch.full((16,), 2.0, dtype=torch.float64)
        >>> half = torch.tensor([2.0, 0.0] * 8, dtype=torch.float64)
        >>> [round(float(ratio_errors(m2, sums, "share")), 3) for sums in (half, m2)]
        [0.121, 0.057]
    """
    base = base.double()
    known = (base > 0).sum(dim=0)
    whole = base.sum(dim=0).where(known > 0, 1.0)
    ratio = sums.sum(dim=0) / whole
    imagined = whole / known.clamp(min=1)
    seen_or_not = ratio**2 + (1 - ratio) ** 2 if unit == "share" else ratio**2 + (IMAGINED_RADIUS * ratio - ratio) ** 2
    squares = (sums - ratio * base).square().sum(dim=0) + imagined**2 * seen_or_not
    variance = squares * (known + 2) / (known + 1) / (whole + 2 * imagined) ** 2
    return variance.sqrt().where((known >= MIN_BLOCKS_OF_A_CELL) & (variance > 0) & variance.isfinite(), math.nan)


class ErrorModel(NamedTuple):
    """The error of a number after some steps: error^2 = bias^2 + a / steps.

    Args:
        a: Variance of the number times the steps that it comes from, as worlds differ within and among each other.
        bias: What is left after any number of steps: by how much the setting is off, such as fewer rays.

    Example:
        >>> model = ErrorModel.of(error=0.02, steps=64)
        >>> model.error_after(256), model.steps_for(0.01)
        (0.01, 256)
        >>> ErrorModel(a=1.0, bias=0.1).steps_for(0.1) is None
        True
    """

    a: float
    bias: float = 0.0

    @classmethod
    def of(cls, error: float, steps: int, bias: float = 0.0) -> "ErrorModel":
        """From the standard error of a run; of an unknown error nothing is known."""
        return cls(error**2 * steps, bias)

    def error_after(self, steps: int) -> float:
        """The error after so many steps."""
        return math.sqrt(self.bias**2 + self.a / steps)

    def steps_for(self, error: float) -> int | None:
        """The fewest steps after which it is at most this; None if there are none, or that is unknown."""
        room = error**2 - self.bias**2
        if math.isnan(self.a) or not room > 0:
            return None
        return max(1, math.ceil(self.a / room * (1 - 1e-12)))  # which rounding would make one more
