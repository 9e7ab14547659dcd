"""Rigs in the order of a number, how alike two such orders are, and whether that is more than chance."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.stats import permutation_test, rankdata

from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.geometry.arrays import Float64

# Two things have two orders, and are alike or opposite by chance.
LEAST = 3
# All permutations of eight values; of more values as many are sampled.
MAX_PERMUTATIONS = math.factorial(8)
# Worlds are drawn again so many times for intervals.
DRAWS = 500
# The metric that numbers of torchcover itself are of; and what takes no simulation to know, or little.
OWN, BASELINE = "torchcover", "baseline"


class Ranking(NamedTuple):
    """One number of every rig, which ranks them.

    Args:
        name: Of the number, with all that decides it.
        metric: The published metric that it is of, `OWN` or `BASELINE`.
        numbers: One for each rig.
        samples: (R, rigs) what they were in worlds that are drawn again; None if that is unknown.

    Example:
        >>> height = Quantity("height", "mean mounting height", "m", lower_is_better=False)
        >>> Ranking.of_values(height, [2.2, 2.5, 2.2]).ranks.tolist()
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
        """Of values (rigs,) without errors."""
        return cls(quantity.key, metric, tuple(Number(quantity, float(value)) for value in values), samples)

    @property
    def quantity(self) -> Quantity:
        """What the numbers are."""
        return self.numbers[0].quantity

    @property
    def is_part(self) -> bool:
        """Whether it is about a part only of what another number is about: a category, a region."""
        return ":" in self.name

    @property
    def scores(self) -> Float64:
        """(rigs,) the values, with the sign turned so that more is better; NaN where unknown."""
        return np.array([number.quantity.compute_improvement(number.value) for number in self.numbers])

    @property
    def sampled_scores(self) -> Float64 | None:
        """(R, rigs) likewise those of the draws."""
        return None if self.samples is None else self.quantity.compute_improvement(1.0) * self.samples

    @property
    def ranks(self) -> Float64:
        """(rigs,) 1 for the best; equal ones share the mean of theirs, NaN where unknown."""
        return rank_values(-self.scores)

    def select(self, rig_indices: Sequence[int]) -> "Ranking":
        """Of some of the rigs, by their places, in another order."""
        numbers = tuple(self.numbers[rig] for rig in rig_indices)
        return self._replace(
            numbers=numbers, samples=None if self.samples is None else self.samples[:, list(rig_indices)]
        )


def build_rankings(
    metric: str, numbers: Sequence[Sequence[Number]], estimates: Sequence[Estimate], seed: int
) -> list[Ranking]:
    """A ranking by each number of a metric, the same of each rig, with draws of worlds from what they come from.

    The seed is the same for all metrics of a run.
    """
    draws = [resample_estimate(estimate, seed) for estimate in estimates]
    known = [each for each in draws if each is not None]
    stacked = np.stack(known, axis=2) if len(known) == len(draws) else None
    return [
        Ranking(each[0].quantity.key, metric, each, None if stacked is None else stacked[:, at])
        for at, each in enumerate(zip(*numbers, strict=True))
    ]


def resample_estimate(estimate: Estimate, seed: int) -> Float64 | None:
    """(R, Q) numbers over worlds that are drawn with replacement; None if too few, or what that gives, are known."""
    worlds = len(estimate.frame_counts)
    if worlds < MIN_BLOCKS:
        return None
    drawn = np.random.default_rng([seed, worlds]).multinomial(worlds, np.full(worlds, 1 / worlds), size=DRAWS)
    again = estimate.resample(torch.from_numpy(drawn))
    return None if again is None else again.cpu().numpy()


def compute_bootstrap_interval95(value: float, sampled_values: Float64) -> tuple[float, float]:
    """Ends of the 95 % interval of a number by what it is in draws; NaN where it, or all of them, are unknown."""
    known = sampled_values[~np.isnan(sampled_values)]
    if math.isnan(value) or not known.size:
        return math.nan, math.nan
    low, high = np.quantile(known, (0.025, 0.975)).tolist()
    return low, high


def rank_values(values: ArrayLike) -> Float64:
    """Rank values from 1, the smallest; equal values share the mean of their ranks, NaN stays NaN.

    Args:
        values: (..., n).
    """
    ranks: Float64 = rankdata(np.asarray(values, dtype=np.float64), axis=-1, nan_policy="omit")
    return ranks


