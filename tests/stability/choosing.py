"""Selections of sensors, against all subsets in fractions."""

from fractions import Fraction
from functools import lru_cache
from itertools import combinations

import numpy as np

from torchcover.placement.selection_solver import CandidateCoverage, SelectionLimits, select_sensors

from .case import Case

WORLDS, COUNT, POINTS, MOST = 12, 7, 24, 3


@lru_cache
def choices(seed):
    """Points of a third, or nearly: what candidates see is often worth the same, and prices decide."""
    generator = np.random.default_rng(seed)
    worth = np.where(generator.random(POINTS) < 0.5, 1 / 3, 1 / 3 + 1e-12) / POINTS
    seen = generator.random((COUNT, POINTS)) < 0.5
    seen[4:] = seen[:3, ::-1] | (generator.random((3, POINTS)) < 0.1)
    return worth, seen, (generator.integers(1, 6, COUNT) * 100.0).tolist()


def every_subset():
    return [some for size in range(MOST + 1) for some in combinations(range(COUNT), size)]


@lru_cache
def right(seed):
    """The price of the best, in fractions: of those that are worth the same up to what counts as the same."""
    worth, seen, prices = choices(seed)
    exact = [Fraction(one) for one in worth.tolist()]
    values = {
        some: sum((one for one, there in zip(exact, seen[list(some)].any(axis=0), strict=True) if there), Fraction(0))
        for some in every_subset()
    }
    top = max(values.values())
    return min((sum(prices[k] for k in some), len(some)) for some, v in values.items() if v > top - Fraction(1, 10**9))


def wrong_choices():
    """Of those that are not the best, the cheapest, or not proven."""
    wrong = 0
    for seed in range(WORLDS):
        worth, seen, prices = choices(seed)
        coverage = CandidateCoverage.from_points([worth], list(seen), np.zeros(POINTS, dtype=bool))
        found = select_sensors(coverage, SelectionLimits(MOST, prices))
        paid = sum(prices[k] for k in found.selected), len(found.selected)
        wrong += paid != right(seed) or not found.is_proven
    return wrong


def wrong_by_greed():
    wrong = 0
    for seed in range(WORLDS):
        worth, seen, prices = choices(seed)
        some = []
        for _ in range(MOST):
            some.append(max(range(COUNT), key=lambda k: worth[seen[[*some, k]].any(axis=0)].sum()))
        wrong += (sum(prices[k] for k in some), len(set(some))) != right(seed)
    return wrong


CASES = (
    Case(
        "the best 3 of 7 that see points of 1/3 or 1e-12 more, by HiGHS",
        "all subsets, fractions",
        f"of {WORLDS} wrong",
        0,
        wrong_choices,
        "what adds most, one by one",
        wrong_by_greed,
    ),
)
