"""How alike two orders of the same rigs are, and whether that is more than chance."""

import math
from collections.abc import Callable
from itertools import permutations
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array: TypeAlias = NDArray[np.float64]
# Of two (..., n) series: how alike they are, (...).
Statistic: TypeAlias = Callable[[ArrayLike, ArrayLike], Array]

# Two things have two orders, and are alike or opposite by chance.
LEAST = 3
# All orders of 8 things are tried; of more, as many are drawn.
MOST_TRIED = math.factorial(8)


def midranks(values: ArrayLike) -> Array:
    """Ranks from 1, the smallest, on; equal values share the mean of theirs, and what is unknown has none.

    Args:
        values: (..., n), NaN where unknown.

    Returns:
        (..., n) ranks, NaN where the value is.

    Example:
        >>> midranks([3.0, float("nan"), 1.0, 3.0]).tolist()
        [2.5, nan, 1.0, 2.5]
    """
    own = np.asarray(values, dtype=np.float64)
    smaller = (own[..., None, :] < own[..., :, None]).sum(axis=-1)
    equal = (own[..., None, :] == own[..., :, None]).sum(axis=-1)
    return np.where(np.isnan(own), math.nan, smaller + (equal + 1) / 2)


def kendall_tau_b(first: ArrayLike, second: ArrayLike) -> Array:
    """Kendall's tau-b: 1 for the same order, -1 for the opposite one; ties count for neither.

        tau_b = (C - D) / sqrt((P - T_1) (P - T_2))

    with C concordant, D discordant and P all pairs, T_i of them equal in the i-th (Kendall 1945, Biometrika 33, 239).

    Args:
        first: (..., n), NaN where unknown: what is unknown in one of the two is in no pair.
        second: (..., n), likewise; the two broadcast.

    Returns:
        (...); NaN for fewer than three that are known, or if all of one are equal.

    Example:
        >>> float(kendall_tau_b([1, 2, 3, 4], [1, 2, 4, 3]))
        0.666...
    """
    one, other = _known_in_both(first, second)
    signs = [_signs(each[..., :, None], each[..., None, :]) for each in (one, other)]
    agreement = (signs[0] * signs[1]).sum(axis=(-2, -1))
    apart = [np.abs(sign).sum(axis=(-2, -1)) for sign in signs]
    return _ratio(agreement, np.sqrt(apart[0] * apart[1]), one)


def spearman(first: ArrayLike, second: ArrayLike) -> Array:
    """Spearman's rank correlation: Pearson's of the midranks, so that ties are right.

    Args:
        first: As in `kendall_tau_b`.
        second: Likewise.

    Returns:
        (...); NaN for fewer than three that are known, or if all of one are equal.

    Example:
        >>> float(spearman([1, 2, 3, 4], [10, 20, 40, 30]))
        0.8
    """
    one, other = (midranks(values) for values in _known_in_both(first, second))
    count = np.maximum((~np.isnan(one)).sum(axis=-1, keepdims=True), 1)
    one, other = (np.nan_to_num(ranks - np.nansum(ranks, axis=-1, keepdims=True) / count) for ranks in (one, other))
    spread = np.sqrt((one**2).sum(axis=-1) * (other**2).sum(axis=-1))
    return _ratio((one * other).sum(axis=-1), spread, _known_in_both(first, second)[0])


def orders(count: int, seed: int = 0) -> NDArray[np.int64]:
    """(P, n) orders of n things: all of them up to n = 8, else as many as 8 have, drawn.

    Args:
        count: n.
        seed: Of the draw.
    """
    if math.factorial(count) <= MOST_TRIED:
        return np.array(list(permutations(range(count))), dtype=np.int64)
    generator = np.random.default_rng(seed)
    return generator.permuted(np.tile(np.arange(count), (MOST_TRIED, 1)), axis=1)


def permutation_p(first: ArrayLike, second: ArrayLike, statistic: Statistic = spearman, seed: int = 0) -> float:
    """Probability that chance gives so strong a relation, of either sign: two-sided.

    With several first series it is that of the best of them: of k metrics that were looked at, one is always good.

    Args:
        first: (n,) or (k, n), NaN where unknown.
        second: (n,) what their orders are held against.
        statistic: `spearman` or `kendall_tau_b`.
        seed: Of the orders that are drawn where they are too many to try.

    Returns:
        The share of orders of the second with as strong a relation; NaN if no relation is known.

    Example:
        >>> permutation_p([1, 2, 3, 4], [1, 2, 3, 4])           # 2 of 24 orders
        0.0833...
    """
    series, target = np.atleast_2d(np.asarray(first, dtype=np.float64)), np.asarray(second, dtype=np.float64)
    found = np.abs([statistic(one, target) for one in series])
    if np.isnan(found).all():
        return math.nan
    best = strongest_by_chance(series, target, statistic, seed)
    as_strong = int((best >= np.nanmax(found) - 1e-12).sum())
    drawn = math.factorial(target.size) > MOST_TRIED  # then the order that was found is one more
    return (as_strong + drawn) / (len(best) + drawn)


def strongest_by_chance(first: ArrayLike, second: ArrayLike, statistic: Statistic = spearman, seed: int = 0) -> Array:
    """The strongest relation of several series, of either sign, to each of many orders of the second.

    Args:
        first: (n,) or (k, n), NaN where unknown.
        second: (n,) what is put in other orders.
        statistic: As in `permutation_p`.
        seed: Likewise.

    Returns:
        (P,) from 0 to 1: what the best of k metrics that mean nothing reaches.

    Example:
        >>> float(strongest_by_chance([1, 2, 3], [1, 2, 3]).mean())             # of six orders two have 1, four 0.5
        0.666...
    """
    target, numbers = np.asarray(second, dtype=np.float64), orders(np.size(second), seed)
    best = np.zeros(len(numbers))
    for one in np.atleast_2d(np.asarray(first, dtype=np.float64)):
        if statistic is spearman and not np.isnan(one + target).any():
            found = _spearman_of_orders(one, target, numbers)
        else:
            found = statistic(one, target[numbers])
        best = np.fmax(best, np.abs(found))
    return best


def _spearman_of_orders(one: Array, target: Array, numbers: NDArray[np.int64]) -> Array:
    """(P,) what `spearman` gives for each order of the second, where all is known: ranks move with what they are of."""
    own, other = (ranks - ranks.mean() for ranks in (midranks(one), midranks(target)))
    spread = np.sqrt((own**2).sum() * (other**2).sum())
    return _ratio(other[numbers] @ own, np.full(len(numbers), spread), np.broadcast_to(one, numbers.shape))


def _signs(one: Array, other: Array) -> Array:
    # No difference: of two that are infinite there is none, and what is unknown is neither more nor less.
    return (one > other).astype(np.float64) - (one < other)


def _known_in_both(first: ArrayLike, second: ArrayLike) -> tuple[Array, Array]:
    one, other = np.broadcast_arrays(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    unknown = np.isnan(one) | np.isnan(other)
    return np.where(unknown, math.nan, one), np.where(unknown, math.nan, other)


def _ratio(above: Array, below: Array, values: Array) -> Array:
    enough = ((~np.isnan(values)).sum(axis=-1) >= LEAST) & (below > 0)
    return np.where(enough, above / np.where(below > 0, below, 1.0), math.nan)
