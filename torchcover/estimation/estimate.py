"""Estimates from sums in blocks, and the numbers and differences that they give."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcover.estimation.errors import (
    MIN_BLOCKS,
    ROUND_OFF,
    Quantity,
    compute_interval95,
    compute_jackknife_error,
    compute_pseudo_values,
    compute_student_p,
    is_significant,
)


class Number(NamedTuple):
    """Number of a rig with the conditions under which it was measured; NaN where a part is unknown.

    Args:
        quantity: Meaning of the number.
        value: In the unit of the quantity; NaN if unknown.
        error: Standard error over blocks of contiguous frames or over scenes.
        low: Lower end of the 95 % confidence interval (`torchcover.estimation.compute_interval95`).
        high: Upper end.
        count: Number of items that the number averages.
        counted_items: Name of these items: "observed cells", "objects", "voxels", ...
        parameters: Further parameters of the computation.
        warning: Reason why the number is not suited for comparisons, as a sentence.

    Example:
        >>> number = Number(Quantity("k_cover", "seen by two sensors", "share", lower_is_better=False), 0.25, count=12)
        >>> number.has_value, number.error
        (True, nan)
    """

    quantity: Quantity
    value: float
    error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    count: int = 0  # type: ignore[assignment]  # hides tuple.count
    counted_items: str = ""
    parameters: Mapping[str, Any] = {}
    warning: str | None = None

    @property
    def has_value(self) -> bool:
        """True if the value is known."""
        return not math.isnan(self.value)


class Difference(NamedTuple):
    """Difference of a rig to a baseline rig over the same frames and reference points.

    Args:
        quantity: Meaning of both numbers.
        value: Rig minus baseline, in the unit of the quantity; of shares in [-1, 1]; NaN if unknown.
        error: Standard error of `value`; smaller than those of the two numbers, since the difficulty of a frame affects
            both rigs and cancels out. NaN if there are not enough blocks.
        low: Lower end of the 95 % confidence interval (`torchcover.estimation.compute_interval95`).
        high: Upper end.
        is_significant: Result of Student's t-test at 95 %; None if unknown.
        p_value: Two-sided p-value.
        block_count: Number of blocks of contiguous frames, or of scenes.
        better_count: Number of blocks in which the rig is better than the baseline.
    """

    quantity: Quantity
    value: float
    error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    is_significant: bool | None = None
    p_value: float = math.nan
    block_count: int = 0
    better_count: int = 0

    @property
    def improvement(self) -> float:
        """Difference with the sign chosen so that positive is better."""
        return self.quantity.compute_improvement(self.value)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Several numbers with their jackknife values: the numbers without each block of frames, or without each scene.

    Args:
        quantities: Meaning of the Q numbers.
        value: (Q,) float64 from all frames; NaN where unknown.
        jackknife_values: (g, Q) numbers without each block.
        frame_counts: (g,) int64 frames in these blocks, each above 0.
        recompute: Function from (R, g) block weights to the (R, Q) numbers if each block occurs as often as its weight;
            None if unknown.
        effective_blocks: (Q,) number of equally weighted blocks with the same information: Kish's
            (sum of w)^2 / sum of w^2 over the denominators w of the blocks. With fewer than 8 there is no interval. By
            default the number of blocks.
        strata: Weights that sum to 1, and estimates, of a mixture; empty otherwise.

    Example:
        >>> detection = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)
        >>> m2, frames = torch.full((8,), 10.0, dtype=torch.float64), torch.ones(8)
        >>> detected_m2 = torch.arange(8.0, dtype=torch.float64)[:, None]
        >>> baseline = Estimate.from_ratios((detection,), m2, detected_m2, frames)
        >>> rig = Estimate.from_ratios((detection,), m2, detected_m2 + 0.5, frames)
        >>> number, = baseline.to_numbers().values()
        >>> round(number.value, 3), round(number.error, 3)
        (0.35, 0.087)
        >>> difference, = rig.compute_differences(baseline).values()
        >>> round(difference.value, 3), difference.block_count, difference.better_count
        (0.05, 8, 8)
        >>> baseline.resample(torch.tensor([[1.0] * 8, [1.0] + [0.0] * 7]))
        tensor([[0.3500],
                [0.0000]], dtype=torch.float64)
    """

    quantities: tuple[Quantity, ...]
    value: Tensor
    jackknife_values: Tensor
    frame_counts: Tensor
    recompute: Callable[[Tensor], Tensor] | None = None
    effective_blocks: Tensor = None  # type: ignore[assignment]  # set in __post_init__
    strata: tuple[tuple[float, "Estimate"], ...] = ()

    def __post_init__(self) -> None:
        if self.effective_blocks is None:
            object.__setattr__(self, "effective_blocks", torch.full_like(self.value, len(self.frame_counts)))

    @classmethod
    def from_values(cls, quantities: Sequence[Quantity], value: Tensor) -> "Estimate":
        """Create an estimate of numbers without blocks, and so without errors.

        Args:
            quantities: Meaning of the numbers.
            value: (Q,) numbers.
        """
        return cls(tuple(quantities), value, value.new_empty((0, len(value))), value.new_empty(0, dtype=torch.int64))

    @classmethod
    def from_ratios(
        cls, quantities: Sequence[Quantity], denominators: Tensor, numerators: Tensor, frame_counts: Tensor
    ) -> "Estimate":
        """Estimate ratios of sums over blocks.

        Args:
            quantities: Meaning of the ratios.
            denominators: (B,) denominators of all quantities, or (B, Q) of each.
            numerators: (B, Q) numerators.
            frame_counts: (B,) frames in each block; 0 in unused blocks.
        """
        value = numerators.sum(dim=0) / denominators.sum(dim=0)
        used = frame_counts.nonzero().flatten() if len(frame_counts) > 1 else frame_counts[:0]
        denominators, numerators = denominators[used], numerators[used]
        if denominators.dim() == 1:
            denominators = denominators[:, None]
        jackknife_values = _sum_without_each(numerators) / _sum_without_each(denominators)
        effective_blocks = (denominators.sum(dim=0) ** 2 / denominators.square().sum(dim=0)).expand(len(value))
        recompute = partial(_recompute_ratios, denominators, numerators)
        return cls(tuple(quantities), value, jackknife_values, frame_counts[used], recompute, effective_blocks)

    @classmethod
    def from_blocks(
        cls, quantities: Sequence[Quantity], recompute: Callable[[Tensor], Tensor], frame_counts: Tensor
    ) -> "Estimate":
        """Estimate numbers that a function computes from block weights.

        Args:
            quantities: Meaning of the numbers.
            recompute: As in `Estimate`; float64.
            frame_counts: (g,) frames in each block, all above 0.
        """
        once = torch.ones(1, len(frame_counts), dtype=torch.float64, device=frame_counts.device)
        values = recompute(torch.cat([once, 1.0 - torch.diag(once[0])]))
        return cls(tuple(quantities), values[0], values[1:], frame_counts, recompute)

    @classmethod
    def from_strata(cls, strata: Sequence[tuple[float, "Estimate"]]) -> "Estimate":
        """Combine estimates of fixed strata, such as kinds of scene, to their weighted mean.

        The variance is the sum of the variances of the strata times the squared weights; its degrees of freedom follow
        Welch and Satterthwaite. Each stratum needs enough blocks of its own.

        Args:
            strata: Weights above 0 that sum to 1, and estimates of the same quantities.

        Example:
            >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
            >>> m2, radius_m = torch.ones(16, dtype=torch.float64), torch.arange(16.0, dtype=torch.float64)[:, None]
            >>> low, high = (Estimate.from_ratios((radius,), m2, radius_m + offset, m2) for offset in (0.0, 10.0))
            >>> mean, = Estimate.from_strata([(0.5, low), (0.5, high)]).to_numbers().values()
            >>> bool(mean.value == 12.5), round(mean.error / low.error.item(), 3)
            (True, 0.707)
        """
        estimates = [estimate for _, estimate in strata]
        value = torch.stack([weight * estimate.value for weight, estimate in strata]).sum(dim=0)
        effective_blocks = torch.stack([estimate.effective_blocks for estimate in estimates]).amin(dim=0)
        frame_counts = torch.cat([estimate.frame_counts for estimate in estimates])
        jackknife_values = torch.cat([estimate.jackknife_values for estimate in estimates])
        quantities = estimates[0].quantities
        return cls(quantities, value, jackknife_values, frame_counts, None, effective_blocks, tuple(strata))

    def __getitem__(self, columns: slice) -> "Estimate":
        """Select some of the numbers."""
        if self.strata:
            return Estimate.from_strata([(weight, stratum[columns]) for weight, stratum in self.strata])
        return Estimate(
            self.quantities[columns],
            self.value[columns],
            self.jackknife_values[:, columns],
            self.frame_counts,
            None if self.recompute is None else partial(_recompute_columns, self.recompute, columns),
            self.effective_blocks[columns],
        )

    def truncate_blocks(self, num_blocks: int) -> "Estimate":
        """Return the estimate from the first blocks alone.

        Args:
            num_blocks: Number of blocks that are kept. Requires `recompute`, which all ratios of sums have.
        """
        assert self.recompute is not None
        omitted_blocks = len(self.frame_counts) - num_blocks
        recompute = partial(_recompute_padded, self.recompute, omitted_blocks)
        return Estimate.from_blocks(self.quantities, recompute, self.frame_counts[:num_blocks])

    def resample(self, block_weights: Tensor) -> Tensor | None:
        """Recompute the numbers for resampled blocks (bootstrap).

        Args:
            block_weights: (R, g) how often each block occurs in each of R samples.

        Returns:
            (R, Q) float64; None if the numbers cannot be recomputed.
        """
        return None if self.recompute is None else self.recompute(block_weights.to(self.value))

    @property
    def error(self) -> Tensor:
        """(Q,) standard errors; NaN if there are fewer than 8 blocks."""
        return self.compute_errors()

    def compute_errors(self, min_blocks: int = MIN_BLOCKS) -> Tensor:
        """Compute the standard errors by the block jackknife.

        Args:
            min_blocks: Smallest number of blocks with an error: 8 for reported errors, 3 for early stopping of a
                search.

        Returns:
            (Q,) standard errors; NaN for too few blocks.
        """
        if self.strata:
            variances = [(weight * stratum.compute_errors(min_blocks)) ** 2 for weight, stratum in self.strata]
            return torch.stack(variances).sum(dim=0).sqrt()
        return compute_jackknife_error(self.jackknife_values, self.value, self.frame_counts, min_blocks)

    @property
    def degrees_of_freedom(self) -> list[int]:
        """(Q,) degrees of freedom of the errors: blocks minus one, or by Welch and Satterthwaite in a mixture."""
        if not self.strata:
            return [len(self.frame_counts) - 1] * len(self.value)
        variances = torch.stack([(weight * stratum.error) ** 2 for weight, stratum in self.strata])
        stratum_degrees = torch.tensor([stratum.degrees_of_freedom for _, stratum in self.strata], device="cpu")
        stratum_degrees = stratum_degrees.to(variances)
        # Computed from shares of the variance, since fourth powers of errors may underflow.
        degrees = 1 / ((variances / variances.sum(dim=0)) ** 2 / stratum_degrees).sum(dim=0)
        degrees = degrees.where(degrees.isfinite(), stratum_degrees.amin(dim=0))
        return [int(degree + 1e-9) for degree in degrees.tolist()]

    @property
    def has_intervals(self) -> list[bool]:
        """(Q,) True for numbers with at least 8 effective blocks."""
        result: list[bool] = (self.effective_blocks > MIN_BLOCKS - ROUND_OFF).tolist()
        return result

    def to_numbers(self, *, count: int = 0, counted_items: str = "") -> dict[str, Number]:
        """Convert to numbers by the key of their quantity; without intervals for fewer than 8 effective blocks.

        Args:
            count: Number of items that the numbers average.
            counted_items: Name of these items.
        """
        # Equal blocks, in a mixture equal blocks of any stratum, prove nothing about other blocks.
        strata = [stratum for _, stratum in self.strata] or [self]
        has_errors = torch.stack([stratum.error > ROUND_OFF for stratum in strata]).all(dim=0).tolist()
        values, errors = self.value.tolist(), self.error.tolist()
        has_intervals, all_degrees = self.has_intervals, self.degrees_of_freedom
        numbers = {}
        for index, quantity in enumerate(self.quantities):
            error = errors[index] if has_errors[index] else math.nan
            interval_error = error if has_intervals[index] else math.nan
            low, high = compute_interval95(values[index], interval_error, all_degrees[index], quantity)
            numbers[quantity.key] = Number(quantity, values[index], error, low, high, count, counted_items)
        return numbers

    def subtract(self, baseline: "Estimate") -> "Estimate":
        """Estimate the difference to a baseline over the same frames; shared variation cancels out in each block.

        Args:
            baseline: Estimate of the same quantities in the same blocks.
        """
        if self.strata:
            differences = []
            for (weight, stratum), (_, baseline_stratum) in zip(self.strata, baseline.strata, strict=True):
                differences.append((weight, stratum.subtract(baseline_stratum)))
            return Estimate.from_strata(differences)
        return Estimate(
            self.quantities,
            self.value - baseline.value,
            self.jackknife_values - baseline.jackknife_values,
            self.frame_counts,
            effective_blocks=torch.minimum(self.effective_blocks, baseline.effective_blocks),
        )

    def compute_differences(self, baseline: "Estimate") -> dict[str, Difference]:
        """Compare with a baseline over the same frames.

        Args:
            baseline: Estimate of the same quantities in the same blocks.

        Returns:
            Difference by the key of its quantity. With fewer than 8 effective blocks it has no interval, and its
            significance is unknown.
        """
        # Two infinite numbers are equal; their difference would be NaN, which means unknown.
        values = (self.value - baseline.value).where(self.value != baseline.value, 0.0).tolist()
        estimate = self.subtract(baseline)
        pseudo_values = []
        for stratum in [stratum for _, stratum in estimate.strata] or [estimate]:
            pseudo_values.append(compute_pseudo_values(stratum.jackknife_values, stratum.value, stratum.frame_counts))
        block_differences = torch.cat(pseudo_values)
        errors, all_degrees, has_intervals = (
            estimate.error.tolist(),
            estimate.degrees_of_freedom,
            estimate.has_intervals,
        )
        differences = {}
        for index, quantity in enumerate(self.quantities):
            value, degrees = values[index], all_degrees[index]
            error = errors[index] if has_intervals[index] else math.nan
            low, high = compute_interval95(value, error, degrees, quantity, is_difference=True)
            sign = -1 if quantity.lower_is_better else 1
            differences[quantity.key] = Difference(
                quantity=quantity,
                value=value,
                error=errors[index],
                low=low,
                high=high,
                is_significant=is_significant(value, error, degrees),
                p_value=compute_student_p(value / error, degrees) if error > ROUND_OFF else math.nan,
                block_count=len(self.frame_counts),
                better_count=int((sign * block_differences[:, index]).gt(ROUND_OFF).sum()),
            )
        return differences


def _sum_without_each(sums: Tensor) -> Tensor:
    """Compute (g, ...) sums over all blocks except each; not by subtraction, which infinite radii would turn to NaN."""
    zero = sums.new_zeros((1, *sums.shape[1:]))
    before = torch.cat([zero, sums])[:-1].cumsum(dim=0)
    after = torch.cat([sums, zero])[1:].flip(0).cumsum(dim=0).flip(0)
    return before + after


def _recompute_ratios(denominators: Tensor, numerators: Tensor, weights: Tensor) -> Tensor:
    return (weights @ numerators) / (weights @ denominators.to(numerators))


def _recompute_columns(recompute: Callable[[Tensor], Tensor], columns: slice, weights: Tensor) -> Tensor:
    return recompute(weights)[:, columns]


def _recompute_padded(recompute: Callable[[Tensor], Tensor], omitted_blocks: int, weights: Tensor) -> Tensor:
    return recompute(pad(weights, (0, omitted_blocks)))
