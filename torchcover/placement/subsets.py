"""Which and how many: the best subset of candidates, from what each of them sees.

What a subset sees is worth the sum over all points that one of it sees, at least. So another sensor adds the less the
more there are (Nemhauser, Wolsey and Fisher 1978): what each adds alone bounds what all may still add, and a branch and
bound leaves out most subsets. Where it gives up, HiGHS goes on, if scipy is installed: as a mixed-integer linear
programme every group of points that the same candidates see is a variable, at most the number of these that are chosen.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64

# Shares closer than this are equal: a ten-thousandth of a percentage point. Then the price decides.
SAME = 1e-6
# In euros. What a sensor costs beside its price, so that of equal choices the one with fewer is taken; rounding.
EACH, CENT = 1.0, 0.01
# What must be there weighs so much more than what is made better: one is not sold for a hundredth point of the other.
FIRST = 1e4
# Of the other objectives, where one is made best: they decide between equals.
LAST = 1e-5
# Subsets that are looked at, within a second or so, before HiGHS goes on, and how long that may take.
MOST_SETS, LONGEST_S = 5000, 60.0
# HiGHS stops at a millionth; in these units a price is more than that.
FINE = 1e3
# Steps to the subset between the best of several objectives, each of which halves what is left.
HALVINGS = 7


@dataclass(frozen=True)
class Limits:
    """What a subset must keep to: so many candidates, which cost so much, at most.

    `apart` (C, C) is whether two candidates may both be there; all may if not given. `least` is what the numbers of
    `Candidates.worth` must be at least; anything, -inf, if not given.
    """

    most: int
    prices: Sequence[float] = ()
    most_to_pay: float = np.inf
    apart: Bools | None = None
    least: Sequence[float] | Float64 | None = None

    def price(self, chosen: Sequence[int]) -> float:
        """What a subset costs."""
        return float(sum(self.prices[one] for one in chosen)) if self.prices else 0.0

    def allow(self, chosen: Sequence[int], other: int) -> bool:
        """Whether another candidate may be added to a subset, whatever `least` is."""
        if len(chosen) >= self.most or other in chosen:
            return False
        if self.apart is not None and not all(self.apart[other, one] for one in chosen):
            return False
        return self.price([*chosen, other]) <= self.most_to_pay + CENT / 2


class Subset(NamedTuple):
    """A choice of candidates by their numbers, and what they are worth together with what is always there.

    `values` are the numbers of `Candidates.worth`. No subset that keeps to the limits is better by more than the `gap`
    in what was made better. `short` is how much it lacks of `Limits.least`, in all; unless there is a gap, no subset
    lacks less.
    """

    chosen: tuple[int, ...]
    values: tuple[float, ...]
    gap: float = np.inf
    short: float = 0.0

    @property
    def proven(self) -> bool:
        """Whether it is the best of all."""
        return self.gap <= SAME


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidates by what they see, of points that are grouped by who sees them.

    `sees` is (G, C) bool, which candidates see a group, without two equal rows; `worth` (Q, G) float64 what the points
    of each group are worth, one row for each number that counts; `always` (Q,) what is seen without any of them.
    """

    sees: Bools
    worth: Float64
    always: Float64

    @classmethod
    def grouped(cls, worth: ArrayLike, seen: Sequence[Bools], always: Bools) -> Self:
        """Group P points by what each is worth, (Q, P), which candidates see it, and whether it is seen anyway."""
        worth = np.asarray(worth, dtype=np.float64)
        rows = np.packbits(np.stack(seen), axis=0)  # eight candidates a byte
        counts = ~always & rows.any(axis=0) & worth.any(axis=0)
        groups, of = np.unique(rows[:, counts].T, axis=0, return_inverse=True)
        sums = np.stack([np.bincount(of.reshape(-1), row, len(groups)) for row in worth[:, counts]]).astype(np.float64)
        sees = np.unpackbits(groups, axis=1, count=len(seen)).astype(bool)
        return cls(sees, sums, worth[:, always].sum(axis=1))

    def values(self, chosen: Sequence[int]) -> Float64:
        """(Q,) what a subset is worth, with what is always there."""
        return self.always + self.worth @ self.sees[:, list(chosen)].any(axis=1)

    def lost_without(self, chosen: Sequence[int]) -> Float64:
        """(chosen, Q) what is lost when each of them fails."""
        rest = [[other for other in chosen if other != one] for one in chosen]
        return np.array([self.values(chosen) - self.values(some) for some in rest])


