"""Standard errors of ratios over the visible surface of a cell, or of several, from blocks of contiguous steps."""

import math

from torch import Tensor

from torchcover.coverage.errors import MIN_BLOCKS_OF_A_CELL, ROUND_OFF


def area_errors(m2: Tensor, sums: Tensor) -> Tensor:
    """Standard error of the ratio of sums R = S / A over blocks, from the residuals s_j - R a_j.

    To first order the variance of R is that of the sum of the residuals, divided by A^2 (Cochran 1977, Sampling
    Techniques, section 6.4).

    Args:
        m2: (B, ...) square metres a_j that were seen in each block.
        sums: (B, ...) sums s_j of a quantity times them.

    Returns:
        (...) standard errors; NaN where fewer than 4 blocks saw anything, and where all blocks agree: a few equal
        numbers do not say that a number is exact.

    Example:
        >>> import torch
        >>> m2 = torch.full((16,), 2.0, dtype=torch.float64)
        >>> detected = torch.tensor([2.0, 0.0] * 8, dtype=torch.float64)
        >>> round(float(area_errors(m2, detected)), 3), float(area_errors(m2, m2))
        (0.129, nan)
    """
    whole = m2.sum(dim=0)
    residual = sums - sums.sum(dim=0) / whole * m2
    seen = (m2 > 0).sum(dim=0)
    error = (residual.square().sum(dim=0) * seen / (seen - 1).clamp(min=1)).sqrt() / whole
    return error.where((seen >= MIN_BLOCKS_OF_A_CELL) & error.isfinite() & (error > ROUND_OFF), math.nan)
