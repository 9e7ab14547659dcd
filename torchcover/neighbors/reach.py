"""How far a search has to look so that the caller can decide what is within."""

import math

import torch


def reach(max_distance: float, dtype: torch.dtype) -> float:
    """A little more than the bound: a search compares squares in its own type, the caller decides by the differences.

    Its square does not vanish: a bound of 0 still finds a point at distance 0.

    Args:
        max_distance: The bound, inclusive.
        dtype: The type that is searched in.
    """
    return max(max_distance * (1 + 1e-5), 2 * math.sqrt(torch.finfo(dtype).tiny))
