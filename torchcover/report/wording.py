"""Numbers in plain words: what tables and maps say in the same way."""

import math

from torchcover.coverage import BevGrid


def percent(share: float) -> str:
    """A share as a percentage that rounds neither something to nothing nor nearly all to all.

    Args:
        share: A number in [0, 1], or NaN.

    Returns:
        One decimal and no sign; "unknown" for NaN.

    Example:
        >>> [percent(share) for share in (0.0, 0.0001, 0.123, 0.9999, 1.0, float("nan"))]
        ['0', '<0.1', '12.3', '>99.9', '100', 'unknown']
    """
    if math.isnan(share):
        return "unknown"
    if share in (0.0, 1.0):
        return f"{share:.0%}".rstrip("%")
    if share < 0.0005:
        return "<0.1"
    if share >= 0.9995:
        return ">99.9"
    return f"{100 * share:.1f}"


def metres(length_m: float) -> str:
    """A length to the centimetre; "unknown" for NaN, "infinite" for infinity.

    Example:
        >>> [metres(length) for length in (0.126, 12.0, float("inf"), float("nan"))]
        ['0.13', '12.00', 'infinite', 'unknown']
    """
    if math.isnan(length_m):
        return "unknown"
    return "infinite" if math.isinf(length_m) else f"{length_m:.2f}"


def span(bounds_m: tuple[float, float]) -> str:
    """Two bounds in metres, as in `-0.5 to 0.5 m`."""
    return f"{bounds_m[0]:g} to {bounds_m[1]:g} m"


def steps_and_cell(steps: int, grid: BevGrid) -> str:
    """How much was measured and how finely: no number is worth anything without the two."""
    return f"{steps:,} step{'s' * (steps != 1)}, cells of {grid.cell:g} m"
