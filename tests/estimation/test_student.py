"""Student's t against SciPy, and range, symmetry and coverage of 95 % confidence intervals."""

import math

import numpy as np
import pytest
from scipy import special, stats

from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.estimation import Quantity, compute_interval95, compute_student_p, compute_student_t95
from torchcover.estimation.errors import BLIND_SIDE_FACTOR, is_significant

SHARE = make_detection_quantity(0.4)
BLIND = Quantity("blind", "share that is not seen", "share", lower_is_better=True)
FAR = Quantity("range_m", "how far it sees", "m", lower_is_better=False)
NATS = Quantity("gain", "gain", "nats", lower_is_better=False)


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 7, 8, 9, 11, 15, 31, 200, 10_000])
def test_students_t_is_that_of_scipy_and_decides(freedom):
    limit = float(stats.t.ppf(0.975, freedom))
    assert compute_student_t95(freedom) == pytest.approx(limit, abs=1e-4)
    for sign in (-1, 1):
        assert is_significant(sign * 1.001 * limit * 0.2, 0.2, freedom) is True
        assert is_significant(sign * 0.999 * limit * 0.2, 0.2, freedom) is False
    assert is_significant(1e-17, 0.0, freedom) is False
    assert is_significant(1.0, math.nan, freedom) is None


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 15, 40])
def test_the_probability_of_t_is_students(freedom):
    for t in (0.0, 0.3, -2.0, 7.0):
        assert compute_student_p(t, freedom) == pytest.approx(2 * stats.t.sf(abs(t), freedom), abs=1e-12)
    assert np.isnan(compute_student_p(float("nan"), freedom))


def twin(value, error, freedom, quantity, is_difference):
    """Compute the ends of the interval with SciPy."""
    t = error * stats.t.ppf(0.975, freedom) * np.array([-1.0, 1.0])
    if quantity.unit == "m":
        t[int(value > 0) if is_difference else int(quantity.lower_is_better)] *= BLIND_SIDE_FACTOR
    if is_difference or quantity.unit not in ("m", "share"):
        return value + t
    if quantity.unit == "m":
        return np.exp(np.log(value) + t / value)
    return special.expit(special.logit(value) + t / (value * (1 - value)))


@pytest.mark.parametrize("quantity", [RADIUS, SHARE, BLIND, FAR, NATS])
@pytest.mark.parametrize("is_difference", [False, True])
@pytest.mark.parametrize("freedom", [7, 10, 42, 255])
def test_intervals_use_student_t_on_unbounded_scales(quantity, is_difference, freedom):
    for value, error in ((0.3, 0.001), (0.3, 0.05), (0.02, 0.015), (0.98, 0.015)):
        result = compute_interval95(value, error, freedom, quantity, is_difference=is_difference)
        assert result == pytest.approx(twin(value, error, freedom, quantity, is_difference), rel=1e-4)


def test_significant_differences_have_intervals_without_0():
    for quantity in (RADIUS, SHARE):
        for value in np.linspace(-0.3, 0.3, 61).tolist():
            low, high = compute_interval95(value, 0.05, 10, quantity, is_difference=True)
            assert is_significant(value, 0.05, 10) is not (low <= 0.0 <= high)


@pytest.mark.parametrize("quantity", [RADIUS, SHARE])
def test_unknown_or_constant_numbers_have_no_interval(quantity):
    assert all(map(math.isnan, compute_interval95(0.5, math.nan, 3, quantity)))
    assert all(map(math.isnan, compute_interval95(1.0, 0.0, 10, quantity)))
    assert compute_interval95(math.inf, math.nan, 10, quantity)[0] != math.inf


@pytest.mark.parametrize("value", [0.0, 1.0, 1 + 2e-16, -1e-17])
def test_shares_of_0_or_1_may_be_anything(value):
    assert compute_interval95(value, 1e-3, 10, SHARE) == (0.0, 1.0)
    assert all(map(math.isnan, compute_interval95(0.0, 1e-3, 10, RADIUS)))


@pytest.mark.parametrize(("value", "error"), [(1e-9, 1.0), (1 - 1e-12, 0.5), (0.5, 1e6)])
def test_absurd_errors_leave_no_range(value, error):
    low, high = compute_interval95(value, error, 7, SHARE)
    assert 0.0 <= low <= value <= high <= 1.0
    low, high = compute_interval95(value, error, 7, RADIUS)
    assert 0.0 <= low <= value < high < math.inf


@pytest.mark.parametrize(("quantity", "sigma"), [(RADIUS, 0.7), (SHARE, 0.7)])
def test_means_of_skewed_blocks_are_covered(quantity, sigma):
    """Sample eleven blocks of a lognormal radius and of the share within a threshold."""
    radii = np.exp(sigma * np.random.default_rng(0).standard_normal((2000, 11)))
    each = radii if quantity is RADIUS else np.clip(2.0 - radii, 0.01, 0.99)
    truth, errors = each.mean(), each.std(axis=1, ddof=1) / math.sqrt(11)
    numbers = list(zip(each.mean(axis=1).tolist(), errors.tolist(), strict=True))
    covered = [low <= truth <= high for low, high in (compute_interval95(*number, 10, quantity) for number in numbers)]
    assert np.mean(covered) > 0.92
    plain = [abs(value - truth) <= 1.96 * error for value, error in numbers]
    assert np.mean(plain) < 0.91
