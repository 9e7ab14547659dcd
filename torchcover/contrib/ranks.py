"""Rankings of rigs by a number, rank correlations and their significance."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.stats import permutation_test, rankdata

from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.geometry.arrays import Float64

# Two items have only two orders, so a rank correlation needs at least three.
LEAST = 3
# Number of permutations of eight values; for more values, this number of permutations is sampled.
MAX_PERMUTATIONS = math.factorial(8)
# Number of bootstrap samples of scenes for intervals.
DRAWS = 500
# Metric name of the numbers of torchcover.
OWN = "torchcover"
# Metric name of properties of a rig that need no simulation.
BASELINE = "baseline"


class Ranking(NamedTuple):
    """Ranking of rigs by one number.

    Args:
        name: Name of the number with its parameters.
        metric: Published metric of the number, `OWN` or `BASELINE`.
        numbers: One number for each rig.
        samples: (R, rigs) bootstrap values over resampled scenes; None if unknown.

    Example:
        >>> height = Quantity("height", "mean mounting height", "m", lower_is_better=False)
        >>> Ranking.from_values(height, [2.2, 2.5, 2.2]).ranks.tolist()
        [2.5, 1.0, 2.5]
    """

    name: str
    metric: str
    numbers: tuple[Number, ...]
    samples: Float64 | None = None

    @classmethod
    def from_values(
        cls,
        quantity: Quantity,
        values: Sequence[float] | Float64,
        metric: str = BASELINE,
        samples: Float64 | None = None,
    ) -> "Ranking":
        """Build a ranking from values without errors.

        Args:
            quantity: Description of the values.
            values: (rigs,) values.
            metric: Name of the metric.
            samples: (R, rigs) bootstrap values; None if unknown.

        Returns:
            The ranking.
        """
        return cls(quantity.key, metric, tuple(Number(quantity, float(value)) for value in values), samples)

    @property
    def quantity(self) -> Quantity:
        """Description of the numbers."""
        return self.numbers[0].quantity

    @property
    def is_part(self) -> bool:
        """True for numbers of a part of the data (a category, a region)."""
        return ":" in self.name

    @property
    def scores(self) -> Float64:
        """(rigs,) values with the sign for which higher is better; NaN if unknown."""
        return np.array([number.quantity.compute_improvement(number.value) for number in self.numbers])

    @property
    def sampled_scores(self) -> Float64 | None:
        """(R, rigs) bootstrap values with the sign for which higher is better."""
        return None if self.samples is None else self.quantity.compute_improvement(1.0) * self.samples

    @property
    def ranks(self) -> Float64:
        """(rigs,) ranks, 1 for the best; equal values share their mean rank, NaN if unknown."""
        return rank_values(-self.scores)

    def select(self, rig_indices: Sequence[int]) -> "Ranking":
        """Select some of the rigs.

        Args:
            rig_indices: Indices of the rigs in the desired order.

        Returns:
            Ranking of the selected rigs.
        """
        numbers = tuple(self.numbers[rig] for rig in rig_indices)
        return self._replace(
            numbers=numbers, samples=None if self.samples is None else self.samples[:, list(rig_indices)]
        )


def build_rankings(
    metric: str, numbers: Sequence[Sequence[Number]], estimates: Sequence[Estimate], seed: int
) -> list[Ranking]:
    """Build a ranking for each number of a metric, with bootstrap values over scenes.

    Args:
        metric: Name of the metric.
        numbers: Numbers of each rig, in the same order for all rigs.
        estimates: Estimate of each rig from which the numbers come.
        seed: Seed of the bootstrap, the same for all metrics of a run.

    Returns:
        One ranking for each number.
    """
    samples = [resample_estimate(estimate, seed) for estimate in estimates]
    available = [sample for sample in samples if sample is not None]
    stacked = np.stack(available, axis=2) if len(available) == len(samples) else None
    rankings = []
    for index, rig_numbers in enumerate(zip(*numbers, strict=True)):
        number_samples = None if stacked is None else stacked[:, index]
        rankings.append(Ranking(rig_numbers[0].quantity.key, metric, rig_numbers, number_samples))
    return rankings


def resample_estimate(estimate: Estimate, seed: int) -> Float64 | None:
    """Resample the scenes of an estimate with replacement.

    Args:
        estimate: Estimate of Q numbers.
        seed: Seed of the bootstrap.

    Returns:
        (R, Q) bootstrap values; None for fewer than 8 blocks or if the estimate cannot be recomputed.
    """
    num_blocks = len(estimate.frame_counts)
    if num_blocks < MIN_BLOCKS:
        return None
    rng = np.random.default_rng([seed, num_blocks])
    block_weights = rng.multinomial(num_blocks, np.full(num_blocks, 1 / num_blocks), size=DRAWS)
    values = estimate.resample(torch.from_numpy(block_weights))
    return None if values is None else values.cpu().numpy()


def compute_bootstrap_interval95(value: float, sampled_values: Float64) -> tuple[float, float]:
    """Compute the 95 % bootstrap interval of a number.

    Args:
        value: The number.
        sampled_values: (R,) bootstrap values; NaN are ignored.

    Returns:
        Lower and upper end; NaN if the number or all bootstrap values are unknown.
    """
    finite_values = sampled_values[~np.isnan(sampled_values)]
    if math.isnan(value) or not finite_values.size:
        return math.nan, math.nan
    low, high = np.quantile(finite_values, (0.025, 0.975)).tolist()
    return low, high


def rank_values(values: ArrayLike) -> Float64:
    """Rank values from 1, the smallest; equal values share the mean of their ranks, NaN stays NaN.

    Args:
        values: (..., n) values.

    Returns:
        (..., n) ranks.
    """
    ranks: Float64 = rankdata(np.asarray(values, dtype=np.float64), axis=-1, nan_policy="omit")
    return ranks


def compute_kendall_tau_b(first: ArrayLike, second: ArrayLike) -> Float64:
    """Compute Kendall's tau-b: 1 for the same order, -1 for the opposite one; ties count for neither.

        tau_b = (C - D) / sqrt((P - T_1) (P - T_2))

    with C concordant, D discordant and P all pairs, T_i of them equal in the i-th series (Kendall 1945, Biometrika 33,
    239). `scipy.stats.kendalltau` takes one pair of series; a bootstrap has thousands.

    Args:
        first: (..., n) series, NaN if unknown; values that are unknown in one series are excluded from all pairs.
        second: (..., n) series; the two broadcast.

    Returns:
        (...) tau-b; NaN for fewer than three known values, or if all values of a series are equal.
    """
    first_known, second_known = _mask_unknown(first, second)
    signs = []
    for values in (first_known, second_known):
        left, right = values[..., :, None], values[..., None, :]
        signs.append((left > right).astype(np.float64) - (left < right))
    agreement = (signs[0] * signs[1]).sum(axis=(-2, -1))
    untied = [np.abs(sign).sum(axis=(-2, -1)) for sign in signs]
    return _divide(agreement, np.sqrt(untied[0] * untied[1]), first_known)


def compute_spearman(first: ArrayLike, second: ArrayLike) -> Float64:
    """Compute Spearman's rank correlation, Pearson's correlation of the ranks, which handles ties.

    Args:
        first: (..., n) series, NaN if unknown.
        second: (..., n) series; the two broadcast.

    Returns:
        (...) correlation; NaN under the same conditions as `compute_kendall_tau_b`.
    """
    masked = _mask_unknown(first, second)
    centered = []
    for values in masked:
        ranks = rank_values(values)
        count = np.maximum(np.isfinite(ranks).sum(axis=-1, keepdims=True), 1)
        centered.append(np.nan_to_num(ranks - np.nansum(ranks, axis=-1, keepdims=True) / count))
    first_known, second_known = centered
    spread = np.sqrt((first_known**2).sum(axis=-1) * (second_known**2).sum(axis=-1))
    return _divide((first_known * second_known).sum(axis=-1), spread, masked[0])


class BestCorrelation(NamedTuple):
    """Strongest rank correlation of several series with one target, compared with chance.

    Args:
        p_value: Two-sided probability that the best series is as strong by chance.
        chance_correlations: (P,) strongest correlation for each permutation of the target.
    """

    p_value: float
    chance_correlations: Float64


def check_best_correlation(first: ArrayLike, second: ArrayLike, seed: int = 0) -> BestCorrelation:
    """Test the strongest of several rank correlations by permutation of the target (`scipy.stats.permutation_test`).

    All permutations are used for up to eight values, a sample of the same size for more values.

    Args:
        first: (n,) series, or (k, n) several series.
        second: (n,) target.
        seed: Seed of sampled permutations.

    Returns:
        p-value of the strongest correlation, corrected for the choice among k series.
    """
    series, target = np.atleast_2d(np.asarray(first, dtype=np.float64)), np.asarray(second, dtype=np.float64)

    def find_strongest(permuted: Float64, axis: int = -1) -> Float64:
        aligned = np.moveaxis(permuted, axis, -1)
        correlations = np.abs([compute_spearman(values, aligned) for values in series])
        strongest: Float64 = np.nan_to_num(correlations).max(axis=0)
        return strongest

    observed = np.abs([compute_spearman(values, target) for values in series])
    if np.isnan(observed).all():
        return BestCorrelation(math.nan, np.empty(0))
    test = permutation_test(
        (target,),
        find_strongest,
        permutation_type="pairings",
        vectorized=True,
        n_resamples=MAX_PERMUTATIONS,
        alternative="greater",
        rng=np.random.default_rng(seed),
    )
    return BestCorrelation(float(test.pvalue), test.null_distribution)


def _mask_unknown(first: ArrayLike, second: ArrayLike) -> tuple[Float64, Float64]:
    """Broadcast two series and set values that are unknown in either to NaN."""
    first_known, second_known = np.broadcast_arrays(
        np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    )
    unknown = np.isnan(first_known) | np.isnan(second_known)
    return np.where(unknown, math.nan, first_known), np.where(unknown, math.nan, second_known)


def _divide(above: Float64, below: Float64, values: Float64) -> Float64:
    """Divide where a correlation is defined: enough known values and a positive denominator."""
    is_defined = ((~np.isnan(values)).sum(axis=-1) >= LEAST) & (below > 0)
    return np.where(is_defined, above / np.where(below > 0, below, 1.0), math.nan)