def best(candidates: Candidates, limits: Limits, weights: Sequence[float] | Float64 = (1.0,)) -> Subset:
    """The best subset, and of equal ones the cheapest. Where none is worth `least`, what lacks the least in all.

    `weights` are of the first numbers of `Candidates.worth`, whose sum is made as large as it gets.
    """
    goal = _Goal.of(candidates, limits, weights)
    chosen, gap = _searched(goal)
    if gap > SAME:
        chosen, gap = _proven(goal, chosen, gap)
    values = candidates.values(chosen)
    return Subset(chosen, tuple(values.tolist()), gap, float((goal.least - values).clip(0.0).sum()))


def best_of_several(candidates: Candidates, limits: Limits, objectives: int) -> list[Subset]:
    """The best of each of the first numbers of `Candidates.worth`; and before them, of several, what lies between.

    That is as near to the best of all of them as the farthest allows, measured from the worst that the others leave.
    """
    if objectives == 1:
        return [best(candidates, limits)]
    ends = [best(candidates, limits, np.where(np.arange(objectives) == one, 1.0, LAST)) for one in range(objectives)]
    values = np.array([end.values[:objectives] for end in ends])
    low, extent = values.min(axis=0), np.ptp(values, axis=0)
    weights = 1.0 / np.where(extent > SAME, extent, 1.0)
    least = np.resize(-np.inf if limits.least is None else limits.least, len(candidates.worth)).astype(float)
    between, share, step = best(candidates, limits, weights), 0.0, 0.5
    for _ in range(HALVINGS):
        asked = least.copy()
        asked[:objectives] = np.maximum(asked[:objectives], low + (share + step) * extent - SAME)
        found = best(candidates, replace(limits, least=asked), weights)
        if found.short <= between.short + SAME:
            between, share = found, share + step
        step /= 2
    return [between, *ends]


@dataclass(frozen=True, eq=False)
class _Goal:
    """What is made large: numbers by their weights, less what lacks of the least, less a little of the price."""

    candidates: Candidates
    limits: Limits
    weights: Float64
    least: Float64
    ties: Float64

    @classmethod
    def of(cls, candidates: Candidates, limits: Limits, weights: Sequence[float] | Float64) -> Self:
        numbers, count = len(candidates.worth), candidates.sees.shape[1]
        prices = np.array(limits.prices or np.zeros(count)) + EACH
        every = np.zeros(numbers)
        every[: len(weights)] = weights
        least = np.resize(-np.inf if limits.least is None else limits.least, numbers)
        # No difference in price weighs as much as what is not the same.
        dearest = min(float(np.sort(prices)[-limits.most :].sum()), limits.most_to_pay + EACH * count)
        return cls(candidates, limits, every, least, SAME * prices / dearest)

    def of_values(self, values: Float64) -> Float64:
        """Of (Q, ...) values, without the price."""
        lacks = np.minimum(values.T - self.least, 0.0)
        return np.asarray(values.T @ self.weights + FIRST * lacks.sum(axis=-1))


def _searched(goal: _Goal) -> tuple[tuple[int, ...], float]:
    """By branch and bound, what adds the most first: the best, and by how much others may be better at most."""
    candidates, limits, sees = goal.candidates, goal.limits, goal.candidates.sees.astype(np.float64)
    found: tuple[int, ...] = ()
    most, left, looks = float(goal.of_values(candidates.always)), -np.inf, 0

    def grow(chosen: tuple[int, ...], covered: Bools, cost: float, later: Sequence[int]) -> None:
        """Look at all subsets of some candidates that may be added."""
        nonlocal found, most, left, looks
        looks += 1
        values = candidates.always + candidates.worth @ covered
        now = float(goal.of_values(values))
        gains = goal.of_values(values[:, None] + (candidates.worth * ~covered) @ sees) - now - goal.ties
        allowed = [one for one in later if gains[one] > 0 and limits.allow(chosen, one)]
        ranked = sorted(allowed, key=lambda one: (-gains[one], one))
        for at, one in enumerate(ranked):
            bound = now - cost + _most_to_add(gains, ranked[at:], limits, chosen)
            if bound <= most:
                break
            if looks >= MOST_SETS:
                left = max(left, bound)
                break
            grown, more = (*chosen, one), now - cost + float(gains[one])
            if more > most:
                found, most = grown, more
            grow(grown, covered | candidates.sees[:, one], cost + float(goal.ties[one]), ranked[at + 1 :])

    grow((), np.zeros(len(sees), dtype=bool), 0.0, range(sees.shape[1]))
    return tuple(sorted(found)), max(left - most, 0.0)


