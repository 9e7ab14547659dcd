"""Numbers in plain words: how they are rounded, and what tables and maps say in the same way."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from torchcover.coverage import BevGrid, Difference, Number, Quantity
from torchcover.coverage.errors import ROUND_OFF
from torchcover.coverage.quantity import Unit


class ShownUnit(NamedTuple):
    """How numbers of a unit are shown.

    Args:
        name: Behind a number.
        difference_name: Behind a difference of two of them.
        factor: From the unit of the quantity to what is shown.
        decimals: Of a number without an error.
        max_decimals: More than anybody can use, however small the error.
        highest: The largest number there is, as it is shown.
    """

    name: str
    difference_name: str
    factor: float
    decimals: int
    max_decimals: int
    highest: float


UNITS: Mapping[Unit, ShownUnit] = MappingProxyType(
    {
        "m": ShownUnit("m", "m", 1.0, 2, 4, math.inf),
        "sensors": ShownUnit("sensors", "sensors", 1.0, 2, 3, math.inf),
        "share": ShownUnit("%", "percentage points", 100.0, 1, 3, 100.0),
    }
)


class Rounded(NamedTuple):
    """A number as a reader sees it; two of them are equal if they look the same.

    Args:
        value: In the unit that is shown: metres or percent.
        decimals: How many are shown.
        relation: "<" or ">" for a number that is beyond `value`, but would be rounded to an end of the scale.
    """

    value: float
    decimals: int
    relation: Literal["", "<", ">"] = ""


def rounded(number: Number, unit: Unit) -> Rounded:
    """Round a number: to the two digits of its error, or to the usual decimals if it has none.

    Args:
        number: A number that is not NaN, and its error; NaN for none.
        unit: That of its quantity.

    Example:
        >>> rounded(Number(0.34127, 0.0123), "m"), rounded(Number(0.9999, float("nan")), "share")
        (Rounded(value=0.341, decimals=3, relation=''), Rounded(value=99.9, decimals=1, relation='>'))
    """
    shown = UNITS[unit]
    value, error = shown.factor * number.value, shown.factor * number.error
    if math.isinf(value):
        return Rounded(value, 0)
    if number.error > ROUND_OFF:
        return _to_error(value, error, shown)
    if value in (0.0, shown.highest) and math.isfinite(shown.highest):
        return Rounded(value, 0)
    return _to_decimals(value, shown)


def rounded_error(error: float, max_decimals: int) -> Rounded:
    """Round an error > 0 to two digits.

    Args:
        error: In the unit that is shown.
        max_decimals: No more decimals than these; what they would round to nothing is less than the least.
    """
    least = 10.0**-max_decimals
    if error < least / 2:
        return Rounded(least, max_decimals, "<")
    return _round(error, decimals_of(error, max_decimals))


def decimals_of(error: float, most: int) -> int:
    """How many decimals show two digits of an error > 0, but at most `most`.

    Example:
        >>> [decimals_of(error, most=4) for error in (123.0, 1.23, 0.0123, 0.0996, 1e-9)]
        [0, 1, 3, 2, 4]
    """
    # Rounding to two digits may add one in front: 0.0996 is 0.10.
    exponent = int(f"{error:.1e}".split("e")[1])
    return min(most, max(0, 1 - exponent))


def _to_error(value: float, error: float, shown: ShownUnit) -> Rounded:
    number = _round(value, decimals_of(error, shown.max_decimals))
    if rounded_error(error, shown.max_decimals).relation == "<":
        return _not_to_an_end(number, value, shown, shown.max_decimals)
    return number


def _to_decimals(value: float, shown: ShownUnit) -> Rounded:
    number = _round(value, shown.decimals)
    # A share is told from none; a length below half a centimetre is none.
    return _not_to_an_end(number, value, shown, shown.decimals) if math.isfinite(shown.highest) else number


def _not_to_an_end(number: Rounded, value: float, shown: ShownUnit, decimals: int) -> Rounded:
    least = 10.0**-decimals
    if value < shown.highest == number.value:
        return Rounded(float(f"{shown.highest - least:.{decimals}f}"), decimals, ">")
    if value > 0 == number.value:
        return Rounded(least, decimals, "<")
    return number


def _round(value: float, decimals: int) -> Rounded:
    return Rounded(float(f"{value:.{decimals}f}"), decimals)


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


def square_metres(m2: float) -> str:
    """An area with one decimal that rounds nothing to none.

    Example:
        >>> [square_metres(m2) for m2 in (0.0, 0.01, 12.34, 1234.56, float("nan"))]
        ['0', '<0.1', '12.3', '1,234.6', 'unknown']
    """
    if math.isnan(m2):
        return UNKNOWN
    if m2 < 0.05:
        return "<0.1" if m2 > 0 else "0"
    return f"{m2:,.1f}"


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
