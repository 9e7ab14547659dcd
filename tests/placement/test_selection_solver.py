"""Which and how many: values add up over points, and the best of all is found, the cheapest of equal ones."""

from itertools import combinations

import numpy as np
import pytest

from torchcover.placement.selection_solver import (
    CandidateCoverage,
    SelectionLimits,
    SolverParams,
    sample_selections,
    select_for_objectives,
    select_sensors,
)

POINTS, COUNT = 37, 8


def some(seed, count=COUNT, numbers=3):
    """Candidates that see points at random, the last of them the same as the first, and all of it ungrouped."""
    generator = np.random.default_rng(seed)
    weights = generator.gamma(0.5, size=(numbers, POINTS)) * (generator.random((numbers, POINTS)) < 0.7)
    weights /= weights.sum(axis=1, keepdims=True)
    seen = generator.random((count + 1, POINTS)) < generator.uniform(0.05, 0.5, (count + 1, 1))
    seen[-2] = seen[0]
    return CandidateCoverage.from_points(weights, list(seen[:-1]), seen[-1]), seen, weights


def slow_values(seen, weights, chosen):
    return (weights * seen[[-1, *chosen]].any(axis=0)).sum(axis=1)


def all_allowed(limits, count=COUNT):
    for size in range(limits.max_sensors + 1):
        for chosen in combinations(range(count), size):
            if all(limits.can_add(chosen[:at], one) for at, one in enumerate(chosen)):
                yield chosen


def prices(generator):
    return generator.integers(1, 4, COUNT) * 100.0


LIMITS = {
    "three": lambda generator: SelectionLimits(3),
    "money": lambda generator: SelectionLimits(COUNT, list(prices(generator)), 700.0),
    "two for money": lambda generator: SelectionLimits(2, list(prices(generator)), 400.0),
    "all for money": lambda generator: SelectionLimits(COUNT, list(prices(generator)), 1e6),
    "free of charge": lambda generator: SelectionLimits(COUNT, [0.0, *prices(generator)[1:]], 500.0),
    "nothing to pay with": lambda generator: SelectionLimits(COUNT, [0.0, 0.0, 0.0, *prices(generator)[3:]], 0.0),
    "no money": lambda generator: SelectionLimits(COUNT, list(prices(generator)), 0.0),
    "apart": lambda generator: SelectionLimits(4, compatible=_apart(generator)),
}


def _apart(generator):
    upper = np.triu(generator.random((COUNT, COUNT)) < 0.5)
    return upper | upper.T | np.eye(COUNT, dtype=bool)


def test_grouping_points_preserves_values():
    candidates, seen, weights = some(0)
    assert len(np.unique(candidates.observes, axis=0)) == len(candidates.observes) < POINTS
    for chosen in ((), (3,), (0, 4, 7), tuple(range(COUNT))):
        np.testing.assert_allclose(candidates.compute_values(chosen), slow_values(seen, weights, chosen), rtol=1e-12)
    lost = candidates.compute_failure_effects((1, 2, 6))
    np.testing.assert_allclose(
        lost[1], candidates.compute_values((1, 2, 6)) - candidates.compute_values((1, 6)), rtol=1e-12
    )


@pytest.mark.parametrize("kind", LIMITS)
@pytest.mark.parametrize("seed", range(4))
def test_selection_is_best_and_cheapest(kind, seed):
    candidates, seen, weights = some(seed)
    limits = LIMITS[kind](np.random.default_rng(seed))
    each = {chosen: slow_values(seen, weights, chosen)[0] for chosen in all_allowed(limits)}
    most = max(each.values())
    cheapest = min((limits.compute_price_eur(one), len(one)) for one, value in each.items() if value > most - 1e-9)
    found = select_sensors(candidates, limits)
    assert found.is_proven
    assert found.shortfall == 0
    assert found.values[0] == pytest.approx(most, abs=2e-6)
    np.testing.assert_allclose(found.values, slow_values(seen, weights, found.selected), rtol=1e-12)
    assert (limits.compute_price_eur(found.selected), len(found.selected)) == cheapest


@pytest.mark.parametrize("seed", range(6))
def test_lower_bounds_are_met_or_nearly_met(seed):
    candidates, seen, weights = some(seed)
    generator = np.random.default_rng(seed)
    least = np.append(-np.inf, generator.uniform(0.3, 0.9, 2))
    limits = SelectionLimits(3, list(prices(generator)), 500.0, min_values=least)
    value = {}
    for chosen in all_allowed(limits):
        values = slow_values(seen, weights, chosen)
        value[chosen] = (least - values).clip(0).sum(), values[0]
    fewest = min(short for short, _ in value.values())
    found = select_sensors(candidates, limits)
    assert found.is_proven
    assert found.shortfall == pytest.approx(fewest, abs=1e-4)
    assert (found.shortfall == 0) == (fewest == 0)
    assert found.values[0] >= max(v for short, v in value.values() if short < fewest + 1e-9) - 2e-6


@pytest.mark.parametrize("seed", range(4))
def test_compromise_minimizes_the_largest_distance(seed):
    candidates, seen, weights = some(seed)
    limits = SelectionLimits(2)
    between, *ends = select_for_objectives(candidates, limits, 2)
    each = np.array([slow_values(seen, weights, chosen)[:2] for chosen in all_allowed(limits)])
    np.testing.assert_allclose([ends[k].values[k] for k in range(2)], each.max(axis=0), atol=2e-5)
    low, extent = (op([end.values[:2] for end in ends], axis=0) for op in (np.min, np.ptp))
    if (extent > 1e-6).all():
        most = ((each - low) / extent).min(axis=1).max()
        assert ((np.array(between.values[:2]) - low) / extent).min() > most - 0.01
        assert between.is_proven
    else:
        assert between.values[:2] == pytest.approx(ends[0].values[:2])
    assert select_for_objectives(candidates, limits, 1) == [select_sensors(candidates, limits)]


def test_solver_without_time_reports_its_gap():
    generator = np.random.default_rng(0)
    seen = list(generator.random((60, 3000)) < 0.05)
    coverage = CandidateCoverage.from_points([np.full(3000, 1 / 3000)], seen, np.zeros(3000, dtype=bool))
    selection = select_sensors(coverage, SelectionLimits(12), params=SolverParams(time_limit_s=0.5))
    assert not selection.is_proven
    assert selection.gap > 0


def test_random_selections_meet_limits_and_are_maximal():
    candidates, seen, weights = some(6)
    limits = LIMITS["two for money"](np.random.default_rng(6))
    drawn = sample_selections(candidates, limits, 50, seed=1)
    assert drawn == sample_selections(candidates, limits, 50, seed=1)
    assert len({one.selected for one in drawn}) > 10
    for one in drawn:
        assert one.values == pytest.approx(slow_values(seen, weights, one.selected).tolist())
        assert limits.compute_price_eur(one.selected) <= 400
        assert not any(limits.can_add(one.selected, other) for other in range(COUNT))
