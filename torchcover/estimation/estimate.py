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
    interval95,
    is_significant,
    jackknife_error,
    pseudo_values,
    student_p,
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
        count_of: What these are: "known cells", "objects", "voxels", ...
        parameters: What else it was computed with.
        warning: What makes it unfit for a comparison, in words.

    Example:
        >>> number = Number(Quantity("k_cover", "seen by two sensors", "share", lower_is_better=False), 0.25, count=12)
        >>> number.known, number.error
        (True, nan)
    """

    quantity: Quantity
    value: float
    error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    count: int = 0  # type: ignore[assignment]  # hides tuple.count
    count_of: str = ""
    parameters: Mapping[str, Any] = {}
    warning: str | None = None

    @property
    def known(self) -> bool:
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
        significant: Whether the difference is more than chance, by Student's t at 95 %; None if that is unknown.
        p: Probability of a t at least as large to either side if there were no difference.
        blocks: Blocks of contiguous steps, or worlds, that it comes from.
        better: In how many of them the rig is better than the other.
    """

    quantity: Quantity
    value: float
    error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    significant: bool | None = None
    p: float = math.nan
    blocks: int = 0
    better: int = 0

    @property
    def gain(self) -> float:
        """The difference with the sign turned so that more is better."""
        return self.quantity.gain(self.value)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Several numbers at once, with what they become without one block of steps, or one world, after the other.

    Args:
        quantities: What the Q numbers are.
        value: (Q,) float64 from all steps; NaN where unknown.
        left_out: (g, Q) without each block.
        steps: (g,) int64 steps in these blocks, each above 0.
        again: From (R, g) how often each block comes to (R, Q) what the numbers were then; None if that is unknown.
        effective: (Q,) how many blocks of equal weight would say as much: Kish's (sum of w)^2 / sum of w^2 over what is
            divided by in each. With fewer than 8 there is no interval. The number of blocks if not given.
        strata: Of a mixture, the weights, which sum to 1, and what is mixed; empty of all else.

    Example:
        >>> detection = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)
        >>> m2 = torch.full((8,), 10.0, dtype=torch.float64)
        >>> seen, more = (torch.arange(8.0, dtype=torch.float64)[:, None] + shift for shift in (0.0, 0.5))
        >>> one, other = (Estimate.of_ratios((detection,), m2, each, torch.ones(8)) for each in (seen, more))
        >>> number, = one.numbers().values()
        >>> round(number.value, 3), round(number.error, 3)
        (0.35, 0.087)
        >>> difference, = other.differences(one).values()
        >>> round(difference.value, 3), difference.blocks, difference.better
        (0.05, 8, 8)
        >>> one.resampled(torch.tensor([[1.0] * 8, [1.0] + [0.0] * 7]))
        tensor([[0.3500],
                [0.0000]], dtype=torch.float64)
    """

    quantities: tuple[Quantity, ...]
    value: Tensor
    left_out: Tensor
    steps: Tensor
    again: Callable[[Tensor], Tensor] | None = None
    effective: Tensor = None  # type: ignore[assignment]  # until the next line
    strata: tuple[tuple[float, "Estimate"], ...] = ()

    def __post_init__(self) -> None:
        if self.effective is None:
            object.__setattr__(self, "effective", torch.full_like(self.value, len(self.steps)))

    @classmethod
    def of(cls, quantities: Sequence[Quantity], value: Tensor) -> "Estimate":
        """Of numbers (Q,) that no block is known of, and so no error."""
        return cls(tuple(quantities), value, value.new_empty((0, len(value))), value.new_empty(0, dtype=torch.int64))

    @classmethod
    def of_ratios(cls, quantities: Sequence[Quantity], base: Tensor, sums: Tensor, steps: Tensor) -> "Estimate":
        """Ratios of sums in blocks, and what they become without each block.

        Args:
            quantities: What they are.
            base: (B,) what is divided by; or (B, Q), of each.
            sums: (B, Q) sums.
            steps: (B,) steps in each block; 0 in blocks that are not in use.
        """
        whole = sums.sum(dim=0) / base.sum(dim=0)
        used = steps.nonzero().flatten() if len(steps) > 1 else steps[:0]
        base, sums = (base if base.dim() == 2 else base[:, None])[used], sums[used]
        without = _without_each(sums) / _without_each(base)
        effective = (base.sum(dim=0) ** 2 / base.square().sum(dim=0)).expand(len(whole))
        return cls(tuple(quantities), whole, without, steps[used], partial(_ratios_again, base, sums), effective)

    @classmethod
    def of_blocks(cls, quantities: Sequence[Quantity], again: Callable[[Tensor], Tensor], steps: Tensor) -> "Estimate":
        """Of numbers that say for themselves what they become if blocks come more or less often.

        Args:
            quantities: What they are.
            again: As in `Estimate`; float64.
            steps: (g,) steps in each block, all above 0.
        """
        once = torch.ones(1, len(steps), dtype=torch.float64, device=steps.device)
        values = again(torch.cat([once, 1.0 - torch.diag(once[0])]))
        return cls(tuple(quantities), values[0], values[1:], steps, again)

    @classmethod
    def mixed(cls, strata: Sequence[tuple[float, "Estimate"]]) -> "Estimate":
        """The weighted mean of the same numbers of several strata, which are given and not drawn.

        Its variance is the sum of theirs, times the squares of the weights; that has as many degrees of freedom as
        Welch and Satterthwaite say. No stratum makes up for the blocks that another one lacks.

        Args:
            strata: Weights above 0 that sum to 1, and the numbers.

        Example:
            >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
            >>> m2, metres = torch.ones(16, dtype=torch.float64), torch.arange(16.0, dtype=torch.float64)[:, None]
            >>> low, high = (Estimate.of_ratios((radius,), m2, metres + more, m2) for more in (0.0, 10.0))
            >>> mean, = Estimate.mixed([(0.5, low), (0.5, high)]).numbers().values()
            >>> bool(mean.value == 12.5), round(mean.error / low.error.item(), 3)
            (True, 0.707)
        """
        each = [one for _, one in strata]
        value = torch.stack([weight * one.value for weight, one in strata]).sum(dim=0)
        effective = torch.stack([one.effective for one in each]).amin(dim=0)
        steps, left_out = torch.cat([one.steps for one in each]), torch.cat([one.left_out for one in each])
        return cls(each[0].quantities, value, left_out, steps, None, effective, tuple(strata))

    def __getitem__(self, which: slice) -> "Estimate":
        """Some of the numbers."""
        if self.strata:
            return Estimate.mixed([(weight, one[which]) for weight, one in self.strata])
        again = None if self.again is None else partial(_some_again, self.again, which)
        some = self.value[which], self.left_out[:, which], self.steps, again, self.effective[which]
        return Estimate(self.quantities[which], *some)

    def after(self, blocks: int) -> "Estimate":
        """What it was after the first blocks alone."""
        again = self.again
        assert again is not None  # known of all that is a ratio of sums
        rest = len(self.steps) - blocks
        return Estimate.of_blocks(self.quantities, lambda some: again(pad(some, (0, rest))), self.steps[:blocks])

    def resampled(self, weights: Tensor) -> Tensor | None:
        """What the numbers were if other worlds had come, for intervals of what is made from numbers of several rigs.

        Args:
            weights: (R, g) how often each block comes, in each of R draws.

        Returns:
            (R, Q) float64; None if it is unknown.
        """
        return None if self.again is None else self.again(weights.to(self.value))

    @property
    def error(self) -> Tensor:
        """(Q,) standard errors; NaN if there are fewer than 8 blocks."""
        return self.errors()

    def errors(self, least: int = MIN_BLOCKS) -> Tensor:
        """(Q,) standard errors by the block jackknife.

        Args:
            least: Fewer blocks than these give none. Errors that are shown need 8; who only races rigs against each
                other is content with 3 worlds.
        """
        if self.strata:
            return torch.stack([(weight * one.errors(least)) ** 2 for weight, one in self.strata]).sum(dim=0).sqrt()
        return jackknife_error(self.left_out, self.value, self.steps, least)

    @property
    def freedom(self) -> list[int]:
        """(Q,) degrees of freedom of the errors: the blocks less one, or in a mixture what they come to."""
        if not self.strata:
            return [len(self.steps) - 1] * len(self.value)
        variances = torch.stack([(weight * one.error) ** 2 for weight, one in self.strata])
        most = torch.tensor([one.freedom for _, one in self.strata], device="cpu").to(variances)
        # As shares, as fourth powers of errors may vanish.
        found = 1 / ((variances / variances.sum(dim=0)) ** 2 / most).sum(dim=0)
        return [int(each + 1e-9) for each in found.where(found.isfinite(), most.amin(dim=0)).tolist()]

    @property
    def has_intervals(self) -> list[bool]:
        """Whether 8 blocks or more are in effect, of each number."""
        enough: list[bool] = (self.effective > MIN_BLOCKS - ROUND_OFF).tolist()
        return enough

    def numbers(self, *, count: int = 0, count_of: str = "") -> dict[str, Number]:
        """The numbers by the keys of their quantities; of fewer than 8 blocks in effect without intervals.

        Args:
            count: How many they are over.
            count_of: What these are.
        """
        # Blocks, in a mixture those of each stratum, that all say the same prove nothing.
        each = [one.error > ROUND_OFF for _, one in self.strata] or [self.error > ROUND_OFF]
        found, varies = {}, torch.stack(each).all(dim=0).tolist()
        errors = [error if known else math.nan for error, known in zip(self.error.tolist(), varies, strict=True)]
        numbers = self.quantities, self.value.tolist(), errors, self.has_intervals, self.freedom
        for quantity, value, error, has_interval, freedom in zip(*numbers, strict=True):
            ends = interval95(value, error if has_interval else math.nan, freedom, quantity)
            found[quantity.key] = Number(quantity, value, error, *ends, count, count_of)
        return found

    def minus(self, other: "Estimate") -> "Estimate":
        """The difference to another rig over the same steps: what both share cancels out, block by block."""
        if self.strata:
            pairs = zip(self.strata, other.strata, strict=True)
            return Estimate.mixed([(weight, one.minus(against)) for (weight, one), (_, against) in pairs])
        both = self.value - other.value, self.left_out - other.left_out, self.steps, None
        return Estimate(self.quantities, *both, torch.minimum(self.effective, other.effective))

    def differences(self, other: "Estimate") -> dict[str, Difference]:
        """The differences to the same numbers of another rig over the same steps, by the keys of the quantities.

        What is from fewer than 8 blocks in effect has no interval, and is neither significant nor chance.
        """
        # Two infinite numbers are equal; their difference would be NaN, which means unknown.
        values = (self.value - other.value).where(self.value != other.value, 0.0)
        between, blocks = self.minus(other), len(self.steps)
        parts = [one for _, one in between.strata] or [between]
        each = torch.cat([pseudo_values(one.left_out, one.value, one.steps) for one in parts])
        found = {}
        numbers = self.quantities, values.tolist(), between.error.tolist(), between.freedom
        for at, (quantity, value, error, freedom) in enumerate(zip(*numbers, strict=True)):
            judged = error if between.has_intervals[at] else math.nan
            low, high = interval95(value, judged, freedom, quantity, is_difference=True)
            found[quantity.key] = Difference(
                quantity=quantity,
                value=value,
                error=error,
                low=low,
                high=high,
                significant=is_significant(value, judged, freedom),
                p=student_p(value / judged, freedom) if judged > ROUND_OFF else math.nan,
                blocks=blocks,
                better=int((-each[:, at] if quantity.lower_is_better else each[:, at]).gt(ROUND_OFF).sum()),
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
