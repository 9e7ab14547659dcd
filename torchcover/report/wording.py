"""Numbers in plain words: what tables and maps say in the same way."""

import math

from torchcover.coverage import BevGrid, Coverage

# A number has no more digits than anybody can use, however small its error.
MAX_DECIMALS_M = 4
MAX_DECIMALS_PERCENT = 3
# Errors below come from rounding in sums of float64: the estimate is the same whichever block is left out.
ROUND_OFF = 1e-12


def percent(share: float, error: float = math.nan) -> str:
    """A share as a percentage that rounds neither something to nothing nor nearly all to all.

    Args:
        share: A number in [0, 1], or NaN.
        error: Its standard error; NaN for none.

    Returns:
        One decimal and no sign; with an error as many decimals as its two digits need, at most 3. "unknown" for NaN.

    Example:
        >>> [percent(share) for share in (0.0, 0.0001, 0.123, 0.9999, 1.0, float("nan"))]
        ['0', '<0.1', '12.3', '>99.9', '100', 'unknown']
        >>> percent(0.49812, 0.00123), percent(1.0, 0.0)
        ('49.81 ± 0.12', '100 ± 0')
    """
    if math.isnan(share):
        return "unknown"
    if not math.isnan(error) and error > ROUND_OFF:
        return _with_error(100 * share, 100 * error, MAX_DECIMALS_PERCENT, highest=100.0)
    words = f"{100 * share:.1f}"
    if share in (0.0, 1.0):
        words = f"{share:.0%}".rstrip("%")
    elif share < 0.0005:
        words = "<0.1"
    elif share >= 0.9995:
        words = ">99.9"
    return words if math.isnan(error) else f"{words} ± 0"


def metres(length_m: float, error_m: float = math.nan) -> str:
    """A length to the centimetre, or to the two digits of its error; "unknown" for NaN, "infinite" for infinity.

    Args:
        length_m: A length >= 0, or NaN.
        error_m: Its standard error; NaN for none.

    Returns:
        Two decimals; with an error as many as its two digits need, at most 4.

    Example:
        >>> [metres(length) for length in (0.126, 12.0, float("inf"), float("nan"))]
        ['0.13', '12.00', 'infinite', 'unknown']
        >>> [metres(0.34127, error) for error in (0.0123, 0.00123, 1e-7, 0.0)]
        ['0.341 ± 0.012', '0.3413 ± 0.0012', '0.3413 ± <0.0001', '0.34 ± 0']
    """
    if math.isnan(length_m):
        return "unknown"
    if math.isinf(length_m):
        return "infinite"
    if not math.isnan(error_m) and error_m > ROUND_OFF:
        return _with_error(length_m, error_m, MAX_DECIMALS_M)
    return f"{length_m:.2f}" if math.isnan(error_m) else f"{length_m:.2f} ± 0"


def metres_more(difference_m: float, error_m: float = math.nan) -> str:
    """A difference of lengths, with its sign; as `metres`.

    Example:
        >>> metres_more(0.0213, 0.0041), metres_more(-0.5), metres_more(0.0, 0.0), metres_more(float("-inf"))
        ('+0.0213 ± 0.0041', '-0.50', '0 ± 0', '-infinite')
    """
    return _more(difference_m, error_m, usual=2, most=MAX_DECIMALS_M)


def points_more(difference: float, error: float = math.nan) -> str:
    """A difference of shares in percentage points, with its sign.

    Example:
        >>> points_more(-0.0213, 0.0041), points_more(0.0213), points_more(float("nan"))
        ('-2.13 ± 0.41', '+2.1', 'unknown')
    """
    return _more(100 * difference, 100 * error, usual=1, most=MAX_DECIMALS_PERCENT)


def decimals_of(error: float, most: int) -> int:
    """How many decimals show two digits of an error > 0, but at most `most`.

    Example:
        >>> [decimals_of(error, most=4) for error in (123.0, 1.23, 0.0123, 0.0996, 1e-9)]
        [0, 1, 3, 2, 4]
    """
    # Rounding to two digits may add one in front: 0.0996 is 0.10.
    exponent = int(f"{error:.1e}".split("e")[1])
    return min(most, max(0, 1 - exponent))


def _with_error(value: float, error: float, most: int, *, highest: float = math.inf) -> str:
    decimals, least = decimals_of(error, most), 10.0**-most
    words, error_words = f"{value:.{decimals}f}", _error_words(error, most)
    if error_words.startswith("<"):
        if value < highest and float(words) == highest:
            words = f">{highest - least:.{most}f}"
        elif value > 0 and float(words) == 0:
            words = error_words
    return f"{words} ± {error_words}"


def _more(difference: float, error: float, *, usual: int, most: int) -> str:
    if math.isnan(difference):
        return "unknown"
    if math.isinf(difference):
        return "+infinite" if difference > 0 else "-infinite"
    inexact = not math.isnan(error) and error > 100 * ROUND_OFF
    decimals = decimals_of(error, most) if inexact else usual
    # Adding 0 turns -0.0 into 0.0.
    words = f"{round(difference, decimals) + 0.0:+.{decimals}f}" if inexact or difference else "0"
    if math.isnan(error):
        return words
    return f"{words} ± {_error_words(error, most)}" if inexact else f"{words} ± 0"


def _error_words(error: float, most: int) -> str:
    least = 10.0**-most
    return f"<{least:.{most}f}" if error < least / 2 else f"{error:.{decimals_of(error, most)}f}"


def span(bounds_m: tuple[float, float]) -> str:
    """Two bounds in metres, as in `-0.5 to 0.5 m`."""
    return f"{bounds_m[0]:g} to {bounds_m[1]:g} m"


def steps_and_cell(steps: int, grid: BevGrid) -> str:
    """How much was measured and how finely: no number is worth anything without the two."""
    return f"{steps:,} step{'s' * (steps != 1)}, cells of {grid.cell:g} m"


def blocks_of_steps(coverage: Coverage) -> tuple[int | None, int | None]:
    """How many blocks of contiguous steps the errors come from, and how many steps a full one has; None: no blocks."""
    if coverage.blocks is None:
        return None, None
    return int((coverage.blocks.steps > 0).sum()), int(coverage.blocks.steps.max())
