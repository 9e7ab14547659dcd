"""Whether metrics rank sensor placements as detectors do, and how much that can mean."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from torchcover.contrib.ranks import (
    DRAWS,
    Ranking,
    check_best_correlation,
    interval95,
    kendall_tau_b,
    spearman,
)
from torchcover.files import read_csv, reads
from torchcover.geometry.arrays import Float64, Int64

# What the best of several metrics that mean nothing exceeds in one of twenty orders.
BY_CHANCE = 0.95
# Of a table of published results.
COLUMNS = ("placement", "quantity", "model", "class")


@dataclass(frozen=True, eq=False)
class Judged:
    """What several judges, detectors or trainings of one, say of the same placements.

    Args:
        name: What they say: "car mAP".
        placements: Names of the n placements.
        judges: Names of the J judges.
        values: (J, n) what each says of each; more is better.

    Raises:
        ValueError: Values of another shape, or that are not finite.

    Example:
        >>> judged = Judged("AP", ("a", "b", "c"), ("net", "other"), np.array([[1.0, 2.0, 3.0], [2.0, 1.0, 3.0]]))
        >>> judged.mean.tolist(), judged.ceiling
        ([1.5, 1.5, 3.0], 0.5)
    """

    name: str
    placements: tuple[str, ...]
    judges: tuple[str, ...]
    values: Float64

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.judges), len(self.placements)) or not np.isfinite(self.values).all():
            raise ValueError(
                f"{self.name}: a finite number of each of {len(self.judges)} judges for each of "
                f"{len(self.placements)} placements is needed; got {self.values.shape}"
            )

    @property
    def mean(self) -> Float64:
        """(n,) mean over the judges."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def ceiling(self) -> float:
        """Mean Spearman correlation of each two judges: what they agree on; NaN for a single one.

        A metric cannot be expected to follow them more closely than they follow each other.
        """
        pairs = [spearman(self.values[a], self.values[b]) for a, b in combinations(range(len(self.judges)), 2)]
        return float(np.mean(pairs)) if pairs else float("nan")

    def of(self, placements: Sequence[str]) -> Self:
        """Of some of the placements, in another order.

        Raises:
            ValueError: One that they say nothing of.
        """
        if missing := [name for name in placements if name not in self.placements]:
            raise ValueError(f"{self.name}: nothing is known of {', '.join(missing)}")
        columns = [self.placements.index(name) for name in placements]
        return type(self)(self.name, tuple(placements), self.judges, self.values[:, columns])


@reads("a table of published results")
def read_results(path: Path) -> Mapping[tuple[str, str], Judged]:
    """The results of a table in CSV with the columns placement, quantity, model, class and value.

    Raises:
        BadFileError: Not such a table, a number that is there twice or missing.
    """
    table = read_csv(path, numbers=("value",), words=COLUMNS)
    found: dict[tuple[str, str], dict[tuple[str, str], float]] = {}
    words = zip(*(table.words[column] for column in COLUMNS), strict=True)
    for (placement, quantity, model, category), value in zip(words, table.numbers["value"].tolist(), strict=True):
        of_kind = found.setdefault((quantity, category), {})
        if (model, placement) in of_kind:
            raise ValueError(f"{quantity} {category} of {model or 'no model'} on {placement} is there twice")
        of_kind[model, placement] = value
    return {key: _judged(" ".join(key).strip(), values) for key, values in found.items()}


def _judged(name: str, values: Mapping[tuple[str, str], float]) -> Judged:
    judges, placements = (tuple(dict.fromkeys(words)) for words in zip(*values, strict=True))
    missing = [f"{judge} on {place}" for judge in judges for place in placements if (judge, place) not in values]
    if missing:
        raise ValueError(f"{name}: no value of {', '.join(missing)}")
    array = np.array([[values[judge, place] for place in placements] for judge in judges])
    return Judged(name, placements, judges, array)


