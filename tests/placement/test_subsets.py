"""Which and how many: values add up over points, and the best of all is found, the cheapest of equal ones."""

import sys
from itertools import combinations

import numpy as np
import pytest

from torchcover.placement import subsets as module
from torchcover.placement.subsets import Candidates, Limits, best, best_of_several, random_subsets

POINTS, COUNT = 37, 8


def some(seed, count=COUNT, numbers=3):
    """Candidates that see points at random, the last of them the same as the first, and all of it ungrouped."""
    generator = np.random.default_rng(seed)
    worth = generator.gamma(0.5, size=(numbers, POINTS)) * (generator.random((numbers, POINTS)) < 0.7)
    worth /= worth.sum(axis=1, keepdims=True)
    seen = generator.random((count + 1, POINTS)) < generator.uniform(0.05, 0.5, (count + 1, 1))
    seen[-2] = seen[0]
    return Candidates.grouped(worth, list(seen[:-1]), seen[-1]), seen, worth


def slow_values(seen, worth, chosen):
    return (worth * seen[[-1, *chosen]].any(axis=0)).sum(axis=1)


def all_allowed(limits, count=COUNT):
    for size in range(limits.most + 1):
        for chosen in combinations(range(count), size):
            if all(limits.allow(chosen[:at], one) for at, one in enumerate(chosen)):
                yield chosen


def prices(generator):
    return generator.integers(1, 4, COUNT) * 100.0


LIMITS = {
    "three": lambda generator: Limits(3),
    "money": lambda generator: Limits(COUNT, list(prices(generator)), 700.0),
    "two for money": lambda generator: Limits(2, list(prices(generator)), 400.0),
    "all for money": lambda generator: Limits(COUNT, list(prices(generator)), 1e6),
    "free of charge": lambda generator: Limits(COUNT, [0.0, *prices(generator)[1:]], 500.0),
    "nothing to pay with": lambda generator: Limits(COUNT, [0.0, 0.0, 0.0, *prices(generator)[3:]], 0.0),
    "no money": lambda generator: Limits(COUNT, list(prices(generator)), 0.0),
    "apart": lambda generator: Limits(4, apart=_apart(generator)),
}


def _apart(generator):
    upper = np.triu(generator.random((COUNT, COUNT)) < 0.5)
    return upper | upper.T | np.eye(COUNT, dtype=bool)


@pytest.fixture
def without_scipy(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)


@pytest.fixture(params=["a search", "HiGHS"])
def by(request, monkeypatch):
    """Who finds the best: a search that may look at all subsets without scipy, or HiGHS from the first one on."""
    request.getfixturevalue("without_scipy") if request.param == "a search" else None
    monkeypatch.setattr(module, "MOST_SETS", 10**6 if request.param == "a search" else 1)


def test_points_that_the_same_candidates_see_are_one_group_and_values_stay():
    candidates, seen, worth = some(0)
    assert len(np.unique(candidates.sees, axis=0)) == len(candidates.sees) < POINTS
    for chosen in ((), (3,), (0, 4, 7), tuple(range(COUNT))):
        np.testing.assert_allclose(candidates.values(chosen), slow_values(seen, worth, chosen), rtol=1e-12)
    lost = candidates.lost_without((1, 2, 6))
    np.testing.assert_allclose(lost[1], candidates.values((1, 2, 6)) - candidates.values((1, 6)), rtol=1e-12)


@pytest.mark.parametrize("kind", LIMITS)
@pytest.mark.parametrize("seed", range(4))
def test_the_choice_is_the_best_of_all_and_the_cheapest_of_equal_ones(by, kind, seed):
    candidates, seen, worth = some(seed)
    limits = LIMITS[kind](np.random.default_rng(seed))
    each = {chosen: slow_values(seen, worth, chosen)[0] for chosen in all_allowed(limits)}
    most = max(each.values())
    cheapest = min((limits.price(one), len(one)) for one, value in each.items() if value > most - 1e-9)
    found = best(candidates, limits)
    assert found.proven
    assert found.short == 0
    assert found.values[0] == pytest.approx(most, abs=2e-6)
    np.testing.assert_allclose(found.values, slow_values(seen, worth, found.chosen), rtol=1e-12)
    assert (limits.price(found.chosen), len(found.chosen)) == cheapest


@pytest.mark.parametrize("seed", range(6))
def test_what_must_not_be_less_is_kept_or_lacks_the_least(by, seed):
    candidates, seen, worth = some(seed)
    generator = np.random.default_rng(seed)
    least = np.append(-np.inf, generator.uniform(0.3, 0.9, 2))
    limits = Limits(3, list(prices(generator)), 500.0, least=least)
    value = {}
    for chosen in all_allowed(limits):
        values = slow_values(seen, worth, chosen)
        value[chosen] = (least - values).clip(0).sum(), values[0]
    fewest = min(short for short, _ in value.values())
    found = best(candidates, limits)
    assert found.proven
    assert found.short == pytest.approx(fewest, abs=1e-4)
    assert (found.short == 0) == (fewest == 0)
    assert found.values[0] >= max(v for short, v in value.values() if short < fewest + 1e-9) - 2e-6


@pytest.mark.parametrize("seed", range(4))
def test_of_several_objectives_the_one_between_is_as_near_to_all_as_the_farthest_allows(by, seed):
    candidates, seen, worth = some(seed)
    limits = Limits(2)
    between, *ends = best_of_several(candidates, limits, 2)
    each = np.array([slow_values(seen, worth, chosen)[:2] for chosen in all_allowed(limits)])
    np.testing.assert_allclose([ends[k].values[k] for k in range(2)], each.max(axis=0), atol=2e-5)
    low, extent = (op([end.values[:2] for end in ends], axis=0) for op in (np.min, np.ptp))
    if (extent > 1e-6).all():
        most = ((each - low) / extent).min(axis=1).max()
        assert ((np.array(between.values[:2]) - low) / extent).min() > most - 0.01
        assert between.proven
    else:
        assert between.values[:2] == pytest.approx(ends[0].values[:2])
    assert best_of_several(candidates, limits, 1) == [best(candidates, limits)]


def test_a_search_that_gives_up_says_how_far_off_it_may_be(monkeypatch, without_scipy):
    monkeypatch.setattr(module, "MOST_SETS", 2)
    candidates, seen, worth = some(3)
    found = best(candidates, Limits(4))
    most = max(slow_values(seen, worth, chosen)[0] for chosen in combinations(range(COUNT), 4))
    assert not found.proven
    assert found.values[0] - 1e-9 <= most <= found.values[0] + found.gap + 2e-6


def test_random_choices_keep_to_the_limits_and_leave_no_room():
    candidates, seen, worth = some(6)
    limits = LIMITS["two for money"](np.random.default_rng(6))
    drawn = random_subsets(candidates, limits, 50, seed=1)
    assert drawn == random_subsets(candidates, limits, 50, seed=1)
    assert len({one.chosen for one in drawn}) > 10
    for one in drawn:
        assert one.values == pytest.approx(slow_values(seen, worth, one.chosen).tolist())
        assert limits.price(one.chosen) <= 400
        assert not any(limits.allow(one.chosen, other) for other in range(COUNT))
