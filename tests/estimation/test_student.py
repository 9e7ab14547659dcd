"""Student's t, by SciPy's, and the 95 % interval of a number: its range, its symmetries, and whether it covers."""

import math

import numpy as np
import pytest
from scipy import stats

from torchcover.coverage.quantity import RADIUS, detection
from torchcover.estimation import Quantity, interval95, student_p, student_t95
from torchcover.estimation.student import BLIND_SIDE, is_significant

SHARE = detection(0.4)
BLIND = Quantity("blind", "share that is not seen", "share", lower_is_better=True)


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 7, 8, 9, 11, 15, 31, 200, 10_000])
def test_students_t_is_that_of_scipy_and_decides(freedom):
    limit = float(stats.t.ppf(0.975, freedom))
    assert student_t95(freedom) == pytest.approx(limit, abs=1e-4)
    for sign in (-1, 1):
        assert is_significant(sign * 1.001 * limit * 0.2, 0.2, freedom) is True
        assert is_significant(sign * 0.999 * limit * 0.2, 0.2, freedom) is False
    assert is_significant(1e-17, 0.0, freedom) is False
    assert is_significant(1.0, math.nan, freedom) is None


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 15, 40])
def test_the_probability_of_t_is_students(freedom):
    for t in (0.0, 0.3, -2.0, 7.0):
        assert student_p(t, freedom) == pytest.approx(2 * stats.t.sf(abs(t), freedom), abs=1e-12)
    assert np.isnan(student_p(float("nan"), freedom))


def test_what_is_worse_decides_which_side_is_longer():
    low, high = interval95(0.3, 0.05, 10, BLIND)
    seen_low, seen_high = interval95(0.7, 0.05, 10, SHARE)
    assert (low, high) == pytest.approx((1 - seen_high, 1 - seen_low), rel=1e-12)
    far = Quantity("range_m", "how far it sees", "m", lower_is_better=False)
    low, high = interval95(50.0, 1.0, 10, far)
    assert math.log(50.0 / low) == pytest.approx(BLIND_SIDE * math.log(high / 50.0), rel=1e-12)


def test_other_units_have_the_plain_interval():
    low, high = interval95(-3.0, 0.5, 7, Quantity("gain", "gain", "nats", lower_is_better=False))
    assert (low, high) == (-3.0 - 0.5 * student_t95(7), -3.0 + 0.5 * student_t95(7))


@pytest.mark.parametrize("freedom", [7, 10, 15])
@pytest.mark.parametrize(("value", "error"), [(0.3, 0.001), (0.3, 0.05), (0.02, 0.015), (0.98, 0.015)])
def test_ends_are_students_t_on_a_scale_without_bounds(value, error, freedom):
    t = float(stats.t.ppf(0.975, freedom))
    low, high = interval95(value, error, freedom, RADIUS)
    assert math.log(high / value) == pytest.approx(BLIND_SIDE * t * error / value, rel=1e-3)
    assert math.log(value / low) == pytest.approx(t * error / value, rel=1e-3)
    low, high = interval95(value, error, freedom, SHARE)
    reach = t * error / (value * (1 - value))
    assert 0 < low < value < high < 1
    logit = lambda share: math.log(share / (1 - share))  # noqa: E731
    assert logit(value) - logit(low) == pytest.approx(BLIND_SIDE * reach, rel=1e-3)
    assert logit(high) - logit(value) == pytest.approx(reach, rel=1e-3)


def test_small_errors_give_the_plain_interval_but_for_the_blind_side():
    low, high = interval95(2.0, 1e-6, 10, RADIUS)
    assert (2.0 - low) / 1e-6 == pytest.approx(2.228, abs=1e-3)
    assert (high - 2.0) / 1e-6 == pytest.approx(BLIND_SIDE * 2.228, abs=1e-3)


@pytest.mark.parametrize("quantity", [RADIUS, SHARE])
def test_what_is_not_known_has_no_interval_and_neither_has_what_all_blocks_agree_on(quantity):
    assert all(map(math.isnan, interval95(0.5, math.nan, 3, quantity)))
    assert all(map(math.isnan, interval95(1.0, 0.0, 10, quantity)))
    assert interval95(math.inf, math.nan, 10, quantity)[0] != math.inf


@pytest.mark.parametrize("value", [0.0, 1.0, 1 + 2e-16, -1e-17])
def test_a_share_at_the_rim_with_an_error_may_be_anything(value):
    assert interval95(value, 1e-3, 10, SHARE) == (0.0, 1.0)
    assert all(map(math.isnan, interval95(0.0, 1e-3, 10, RADIUS)))


@pytest.mark.parametrize(("value", "error"), [(1e-9, 1.0), (1 - 1e-12, 0.5), (0.5, 1e6)])
def test_absurd_errors_leave_no_range(value, error):
    low, high = interval95(value, error, 7, SHARE)
    assert 0.0 <= low <= value <= high <= 1.0
    low, high = interval95(value, error, 7, RADIUS)
    assert 0.0 <= low <= value < high < math.inf


@pytest.mark.parametrize("quantity", [RADIUS, SHARE])
def test_means_of_skewed_blocks_are_covered(quantity):
    """Eleven blocks of a lognormal radius, whose skewness is 6, and of the share of them that is near."""
    radii = np.exp(np.random.default_rng(0).standard_normal((2000, 11)))
    each = radii if quantity is RADIUS else np.clip(2.0 - radii, 0.01, 0.99)
    truth, errors = each.mean(), each.std(axis=1, ddof=1) / math.sqrt(11)
    numbers = list(zip(each.mean(axis=1).tolist(), errors.tolist(), strict=True))
    covered = [low <= truth <= high for low, high in (interval95(*number, 10, quantity) for number in numbers)]
    assert np.mean(covered) > 0.93
    plain = [abs(value - truth) <= 1.96 * error for value, error in numbers]
    assert np.mean(plain) < 0.92
