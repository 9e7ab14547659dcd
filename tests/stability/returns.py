"""Returns at the limits of reflectivity, range and incidence angle, in clear air and in fog."""

from functools import lru_cache

import mpmath
import numpy as np

from torchcover.simulation.returns import MAX_RETURN_PROBABILITY, compute_log_excess, compute_return_probability

from .case import Case, most

FOG_PER_M, SPREAD = 0.06, 0.2


@lru_cache
def extremes():
    """Create all combinations of (N,) ranges, cosines, reflectivities and exponents."""
    columns = np.meshgrid([1e-3, 1.0, 20.0, 30.0, 80.0, 1e4], [1.0, 0.02, 1e-4], [1e-9, 0.1, 1.0], [0.0, 0.2, 30.0])
    return tuple(column.reshape(-1) for column in columns)


@lru_cache
def exact_log_excess():
    with mpmath.workdps(60):
        result = []
        for row in zip(*extremes(), strict=True):
            range_m, cosine, reflectivity, exponent = map(mpmath.mpf, row)
            power = reflectivity / mpmath.mpf(0.1) * cosine**exponent * mpmath.exp(-2 * mpmath.mpf(FOG_PER_M) * range_m)
            result.append(mpmath.log(power * (100 / range_m) ** 2))
        return result


@lru_cache
def exact_probability():
    with mpmath.workdps(60):
        width = 2 * mpmath.mpf(SPREAD)
        return np.array(
            [float(mpmath.mpf(MAX_RETURN_PROBABILITY) * mpmath.ncdf(excess / width)) for excess in exact_log_excess()]
        )


def our_excess():
    range_m, cosine, reflectivity, exponent = extremes()
    return compute_log_excess(range_m, cosine, reflectivity, exponent, 100.0, FOG_PER_M)


def excess_error():
    exact = np.array([float(value) for value in exact_log_excess()])
    return most((our_excess() - exact) / np.maximum(np.abs(exact), 1.0))


def power_first_error():
    range_m, cosine, reflectivity, exponent = (column.astype(np.float32) for column in extremes())
    with np.errstate(all="ignore"):
        power = reflectivity / np.float32(0.1) * cosine**exponent * np.exp(np.float32(-2 * FOG_PER_M) * range_m)
        excess = np.log(power * (np.float32(100.0) / range_m) ** 2)
    exact = np.array([float(value) for value in exact_log_excess()])
    return most((excess - exact) / np.maximum(np.abs(exact), 1.0))


def probability_error():
    return most(compute_return_probability(our_excess(), SPREAD) - exact_probability())


def logistic_error():
    """Approximate the error function by a logistic function of equal slope."""
    slope = 4 / np.sqrt(2 * np.pi) / (2 * SPREAD)
    with np.errstate(over="ignore"):
        return most(MAX_RETURN_PROBABILITY / (1 + np.exp(-slope * our_excess())) - exact_probability())


CASES = (
    Case(
        "ln q of hits at 1 mm to 10 km, to 89.99 degrees, of 1e-9 to 1, in fog of 50 m",
        "60 digits (mpmath)",
        "relative",
        1e-13,
        excess_error,
        "the power in float32, then its logarithm",
        power_first_error,
    ),
    Case(
        "P(return) of the same",
        "60 digits (mpmath)",
        "absolute",
        1e-13,
        probability_error,
        "a logistic function of the same slope",
        logistic_error,
    ),
)