def compute_kendall_tau_b(first: ArrayLike, second: ArrayLike) -> Float64:
    """Compute Kendall's tau-b: 1 for the same order, -1 for the opposite one; ties count for neither.

        tau_b = (C - D) / sqrt((P - T_1) (P - T_2))

    with C concordant, D discordant and P all pairs, T_i of them equal in the i-th series (Kendall 1945, Biometrika 33,
    239). `scipy.stats.kendalltau` takes one pair of series; a bootstrap has thousands.

    Args:
        first: (..., n), NaN where unknown; a value that is unknown in one series is in no pair.
        second: (..., n), likewise; the two broadcast.

    Returns:
        (...); NaN for fewer than three known values, or if all values of a series are equal.
    """
    one, other = _mask_unknown(first, second)
    signs = []
    for values in (one, other):
        left, right = values[..., :, None], values[..., None, :]
        signs.append((left > right).astype(np.float64) - (left < right))
    agreement = (signs[0] * signs[1]).sum(axis=(-2, -1))
    untied = [np.abs(sign).sum(axis=(-2, -1)) for sign in signs]
    return _divide(agreement, np.sqrt(untied[0] * untied[1]), one)


def compute_spearman(first: ArrayLike, second: ArrayLike) -> Float64:
    """Compute Spearman's rank correlation: Pearson's of the ranks, so that ties are right; else as `compute_kendall_tau_b`."""
    masked = _mask_unknown(first, second)
    centered = []
    for values in masked:
        ranks = rank_values(values)
        count = np.maximum(np.isfinite(ranks).sum(axis=-1, keepdims=True), 1)
        centered.append(np.nan_to_num(ranks - np.nansum(ranks, axis=-1, keepdims=True) / count))
    one, other = centered
    spread = np.sqrt((one**2).sum(axis=-1) * (other**2).sum(axis=-1))
    return _divide((one * other).sum(axis=-1), spread, masked[0])


class BestCorrelation(NamedTuple):
    """How strong the best rank correlation of several series with one target is, and how strong it is by chance.

    Args:
        strongest: Absolute rank correlation of the best series; NaN if none is known.
        p_value: Two-sided probability that the best series is as strong by chance.
        chance_correlations: (P,) strongest correlation for each permutation of the target.
    """

    strongest: float
    p_value: float
    chance_correlations: Float64


def check_best_correlation(first: ArrayLike, second: ArrayLike, seed: int = 0) -> BestCorrelation:
    """Compare the best of several series with what permutations of the target give (`scipy.stats.permutation_test`).

    All permutations of up to eight values are tried, else as many are sampled.

    Args:
        first: (n,) a series, or (k, n) several: of k metrics that mean nothing, one is always good.
        second: (n,) the target.
        seed: Seed of sampled permutations.
    """
    series, target = np.atleast_2d(np.asarray(first, dtype=np.float64)), np.asarray(second, dtype=np.float64)

    def find_strongest(permuted: Float64, axis: int = -1) -> Float64:
        aligned = np.moveaxis(permuted, axis, -1)
        correlations = np.abs([compute_spearman(values, aligned) for values in series])
        strongest: Float64 = np.nan_to_num(correlations).max(axis=0)
        return strongest

    observed = np.abs([compute_spearman(values, target) for values in series])
    if np.isnan(observed).all():
        return BestCorrelation(math.nan, math.nan, np.empty(0))
    test = permutation_test(
        (target,),
        find_strongest,
        permutation_type="pairings",
        vectorized=True,
        n_resamples=MAX_PERMUTATIONS,
        alternative="greater",
        rng=np.random.default_rng(seed),
    )
    return BestCorrelation(float(np.nanmax(observed)), float(test.pvalue), test.null_distribution)


def _mask_unknown(first: ArrayLike, second: ArrayLike) -> tuple[Float64, Float64]:
    one, other = np.broadcast_arrays(np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64))
    unknown = np.isnan(one) | np.isnan(other)
    return np.where(unknown, math.nan, one), np.where(unknown, math.nan, other)


def _divide(above: Float64, below: Float64, values: Float64) -> Float64:
    enough = ((~np.isnan(values)).sum(axis=-1) >= LEAST) & (below > 0)
    return np.where(enough, above / np.where(below > 0, below, 1.0), math.nan)
