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
    compute_bootstrap_interval95,
    compute_kendall_tau_b,
    compute_spearman,
)
from torchcover.files import guard_reader, read_csv
from torchcover.geometry.arrays import Float64, Int64

# What the best of several metrics that mean nothing exceeds in one of twenty orders.
BY_CHANCE = 0.95
# Of a table of published results.
COLUMNS = ("placement", "quantity", "model", "class")


@dataclass(frozen=True, eq=False)
class PlacementRatings:
    """What several judges, detectors or trainings of one, say of the same placements.

    Args:
        name: What they say: "car mAP".
        placements: Names of the n placements.
        raters: Names of the J judges.
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
    raters: tuple[str, ...]
    values: Float64

    def __post_init__(self) -> None:
        if self.values.shape != (len(self.raters), len(self.placements)) or not np.isfinite(self.values).all():
            raise ValueError(
                f"{self.name}: a finite number of each of {len(self.raters)} judges for each of "
                f"{len(self.placements)} placements is needed; got {self.values.shape}"
            )

    @property
    def mean(self) -> Float64:
        """(n,) mean over the judges."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def inter_rater_correlation(self) -> float:
        """Mean Spearman correlation of each two judges: what they agree on; NaN for a single one.

        A metric cannot be expected to follow them more closely than they follow each other.
        """
        pairs = [compute_spearman(self.values[a], self.values[b]) for a, b in combinations(range(len(self.raters)), 2)]
        return float(np.mean(pairs)) if pairs else float("nan")

    def select(self, placements: Sequence[str]) -> Self:
        """Of some of the placements, in another order.

        Raises:
            ValueError: One that they say nothing of.
        """
        if missing := [name for name in placements if name not in self.placements]:
            raise ValueError(f"{self.name}: nothing is known of {', '.join(missing)}")
        columns = [self.placements.index(name) for name in placements]
        return type(self)(self.name, tuple(placements), self.raters, self.values[:, columns])


@guard_reader("a table of published results")
def read_results(path: Path) -> Mapping[tuple[str, str], PlacementRatings]:
    """The results of a table in CSV with the columns placement, quantity, model, class and value.

    Raises:
        BadFileError: Not such a table, a number that is there twice or missing.
    """
    table = read_csv(path, number_columns=("value",), text_columns=COLUMNS)
    found: dict[tuple[str, str], dict[tuple[str, str], float]] = {}
    words = zip(*(table.texts[column] for column in COLUMNS), strict=True)
    for (placement, quantity, model, category), value in zip(words, table.numbers["value"].tolist(), strict=True):
        of_kind = found.setdefault((quantity, category), {})
        if (model, placement) in of_kind:
            raise ValueError(f"{quantity} {category} of {model or 'no model'} on {placement} is there twice")
        of_kind[model, placement] = value
    return {key: _judged(" ".join(key).strip(), values) for key, values in found.items()}


def _judged(name: str, values: Mapping[tuple[str, str], float]) -> PlacementRatings:
    judges, placements = (tuple(dict.fromkeys(words)) for words in zip(*values, strict=True))
    missing = [f"{judge} on {place}" for judge in judges for place in placements if (judge, place) not in values]
    if missing:
        raise ValueError(f"{name}: no value of {', '.join(missing)}")
    array = np.array([[values[judge, place] for place in placements] for judge in judges])
    return PlacementRatings(name, placements, judges, array)


class RankCorrelation(NamedTuple):
    """A rank correlation and its 95 % interval; NaN where one of the two series does not vary."""

    value: float
    low: float
    high: float

    @classmethod
    def from_samples(cls, value: float, sampled_values: Float64) -> Self:
        """Of a number, and what it is in draws."""
        return cls(value, *compute_bootstrap_interval95(value, sampled_values))

    @property
    def text(self) -> str:
        """Both.

        Example:
            >>> Relation(0.857, 0.5, 0.95).words
            '+0.86 [+0.50, +0.95]'
        """
        return "-" if math.isnan(self.value) else f"{self.value:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


@dataclass(frozen=True)
class MetricCorrelation:
    """How one metric ranks the placements.

    Args:
        metric: Its name.
        spearman: Spearman's rank correlation with the mean of the judges.
        kendall: Kendall's tau-b with it.
        p_value: Probability of a Spearman correlation as strong, of either sign, by chance; of this metric alone.
        resamples_scenes: Whether the intervals are over worlds too, or over judges only.
    """

    metric: str
    spearman: RankCorrelation
    kendall: RankCorrelation
    p_value: float
    resamples_scenes: bool


@dataclass(frozen=True)
class MetricAgreement:
    """How metrics rank placements, compared with what judges say of them.

    Args:
        ratings: What the judges say.
        correlations: A row for each metric.
        best_metric: The metric with the strongest Spearman correlation, of either sign; None if none has one.
        best_p_value: Probability that the best of so many metrics that mean nothing is as strong.
        chance_threshold: What the best of them exceeds in one of twenty orders.
    """

    ratings: PlacementRatings
    correlations: tuple[MetricCorrelation, ...]
    best_metric: str | None
    best_p_value: float
    chance_threshold: float

    @property
    def metric_count(self) -> int:
        """How many metrics have a rank correlation."""
        return sum(not math.isnan(row.spearman.value) for row in self.correlations)


