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
        """Select the columns of some sensor placements in the ratings of all raters.

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
    results: dict[tuple[str, str], dict[tuple[str, str], float]] = {}
    rows = zip(*(table.texts[column] for column in COLUMNS), table.numbers["value"].tolist(), strict=True)
    for placement, quantity, model, category, value in rows:
        values = results.setdefault((quantity, category), {})
        if (model, placement) in values:
            raise ValueError(f"{quantity} {category} of {model or 'no model'} on {placement} is there twice")
        values[model, placement] = value
    return {key: _build_ratings(" ".join(key).strip(), values) for key, values in results.items()}


def _build_ratings(name: str, values: Mapping[tuple[str, str], float]) -> PlacementRatings:
    """Build ratings from values by (rater, placement); ValueError for missing values."""
    raters, placements = (tuple(dict.fromkeys(names)) for names in zip(*values, strict=True))
    array = np.full((len(raters), len(placements)), math.nan)
    missing = []
    for row, rater in enumerate(raters):
        for column, placement in enumerate(placements):
            if (rater, placement) in values:
                array[row, column] = values[rater, placement]
            else:
                missing.append(f"{rater} on {placement}")
    if missing:
        raise ValueError(f"{name}: no value of {', '.join(missing)}")
    return PlacementRatings(name, placements, raters, array)


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
        >>> values = np.array([[1.0, 2, 3, 4], [1, 2, 4, 3]])
        >>> ratings = PlacementRatings("AP", tuple("abcd"), ("PointPillars", "CenterPoint"), values)
        >>> height = Ranking.from_values(Quantity("height", "mean height", "m", lower_is_better=False), [1.0, 2, 3, 3])
        >>> agreement = correlate_rankings([height], ratings, num_samples=100)
        >>> round(agreement.correlations[0].spearman.value, 3), agreement.best_metric, agreement.metric_count
        (1.0, 'height', 1)
    """
    count = len(ratings.placements)
    for ranking in rankings:
        samples = ranking.samples
        has_samples = samples is None or samples[:num_samples].shape == (num_samples, count)
        if len(ranking.numbers) != count or not has_samples:
            raise ValueError(
                f"{ranking.name}: a value of each of {count} placements is needed, and {num_samples} draws or none"
            )
    sampled_means, columns = _resample_ratings(ratings, num_samples, resample_placements=resample_placements)
    correlations = tuple(_correlate_ranking(ranking, ratings.mean, sampled_means, columns) for ranking in rankings)
    strengths = np.array([abs(correlation.spearman.value) for correlation in correlations])
    if np.isnan(strengths).all():
        return MetricAgreement(ratings, correlations, None, math.nan, math.nan)
    best = check_best_correlation(np.stack([ranking.scores for ranking in rankings]), ratings.mean)
    return MetricAgreement(
        ratings=ratings,
        correlations=correlations,
        best_metric=rankings[int(np.nanargmax(strengths))].name,
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
        >>> ratings = PlacementRatings("AP", tuple("abcd"), ("PointPillars",), np.array([[1.0, 2, 3, 4]]))
        >>> height = Quantity("height", "mean height", "m", lower_is_better=False)
        >>> good, bad = (Ranking.from_values(height, values) for values in ([1.0, 2, 3, 4], [4.0, 3, 2, 1]))
        >>> compare_correlations(good, bad, ratings)
        RankCorrelation(value=2.0, low=2.0, high=2.0)
    """
    sampled_means, columns = _resample_ratings(ratings, num_samples, resample_placements=resample_placements)
    values, samples = [], []
    for ranking in (first, second):
        values.append(float(compute_spearman(ranking.scores, ratings.mean)))
        samples.append(compute_spearman(*_get_sampled_scores(ranking, sampled_means, columns)))
    return RankCorrelation.from_samples(values[0] - values[1], samples[0] - samples[1])


def _resample_ratings(
    ratings: PlacementRatings, num_samples: int, *, resample_placements: bool
) -> tuple[Float64, Int64]:
    """Resample the raters: (R, n) means of the ratings and (R, n) indices of the placements."""
    rng, placement_count, rater_count = np.random.default_rng(0), len(ratings.placements), len(ratings.raters)
    raters = rng.integers(rater_count, size=(num_samples, rater_count))
    columns = np.tile(np.arange(placement_count), (num_samples, 1))
    if resample_placements:
        columns = rng.integers(placement_count, size=(num_samples, placement_count))
    return ratings.values[raters].mean(axis=1), columns


def _get_sampled_scores(ranking: Ranking, sampled_means: Float64, columns: Int64) -> tuple[Float64, Float64]:
    """Return (R, n) scores of a metric and (R, n) mean ratings in each bootstrap sample."""
    scores = ranking.sampled_scores
    if scores is None:
        scores = np.broadcast_to(ranking.scores, sampled_means.shape)
    scores = scores[: len(sampled_means)]
    return np.take_along_axis(scores, columns, axis=1), np.take_along_axis(sampled_means, columns, axis=1)


def _correlate_ranking(
    ranking: Ranking, mean_ratings: Float64, sampled_means: Float64, columns: Int64
) -> MetricCorrelation:
    """Correlate one ranking with the mean of the raters, with bootstrap intervals."""
    sampled_scores = _get_sampled_scores(ranking, sampled_means, columns)
    correlations = []
    for compute_correlation in (compute_spearman, compute_kendall_tau_b):
        value = float(compute_correlation(ranking.scores, mean_ratings))
        correlations.append(RankCorrelation.from_samples(value, compute_correlation(*sampled_scores)))
    p_value = check_best_correlation(ranking.scores, mean_ratings).p_value
    spearman, kendall_tau = correlations
    return MetricCorrelation(ranking.name, spearman, kendall_tau, p_value, ranking.samples is not None)
