"""The winner of a search against its start, in worlds that the search has never seen, in numbers and words."""

import math
from collections.abc import Mapping
from contextlib import closing
from typing import Any, NamedTuple

from torchcover.estimation import Difference
from torchcover.placement.common_instants import CommonInstants
from torchcover.report.wording import difference_words, shown_unit
from torchcover.simulation import Rig


class FreshGain(NamedTuple):
    """What the winner has better than the start, of one objective by one estimate.

    Args:
        objective: Its name.
        estimate: What its number is a mean over: "area", "known", or "-" where there is no such choice.
        test: The difference on fresh worlds, paired.
        search_gain: The gain on the instants of the search, which chose the winner by it.
    """

    objective: str
    estimate: str
    test: Difference
    search_gain: float

    @property
    def words(self) -> str:
        """The gain on fresh worlds with its interval, without its unit: shares in percentage points."""
        test = self.test
        if test.quantity.lower_is_better:
            test = test._replace(value=-test.value, low=-test.high, high=-test.low)
        return difference_words(test)

    @property
    def optimism(self) -> float:
        """How much more the search had promised."""
        return self.search_gain - self.test.gain

    @property
    def t(self) -> float:
        """Gain over error; NaN if the error is unknown, or 0."""
        return self.test.gain / self.test.error if self.test.error > 0 else math.nan

    @property
    def record(self) -> dict[str, Any]:
        """All of it, for JSON."""
        test = self.test
        return {
            "unit": test.quantity.unit,
            "gain": test.gain,
            "error": test.error,
            "interval": sorted([test.quantity.gain(test.low), test.quantity.gain(test.high)]),
            "t": self.t,
            "p": test.p,
            "worlds": test.blocks,
            "better": test.better,
            "search_gain": self.search_gain,
            "optimism": self.optimism,
        }


def fresh_test(
    winners: Mapping[str, Rig], start: Rig, searched: CommonInstants, *, test_seed: int, worlds: int
) -> dict[str, tuple[FreshGain, ...]]:
    """Score rigs in worlds of another seed, instant by instant against the same reference.

    Args:
        winners: What the search has found, by name; all are tested in the same worlds.
        start: What it started from.
        searched: The instants of the search.
        test_seed: Seed of the fresh worlds; another one than that of the search, so that no world is in both.
        worlds: Fresh worlds of each scenario with traffic; a scenario without is the same world for any seed, and is
            left out.

    Returns:
        The gains by the names of the winners: in each objective by the estimate of the search, then by the other one
        where that is a choice.

    Raises:
        ValueError: The seed of the search; no scenario with traffic; a rig that cannot be mounted in a fresh world.
    """
    with closing(searched.anew(test_seed, worlds)) as fresh:
        start_by_test = fresh.estimates(start)
        by_test = {name: fresh.estimates(winner) for name, winner in winners.items()}
    start_by_search = searched.estimates(start)
    own = {objective: asked.own_estimate for objective, asked in searched.objectives.items()}
    tests = {}
    for name, winner in winners.items():
        by_search = searched.estimates(winner)
        tests[name] = tuple(
            FreshGain(objective, own[objective] or estimate, test, in_search[objective].gain)
            for estimate in sorted(start_by_search, key=lambda one: one != searched.estimate)
            for in_search in [by_search[estimate].differences(start_by_search[estimate])]
            for objective, test in by_test[name][estimate].differences(start_by_test[estimate]).items()
            if estimate == searched.estimate or not own[objective]
        )
    return tests


def amount(value: float, unit: str) -> str:
    """A gain without its unit: shares in percentage points.

    Example:
        >>> amount(0.01234, "share"), amount(0.01234, "m")
        ('+1.23', '+0.012')
    """
    return f"{shown_unit(unit).factor * value:+.{2 if unit == 'share' else 3}f}"


def unit_words(unit: str) -> str:
    """What stands behind it."""
    return "points" if unit == "share" else unit


def told(gain: FreshGain, *, optimism: bool = False) -> str:
    """A gain in words, which call it one only where it is told from chance: by Student's t at 95 %.

    Args:
        gain: It.
        optimism: Whether to say how much more the search had promised.

    Example:
        >>> from torchcover.coverage.quantity import detection
        >>> test = Difference(detection(0.4), 0.0132, 0.0024, 0.0081, 0.0183, significant=True, blocks=16, better=16)
        >>> told(FreshGain("near", "area", test, 0.0148), optimism=True)
        'gained +1.32  [+0.81, +1.83] points on 16 fresh worlds (t 5.5, better in 16), optimism +0.16'
        >>> small = test._replace(value=0.002, low=-0.0031, high=0.0071, significant=False)
        >>> told(FreshGain("near", "area", small, 0.0148))
        'no gain is shown: +0.20  [-0.31, +0.71] points on 16 fresh worlds (t 0.8, better in 16)'
    """
    test, unit = gain.test, gain.test.quantity.unit
    if math.isnan(test.value):
        return "unknown in the fresh worlds"
    t = "t unknown" if math.isnan(gain.t) else f"t {gain.t:.1f}"
    rest = f"{gain.words} {unit_words(unit)} on {test.blocks} fresh worlds ({t}, better in {test.better})"
    if optimism and not math.isnan(gain.optimism):
        rest += f", optimism {amount(gain.optimism, unit)}"
    if test.significant:
        return f"{'gained' if test.gain > 0 else 'lost'} {rest}"
    return f"no gain is shown: {rest}"


def finite(value: Any) -> Any:  # noqa: ANN401  (whatever a record holds)
    """A record as JSON can have it: what is unknown is None."""
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