def correlate_rankings(
    rankings: Sequence[Ranking],
    ratings: PlacementRatings,
    *,
    num_samples: int = DRAWS,
    resample_placements: bool = False,
) -> MetricAgreement:
    """Rank placements by metrics, and compare with the mean of the judges.

    The intervals are those of a bootstrap: judges are drawn anew, and with them the worlds of the metrics that have
    `num_samples`. The placements are the same in each draw, unless they too are a sample.

    Args:
        rankings: What the metrics say of the placements of `ratings`, in its order.
        ratings: What the judges say.
        num_samples: How often; at most as many as the rankings have.
        resample_placements: Whether to draw placements, too.

    Raises:
        ValueError: A metric of another number of placements, or with fewer draws.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = Judged("AP", tuple("abcd"), ("net", "other"), np.array([[1.0, 2, 3, 4], [1, 2, 4, 3]]))
        >>> height = Ranking.of_values(Quantity("height", "mean height", "m", lower_is_better=False), [1.0, 2, 3, 3])
        >>> found = correlate_rankings([height], judged, draws=100)
        >>> round(found.ranked[0].spearman.value, 3), found.best, found.looked_at
        (1.0, 'height', 1)
    """
    count = len(ratings.placements)
    for one in rankings:
        if len(one.numbers) != count or (
            one.samples is not None and one.samples[:num_samples].shape != (num_samples, count)
        ):
            raise ValueError(
                f"{one.name}: a value of each of {count} placements is needed, and {num_samples} draws or none"
            )
    truths, columns = _drawn(ratings, num_samples, placements=resample_placements)
    ranked = tuple(_ranked(one, ratings.mean, truths, columns) for one in rankings)
    strength = np.array([abs(row.spearman.value) for row in ranked])
    if np.isnan(strength).all():
        return MetricAgreement(ratings, ranked, None, math.nan, math.nan)
    best = check_best_correlation(np.stack([one.scores for one in rankings]), ratings.mean)
    return MetricAgreement(
        ratings=ratings,
        correlations=ranked,
        best_metric=rankings[int(np.nanargmax(strength))].name,
        best_p_value=best.p_value,
        chance_threshold=float(np.quantile(best.chance_correlations, BY_CHANCE)),
    )


def compare_correlations(
    first: Ranking,
    second: Ranking,
    ratings: PlacementRatings,
    *,
    num_samples: int = DRAWS,
    resample_placements: bool = False,
) -> RankCorrelation:
    """By how much Spearman's correlation of a metric is above that of another one, with its interval.

    Both are held against the same draws, so that what they share cancels out.

    Args:
        first: The metric.
        second: What it is to beat.
        ratings: As in `correlate_rankings`, and so are all that follow.
        num_samples: How often.
        resample_placements: Whether to draw placements, too.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = Judged("AP", tuple("abcd"), ("net",), np.array([[1.0, 2, 3, 4]]))
        >>> height = Quantity("height", "mean height", "m", lower_is_better=False)
        >>> good, bad = (Ranking.of_values(height, values) for values in ([1.0, 2, 3, 4], [4.0, 3, 2, 1]))
        >>> lead(good, bad, judged)
        Relation(value=2.0, low=2.0, high=2.0)
    """
    truths, columns = _drawn(ratings, num_samples, placements=resample_placements)
    found = [compute_spearman(each.scores, ratings.mean) for each in (first, second)]
    drawn = [compute_spearman(*_along(each, truths, columns)) for each in (first, second)]
    return RankCorrelation.from_samples(float(found[0] - found[1]), drawn[0] - drawn[1])


def _drawn(judged: PlacementRatings, draws: int, *, placements: bool) -> tuple[Float64, Int64]:
    """(R, n) the mean of judges that are drawn anew, and which placements are drawn."""
    generator, count = np.random.default_rng(0), len(judged.placements)
    chosen = generator.integers(len(judged.raters), size=(draws, len(judged.raters)))
    columns = generator.integers(count, size=(draws, count)) if placements else np.tile(np.arange(count), (draws, 1))
    return judged.values[chosen].mean(axis=1), columns


def _along(one: Ranking, truths: Float64, columns: Int64) -> tuple[Float64, Float64]:
    """(R, n) what a metric and the judges say in each draw."""
    drawn = (
        np.broadcast_to(one.scores, truths.shape) if one.sampled_scores is None else one.sampled_scores[: len(truths)]
    )
    return np.take_along_axis(drawn, columns, axis=1), np.take_along_axis(truths, columns, axis=1)


def _ranked(one: Ranking, truth: Float64, truths: Float64, columns: Int64) -> MetricCorrelation:
    drawn = _along(one, truths, columns)
    rho, tau = (
        RankCorrelation.from_samples(float(statistic(one.scores, truth)), statistic(*drawn))
        for statistic in (compute_spearman, compute_kendall_tau_b)
    )
    return MetricCorrelation(
        one.name, rho, tau, check_best_correlation(one.scores, truth).p_value, one.samples is not None
    )
