"""The 95 % interval of a region's number: its range, its symmetries, and whether it covers."""

import math

import numpy as np
import pytest
from scipy import stats

from torchcover.coverage.intervals import BLIND_SIDE, interval95


@pytest.mark.parametrize("freedom", [7, 10, 15])
@pytest.mark.parametrize(("value", "error"), [(0.3, 0.001), (0.3, 0.05), (0.02, 0.015), (0.98, 0.015)])
def test_ends_are_students_t_on_a_scale_without_bounds(value, error, freedom):
    t = float(stats.t.ppf(0.975, freedom))
    low, high = interval95(value, error, freedom, "m")
    assert math.log(high / value) == pytest.approx(BLIND_SIDE * t * error / value, rel=1e-3)
    assert math.log(value / low) == pytest.approx(t * error / value, rel=1e-3)
    low, high = interval95(value, error, freedom, "share")
    reach = t * error / (value * (1 - value))
    assert 0 < low < value < high < 1
    logit = lambda share: math.log(share / (1 - share))  # noqa: E731
    assert logit(value) - logit(low) == pytest.approx(BLIND_SIDE * reach, rel=1e-3)
    assert logit(high) - logit(value) == pytest.approx(reach, rel=1e-3)


def test_small_errors_give_the_plain_interval_but_for_the_blind_side():
    low, high = interval95(2.0, 1e-6, 10, "m")
    assert (2.0 - low) / 1e-6 == pytest.approx(2.228, abs=1e-3)
    assert (high - 2.0) / 1e-6 == pytest.approx(BLIND_SIDE * 2.228, abs=1e-3)


@pytest.mark.parametrize("unit", ["m", "share"])
def test_what_is_not_known_has_no_interval_and_neither_has_what_all_blocks_agree_on(unit):
    assert all(map(math.isnan, interval95(0.5, math.nan, 3, unit)))
    assert all(map(math.isnan, interval95(1.0, 0.0, 10, unit)))
    assert interval95(math.inf, math.nan, 10, unit)[0] != math.inf


@pytest.mark.parametrize("value", [0.0, 1.0, 1 + 2e-16, -1e-17])
def test_a_share_at_the_rim_with_an_error_may_be_anything(value):
    assert interval95(value, 1e-3, 10, "share") == (0.0, 1.0)
    assert all(map(math.isnan, interval95(0.0, 1e-3, 10, "m")))


@pytest.mark.parametrize(("value", "error"), [(1e-9, 1.0), (1 - 1e-12, 0.5), (0.5, 1e6)])
def test_absurd_errors_leave_no_range(value, error):
    low, high = interval95(value, error, 7, "share")
    assert 0.0 <= low <= value <= high <= 1.0
    low, high = interval95(value, error, 7, "m")
    assert 0.0 <= low <= value < high < math.inf


@pytest.mark.parametrize("unit", ["m", "share"])
def test_means_of_skewed_blocks_are_covered(unit):
    """Eleven blocks of a lognormal radius, whose skewness is 6, and of the share of them that is near."""
    radii = np.exp(np.random.default_rng(0).standard_normal((2000, 11)))
    each = radii if unit == "m" else np.clip(2.0 - radii, 0.01, 0.99)
    truth, errors = each.mean(), each.std(axis=1, ddof=1) / math.sqrt(11)
    numbers = list(zip(each.mean(axis=1).tolist(), errors.tolist(), strict=True))
    covered = [low <= truth <= high for low, high in (interval95(*number, 10, unit) for number in numbers)]
    assert np.mean(covered) > 0.93
    plain = [abs(value - truth) <= 1.96 * error for value, error in numbers]
    assert np.mean(plain) < 0.92
