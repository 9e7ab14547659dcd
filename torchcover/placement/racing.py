"""Racing: rigs are scored on a few instants at a time, and those that are clearly worse are given up."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage import Measure
from torchcover.placement.scores import Scores

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]
Candidate = TypeVar("Candidate")

TOGETHER = 3
ERRORS_BELOW = 2.0
# Differences in fewer worlds than this say nothing about their error.
MIN_WORLDS = 3


@dataclass(frozen=True, eq=False)
class Paired:
    """What one rig scores more than another at the same instants, for each objective.

    Args:
        gain: (O,) mean over the worlds that know the objective of the difference there; NaN if none does.
        error: (O,) its standard error, from the spread over these worlds; NaN for fewer than 3.
        worlds: (O,) int64 how many these are.
        better: (O,) int64 in how many of them it scores more.
    """

    gain: Float64
    error: Float64
    worlds: Numbers
    better: Numbers


def paired(scores: Scores, other: Scores, measure: Measure = "area") -> Paired:
    """Compare two rigs.

    Args:
        scores: Of the one.
        other: Of the other, at the same instants and perhaps more.
        measure: Which share of the reference points counts, see `Scores.by_world`.

    Raises:
        ValueError: The other was not scored at all of these instants.
    """
    difference = scores.by_world(measure) - other.at(scores.instants).by_world(measure)
    known = ~np.isnan(difference)
    worlds = known.sum(axis=0)
    each = np.where(known, difference, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = each.sum(axis=0) / worlds
        spread = np.where(known, difference - gain, 0.0)
        error = np.sqrt((spread**2).sum(axis=0) / (worlds - 1) / worlds)
    return Paired(gain, np.where(worlds >= MIN_WORLDS, error, np.nan), worlds, (each > 0).sum(axis=0))


def racing_order(world_of: Sequence[int] | Numbers, seed: int) -> Numbers:
    """All instants in an order drawn at random, round by round of one instant of each world.

    Args:
        world_of: World of each instant.
        seed: Decides it.

    Returns:
        (n,) numbers of the instants.

    Example:
        >>> worlds = np.array([0, 0, 1, 1, 2, 2])
        >>> order = racing_order(worlds, seed=0)
        >>> sorted(order.tolist()), sorted(worlds[order[:3]].tolist())
        ([0, 1, 2, 3, 4, 5], [0, 1, 2])
    """
    generator = np.random.default_rng(seed)
    shuffled = generator.permutation(len(world_of))
    worlds = np.asarray(world_of)[shuffled]
    # How many instants of its world come before each.
    rounds = np.array([np.count_nonzero(worlds[:k] == world) for k, world in enumerate(worlds)], dtype=np.int64)
    order: Numbers = shuffled[np.argsort(rounds, kind="stable")]
    return order


@dataclass(frozen=True, eq=False)
class Raced:
    """What became of a rig in a race.

    Args:
        scores: At the instants that it was given.
        dropped: Whether it was given up before the last one.
    """

    scores: Scores
    dropped: bool


def race(
    score: Callable[[Candidate, Numbers], Scores],
    candidates: Sequence[Candidate],
    order: Sequence[int] | Numbers,
    *,
    incumbents: Sequence[Scores] = (),
    measure: Measure = "area",
    together: int = TOGETHER,
) -> list[Raced]:
    """Score rigs on a few more instants at a time; give up each that is clearly below another one.

    That is two standard errors of their paired difference below it, over worlds, in every objective: below one of the
    incumbents, or another candidate that is still in the race.

    Args:
        score: `CommonInstants.score`, or what asks it.
        candidates: One or several.
        order: Of the instants, as from `racing_order`.
        incumbents: Scores of the best so far, at all of these instants; of several objectives there may be several.
        measure: As in `paired`.
        together: Instants that are added at a time.

    Returns:
        What became of each candidate.

    Raises:
        ValueError: What `score` raises, of a rig that cannot be mounted; no instant; fewer than one at a time.
    """
    instants = np.asarray(order, dtype=np.int64)
    if len(instants) == 0 or together < 1:
        raise ValueError(f"order, together: an instant, and one at a time, are needed; got {len(instants)}, {together}")
    scores: dict[int, Scores] = {}
    racing = list(range(len(candidates)))
    for start in range(0, len(instants), together):
        batch = instants[start : start + together]
        for number in racing:
            added = score(candidates[number], batch)
            scores[number] = scores[number].joined(added) if start else added
        if start + together < len(instants):
            racing = _left(racing, scores, incumbents, measure)
    return [Raced(scores[number], number not in racing) for number in range(len(candidates))]


def _left(
    racing: Sequence[int], scores: dict[int, Scores], incumbents: Sequence[Scores], measure: Measure
) -> list[int]:
    def is_below(number: int) -> bool:
        others = [*incumbents, *(scores[other] for other in racing if other != number)]
        differences = (paired(scores[number], other, measure) for other in others)
        return any(bool((one.gain < -ERRORS_BELOW * one.error).all()) for one in differences)

    return [number for number in racing if not is_below(number)]
