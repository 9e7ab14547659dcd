"""Estimates from sums in blocks, and the numbers and differences that are read from them."""

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
    """A number of a rig, with all that decides it; NaN where something is unknown.

    Args:
        quantity: What it is.
        value: In the unit of the quantity; NaN if it is unknown.
        error: Its standard error, over blocks of contiguous steps or worlds.
        low: Lower end of its 95 % interval, as from `torchcover.estimation.interval95`.
        high: Upper end.
        count: How many it is over.
        counted_items: What these are: "known cells", "objects", "voxels", ...
        parameters: What else it was computed with.
        warning: What makes it unfit for a comparison, in words.

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
        """Whether it has a value."""
        return not math.isnan(self.value)


class Difference(NamedTuple):
    """What a rig has more than another one, in the same steps and against the same reference points.

    Args:
        quantity: What the two numbers are.
        value: In its unit, a share in [-1, 1]; NaN if unknown.
        error: Standard error of `value` itself, which is less than that of the two numbers: what makes a step easy or
            hard for both rigs cancels out. NaN if there are not enough blocks.
        low: Lower end of its 95 % interval, as from `torchcover.estimation.interval95`.
        high: Upper end.
        is_significant: Whether the difference is more than chance, by Student's t at 95 %; None if that is unknown.
        p_value: Probability of a t at least as large to either side if there were no difference.
        block_count: Blocks of contiguous steps, or worlds, that it comes from.
        better_count: In how many of them the rig is better than the other.
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
        """The difference with the sign turned so that more is better."""
        return self.quantity.compute_improvement(self.value)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Several numbers at once, with what they become without one block of steps, or one world, after the other.

    Args:
        quantities: What the Q numbers are.
        value: (Q,) float64 from all steps; NaN where unknown.
        jackknife_values: (g, Q) without each block.
        frame_counts: (g,) int64 steps in these blocks, each above 0.
        recompute: From (R, g) how often each block comes to (R, Q) what the numbers were then; None if that is unknown.
        effective_blocks: (Q,) how many blocks of equal weight would say as much: Kish's (sum of w)^2 / sum of w^2 over what is
            divided by in each. With fewer than 8 there is no interval. The number of blocks if not given.
        strata: Of a mixture, the weights, which sum to 1, and what is mixed; empty of all else.

    Example:
        >>> detection = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)
        >>> m2 = torch.full((8,), 10.0, dtype=torch.float64)
        >>> seen, more = (torch.arange(8.0, dtype=torch.float64)[:, None] + shift for shift in (0.0, 0.5))
        >>> one, other = (Estimate.from_ratios((detection,), m2, each, torch.ones(8)) for each in (seen, more))
        >>> number, = one.to_numbers().values()
        >>> round(number.value, 3), round(number.error, 3)
        (0.35, 0.087)
        >>> difference, = other.compute_differences(one).values()
        >>> round(difference.value, 3), difference.block_count, difference.better_count
        (0.05, 8, 8)
        >>> one.resample(torch.tensor([[1.0] * 8, [1.0] + [0.0] * 7]))
        tensor([[0.3500],
                [0.0000]], dtype=torch.float64)
    """

    quantities: tuple[Quantity, ...]
    value: Tensor
    jackknife_values: Tensor
    frame_counts: Tensor
    recompute: Callable[[Tensor], Tensor] | None = None
    effective_blocks: Tensor = None  # type: ignore[assignment]  # until the next line
    strata: tuple[tuple[float, "Estimate"], ...] = ()

    def __post_init__(self) -> None:
        if self.effective_blocks is None:
            object.__setattr__(self, "effective_blocks", torch.full_like(self.value, len(self.frame_counts)))

    @classmethod
    def from_values(cls, quantities: Sequence[Quantity], value: Tensor) -> "Estimate":
        """Of numbers (Q,) that no block is known of, and so no error."""
        return cls(tuple(quantities), value, value.new_empty((0, len(value))), value.new_empty(0, dtype=torch.int64))

    @classmethod
    def from_ratios(
        cls, quantities: Sequence[Quantity], denominators: Tensor, numerators: Tensor, frame_counts: Tensor
    ) -> "Estimate":
        """Ratios of sums in blocks, and what they become without each block.

        Args:
            quantities: What they are.
            denominators: (B,) what is divided by; or (B, Q), of each.
            numerators: (B, Q) sums.
            frame_counts: (B,) steps in each block; 0 in blocks that are not in use.
        """
        whole = numerators.sum(dim=0) / denominators.sum(dim=0)
        used = frame_counts.nonzero().flatten() if len(frame_counts) > 1 else frame_counts[:0]
        denominators, numerators = (
            (denominators if denominators.dim() == 2 else denominators[:, None])[used],
            numerators[used],
        )
        without = _without_each(numerators) / _without_each(denominators)
        effective = (denominators.sum(dim=0) ** 2 / denominators.square().sum(dim=0)).expand(len(whole))
        return cls(
            tuple(quantities),
            whole,
            without,
            frame_counts[used],
            partial(_ratios_again, denominators, numerators),
            effective,
        )

    @classmethod
    def from_blocks(
        cls, quantities: Sequence[Quantity], recompute: Callable[[Tensor], Tensor], frame_counts: Tensor
    ) -> "Estimate":
        """Of numbers that say for themselves what they become if blocks come more or less often.

        Args:
            quantities: What they are.
            recompute: As in `Estimate`; float64.
            frame_counts: (g,) steps in each block, all above 0.
        """
        once = torch.ones(1, len(frame_counts), dtype=torch.float64, device=frame_counts.device)
        values = recompute(torch.cat([once, 1.0 - torch.diag(once[0])]))
        return cls(tuple(quantities), values[0], values[1:], frame_counts, recompute)

    @classmethod
    def from_strata(cls, strata: Sequence[tuple[float, "Estimate"]]) -> "Estimate":
        """The weighted mean of the same numbers of several strata, which are given and not drawn.

        Its variance is the sum of theirs, times the squares of the weights; that has as many degrees of freedom as
        Welch and Satterthwaite say. No stratum makes up for the blocks that another one lacks.

        Args:
            strata: Weights above 0 that sum to 1, and the numbers.

        Example:
            >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
            >>> m2, metres = torch.ones(16, dtype=torch.float64), torch.arange(16.0, dtype=torch.float64)[:, None]
            >>> low, high = (Estimate.from_ratios((radius,), m2, metres + more, m2) for more in (0.0, 10.0))
            >>> mean, = Estimate.from_strata([(0.5, low), (0.5, high)]).to_numbers().values()
            >>> bool(mean.value == 12.5), round(mean.error / low.error.item(), 3)
            (True, 0.707)
        """
        each = [one for _, one in strata]
        value = torch.stack([weight * one.value for weight, one in strata]).sum(dim=0)
        effective = torch.stack([one.effective_blocks for one in each]).amin(dim=0)
        steps, left_out = (
            torch.cat([one.frame_counts for one in each]),
            torch.cat([one.jackknife_values for one in each]),
        )
        return cls(each[0].quantities, value, left_out, steps, None, effective, tuple(strata))

    def __getitem__(self, which: slice) -> "Estimate":
        """Some of the numbers."""
        if self.strata:
            return Estimate.from_strata([(weight, one[which]) for weight, one in self.strata])
        again = None if self.recompute is None else partial(_some_again, self.recompute, which)
        some = (
            self.value[which],
            self.jackknife_values[:, which],
            self.frame_counts,
            again,
            self.effective_blocks[which],
        )
        return Estimate(self.quantities[which], *some)

    def truncate_blocks(self, num_blocks: int) -> "Estimate":
        """What it was after the first blocks alone."""
        again = self.recompute
        assert again is not None  # known of all that is a ratio of sums
        rest = len(self.frame_counts) - num_blocks
        return Estimate.from_blocks(
            self.quantities, lambda some: again(pad(some, (0, rest))), self.frame_counts[:num_blocks]
        )

    def resample(self, block_weights: Tensor) -> Tensor | None:
        """What the numbers were if other worlds had come, for intervals of what is made from numbers of several rigs.

        Args:
            block_weights: (R, g) how often each block comes, in each of R draws.

        Returns:
            (R, Q) float64; None if it is unknown.
        """
        return None if self.recompute is None else self.recompute(block_weights.to(self.value))

    @property
    def error(self) -> Tensor:
        """(Q,) standard errors; NaN if there are fewer than 8 blocks."""
        return self.compute_errors()

    def compute_errors(self, min_blocks: int = MIN_BLOCKS) -> Tensor:
        """(Q,) standard errors by the block jackknife.

        Args:
            min_blocks: Fewer blocks than these give none. Errors that are shown need 8; who only races rigs against each
                other is content with 3 worlds.
        """
        if self.strata:
            return (
                torch.stack([(weight * one.compute_errors(min_blocks)) ** 2 for weight, one in self.strata])
                .sum(dim=0)
                .sqrt()
            )
        return compute_jackknife_error(self.jackknife_values, self.value, self.frame_counts, min_blocks)

    @property
    def degrees_of_freedom(self) -> list[int]:
        """(Q,) degrees of freedom of the errors: the blocks less one, or in a mixture what they come to."""
        if not self.strata:
            return [len(self.frame_counts) - 1] * len(self.value)
        variances = torch.stack([(weight * one.error) ** 2 for weight, one in self.strata])
        most = torch.tensor([one.degrees_of_freedom for _, one in self.strata], device="cpu").to(variances)
        # As shares, as fourth powers of errors may vanish.
        found = 1 / ((variances / variances.sum(dim=0)) ** 2 / most).sum(dim=0)
        return [int(each + 1e-9) for each in found.where(found.isfinite(), most.amin(dim=0)).tolist()]

    @property
    def has_intervals(self) -> list[bool]:
        """Whether 8 blocks or more are in effect, of each number."""
        enough: list[bool] = (self.effective_blocks > MIN_BLOCKS - ROUND_OFF).tolist()
        return enough

    def to_numbers(self, *, count: int = 0, counted_items: str = "") -> dict[str, Number]:
        """The numbers by the keys of their quantities; of fewer than 8 blocks in effect without intervals.

        Args:
            count: How many they are over.
            counted_items: What these are.
        """
        # Blocks, in a mixture those of each stratum, that all say the same prove nothing.
        each = [one.error > ROUND_OFF for _, one in self.strata] or [self.error > ROUND_OFF]
        found, varies = {}, torch.stack(each).all(dim=0).tolist()
        errors = [error if known else math.nan for error, known in zip(self.error.tolist(), varies, strict=True)]
        numbers = self.quantities, self.value.tolist(), errors, self.has_intervals, self.degrees_of_freedom
        for quantity, value, error, has_interval, freedom in zip(*numbers, strict=True):
            ends = compute_interval95(value, error if has_interval else math.nan, freedom, quantity)
            found[quantity.key] = Number(quantity, value, error, *ends, count, counted_items)
        return found

    def subtract(self, baseline: "Estimate") -> "Estimate":
        """The difference to another rig over the same steps: what both share cancels out, block by block."""
        if self.strata:
            pairs = zip(self.strata, baseline.strata, strict=True)
            return Estimate.from_strata([(weight, one.subtract(against)) for (weight, one), (_, against) in pairs])
        both = self.value - baseline.value, self.jackknife_values - baseline.jackknife_values, self.frame_counts, None
        return Estimate(self.quantities, *both, torch.minimum(self.effective_blocks, baseline.effective_blocks))

    def compute_differences(self, baseline: "Estimate") -> dict[str, Difference]:
        """The differences to the same numbers of another rig over the same steps, by the keys of the quantities.

        What is from fewer than 8 blocks in effect has no interval, and is neither significant nor chance.
        """
        # Two infinite numbers are equal; their difference would be NaN, which means unknown.
        values = (self.value - baseline.value).where(self.value != baseline.value, 0.0)
        between, blocks = self.subtract(baseline), len(self.frame_counts)
        parts = [one for _, one in between.strata] or [between]
        each = torch.cat([compute_pseudo_values(one.jackknife_values, one.value, one.frame_counts) for one in parts])
        found = {}
        numbers = self.quantities, values.tolist(), between.error.tolist(), between.degrees_of_freedom
        for at, (quantity, value, error, freedom) in enumerate(zip(*numbers, strict=True)):
            judged = error if between.has_intervals[at] else math.nan
            low, high = compute_interval95(value, judged, freedom, quantity, is_difference=True)
            found[quantity.key] = Difference(
                quantity=quantity,
                value=value,
                error=error,
                low=low,
                high=high,
                is_significant=is_significant(value, judged, freedom),
                p_value=compute_student_p(value / judged, freedom) if judged > ROUND_OFF else math.nan,
                block_count=blocks,
                better_count=int((-each[:, at] if quantity.lower_is_better else each[:, at]).gt(ROUND_OFF).sum()),
            )
        return found


def _without_each(sums: Tensor) -> Tensor:
    """(g, ...) what all blocks but each add up to; not by a difference, which infinite radii would not survive."""
    none = sums.new_zeros((1, *sums.shape[1:]))
    before = torch.cat([none, sums])[:-1].cumsum(dim=0)
    after = torch.cat([sums, none])[1:].flip(0).cumsum(dim=0).flip(0)
    return before + after


def _ratios_again(base: Tensor, sums: Tensor, weights: Tensor) -> Tensor:
    return (weights @ sums) / (weights @ base.to(sums))


def _some_again(again: Callable[[Tensor], Tensor], which: slice, weights: Tensor) -> Tensor:
    return again(weights)[:, which]
