"""How a number is rounded: to the digits of its error, and never something to nothing nor nearly all to all."""

import math
from typing import Literal, NamedTuple

from torchcover.coverage import Number
from torchcover.coverage.errors import ROUND_OFF
from torchcover.coverage.quantity import Unit
from torchcover.report.units import UNITS, ShownUnit


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
