"""Rank correlation of metrics with detectors over sensor placements, with confidence intervals and p-values."""

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

# Quantile of the strongest correlation of meaningless metrics that serves as threshold of chance.
BY_CHANCE = 0.95
# Text columns of a table of published results.
COLUMNS = ("placement", "quantity", "model", "class")


@dataclass(frozen=True, eq=False)
class PlacementRatings:
    """Ratings of placements by several raters (detectors, or trainings of one detector).

    Args:
        name: Name of the rating: "car mAP".
        placements: Names of the n placements.
        raters: Names of the J raters.
        values: (J, n) ratings; higher is better.

    Raises:
        ValueError: Values of another shape, or that are not finite.

    Example:
        >>> values = np.array([[1.0, 2.0, 3.0], [2.0, 1.0, 3.0]])
        >>> judged = PlacementRatings("AP", ("a", "b", "c"), ("net", "other"), values)
        >>> judged.mean.tolist(), judged.inter_rater_correlation
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
        """(n,) mean over the raters."""
        return np.asarray(self.values.mean(axis=0))

    @property
    def inter_rater_correlation(self) -> float:
        """Mean Spearman correlation of all pairs of raters; NaN for a single rater.

        It limits the correlation that a metric can be expected to reach.
        """
        pairs = [compute_spearman(self.values[a], self.values[b]) for a, b in combinations(range(len(self.raters)), 2)]
        return float(np.mean(pairs)) if pairs else float("nan")

    def select(self, placements: Sequence[str]) -> Self:
        """Select some of the placements.

        Args:
            placements: Names in the desired order.

        Returns:
            Ratings of these placements.

        Raises:
            ValueError: A placement without ratings.
        """
        if missing := [name for name in placements if name not in self.placements]:
            raise ValueError(f"{self.name}: nothing is known of {', '.join(missing)}")
        columns = [self.placements.index(name) for name in placements]
        return type(self)(self.name, tuple(placements), self.raters, self.values[:, columns])


@guard_reader("a table of published results")
def read_results(path: Path) -> Mapping[tuple[str, str], PlacementRatings]:
    """Read a CSV table with the columns placement, quantity, model, class and value.

    Args:
        path: Path of the table.

    Returns:
        (quantity, class) -> ratings of all placements by all models.

    Raises:
        BadFileError: Another content, or a repeated or missing value.
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
        """Compute the interval from bootstrap values.

        Args:
            value: Rank correlation.
            sampled_values: (R,) bootstrap values.

        Returns:
            Correlation with its interval.
        """
        return cls(value, *compute_bootstrap_interval95(value, sampled_values))

    @property
    def text(self) -> str:
        """Correlation and interval as text.

        Example:
            >>> RankCorrelation(0.857, 0.5, 0.95).text
            '+0.86 [+0.50, +0.95]'
        """
        return "-" if math.isnan(self.value) else f"{self.value:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


@dataclass(frozen=True)
class MetricCorrelation:
    """Rank correlation of one metric with the ratings.

    Args:
        metric: Name of the metric.
        spearman: Spearman's rank correlation with the mean of the raters.
        kendall: Kendall's tau-b with the mean of the raters.
        p_value: Two-sided probability of a Spearman correlation as strong by chance, for this metric alone.
        resamples_scenes: True if the intervals are over scenes and raters, False if over raters only.
    """

    metric: str
    spearman: RankCorrelation
    kendall: RankCorrelation
    p_value: float
    resamples_scenes: bool


@dataclass(frozen=True)
class MetricAgreement:
    """Rank correlations of several metrics with the ratings of placements.

    Args:
        ratings: Ratings of the placements.
        correlations: One entry for each metric.
        best_metric: The metric with the strongest Spearman correlation, of either sign; None if none has one.
        best_p_value: Probability that the best of the same number of meaningless metrics is as strong.
        chance_threshold: 95 % quantile of the strongest correlation of meaningless metrics.
    """

    ratings: PlacementRatings
    correlations: tuple[MetricCorrelation, ...]
    best_metric: str | None
    best_p_value: float
    chance_threshold: float

    @property
    def metric_count(self) -> int:
        """Number of metrics with a rank correlation."""
        return sum(not math.isnan(row.spearman.value) for row in self.correlations)


