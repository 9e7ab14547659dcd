"""Numbers in plain words: what tables and maps say in the same way."""

import math

from torchcover.coverage import BevGrid, Difference, Number, Quantity
from torchcover.coverage.errors import ROUND_OFF
from torchcover.coverage.quantity import Unit
from torchcover.report.rounding import Rounded, decimals_of, rounded, rounded_error
from torchcover.report.units import UNITS

UNKNOWN = "unknown"


def number_words(number: Number, unit: Unit) -> str:
    """A number and its standard error, without the unit.

    Args:
        number: Metres, or a share in [0, 1]; its error is NaN for none.
        unit: That of its quantity.

    Returns:
        A length with two decimals, a share in percent with one; with an error as many as its two digits need, at most
        four and three. A share is never rounded to 0 or 100. "unknown" for NaN, "infinite" for infinity.

    Example:
        >>> none = float("nan")
        >>> [number_words(Number(length, none), "m") for length in (0.126, 12.0, float("inf"), none)]
        ['0.13', '12.00', 'infinite', 'unknown']
        >>> [number_words(Number(0.34127, error), "m") for error in (0.0123, 0.00123, 1e-7, 0.0)]
        ['0.341 ± 0.012', '0.3413 ± 0.0012', '0.3413 ± <0.0001', '0.34 ± 0']
        >>> number_words(Number(0.49812, 0.00123), "share"), number_words(Number(1.0, 0.0), "share")
        ('49.81 ± 0.12', '100 ± 0')
    """
    if math.isnan(number.value):
        return UNKNOWN
    if math.isinf(number.value):
        return "infinite"
    words = _words(rounded(number, unit))
    return words if math.isnan(number.error) else f"{words} ± {_error_words(number.error, unit, ROUND_OFF)}"


def percent(share: float) -> str:
    """A share in percent that rounds neither something to nothing nor nearly all to all.

    Example:
        >>> [percent(share) for share in (0.0, 0.0001, 0.123, 0.9999, 1.0, float("nan"))]
        ['0', '<0.1', '12.3', '>99.9', '100', 'unknown']
    """
    return number_words(Number(share, math.nan), "share")


def error_words(error: float, unit: Unit) -> str:
    """A standard error alone, with two digits; "unknown" for NaN.

    Example:
        >>> error_words(0.0123, "m"), error_words(0.0123, "share"), error_words(0.0, "m")
        ('0.012', '1.2', '0')
    """
    return UNKNOWN if math.isnan(error) else _error_words(error, unit, ROUND_OFF)


def difference_words(difference: Difference, unit: Unit) -> str:
    """A difference and its standard error, with its sign: lengths in metres, shares in percentage points.

    Example:
        >>> difference_words(Difference(0.0213, 0.0041, True), "m"), difference_words(Difference(-0.5, 0.0, None), "m")
        ('+0.0213 ± 0.0041', '-0.50 ± 0')
        >>> difference_words(Difference(-0.0213, 0.0041, True), "share")
        '-2.13 ± 0.41'
    """
    if math.isnan(difference.value):
        return UNKNOWN
    if math.isinf(difference.value):
        return "+infinite" if difference.value > 0 else "-infinite"
    shown = UNITS[unit]
    value, error = shown.factor * difference.value, shown.factor * difference.error
    inexact = error > 100 * ROUND_OFF
    decimals = decimals_of(error, shown.max_decimals) if inexact else shown.decimals
    # Adding 0 turns -0.0 into 0.0.
    words = f"{round(value, decimals) + 0.0:+.{decimals}f}" if inexact or value else "0"
    if math.isnan(error):
        return words
    return f"{words} ± {_error_words(difference.error, unit, 100 * ROUND_OFF / shown.factor)}"


def heading(quantity: Quantity) -> str:
    """What a quantity is called, with its unit.

    Example:
        >>> heading(Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True))
        'mean blind spot radius (m)'
    """
    return f"{quantity.title} ({UNITS[quantity.unit].name})"


def difference_heading(quantity: Quantity) -> str:
    """What its differences are called, with their unit."""
    return f"{quantity.title} ({UNITS[quantity.unit].difference_name})"


def capitalised(words: str) -> str:
    """With a capital at the beginning, and the rest as it is."""
    return words[:1].upper() + words[1:]


def span(bounds_m: tuple[float, float]) -> str:
    """Two bounds in metres, as in `-0.5 to 0.5 m`."""
    return f"{bounds_m[0]:g} to {bounds_m[1]:g} m"


def steps_and_cell(steps: int, grid: BevGrid) -> str:
    """How much was measured and how finely: no number is worth anything without the two."""
    return f"{steps:,} step{'s' * (steps != 1)}, cells of {grid.cell:g} m"


def _words(number: Rounded) -> str:
    return f"{number.relation}{number.value:.{number.decimals}f}"


def _error_words(error: float, unit: Unit, negligible: float) -> str:
    if error <= negligible:
        return "0"
    shown = UNITS[unit]
    return _words(rounded_error(shown.factor * error, shown.max_decimals))
