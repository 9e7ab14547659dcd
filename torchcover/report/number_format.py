"""Numbers as text: rounding, units and intervals, the same in tables, maps and sentences."""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple

from torchcover.coverage import BevGrid
from torchcover.estimation import ROUND_OFF, Difference, Number, Quantity, Unit


class DisplayUnit(NamedTuple):
    """Unit in which numbers are shown.

    Args:
        name: Name of the unit.
        difference_name: Name of the unit of differences.
        factor: Factor from the number to the shown number.
        decimals: Decimals of a number without standard error; None shows four digits.
        max_decimals: Maximum number of decimals.
        max_value: Maximum of the shown number, such as 100 %.
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
    """Return the unit in which numbers of a unit are shown; unknown units are shown as they are.

    Args:
        unit: Unit of a quantity.

    Example:
        >>> get_display_unit("share").name, get_display_unit("nats").name
        ('%', 'nats')
    """
    return _UNITS.get(unit) or DisplayUnit(unit, unit, 1.0, None, 9, math.inf)


class RoundedNumber(NamedTuple):
    """Number as it is shown.

    Args:
        value: Rounded value in the shown unit.
        decimals: Number of decimals.
        relation: "<" or ">" if rounding would move the number onto an end of the scale; then `value` is the bound.
    """

    value: float
    decimals: int
    relation: Literal["", "<", ">"] = ""


def round_number(number: float, error: float, unit: Unit) -> RoundedNumber:
    """Round a number to the two digits of its error, or to the default decimals without an error.

    Args:
        number: Number in its unit, not NaN.
        error: Standard error; NaN if unknown.
        unit: Unit of the quantity.
    """
    display_unit = get_display_unit(unit)
    value = display_unit.factor * number
    if math.isinf(value):
        return RoundedNumber(value, 0)
    if error > ROUND_OFF:
        error *= display_unit.factor
        rounded = _round(value, count_decimals(error, display_unit.max_decimals))
        if round_error(error, display_unit.max_decimals).relation == "<":
            return _keep_off_ends(rounded, value, display_unit, display_unit.max_decimals)
        return rounded
    if value in (0.0, display_unit.max_value) and math.isfinite(display_unit.max_value):
        return RoundedNumber(value, 0)
    decimals = _get_default_decimals(value, display_unit)
    rounded = _round(value, decimals)
    # A small share is not shown as 0; a length below half a centimeter is.
    return _keep_off_ends(rounded, value, display_unit, decimals) if math.isfinite(display_unit.max_value) else rounded


def round_error(error: float, max_decimals: int) -> RoundedNumber:
    """Round a standard error to two digits.

    Args:
        error: Standard error > 0 in the shown unit.
        max_decimals: Maximum number of decimals; an error that they round to 0 is shown as "<" their smallest number.
    """
    smallest = 10.0**-max_decimals
    if error < smallest / 2:
        return RoundedNumber(smallest, max_decimals, "<")
    return _round(error, count_decimals(error, max_decimals))


def count_decimals(error: float, max_decimals: int) -> int:
    """Count the decimals that show two digits of a standard error.

    Args:
        error: Standard error > 0.
        max_decimals: Maximum number of decimals.

    Example:
        >>> [count_decimals(error, max_decimals=4) for error in (123.0, 1.23, 0.0123, 0.0996, 1e-9)]
        [0, 1, 3, 2, 4]
    """
    # Rounding to two digits may add a leading digit: 0.0996 becomes 0.10.
    exponent = int(f"{error:.1e}".split("e")[1])
    return min(max_decimals, max(0, 1 - exponent))


def _get_default_decimals(value: float, display_unit: DisplayUnit) -> int:
    """Return the decimals of the unit, or enough for four significant digits up to its maximum."""
    if display_unit.decimals is not None:
        return display_unit.decimals
    return min(display_unit.max_decimals, max(0, 3 - math.floor(math.log10(abs(value))))) if value else 0


def _keep_off_ends(rounded: RoundedNumber, value: float, display_unit: DisplayUnit, decimals: int) -> RoundedNumber:
    """Replace a number that was rounded to 0 or to the maximum by a bound."""
    smallest = 10.0**-decimals
    if value < display_unit.max_value == rounded.value:
        return RoundedNumber(float(f"{display_unit.max_value - smallest:.{decimals}f}"), decimals, ">")
    if value > 0 == rounded.value:
        return RoundedNumber(smallest, decimals, "<")
    return rounded


def _round(value: float, decimals: int) -> RoundedNumber:
    """Round to the value that the formatted text shows."""
    return RoundedNumber(float(f"{value:.{decimals}f}"), decimals)


UNKNOWN = "unknown"


def format_number(number: Number) -> str:
    """Format a number with its 95 % confidence interval, without unit.

    Args:
        number: The number.

    Returns:
        The number as from `format_value`, or with a standard error in the decimals of its two digits, at most four for
        lengths and three for shares; followed by the interval if there is one.

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
    rounded = round_number(number.value, number.error, unit)
    return _format_rounded(rounded) + _format_interval(number, rounded.decimals, is_signed=False)


