"""Which and how many: values add up over points, greedy keeps its promise, branch and bound finds the best."""

from itertools import combinations

import numpy as np
import pytest

from torchcover.placement import Candidates, Limits, Worth, exact, greedy
from torchcover.placement import subsets as module
from torchcover.placement.subsets import marginal_values, random_subsets

POINTS = 37


def some(seed, count=9):
    """Candidates that see points at random, and the same as booleans and weights."""
    generator = np.random.default_rng(seed)
    of_bits = np.zeros(40)
    of_bits[:POINTS] = generator.gamma(0.5, size=POINTS)
    seen = generator.random((count + 1, 40)) < generator.uniform(0.05, 0.5, (count + 1, 1))
    packed = np.packbits(seen, axis=1)
    return Candidates(Worth(of_bits), list(packed[1:]), packed[0]), seen, of_bits


def slow_value(seen, of_bits, chosen):
    return (of_bits * seen[[0, *(one + 1 for one in chosen)]].any(axis=0)).sum()


def all_allowed(limits, count):
    for size in range(limits.most + 1):
        for chosen in combinations(range(count), size):
            if all(limits.allow(chosen[:at], one) for at, one in enumerate(chosen)):
                yield chosen


LIMITS = {
    "three": lambda generator: Limits(3),
    "money": lambda generator: Limits(9, list(generator.uniform(0.5, 3.0, 9)), 4.0),
    "two for money": lambda generator: Limits(2, list(generator.uniform(0.5, 3.0, 9)), 3.5),
    "free of charge": lambda generator: Limits(9, [0.0, *generator.uniform(0.5, 3.0, 8)], 4.0),
    "nothing to pay with": lambda generator: Limits(9, [0.0, 0.0, 0.0, *generator.uniform(0.5, 3.0, 6)], 0.0),
    "apart": lambda generator: Limits(4, apart=_apart(generator)),
}


def _apart(generator):
    upper = np.triu(generator.random((9, 9)) < 0.5)
    return upper | upper.T


def test_a_value_is_the_sum_over_the_points_that_are_seen():
    candidates, seen, of_bits = some(0)
    for chosen in ((), (3,), (0, 4, 8), tuple(range(9))):
        assert candidates.value(chosen) == pytest.approx(slow_value(seen, of_bits, chosen), rel=1e-12)
    assert candidates.worth.total == pytest.approx(of_bits.sum())


def test_another_sensor_never_harms_and_adds_the_less_the_more_there_are():
    candidates, _, _ = some(1)
    generator = np.random.default_rng(1)
    for _ in range(200):
        order = generator.permutation(9)
        few, more, other = order[:2].tolist(), order[:5].tolist(), int(order[7])
        added = [candidates.gain(candidates.covered(those), other) for those in (few, more)]
        assert added[0] >= added[1] >= 0.0
        for those, gain in zip((few, more), added, strict=True):
            assert candidates.value([*those, other]) - candidates.value(those) == pytest.approx(gain, abs=1e-12)


@pytest.mark.parametrize("kind", LIMITS)
@pytest.mark.parametrize("seed", range(6))
def test_the_exact_choice_is_the_best_of_all_and_bounds_hold(kind, seed):
    candidates, seen, of_bits = some(seed)
    limits = LIMITS[kind](np.random.default_rng(seed))
    values = {chosen: slow_value(seen, of_bits, chosen) for chosen in all_allowed(limits, 9)}
    best, found, quick = max(values.values()), exact(candidates, limits), greedy(candidates, limits)
    assert found.proven
    assert found.value == pytest.approx(best, rel=1e-12)
    assert found.upper_bound == found.value
    assert values[tuple(sorted(found.chosen))] == pytest.approx(found.value, rel=1e-12)
    assert tuple(sorted(quick.chosen)) in values
    assert quick.upper_bound >= best - 1e-12
    nothing = slow_value(seen, of_bits, ())
    if kind != "apart":
        share = 1 - 1 / np.e if not limits.prices else (1 - 1 / np.e) / 2
        assert quick.value - nothing >= share * (best - nothing)


def test_an_exact_search_that_gives_up_says_so_and_how_far_off_it_may_be(monkeypatch):
    monkeypatch.setattr(module, "MOST_LOOKS", 1)
    candidates, seen, of_bits = some(3)
    found = exact(candidates, Limits(4))
    best = max(slow_value(seen, of_bits, chosen) for chosen in combinations(range(9), 4))
    assert not found.proven
    assert found.value - 1e-12 <= best <= found.upper_bound + 1e-12


def test_the_order_of_candidates_does_not_matter():
    candidates, _, _ = some(4)
    order = np.random.default_rng(0).permutation(9).tolist()
    shuffled = Candidates(candidates.worth, [candidates.seen[one] for one in order], candidates.always)
    found, other = exact(candidates, Limits(3)), exact(shuffled, Limits(3))
    assert sorted(found.chosen) == sorted(order[one] for one in other.chosen)


def test_what_is_lost_is_what_the_others_do_not_see():
    candidates, seen, of_bits = some(5)
    chosen = (1, 2, 6)
    lost = marginal_values(candidates, chosen)
    for at, one in enumerate(chosen):
        others = [0, *(other + 1 for other in chosen if other != one)]
        alone = seen[one + 1] & ~seen[others].any(axis=0)
        assert lost[at] == pytest.approx((of_bits * alone).sum(), abs=1e-12)


def test_random_choices_keep_to_the_limits_and_leave_no_room():
    candidates, seen, of_bits = some(6)
    limits = LIMITS["two for money"](np.random.default_rng(6))
    drawn = random_subsets(candidates, limits, 50, seed=1)
    assert drawn == random_subsets(candidates, limits, 50, seed=1)
    assert len({one.chosen for one in drawn}) > 10
    for one in drawn:
        assert one.value == pytest.approx(slow_value(seen, of_bits, one.chosen))
        assert limits.price(one.chosen) <= 3.5
        assert not any(limits.allow(one.chosen, other) for other in range(9))
