"""Metrics side by side: which rig each thinks best, and how alike their orders are."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from torchcover.published.number import PublishedNumber
from torchcover.published.ranks import LEAST, Array, kendall_tau_b, midranks
from torchcover.published.s_mig import unequal_rays

# The metric that numbers of torchcover itself are of.
OWN = "torchcover"
INTERVAL = (0.025, 0.975)
NOT_VALIDATED = "None of these metrics is validated; docs/metrics.md says what each is blind to."
TOO_FEW = "Kendall's tau needs three rigs or more: two are in one order or in the other by chance; there are {}"


class Series(NamedTuple):
    """One number of every rig.

    Args:
        metric: The metric that it is of; `OWN` for a number of torchcover's table.
        numbers: One for each rig; None of a rig that the metric could not be made for.
        draws: (R, rigs) the numbers over worlds that were drawn again; None if they are unknown.
    """

    metric: str
    numbers: tuple[PublishedNumber | None, ...]
    draws: Array | None = None

    @property
    def any_number(self) -> PublishedNumber:
        """That of the first rig that has one."""
        return next(number for number in self.numbers if number is not None)

    @property
    def name(self) -> str:
        """Its name."""
        return self.any_number.name

    @property
    def sign(self) -> int:
        """1 where more is better, else -1."""
        return 1 if self.any_number.higher_is_better else -1

    @property
    def values(self) -> Array:
        """(rigs,) its values; NaN where unknown."""
        return np.array([math.nan if number is None else number.value for number in self.numbers])

    @property
    def ranks(self) -> Array:
        """(rigs,) 1 for the best; equal ones share the mean of theirs, NaN where unknown."""
        return midranks(-self.sign * self.values)


class Tau(NamedTuple):
    """How alike two numbers order the rigs: tau-b of what each holds for better, and its 95 % interval over worlds.

    The interval is NaN where one of the two does not say what it would be over other worlds.
    """

    first: str
    second: str
    tau: float
    low: float
    high: float
    rigs: int


@dataclass(frozen=True, eq=False)
class MetricComparison:
    """What metrics of others say of the rigs of a run, compared with torchcover's own numbers.

    Args:
        rigs: Their names.
        series: The metrics' numbers.
        own: torchcover's numbers of regions that they are held against.
        left_out: Name of a metric that could not be made -> why.
    """

    rigs: tuple[str, ...]
    series: Sequence[Series]
    own: Sequence[Series] = ()
    left_out: Mapping[str, str] | None = None

    @property
    def main(self) -> list[Series]:
        """The numbers that are about everything, and not about a category or a region only."""
        return [one for one in self.series if not one.any_number.is_part]

    def taus(self) -> list[Tau]:
        """Of all pairs of the main numbers and torchcover's own; none for fewer than three rigs."""
        if len(self.rigs) < LEAST:
            return []
        return [tau_of(first, second) for first, second in combinations([*self.main, *self.own], 2)]

    def rows(self) -> Iterator[dict[str, Any]]:
        """A row for each rig and number, those of parts too; NaN where unknown."""
        for one in (*self.series, *self.own):
            for rig, number, rank in zip(self.rigs, one.numbers, one.ranks.tolist(), strict=True):
                if number is not None:
                    yield {"rig": rig, "metric": one.metric, **number._asdict(), "rank": rank}

    @property
    def notes(self) -> list[str]:
        """What a reader is to know."""
        few = [] if len(self.rigs) >= LEAST else [f"{TOO_FEW.format(len(self.rigs))}."]
        warned: dict[str, dict[str, None]] = {}  # what to say of which metrics
        for one in self.series:
            for number in one.numbers:
                if number is not None and number.warning:
                    warned.setdefault(number.warning, {})[one.metric] = None
        warnings = [f"{', '.join(metrics)}: {warning}" for warning, metrics in warned.items()]
        rays = [note for one in self.main if one.metric.startswith("s_mig") and (note := self._unequal_rays(one))]
        missing = [f"Without {name}: {why}" for name, why in (self.left_out or {}).items()]
        return [NOT_VALIDATED, *few, *warnings, *rays, *missing]

    def _unequal_rays(self, one: Series) -> str | None:
        known = {rig: number for rig, number in zip(self.rigs, one.numbers, strict=True) if number is not None}
        return unequal_rays(known)


def tau_of(first: Series, second: Series) -> Tau:
    """Kendall's tau-b of two numbers, each turned so that more is better, and its interval over drawn worlds."""
    value = float(kendall_tau_b(first.sign * first.values, second.sign * second.values))
    known = int((~np.isnan(first.values + second.values)).sum())
    low = high = math.nan
    if first.draws is not None and second.draws is not None:
        drawn = kendall_tau_b(first.sign * first.draws, second.sign * second.draws)
        if not np.isnan(value) and not np.isnan(drawn).all():
            low, high = (float(end) for end in np.nanquantile(drawn, INTERVAL))
    return Tau(first.name, second.name, value, low, high, known)
