"""The winner of a search against its start, in worlds that the search has never seen."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torchcover.coverage import Measure
from torchcover.placement.common_instants import CommonInstants
from torchcover.placement.racing import Paired, paired
from torchcover.simulation import Rig

WORLDS = 16
MEASURES: tuple[Measure, Measure] = ("area", "known")


@dataclass(frozen=True)
class FreshGain:
    """What the winner scores more than the start, of one objective by one measure.

    Args:
        gain: Mean over the fresh worlds of the difference, a share.
        error: Its standard error, paired over these worlds.
        t: Gain over error.
        p: Probability of a t at least as large to either side if there were no difference (Student).
        worlds: Worlds that know the objective.
        better: In how many of them the winner scores more.
        search_gain: The gain on the instants of the search, which chose the winner by it.
        optimism: How much more that was than the gain on fresh worlds.
    """

    gain: float
    error: float
    t: float
    p: float
    worlds: int
    better: int
    search_gain: float
    optimism: float


@dataclass(frozen=True)
class FreshTest:
    """Winner against start on fresh worlds.

    Args:
        search_seed: Seed of the worlds of the search.
        test_seed: Seed of the fresh ones.
        instants: How many fresh instants there were.
        gains: Name of the objective -> measure ("area", "known") -> gain.
    """

    search_seed: int
    test_seed: int
    instants: int
    gains: Mapping[str, Mapping[Measure, FreshGain]]


def fresh_test(winner: Rig, start: Rig, searched: CommonInstants, *, test_seed: int, worlds: int = WORLDS) -> FreshTest:
    """Score both rigs in worlds of another seed, instant by instant against the same reference.

    Args:
        winner: What the search has found.
        start: What it started from.
        searched: The instants of the search.
        test_seed: Seed of the fresh worlds; another one than that of the search, so that no world is in both.
        worlds: Fresh worlds of each scenario with traffic; a scenario without is the same world for any seed, and is
            left out.

    Raises:
        ValueError: The seed of the search; no scenario with traffic; a rig that cannot be mounted in a fresh world.
    """
    with searched.anew(test_seed, worlds) as fresh:
        by_test = fresh.score(winner), fresh.score(start)
    by_search = searched.score(winner), searched.score(start)
    pairs = {measure: (paired(*by_test, measure), paired(*by_search, measure)) for measure in MEASURES}
    return FreshTest(
        search_seed=searched.seed,
        test_seed=test_seed,
        instants=len(by_test[0].instants),
        gains={
            name: {measure: _gain(*pair, column) for measure, pair in pairs.items()}
            for column, name in enumerate(by_test[0].objectives)
        },
    )


def _gain(test: Paired, search: Paired, column: int) -> FreshGain:
    gain, error, worlds = float(test.gain[column]), float(test.error[column]), int(test.worlds[column])
    t = gain / error if error > 0 else math.nan
    return FreshGain(
        gain=gain,
        error=error,
        t=t,
        p=student_p(t, worlds - 1),
        worlds=worlds,
        better=int(test.better[column]),
        search_gain=float(search.gain[column]),
        optimism=float(search.gain[column]) - gain,
    )


def student_p(t: float, degrees_of_freedom: int) -> float:
    """Probability that Student's t lies farther from 0 than some value, to either side.

    The finite series of Abramowitz & Stegun 1964, equations 26.7.3 and 26.7.4.

    Args:
        t: The value; NaN gives NaN.
        degrees_of_freedom: 1 or more.

    Example:
        >>> round(student_p(2.131, 15), 3), round(student_p(1.0, 1), 3)
        (0.05, 0.5)
    """
    if math.isnan(t):
        return math.nan
    angle = math.atan(abs(t) / math.sqrt(degrees_of_freedom))
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees_of_freedom % 2
    term, total = (cosine, 0.0) if odd else (1.0, 0.0)
    for power in range(1 if odd else 0, degrees_of_freedom - 1, 2):
        total += term
        term *= cosine**2 * (power + 1) / (power + 2)
    within = 2 / math.pi * (angle + sine * total) if odd else sine * total
    return max(0.0, 1.0 - within)
