"""Rigs in the order of a number, how alike two such orders are, and whether that is more than chance."""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import permutations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.geometry.arrays import Float64, Int64

# Two things have two orders, and are alike or opposite by chance.
LEAST = 3
# All orders of 8 things are tried; of more, as many are drawn.
MOST_TRIED = math.factorial(8)
# Worlds are drawn again so many times for intervals.
DRAWS = 500
# The metric that numbers of torchcover itself are of; and what takes no simulation to know, or little.
OWN, BASELINE = "torchcover", "baseline"


class Ranking(NamedTuple):
    """One number of every rig, which ranks them.

    Args:
        name: Of the number, with all that decides it.
        metric: The published metric that it is of, `OWN` or `BASELINE`.
        numbers: One for each rig.
        draws: (R, rigs) what they were in worlds that are drawn again; None if that is unknown.

    Example:
        >>> height = Quantity("height", "mean mounting height", "m", lower_is_better=False)
        >>> Ranking.of_values(height, [2.2, 2.5, 2.2]).ranks.tolist()
        [2.5, 1.0, 2.5]
    """

    name: str
    metric: str
    numbers: tuple[Number, ...]
    draws: Float64 | None = None

    @classmethod
    def of_values(
        cls, quantity: Quantity, values: Sequence[float] | Float64, metric: str = BASELINE, draws: Float64 | None = None
    ) -> "Ranking":
        """Of values (rigs,) without errors."""
        return cls(quantity.key, metric, tuple(Number(quantity, float(value)) for value in values), draws)

    @property
    def quantity(self) -> Quantity:
        """What the numbers are."""
        return self.numbers[0].quantity

    @property
    def is_part(self) -> bool:
        """Whether it is about a part only of what another number is about: a category, a region."""
        return ":" in self.name

    @property
    def gains(self) -> Float64:
        """(rigs,) the values, with the sign turned so that more is better; NaN where unknown."""
        return np.array([number.quantity.gain(number.value) for number in self.numbers])

    @property
    def drawn_gains(self) -> Float64 | None:
        """(R, rigs) likewise those of the draws."""
        return None if self.draws is None else self.quantity.gain(1.0) * self.draws

    @property
    def ranks(self) -> Float64:
        """(rigs,) 1 for the best; equal ones share the mean of theirs, NaN where unknown."""
        return midranks(-self.gains)

    def of(self, rigs: Sequence[int]) -> "Ranking":
        """Of some of the rigs, by their places, in another order."""
        numbers = tuple(self.numbers[rig] for rig in rigs)
        return self._replace(numbers=numbers, draws=None if self.draws is None else self.draws[:, list(rigs)])


def rankings(
    metric: str, numbers: Sequence[Sequence[Number]], estimates: Sequence[Estimate], seed: int
) -> list[Ranking]:
    """A ranking by each number of a metric, the same of each rig, with draws of worlds from what they come from.

    The seed is the same for all metrics of a run.
    """
    draws = [drawn_again(estimate, seed) for estimate in estimates]
    known = [each for each in draws if each is not None]
    stacked = np.stack(known, axis=2) if len(known) == len(draws) else None
    return [
        Ranking(each[0].quantity.key, metric, each, None if stacked is None else stacked[:, at])
        for at, each in enumerate(zip(*numbers, strict=True))
    ]


def drawn_again(estimate: Estimate, seed: int) -> Float64 | None:
    """(R, Q) numbers over worlds that are drawn with replacement; None if too few, or what that gives, are known."""
    worlds = len(estimate.steps)
    if worlds < MIN_BLOCKS:
        return None
    drawn = np.random.default_rng([seed, worlds]).multinomial(worlds, np.full(worlds, 1 / worlds), size=DRAWS)
    again = estimate.resampled(torch.from_numpy(drawn))
    return None if again is None else again.cpu().numpy()


def interval95(value: float, drawn: Float64) -> tuple[float, float]:
    """Ends of the 95 % interval of a number by what it is in draws; NaN where it, or all of them, are unknown."""
    known = drawn[~np.isnan(drawn)]
    if math.isnan(value) or not known.size:
        return math.nan, math.nan
    low, high = np.quantile(known, (0.025, 0.975)).tolist()
    return low, high


def midranks(values: ArrayLike) -> Float64:
    """(..., n) ranks from 1, the smallest, on; equal values share the mean of theirs, and what is NaN stays so."""
    own = np.asarray(values, dtype=np.float64)
    smaller = (own[..., None, :] < own[..., :, None]).sum(axis=-1)
    equal = (own[..., None, :] == own[..., :, None]).sum(axis=-1)
    return np.where(np.isnan(own), math.nan, smaller + (equal + 1) / 2)


