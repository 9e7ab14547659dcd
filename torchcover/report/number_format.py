"""Numbers in plain words: how they are rounded, and what tables and maps say in the same way."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from torchcover.coverage import BevGrid
from torchcover.estimation import ROUND_OFF, Difference, Number, Quantity, Unit


class DisplayUnit(NamedTuple):
    """How numbers of a unit, and differences of two, are shown: `factor` times what they are, up to the `max_value`.

    Without an error a number has so many decimals, four digits for None, and never more than anybody can use.
    """

    name: str
    difference_name: str
    factor: float
    decimals: int | None
    max_decimals: int
    max_value: float


_UNITS: Mapping[Unit, DisplayUnit] = MappingProxyType(
    {
        "m": DisplayUnit("m", "m", 1.0, 2, 4, math.inf),
        "sensors": DisplayUnit("sensors", "sensors", 1.0, 2, 3, math.inf),
        "share": DisplayUnit("%", "percentage points", 100.0, 1, 3, 100.0),
    }
)


def get_display_unit(unit: Unit) -> DisplayUnit:
    """How numbers of a unit are shown: as they are where nothing else is known of it.

    Example:
        >>> get_display_unit("share").name, get_display_unit("nats").name
        ('%', 'nats')
    """
    return _UNITS.get(unit) or DisplayUnit(unit, unit, 1.0, None, 9, math.inf)


class RoundedNumber(NamedTuple):
    """A number as a reader sees it.

    `value`: in the unit that is shown: metres or percent; `decimals`: how many are shown; `relation`: "<" or ">" for a
    number that is beyond `value`, but would be rounded to an end of the scale.
    """

    value: float
    decimals: int
    relation: Literal["", "<", ">"] = ""


def round_number(number: float, error: float, unit: Unit) -> RoundedNumber:
    """Round a number: to the two digits of its error, or to the usual decimals if it has none.

    `number`: in its unit; not NaN; `error`: its standard error; NaN for none; `unit`: that of its quantity.
    """
    shown = get_display_unit(unit)
    value = shown.factor * number
    if math.isinf(value):
        return RoundedNumber(value, 0)
    if error > ROUND_OFF:
        error *= shown.factor
        rounded_value = _round(value, count_decimals(error, shown.max_decimals))
        if round_error(error, shown.max_decimals).relation == "<":
            return _not_to_an_end(rounded_value, value, shown, shown.max_decimals)
        return rounded_value
    if value in (0.0, shown.max_value) and math.isfinite(shown.max_value):
        return RoundedNumber(value, 0)
    decimals = _decimals(value, shown)
    rounded_value = _round(value, decimals)
    # A share is told from none; a length below half a centimetre is none.
    return _not_to_an_end(rounded_value, value, shown, decimals) if math.isfinite(shown.max_value) else rounded_value


def round_error(error: float, max_decimals: int) -> RoundedNumber:
    """Round an error > 0 to two digits.

    `error`: in the unit that is shown; `max_decimals`: no more decimals than these; what they would round to nothing is
    less than the least.
    """
    least = 10.0**-max_decimals
    if error < least / 2:
        return RoundedNumber(least, max_decimals, "<")
    return _round(error, count_decimals(error, max_decimals))


def count_decimals(error: float, max_decimals: int) -> int:
    """How many decimals show two digits of an error > 0, but at most `max_decimals`.

    Example:
        >>> [count_decimals(error, most=4) for error in (123.0, 1.23, 0.0123, 0.0996, 1e-9)]
        [0, 1, 3, 2, 4]
    """
    # Rounding to two digits may add one in front: 0.0996 is 0.10.
    exponent = int(f"{error:.1e}".split("e")[1])
    return min(max_decimals, max(0, 1 - exponent))


def _decimals(value: float, shown: DisplayUnit) -> int:
    if shown.decimals is not None:
        return shown.decimals
    return min(shown.max_decimals, max(0, 3 - math.floor(math.log10(abs(value))))) if value else 0


def _not_to_an_end(number: RoundedNumber, value: float, shown: DisplayUnit, decimals: int) -> RoundedNumber:
    least = 10.0**-decimals
    if value < shown.max_value == number.value:
        return RoundedNumber(float(f"{shown.max_value - least:.{decimals}f}"), decimals, ">")
    if value > 0 == number.value:
        return RoundedNumber(least, decimals, "<")
    return number


def _round(value: float, decimals: int) -> RoundedNumber:
    return RoundedNumber(float(f"{value:.{decimals}f}"), decimals)


UNKNOWN = "unknown"
# An end of an interval beyond is no number for anybody.
ENDLESS = 1e9


def format_number(number: Number) -> str:
    """A number and its 95 % interval, without the unit.

    Returns:
        As `format_value` has it; with an error in as many decimals as its two digits need, of lengths and shares at most
        four and three, and with the interval behind it if there is one.

    Example:
        >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
        >>> format_number(Number(radius, 0.34127, 0.0123, 0.31812, 0.36992)), format_number(Number(radius, 0.34127))
        ('0.341  [0.318, 0.370]', '0.34')
        >>> format_number(Number(radius._replace(unit="share"), 0.869, 0.0121, 0.8412, 0.8899))
        '86.9  [84.1, 89.0]'
    """
    unit = number.quantity.unit
    if not math.isfinite(number.value):
        return format_value(number.value, unit)
    found = round_number(number.value, number.error, unit)
    return _words(found) + _interval_words(number, found.decimals)


def format_value(value: float, unit: Unit) -> str:
    """A number alone, without the unit.

    `value`: in its unit; `unit`: its unit. Returns a length with two decimals, a share in percent with one, what has
    another unit with four digits. A share is never rounded to 0 or 100. "unknown" for NaN, "infinite" for infinity.
    """
    if math.isnan(value):
        return UNKNOWN
    return "infinite" if math.isinf(value) else _words(round_number(value, math.nan, unit))


def format_percent(share: float) -> str:
    """A share in percent that rounds neither something to nothing nor nearly all to all.

    Example:
        >>> [percent(share) for share in (0.0, 0.0001, 0.123, 0.9999, 1.0, float("nan"))]
        ['0', '<0.1', '12.3', '>99.9', '100', 'unknown']
    """
    return format_value(share, "share")


def format_square_meters(m2: float) -> str:
    """An area with one decimal that rounds nothing to none."""
    if math.isnan(m2):
        return UNKNOWN
    if m2 < 0.05:
        return "<0.1" if m2 > 0 else "0"
    return f"{m2:,.1f}"


def format_error(error: float, unit: Unit) -> str:
    """A standard error alone, with two digits; "unknown" for NaN.

    Example:
        >>> format_error(0.0123, "m"), format_error(0.0123, "share"), format_error(0.0, "m")
        ('0.012', '1.2', '0')
    """
    if math.isnan(error):
        return UNKNOWN
    shown = get_display_unit(unit)
    return _words(round_error(shown.factor * error, shown.max_decimals)) if error > ROUND_OFF else "0"


def format_difference(difference: Difference) -> str:
    """A difference and its 95 % interval, with signs: lengths in metres, shares in percentage points.

    Example:
        >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
        >>> format_difference(Difference(radius, 0.0213, 0.0041, 0.0126, 0.0301))
        '+0.0213  [+0.0126, +0.0301]'
        >>> format_difference(Difference(radius._replace(unit="share"), -0.0213, 0.0041, -0.0301, -0.0126))
        '-2.13  [-3.01, -1.26]'
    """
    if math.isnan(difference.value):
        return UNKNOWN
    if math.isinf(difference.value):
        return "+infinite" if difference.value > 0 else "-infinite"
    unit = difference.quantity.unit
    shown = get_display_unit(unit)
    value, error = shown.factor * difference.value, shown.factor * difference.error
    inexact = error > 100 * ROUND_OFF
    decimals = count_decimals(error, shown.max_decimals) if inexact else _decimals(value, shown)
    words = _signed(value, decimals) if inexact or value else "0"
    return words + (_interval_words(difference, decimals, _signed) if inexact else "")


def format_heading(quantity: Quantity) -> str:
    """What a quantity is called, with its unit.

    Example:
        >>> heading(Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True))
        'mean blind spot radius (m)'
    """
    return f"{quantity.title} ({get_display_unit(quantity.unit).name})"


def format_difference_heading(quantity: Quantity) -> str:
    """What its differences are called, with their unit."""
    return f"{quantity.title} ({get_display_unit(quantity.unit).difference_name})"


def capitalize(text: str) -> str:
    """With a capital at the beginning, and the rest as it is."""
    return text[:1].upper() + text[1:]


def format_height_band(grid: BevGrid, band: str) -> str:
    """The bounds of a height band, as in `z -0.5 to 0.5 m` or `-0.5 to 0.5 m above ground`."""
    low, high = grid.heights[band]
    metres = f"{low:g} to {high:g} m"
    return f"{metres} above ground" if grid.band_frame == "ground" else f"z {metres}"


def format_resolution(num_frames: int, grid: BevGrid) -> str:
    """How much was measured and how finely: no number is worth anything without the two."""
    return f"{num_frames:,} step{'s' * (num_frames != 1)}, cells of {grid.cell_m:g} m"


def _words(number: RoundedNumber) -> str:
    return f"{number.relation}{number.value:.{number.decimals}f}"


def _plain(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}"


def _signed(value: float, decimals: int) -> str:
    # What rounds to nothing has no sign: a loss too small to be shown is no gain. Adding 0 turns -0.0 into 0.0.
    shown = round(value, decimals) + 0.0
    return f"{shown:{'+' if shown else ''}.{decimals}f}"


def _interval_words(number: Number | Difference, decimals: int, words: Callable[[float, int], str] = _plain) -> str:
    """Behind a number, as `  [84.1, 89.0]`; nothing if it has no interval."""
    if math.isnan(number.low) or math.isnan(number.high):
        return ""
    factor = get_display_unit(number.quantity.unit).factor
    low, high = (words(factor * end, decimals) if abs(end) < ENDLESS else "inf" for end in (number.low, number.high))
    return f"  [{low}, {high}]"