def correlate_rankings(
    rankings: Sequence[Ranking],
    ratings: PlacementRatings,
    *,
    num_samples: int = DRAWS,
    resample_placements: bool = False,
) -> MetricAgreement:
    """Correlate rankings by metrics with the mean of the raters.

    Intervals come from a bootstrap over raters, and over scenes for metrics with bootstrap values.

    Args:
        rankings: Rankings of the placements, in the order of `ratings`.
        ratings: Ratings of the placements.
        num_samples: Number of bootstrap samples; at most that of the rankings.
        resample_placements: True: the placements are resampled, too.

    Returns:
        Correlations, and the significance of the best metric.

    Raises:
        ValueError: A metric with another number of placements, or with fewer bootstrap samples.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = PlacementRatings("AP", tuple("abcd"), ("net", "other"), np.array([[1.0, 2, 3, 4], [1, 2, 4, 3]]))
        >>> height = Ranking.from_values(Quantity("height", "mean height", "m", lower_is_better=False), [1.0, 2, 3, 3])
        >>> found = correlate_rankings([height], judged, num_samples=100)
        >>> round(found.correlations[0].spearman.value, 3), found.best_metric, found.metric_count
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
    truths, columns = _resample_ratings(ratings, num_samples, placements=resample_placements)
    ranked = tuple(_correlate_ranking(one, ratings.mean, truths, columns) for one in rankings)
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
    """Compute the difference of the Spearman correlations of two metrics, with its interval.

    Both use the same bootstrap samples, so that common variation cancels out.

    Args:
        first: Metric.
        second: Metric to subtract.
        ratings: Ratings of the placements.
        num_samples: Number of bootstrap samples.
        resample_placements: True: the placements are resampled, too.

    Returns:
        Difference of the correlations with its interval.

    Example:
        >>> from torchcover.estimation import Quantity
        >>> judged = PlacementRatings("AP", tuple("abcd"), ("net",), np.array([[1.0, 2, 3, 4]]))
        >>> height = Quantity("height", "mean height", "m", lower_is_better=False)
        >>> good, bad = (Ranking.from_values(height, values) for values in ([1.0, 2, 3, 4], [4.0, 3, 2, 1]))
        >>> compare_correlations(good, bad, judged)
        RankCorrelation(value=2.0, low=2.0, high=2.0)
    """
    truths, columns = _resample_ratings(ratings, num_samples, placements=resample_placements)
    found = [compute_spearman(each.scores, ratings.mean) for each in (first, second)]
    drawn = [compute_spearman(*_get_sampled_scores(each, truths, columns)) for each in (first, second)]
    return RankCorrelation.from_samples(float(found[0] - found[1]), drawn[0] - drawn[1])


def _resample_ratings(judged: PlacementRatings, draws: int, *, placements: bool) -> tuple[Float64, Int64]:
    """Resample the raters: (R, n) means of the ratings and (R, n) indices of the placements."""
    generator, count = np.random.default_rng(0), len(judged.placements)
    chosen = generator.integers(len(judged.raters), size=(draws, len(judged.raters)))
    columns = generator.integers(count, size=(draws, count)) if placements else np.tile(np.arange(count), (draws, 1))
    return judged.values[chosen].mean(axis=1), columns


def _get_sampled_scores(one: Ranking, truths: Float64, columns: Int64) -> tuple[Float64, Float64]:
    """Return (R, n) scores of a metric and (R, n) mean ratings in each bootstrap sample."""
    drawn = (
        np.broadcast_to(one.scores, truths.shape) if one.sampled_scores is None else one.sampled_scores[: len(truths)]
    )
    return np.take_along_axis(drawn, columns, axis=1), np.take_along_axis(truths, columns, axis=1)


def _correlate_ranking(one: Ranking, truth: Float64, truths: Float64, columns: Int64) -> MetricCorrelation:
    drawn = _get_sampled_scores(one, truths, columns)
    rho, tau = (
        RankCorrelation.from_samples(float(statistic(one.scores, truth)), statistic(*drawn))
        for statistic in (compute_spearman, compute_kendall_tau_b)
    )
    return MetricCorrelation(
        one.name, rho, tau, check_best_correlation(one.scores, truth).p_value, one.samples is not None
    )
