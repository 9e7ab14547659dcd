"""Rankings of rigs against SciPy and in closed form."""

import math
from itertools import permutations

import numpy as np
import pytest
from scipy import stats

from torchcover.contrib.ranks import check_best_correlation, compute_kendall_tau_b, compute_spearman, rank_values

STATISTICS = pytest.mark.parametrize(
    ("own", "of_scipy"),
    [(compute_kendall_tau_b, stats.kendalltau), (compute_spearman, stats.spearmanr)],
    ids=["tau", "spearman"],
)


@STATISTICS
@pytest.mark.parametrize("levels", [2, 4, 1000])
@pytest.mark.parametrize("count", [3, 4, 9])
def test_it_is_scipys_with_and_without_ties(own, of_scipy, levels, count):
    generator = np.random.default_rng([levels, count])
    series = generator.integers(0, levels, (2, 20, count)).astype(float)
    together = own(*series)
    for row, one, other in zip(together, *series, strict=True):
        constant = len(set(one)) == 1 or len(set(other)) == 1
        expected = math.nan if constant else of_scipy(one, other).statistic
        assert row == pytest.approx(expected, abs=1e-12, nan_ok=True)
        assert own(one, other) == pytest.approx(row, abs=1e-15, nan_ok=True)


@STATISTICS
def test_unknown_values_are_excluded_from_both_series(own, of_scipy):
    one, other = [1.0, math.nan, 3.0, 2.0, 7.0, 5.0], [2.0, 9.0, 1.0, math.nan, 8.0, 8.0]
    known = of_scipy([1.0, 3.0, 7.0, 5.0], [2.0, 1.0, 8.0, 8.0]).statistic
    assert own(one, other) == pytest.approx(known, abs=1e-12)


@STATISTICS
@pytest.mark.parametrize(
    "series",
    [([], []), ([1, 2], [1, 2]), ([1, 2, math.nan], [1, 2, 3]), ([1, 1, 1], [1, 2, 3]), ([math.nan] * 4, range(4))],
)
def test_two_or_equal_rigs_have_no_correlation(own, of_scipy, series):
    assert math.isnan(own(np.array(series[0], dtype=float), np.array(series[1], dtype=float)))


def test_infinite_values_are_the_largest_not_unknown():
    assert compute_kendall_tau_b([1.0, 2.0, math.inf], [1.0, 2.0, 3.0]) == pytest.approx(1.0)
    assert rank_values([math.inf, 1.0, math.inf]).tolist() == [2.5, 1.0, 2.5]


def test_p_values_use_all_permutations():
    one, other = [1, 2, 3, 4, 5], [2, 1, 4, 3, 5]
    result = abs(stats.spearmanr(one, other).statistic)
    expected = np.mean([abs(stats.spearmanr(one, order).statistic) >= result - 1e-9 for order in permutations(other)])
    assert check_best_correlation(one, other).p_value == pytest.approx(expected, abs=1e-15)


def test_sampled_permutations_are_reproducible():
    same = np.arange(12.0)
    first, second = (check_best_correlation(same, same, seed=5) for _ in range(2))
    assert first.p_value == pytest.approx(1 / 40321)
    np.testing.assert_array_equal(first.chance_correlations, second.chance_correlations)


def test_unknown_series_have_no_p():
    assert math.isnan(check_best_correlation([1, 1, 1], [1, 2, 3]).p_value)
    assert math.isnan(check_best_correlation([1, math.nan, 2], [1, 2, 3]).p_value)