class Relation(NamedTuple):
    """A rank correlation and its 95 % interval; NaN where one of the two series does not vary."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: float, drawn: Float64) -> Self:
        """Of a number, and what it is in draws."""
        return cls(value, *interval95(value, drawn))

    @property
    def words(self) -> str:
        """Both.

        Example:
            >>> Relation(0.857, 0.5, 0.95).words
            '+0.86 [+0.50, +0.95]'
        """
        return "-" if math.isnan(self.value) else f"{self.value:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


@dataclass(frozen=True)
class Ranked:
    """How one metric ranks the placements.

    Args:
        metric: Its name.
        spearman: Spearman's rank correlation with the mean of the judges.
        kendall: Kendall's tau-b with it.
        p: Probability of a Spearman correlation as strong, of either sign, by chance; of this metric alone.
        over_worlds: Whether the intervals are over worlds too, or over judges only.
    """

    metric: str
    spearman: Relation
    kendall: Relation
    p: float
    over_worlds: bool


@dataclass(frozen=True)
class Agreement:
    """How metrics rank placements, compared with what judges say of them.

    Args:
        judged: What the judges say.
        ranked: A row for each metric.
        best: The metric with the strongest Spearman correlation, of either sign; None if none has one.
        best_p: Probability that the best of so many metrics that mean nothing is as strong.
        by_chance: What the best of them exceeds in one of twenty orders.
    """

    judged: Judged
    ranked: tuple[Ranked, ...]
    best: str | None
    best_p: float
    by_chance: float

    @property
    def looked_at(self) -> int:
        """How many metrics have a rank correlation."""
        return sum(not math.isnan(row.spearman.value) for row in self.ranked)


def agreement_of(
    rankings: Sequence[Ranking], judged: Judged, *, draws: int = DRAWS, placements: bool = False
) -> Agreement:
    """Rank placements by metrics, and compare with the mean of the judges.

    The intervals are those of a bootstrap: judges are drawn anew, and with them the worlds of the metrics that have
    `draws`. The placements are the same in each draw, unless they too are a sample.

    Args:
        rankings: What the metrics say of the placements of `judged`, in its order.
        judged: What the judges say.
        draws: How often; at most as many as the rankings have.
        placements: Whether to draw placements, too.

    Raises:
        ValueError: A metric of another number of placements, or with fewer draws.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = Judged("AP", tuple("abcd"), ("net", "other"), np.array([[1.0, 2, 3, 4], [1, 2, 4, 3]]))
        >>> height = Ranking.of_values(Quantity("height", "mean height", "m", lower_is_better=False), [1.0, 2, 3, 3])
        >>> found = agreement_of([height], judged, draws=100)
        >>> round(found.ranked[0].spearman.value, 3), found.best, found.looked_at
        (1.0, 'height', 1)
    """
    count = len(judged.placements)
    for one in rankings:
        if len(one.numbers) != count or (one.draws is not None and one.draws[:draws].shape != (draws, count)):
            raise ValueError(f"{one.name}: a value of each of {count} placements is needed, and {draws} draws or none")
    truths, columns = _drawn(judged, draws, placements=placements)
    ranked = tuple(_ranked(one, judged.mean, truths, columns) for one in rankings)
    strength = np.array([abs(row.spearman.value) for row in ranked])
    if np.isnan(strength).all():
        return Agreement(judged, ranked, None, math.nan, math.nan)
    best = check_best_correlation(np.stack([one.gains for one in rankings]), judged.mean)
    return Agreement(
        judged=judged,
        ranked=ranked,
        best=rankings[int(np.nanargmax(strength))].name,
        best_p=best.p,
        by_chance=float(np.quantile(best.by_chance, BY_CHANCE)),
    )


def lead(one: Ranking, other: Ranking, judged: Judged, *, draws: int = DRAWS, placements: bool = False) -> Relation:
    """By how much Spearman's correlation of a metric is above that of another one, with its interval.

    Both are held against the same draws, so that what they share cancels out.

    Args:
        one: The metric.
        other: What it is to beat.
        judged: As in `agreement_of`, and so are all that follow.
        draws: How often.
        placements: Whether to draw placements, too.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = Judged("AP", tuple("abcd"), ("net",), np.array([[1.0, 2, 3, 4]]))
        >>> height = Quantity("height", "mean height", "m", lower_is_better=False)
        >>> good, bad = (Ranking.of_values(height, values) for values in ([1.0, 2, 3, 4], [4.0, 3, 2, 1]))
        >>> lead(good, bad, judged)
        Relation(value=2.0, low=2.0, high=2.0)
    """
    truths, columns = _drawn(judged, draws, placements=placements)
    found = [spearman(each.gains, judged.mean) for each in (one, other)]
    drawn = [spearman(*_along(each, truths, columns)) for each in (one, other)]
    return Relation.of(float(found[0] - found[1]), drawn[0] - drawn[1])


def _drawn(judged: Judged, draws: int, *, placements: bool) -> tuple[Float64, Int64]:
    """(R, n) the mean of judges that are drawn anew, and which placements are drawn."""
    generator, count = np.random.default_rng(0), len(judged.placements)
    chosen = generator.integers(len(judged.judges), size=(draws, len(judged.judges)))
    columns = generator.integers(count, size=(draws, count)) if placements else np.tile(np.arange(count), (draws, 1))
    return judged.values[chosen].mean(axis=1), columns


def _along(one: Ranking, truths: Float64, columns: Int64) -> tuple[Float64, Float64]:
    """(R, n) what a metric and the judges say in each draw."""
    drawn = np.broadcast_to(one.gains, truths.shape) if one.drawn_gains is None else one.drawn_gains[: len(truths)]
    return np.take_along_axis(drawn, columns, axis=1), np.take_along_axis(truths, columns, axis=1)


def _ranked(one: Ranking, truth: Float64, truths: Float64, columns: Int64) -> Ranked:
    drawn = _along(one, truths, columns)
    rho, tau = (
        Relation.of(float(statistic(one.gains, truth)), statistic(*drawn)) for statistic in (spearman, kendall_tau_b)
    )
    return Ranked(one.name, rho, tau, check_best_correlation(one.gains, truth).p, one.draws is not None)
