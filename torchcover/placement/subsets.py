"""Which and how many: the best subset of candidates whose bits are known.

What a subset is worth is monotone and submodular: another sensor never harms, and adds the less the more there are. So
the greedy choice of k is worth at least 1 - 1/e of the best (Nemhauser, Wolsey and Fisher 1978); with prices the better
of two greedy choices at least half of that (Leskovec et al. 2007); neither holds where some may not stand side by side.
What is added at most also bounds the best from above, whatever was chosen, and lets a search leave out the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Sets whose value is looked up before the exact search gives up; deterministic, other than a time.
MOST_LOOKS = 50_000
# Values of sums of many thousand weights that agree to this are equal.
SAME = 1e-12
LOW_HALF = np.uint8(15)
# Row k has the bits of k, the highest first, as `numpy.packbits` has them.
BITS_OF_HALF = np.unpackbits(np.arange(16, dtype=np.uint8)[:, None], axis=1)[:, 4:].astype(np.float64)


class Worth:
    """Sums of what points are worth, from their bits.

    An objective that is a detection is a sum of weights over the points that the rig sees, by either measure, since it
    has the same denominators for every rig: so it is monotone and submodular in the set of its sensors.

    Args:
        of_bits: (8 B,) float64 weight of each bit; of padding 0.

    Example:
        >>> worth = Worth(np.array([0.5, 0.25, 0.125, 0, 0, 0, 0, 0]))
        >>> worth.of(np.array([0b1010_0000], dtype=np.uint8)), worth.total
        (0.625, 0.875)
    """

    def __init__(self, of_bits: Float64) -> None:
        self.total = float(of_bits.sum())
        halves = of_bits.reshape(-1, 2, 4) @ BITS_OF_HALF.T
        self._high, self._low = halves[:, 0].copy(), halves[:, 1].copy()
        self._at = np.arange(len(halves))

    def of(self, seen: Bytes) -> float:
        """The sum over the points that are seen, (B,) uint8, eight points a byte."""
        return float(self._high[self._at, seen >> 4].sum() + self._low[self._at, seen & LOW_HALF].sum())


@dataclass(frozen=True)
class Limits:
    """What a subset must keep to.

    Args:
        most: The most candidates in it.
        prices: Of each candidate.
        most_to_pay: In all.
        apart: (C, C) bool whether two candidates may both be there; all may if not given.
    """

    most: int
    prices: Sequence[float] = ()
    most_to_pay: float = np.inf
    apart: NDArray[np.bool_] | None = None

    def price(self, chosen: Sequence[int]) -> float:
        """What a subset costs."""
        return float(sum(self.prices[one] for one in chosen)) if self.prices else 0.0

    def allow(self, chosen: Sequence[int], other: int) -> bool:
        """Whether another candidate may be added to a subset."""
        if len(chosen) >= self.most or other in chosen:
            return False
        if self.apart is not None and not all(self.apart[other, one] for one in chosen):
            return False
        return self.price([*chosen, other]) <= self.most_to_pay + SAME


class Subset(NamedTuple):
    """A choice of candidates.

    Args:
        chosen: Their numbers, in the order in which they were chosen.
        value: What they are worth together with what is always there.
        upper_bound: No subset that keeps to the limits is worth more.
        proven: Whether this is the best of all.
    """

    chosen: tuple[int, ...]
    value: float
    upper_bound: float
    proven: bool


@dataclass
class Candidates:
    """Candidates by what they see.

    Args:
        worth: What points are worth.
        seen: One (B,) array of bits for each.
        always: Bits of what is always there.
    """

    worth: Worth
    seen: Sequence[Bytes]
    always: Bytes
    looks: int = field(default=0, init=False)

    def value(self, chosen: Sequence[int]) -> float:
        """What a subset is worth, with what is always there."""
        return self.worth.of(self.covered(chosen))

    def covered(self, chosen: Sequence[int]) -> Bytes:
        """What a subset sees, with what is always there."""
        return reduce(np.bitwise_or, (self.seen[one] for one in chosen), self.always)

    def gain(self, covered: Bytes, other: int) -> float:
        """What another candidate adds."""
        self.looks += 1
        return self.worth.of(self.seen[other] & ~covered)


def greedy(candidates: Candidates, limits: Limits) -> Subset:
    """Add what adds the most, as long as something may be added; with prices, for its price, if that is better.

    Args:
        candidates: What there is.
        limits: What to keep to.
    """
    ways = [_greedily(candidates, limits, by_price=False)]
    if limits.prices and np.isfinite(limits.most_to_pay):
        ways.append(_greedily(candidates, limits, by_price=True))
    chosen, value, _ = max(ways, key=lambda way: way[1])
    upper = min(bound for _, _, bound in ways)
    return Subset(chosen, value, upper, proven=upper <= value + SAME)


def _greedily(candidates: Candidates, limits: Limits, *, by_price: bool) -> tuple[tuple[int, ...], float, float]:
    """The choice, its value, and the lowest of the bounds that its steps give."""
    chosen: list[int] = []
    covered, everyone = candidates.always, range(len(candidates.seen))
    value, upper = candidates.worth.of(covered), np.inf
    while True:
        gains = {one: candidates.gain(covered, one) for one in everyone if one not in chosen}
        upper = min(upper, value + _most_to_add(gains, limits, limits.most, limits.most_to_pay))
        allowed = {one: gain for one, gain in gains.items() if gain > 0 and limits.allow(chosen, one)}
        if not allowed:
            return tuple(chosen), value, upper
        per = {one: gain / max(limits.prices[one], SAME) if by_price else gain for one, gain in allowed.items()}
        best = max(per, key=lambda one: (per[one], -one))
        chosen.append(best)
        covered = covered | candidates.seen[best]
        value += gains[best]


def exact(candidates: Candidates, limits: Limits) -> Subset:
    """The best subset, by branch and bound from the greedy choice on; or what was found after `MOST_LOOKS`.

    Args:
        candidates: What there is.
        limits: What to keep to.
    """
    best = greedy(candidates, limits)
    first = {one: candidates.gain(candidates.always, one) for one in range(len(candidates.seen))}
    order = sorted(first, key=lambda one: (-first[one], one))
    last = candidates.looks + MOST_LOOKS

    def search(chosen: tuple[int, ...], covered: Bytes, value: float, later: Sequence[int]) -> bool:
        """Look at all subsets of some candidates that may be added; whether none was left out for want of looks."""
        nonlocal best
        if candidates.looks >= last:
            return False
        gains = {one: candidates.gain(covered, one) for one in later if limits.allow(chosen, one)}
        complete = True
        for at, one in enumerate(ranked := sorted(gains, key=lambda each: (-gains[each], each))):
            left = {each: gains[each] for each in ranked[at:]}
            to_pay = limits.most_to_pay - limits.price(chosen)
            if value + _most_to_add(left, limits, limits.most - len(chosen), to_pay) <= best.value + SAME:
                break
            grown = (*chosen, one)
            if value + gains[one] > best.value + SAME:
                best = best._replace(chosen=grown, value=value + gains[one])
            if len(grown) < limits.most and at + 1 < len(ranked):
                complete &= search(grown, covered | candidates.seen[one], value + gains[one], ranked[at + 1 :])
        return complete

    proven = search((), candidates.always, candidates.worth.of(candidates.always), order)
    value = candidates.value(best.chosen)
    return best._replace(value=value, upper_bound=value if proven else best.upper_bound, proven=proven)


def _most_to_add(gains: dict[int, float], limits: Limits, count: int, to_pay: float) -> float:
    """What the best of some candidates add at most: as if they saw nothing in common, and one could be cut in two."""
    ranked = sorted(gains, key=lambda one: -gains[one])
    most = float(sum(gains[one] for one in ranked[:count]))
    if not limits.prices or not np.isfinite(to_pay):
        return most
    added = 0.0
    for one in sorted(gains, key=lambda one: -gains[one] / max(limits.prices[one], SAME)):
        price = limits.prices[one]
        share = min(max(to_pay, 0.0) / price, 1.0) if price > 0 else 1.0
        added += share * gains[one]
        to_pay -= share * price
    return min(most, added)


def marginal_values(candidates: Candidates, chosen: Sequence[int]) -> list[float]:
    """What is lost when each of the chosen fails."""
    whole = candidates.value(chosen)
    return [whole - candidates.value([other for other in chosen if other != one]) for one in chosen]


def random_subsets(candidates: Candidates, limits: Limits, count: int, seed: int) -> list[Subset]:
    """Subsets that are drawn: candidates in a random order, each added if it may be.

    Args:
        candidates: What there is.
        limits: What to keep to.
        count: How many subsets.
        seed: Seed of the orders.
    """
    generator, found = np.random.default_rng(seed), []
    for _ in range(count):
        chosen: list[int] = []
        for one in generator.permutation(len(candidates.seen)).tolist():
            if limits.allow(chosen, one):
                chosen.append(one)
        found.append(Subset(tuple(chosen), candidates.value(chosen), np.inf, proven=False))
    return found
