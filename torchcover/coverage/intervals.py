"""The 95 % interval around the number of a region, which is longer on the side of blindness."""

import math

from torchcover.coverage.errors import ROUND_OFF
from torchcover.coverage.quantity import Unit

# Of the standard normal distribution, exceeded to either side with 5 %.
NORMAL_QUANTILE = 1.959963984540054
# Scenes in which a rig is all but blind are rare and missing from most short runs, so that the truth lies far on that
# side more often than on the other (docs/measured/error_bars.md).
BLIND_SIDE = 1.75
# exp of more is no float64.
MOST = 700.0


def interval95(value: float, error: float, degrees_of_freedom: int, unit: Unit) -> tuple[float, float]:
    """The 95 % interval around a number.

    With Student's t, on the scale of the logarithm for a radius and of the logit for a share, so that neither leaves
    its range; on the blind side, of larger radii and lower shares, 1.75 times as long on that scale.

    Args:
        value: Metres, or a share in [0, 1].
        error: Its standard error.
        degrees_of_freedom: Blocks that the error comes from, less one; 7 or more.
        unit: Which of the two it is.

    Returns:
        Its ends; NaN if the error is, or 0: blocks that all say the same do not prove that others would.

    Example:
        >>> [round(end, 3) for end in interval95(2.0, 0.1, 10, "m")]
        [1.789, 2.431]
        >>> [round(end, 3) for end in interval95(0.9, 0.02, 10, "share")]
        [0.791, 0.937]
    """
    if math.isnan(error) or error <= ROUND_OFF or (unit == "m" and value <= 0):
        return math.nan, math.nan
    if unit == "m":
        reach = student_t95(degrees_of_freedom) * error / value
        return value * math.exp(-reach), value * math.exp(min(BLIND_SIDE * reach, MOST))
    if not 0 < value < 1:  # rounding may have put it there; nothing is known of the other side
        return 0.0, 1.0
    against = (1 - value) / value
    reach = student_t95(degrees_of_freedom) * error / (value * (1 - value))
    return 1 / (1 + against * math.exp(min(BLIND_SIDE * reach, MOST))), 1 / (1 + against * math.exp(-reach))


def student_t95(degrees_of_freedom: int) -> float:
    """The t that is exceeded to either side with 5 %, by Fisher's expansion around the normal distribution.

    Abramowitz & Stegun 1964, equation 26.7.5; from 7 degrees of freedom on, which 8 blocks have, the error is below
    0.0001.

    Args:
        degrees_of_freedom: 7 or more.

    Example:
        >>> round(student_t95(7), 3), round(student_t95(15), 3), round(student_t95(1000), 3)
        (2.365, 2.131, 1.962)
    """
    z: float = NORMAL_QUANTILE
    terms: tuple[float, ...] = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return sum(term / float(degrees_of_freedom) ** power for power, term in enumerate(terms))


def is_significant(difference: float, error: float, degrees_of_freedom: int) -> bool | None:
    """Whether a difference is more than chance, by Student's t at 95 %.

    Args:
        difference: The difference.
        error: Its standard error; NaN if unknown.
        degrees_of_freedom: Blocks that the error comes from, less one.

    Returns:
        None if the error is unknown.

    Example:
        >>> is_significant(0.3, 0.1, 15), is_significant(0.2, 0.1, 15), is_significant(0.2, float("nan"), 3)
        (True, False, None)
    """
    if math.isnan(error):
        return None
    return abs(difference) > max(student_t95(degrees_of_freedom) * error, ROUND_OFF)