def format_value(value: float, unit: Unit) -> str:
    """Format a number without interval and unit.

    Args:
        value: Number in its unit.
        unit: Unit of the quantity.

    Returns:
        A length with two decimals, a share in percent with one, any other unit with four digits. A share is never
        rounded to 0 or 100. "unknown" for NaN, "infinite" for infinity.
    """
    if math.isnan(value):
        return UNKNOWN
    return "infinite" if math.isinf(value) else _format_rounded(round_number(value, math.nan, unit))


def format_percent(share: float) -> str:
    """Format a share in percent that is never rounded to 0 or 100.

    Args:
        share: Share in [0, 1].

    Example:
        >>> [format_percent(share) for share in (0.0, 0.0001, 0.123, 0.9999, 1.0, float("nan"))]
        ['0', '<0.1', '12.3', '>99.9', '100', 'unknown']
    """
    return format_value(share, "share")


def format_square_meters(area_m2: float) -> str:
    """Format an area with one decimal that is never rounded to 0.

    Args:
        area_m2: Area in square meters.
    """
    if math.isnan(area_m2):
        return UNKNOWN
    if area_m2 < 0.05:
        return "<0.1" if area_m2 > 0 else "0"
    return f"{area_m2:,.1f}"


def format_error(error: float, unit: Unit) -> str:
    """Format a standard error with two digits; "unknown" for NaN.

    Args:
        error: Standard error in its unit.
        unit: Unit of the quantity.

    Example:
        >>> format_error(0.0123, "m"), format_error(0.0123, "share"), format_error(0.0, "m")
        ('0.012', '1.2', '0')
    """
    if math.isnan(error):
        return UNKNOWN
    display_unit = get_display_unit(unit)
    if error <= ROUND_OFF:
        return "0"
    return _format_rounded(round_error(display_unit.factor * error, display_unit.max_decimals))


def format_difference(difference: Difference) -> str:
    """Format a difference with its 95 % confidence interval and signs: lengths in meters, shares in percentage points.

    Args:
        difference: The difference.

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
    display_unit = get_display_unit(difference.quantity.unit)
    value, error = display_unit.factor * difference.value, display_unit.factor * difference.error
    if error > 100 * ROUND_OFF:
        decimals = count_decimals(error, display_unit.max_decimals)
        return _format_signed(value, decimals) + _format_interval(difference, decimals, is_signed=True)
    return _format_signed(value, _get_default_decimals(value, display_unit)) if value else "0"


def format_heading(quantity: Quantity) -> str:
    """Format the title of a quantity with its unit.

    Args:
        quantity: The quantity.

    Example:
        >>> format_heading(Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True))
        'mean blind spot radius (m)'
    """
    return f"{quantity.title} ({get_display_unit(quantity.unit).name})"


def format_difference_heading(quantity: Quantity) -> str:
    """Format the title of a quantity with the unit of its differences.

    Args:
        quantity: The quantity.
    """
    return f"{quantity.title} ({get_display_unit(quantity.unit).difference_name})"


def capitalize(text: str) -> str:
    """Capitalize the first character; the others stay as they are.

    Args:
        text: The text.
    """
    return text[:1].upper() + text[1:]


def format_height_band(grid: BevGrid, band: str) -> str:
    """Format the bounds of a height band, as in `z -0.5 to 0.5 m` or `-0.5 to 0.5 m above ground`.

    Args:
        grid: Grid with the band.
        band: Name of the band.
    """
    low_m, high_m = grid.heights[band]
    bounds = f"{low_m:g} to {high_m:g} m"
    return f"{bounds} above ground" if grid.band_frame == "ground" else f"z {bounds}"


def format_resolution(num_frames: int, grid: BevGrid) -> str:
    """Format the number of frames and the cell size of a measurement.

    Args:
        num_frames: Number of frames.
        grid: The grid.
    """
    return f"{num_frames:,} frame{'s' * (num_frames != 1)}, cells of {grid.cell_m:g} m"


def _format_rounded(number: RoundedNumber) -> str:
    """Format a rounded number with its relation, such as "<"."""
    return f"{number.relation}{number.value:.{number.decimals}f}"


def _format_signed(value: float, decimals: int) -> str:
    """Format a number with its sign; zero has none."""
    # A number that is rounded to 0 has no sign. Adding 0 turns -0.0 into 0.0.
    rounded = round(value, decimals) + 0.0
    return f"{rounded:{'+' if rounded else ''}.{decimals}f}"


def _format_interval(number: Number | Difference, decimals: int, *, is_signed: bool) -> str:
    """Format the interval of a number, as `  [84.1, 89.0]`; empty if it has none."""
    if math.isnan(number.low) or math.isnan(number.high):
        return ""
    factor = get_display_unit(number.quantity.unit).factor
    texts = []
    for end in (number.low, number.high):
        if abs(end) >= 1e9:  # wider than any physical value
            texts.append("inf")
        else:
            texts.append(_format_signed(factor * end, decimals) if is_signed else f"{factor * end:.{decimals}f}")
    return f"  [{', '.join(texts)}]"