def _most_to_add(gains: Float64, those: Sequence[int], limits: Limits, chosen: Sequence[int]) -> float:
    """What the best of some candidates add at most: as if they saw nothing in common, and one could be cut in two."""
    each = gains[those]
    most = float(each[: limits.most - len(chosen)].sum())  # the best come first
    if not limits.prices or not np.isfinite(limits.most_to_pay):
        return most
    prices = np.maximum(np.array(limits.prices)[those], CENT)
    order = np.argsort(-each / prices, kind="stable")
    left = limits.most_to_pay + CENT / 2 - limits.price(chosen) - np.cumsum(prices[order]) + prices[order]
    return min(most, float((each[order] * (left / prices[order]).clip(0.0, 1.0)).sum()))


def _proven(goal: _Goal, chosen: tuple[int, ...], gap: float) -> tuple[tuple[int, ...], float]:
    """The same by HiGHS, from a choice on: whether each candidate is there, what is seen of each group, what lacks."""
    try:
        from scipy.optimize import Bounds, LinearConstraint, milp
        from scipy.sparse import csr_array, eye, hstack
    except ImportError:
        return chosen, gap
    candidates, limits = goal.candidates, goal.limits
    (groups, count), asked = candidates.sees.shape, np.flatnonzero(np.isfinite(goal.least))

    def row(there: ArrayLike, seen: ArrayLike = 0.0, lacks: ArrayLike = 0.0) -> Float64:
        sizes = (there, count), (seen, groups), (lacks, len(asked))
        return np.concatenate([np.broadcast_to(np.asarray(each, dtype=np.float64), size) for each, size in sizes])

    rows, most = [row(1.0)], [float(limits.most)]
    if limits.prices and np.isfinite(limits.most_to_pay):
        rows, most = [*rows, row(limits.prices)], [*most, limits.most_to_pay + CENT / 2]
    for one in () if limits.apart is None else _cliques(limits.apart):
        rows, most = [*rows, row(np.isin(range(count), one))], [*most, 1.0]
    for at, number in enumerate(asked):
        rows.append(row(0.0, -candidates.worth[number], -np.eye(len(asked))[at]))
        most.append(candidates.always[number] - goal.least[number])
    large = row(-goal.ties, goal.weights @ candidates.worth, -FIRST)
    begun = float(goal.of_values(candidates.values(chosen)) - goal.weights @ candidates.always)
    begun -= float(goal.ties[list(chosen)].sum())
    seen = hstack([csr_array(-candidates.sees.astype(float)), eye(groups), csr_array((groups, len(asked)))])
    found = milp(
        -FINE * large,
        integrality=row(1.0),
        bounds=Bounds(0.0, row(1.0, 1.0, np.inf)),
        constraints=[
            LinearConstraint(seen, ub=0.0),
            LinearConstraint(csr_array(np.array([*rows, -large])), ub=[*most, SAME / 2 - begun]),
        ],
        options={"mip_rel_gap": 0.0, "time_limit": LONGEST_S},
    )
    bound = begun + gap if found.mip_dual_bound is None else min(-found.mip_dual_bound / FINE, begun + gap)
    if found.x is None or -found.fun / FINE <= begun:
        return chosen, max(bound - begun, 0.0)
    return tuple(np.flatnonzero(found.x[:count] > 0.5).tolist()), max(bound + found.fun / FINE, 0.0)


def _cliques(apart: Bools) -> Iterable[list[int]]:
    """Sets of candidates of which one may be there, which together have all pairs of them that may not."""
    left = np.triu(~apart, 1)
    while left.any():
        clique = np.argwhere(left)[0].tolist()
        for one in range(len(apart)):
            if one not in clique and not apart[one, clique].any():
                clique.append(one)
        left[np.ix_(clique, clique)] = False
        yield clique


def random_subsets(candidates: Candidates, limits: Limits, count: int, seed: int) -> list[Subset]:
    """Subsets that are drawn: candidates in a random order, each added if it may be."""
    generator, found = np.random.default_rng(seed), []
    for _ in range(count):
        chosen: list[int] = []
        for one in generator.permutation(candidates.sees.shape[1]).tolist():
            if limits.allow(chosen, one):
                chosen.append(one)
        found.append(Subset(tuple(chosen), tuple(candidates.values(chosen).tolist())))
    return found