def kendall_tau_b(first: ArrayLike, second: ArrayLike) -> Float64:
    """Kendall's tau-b: 1 for the same order, -1 for the opposite one; ties count for neither.

        tau_b = (C - D) / sqrt((P - T_1) (P - T_2))

    with C concordant, D discordant and P all pairs, T_i of them equal in the i-th (Kendall 1945, Biometrika 33, 239).

    `first`: (..., n), NaN where unknown: what is unknown in one of the two is in no pair; `second`: (..., n), likewise;
    the two broadcast. Returns (...); NaN for fewer than three that are known, or if all of one are equal.
    """
    one, other = _known_in_both(first, second)
    # No difference: of two that are infinite there is none, and what is unknown is neither more nor less.
    pairs = [(each[..., :, None], each[..., None, :]) for each in (one, other)]
    signs = [(first > second).astype(np.float64) - (first < second) for first, second in pairs]
    agreement = (signs[0] * signs[1]).sum(axis=(-2, -1))
    apart = [np.abs(sign).sum(axis=(-2, -1)) for sign in signs]
    return _ratio(agreement, np.sqrt(apart[0] * apart[1]), one)


def spearman(first: ArrayLike, second: ArrayLike) -> Float64:
    """Spearman's rank correlation: Pearson's of the midranks, so that ties are right; else as `kendall_tau_b`."""
    one, other = (midranks(values) for values in _known_in_both(first, second))
    count = np.maximum((~np.isnan(one)).sum(axis=-1, keepdims=True), 1)
    one, other = (np.nan_to_num(ranks - np.nansum(ranks, axis=-1, keepdims=True) / count) for ranks in (one, other))
    spread = np.sqrt((one**2).sum(axis=-1) * (other**2).sum(axis=-1))
    return _ratio((one * other).sum(axis=-1), spread, _known_in_both(first, second)[0])


@lru_cache(maxsize=8)  # each metric asks for the same ones
def orders(count: int, seed: int = 0) -> Int64:
    """(P, n) orders of n things, to be read only: all of them up to n = 8, else as many as 8 have, drawn."""
    if math.factorial(count) <= MOST_TRIED:
        found = np.array(list(permutations(range(count))), dtype=np.int64)
    else:
        drawn = np.tile(np.arange(count), (MOST_TRIED, 1))
        found = np.random.default_rng(seed).permuted(drawn, axis=1)
    found.setflags(write=False)
    return found


def permutation_p(first: ArrayLike, second: ArrayLike) -> float:
    """Probability that chance gives so strong a rank correlation (`spearman`), of either sign: two-sided.

    It is the share of orders of the second with as strong a one, NaN if none is known. With several first series, (k,
    n), it is that of the best of them: of k metrics that were looked at, one is always good.
    """
    series, target = np.atleast_2d(np.asarray(first, dtype=np.float64)), np.asarray(second, dtype=np.float64)
    found = np.abs([spearman(one, target) for one in series])
    if np.isnan(found).all():
        return math.nan
    best = strongest_by_chance(series, target)
    as_strong = int((best >= np.nanmax(found) - 1e-12).sum())
    drawn = math.factorial(target.size) > MOST_TRIED  # then the order that was found is one more
    return (as_strong + drawn) / (len(best) + drawn)


def strongest_by_chance(first: ArrayLike, second: ArrayLike) -> Float64:
    """(P,) the strongest rank correlation of (k, n) series, of either sign, to each of many orders of the second.

    From 0 to 1: what the best of k metrics that mean nothing reaches.
    """
    target, numbers = np.asarray(second, dtype=np.float64), orders(np.size(second))
    best = np.zeros(len(numbers))
    for one in np.atleast_2d(np.asarray(first, dtype=np.float64)):
        known = not np.isnan(one + target).any()
        found = _spearman_of_orders(one, target, numbers) if known else spearman(one, target[numbers])
        best = np.fmax(best, np.abs(found))
    return best


def _spearman_of_orders(one: Float64, target: Float64, numbers: Int64) -> Float64:
    """(P,) what `spearman` gives for each order of the second, where all is known: ranks move with what they are of."""
    own, other = (ranks - ranks.mean() for ranks in (midranks(one), midranks(target)))
    spread = np.sqrt((own**2).sum() * (other**2).sum())
    return _ratio(other[numbers] @ own, np.full(len(numbers), spread), np.broadcast_to(one, numbers.shape))


def _known_in_both(first: ArrayLike, second: ArrayLike) -> tuple[Float64, Float64]:
    one, other = np.broadcast_arrays(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    unknown = np.isnan(one) | np.isnan(other)
    return np.where(unknown, math.nan, one), np.where(unknown, math.nan, other)


def _ratio(above: Float64, below: Float64, values: Float64) -> Float64:
    enough = ((~np.isnan(values)).sum(axis=-1) >= LEAST) & (below > 0)
    return np.where(enough, above / np.where(below > 0, below, 1.0), math.nan)
