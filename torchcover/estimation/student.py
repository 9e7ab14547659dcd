"""Student's t: the 95 % interval around a number, and what is more than chance."""

import math

from torchcover.estimation.jackknife import ROUND_OFF
from torchcover.estimation.quantity import Quantity

# Of the standard normal distribution, exceeded to either side with 5 %.
NORMAL_QUANTILE = 1.959963984540054
# Of Student's distribution with 1 to 6 degrees of freedom, likewise; there the expansion below is off.
FEW = 12.7062047362, 4.3026527297, 3.1824463053, 2.7764451052, 2.5705818356, 2.4469118511
# Scenes in which a rig is all but blind are rare and missing from most short runs, so that the true mean of a length
# lies on that side more often than on the other (docs/measured/accuracy.md).
BLIND_SIDE = 1.25
# exp of more is no float64.
MOST = 700.0


def interval95(
    value: float, error: float, degrees_of_freedom: int, quantity: Quantity, *, is_difference: bool = False
) -> tuple[float, float]:
    """The 95 % interval around a number, or around a difference of two.

    With Student's t: of a length on the scale of the logarithm, of a share on that of the logit, so that neither leaves
    its range; of any other unit, and of differences, value plus and minus t errors. Of lengths 1.25 times as far on the
    side of scenes in which a rig is all but blind: the worse one, of differences that away from 0.

    Args:
        value: In the unit of the quantity.
        error: Its standard error.
        degrees_of_freedom: Blocks that the error comes from, less one.
        quantity: Its unit decides the scale, its direction the worse side.
        is_difference: Of two such numbers. The interval holds 0 just where Student's test finds nothing.

    Returns:
        Its ends; NaN if the error is, or 0: blocks that all say the same do not prove that others would.

    Example:
        >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
        >>> detection = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)
        >>> [round(end, 3) for end in interval95(2.0, 0.1, 10, radius)]
        [1.789, 2.299]
        >>> [round(end, 3) for end in interval95(0.9, 0.02, 10, detection)]
        [0.846, 0.937]
        >>> [round(end, 3) for end in interval95(-0.3, 0.1, 10, radius, is_difference=True)]
        [-0.579, -0.077]
    """
    t, unit = student_t95(degrees_of_freedom), quantity.unit
    if math.isnan(error) or error <= ROUND_OFF or (unit == "m" and not is_difference and value <= 0):
        return math.nan, math.nan
    below = above = t * error
    if unit == "m":
        farther_above = value > 0 if is_difference else quantity.lower_is_better
        below, above = (below, BLIND_SIDE * above) if farther_above else (BLIND_SIDE * below, above)
    if is_difference or unit not in ("m", "share"):
        return value - below, value + above
    if unit == "m":
        return value * math.exp(-below / value), value * math.exp(min(above / value, MOST))
    if not 0 < value < 1:  # rounding may have put it there; nothing is known of the other side
        return 0.0, 1.0
    against, slope = (1 - value) / value, value * (1 - value)
    return 1 / (1 + against * math.exp(min(below / slope, MOST))), 1 / (1 + against * math.exp(-above / slope))


def student_t95(degrees_of_freedom: int) -> float:
    """The t that is exceeded to either side with 5 %; from 7 on by Fisher's expansion around the normal distribution.

    Abramowitz & Stegun 1964, equation 26.7.5; from 7 degrees of freedom on, which 8 blocks have, the error is below
    0.0001.

    Args:
        degrees_of_freedom: 1 or more; NaN for fewer.

    Example:
        >>> round(student_t95(2), 3), round(student_t95(7), 3), round(student_t95(15), 3), round(student_t95(1000), 3)
        (4.303, 2.365, 2.131, 1.962)
    """
    if degrees_of_freedom <= len(FEW):
        return FEW[degrees_of_freedom - 1] if degrees_of_freedom >= 1 else math.nan
    z: float = NORMAL_QUANTILE
    terms: tuple[float, ...] = (
        z,
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return sum(term / float(degrees_of_freedom) ** power for power, term in enumerate(terms))


def student_p(t: float, degrees_of_freedom: int) -> float:
    """Probability that Student's t lies farther from 0 than some value, to either side.

    The finite series of Abramowitz & Stegun 1964, equations 26.7.3 and 26.7.4.

    Args:
        t: The value; NaN gives NaN.
        degrees_of_freedom: 1 or more.

    Example:
        >>> round(student_p(2.131, 15), 3), round(student_p(1.0, 1), 3)
        (0.05, 0.5)
    """
    if math.isnan(t):
        return math.nan
    angle = math.atan(abs(t) / math.sqrt(degrees_of_freedom))
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees_of_freedom % 2
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for power in range(1 if odd else 0, degrees_of_freedom - 1, 2):
        total += term
        term *= cosine**2 * (power + 1) / (power + 2)
    within = 2 / math.pi * (angle + sine * total) if odd else sine * total
    return max(0.0, 1.0 - within)


def is_significant(difference: float, error: float, degrees_of_freedom: int) -> bool | None:
    """Whether a difference is more than chance, by Student's t at 95 %; None if its standard error is NaN."""
    if math.isnan(error):
        return None
    return abs(difference) > max(student_t95(degrees_of_freedom) * error, ROUND_OFF)
