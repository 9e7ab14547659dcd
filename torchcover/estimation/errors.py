"""What a number is, its standard error from blocks of contiguous steps (the block jackknife) and its 95 % interval."""

import math
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

# "m" is metres, "m2" their squares, "sensors" a number of them, "nats" an entropy, ...; a "share" lies in [0, 1], and
# tables and maps show it in percent.
Unit: TypeAlias = str


# No dataclass, as no part of a `Number` is: torchmetrics goes through what `compute` gives, and refuses frozen ones.
class Quantity(NamedTuple):
    """What a number, or every cell of a map, is.

    Args:
        key: Its name in files, dicts and loggers; with `_error` behind it, that of its standard error.
        title: What tables and maps call it, without its unit.
        unit: "m", "share" for a number in [0, 1], "sensors", "nats", ...
        lower_is_better: Whether less of it is better. Nothing else decides the direction of a number.

    Example:
        >>> Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True).compute_improvement(-0.1)
        0.1
    """

    key: str
    title: str
    unit: Unit
    lower_is_better: bool

    def compute_improvement(self, difference: float) -> float:
        """A difference of two of them with the sign turned so that more is better."""
        return -difference if self.lower_is_better else difference


# With fewer, the error itself is off by more than a quarter: 1 / sqrt(2 (blocks - 1)).
MIN_BLOCKS = 8
# Errors below come from rounding in sums of float64: the estimate is the same whichever block is left out.
ROUND_OFF = 1e-12
# A cell has an error if it was probed in at least as many blocks.
MIN_BLOCKS_OF_A_CELL = 8
# The radius of a cell in a block that was not seen, over its mean radius in those that were.
IMAGINED_RADIUS = 5.0


def estimate_blocks_needed(
    num_blocks: int, effective_blocks: float, *, min_effective_ratio: float = 1.25, margin: float = 1.1
) -> int:
    """How many blocks give intervals, which need 8 effective ones, if further blocks are as unequal as those of a run.

    Args:
        num_blocks: Blocks of the run.
        effective_blocks: How many blocks of equal weight would say as much; see `Estimate.effective`.
        min_effective_ratio: Least ratio of the two where fewer than 4 blocks show it; that of a city's streets.
        margin: Factor by which the advice exceeds the expected number: it has to hold for other blocks, too.

    Example:
        >>> estimate_blocks_needed(4, 4.0), estimate_blocks_needed(4, 3.5), estimate_blocks_needed(1, 1.0)
        (9, 11, 11)
    """
    ratio = num_blocks / effective_blocks if effective_blocks > 0 else 1.0
    return math.ceil(margin * MIN_BLOCKS * (max(ratio, min_effective_ratio) if num_blocks < 4 else ratio))


def compute_jackknife_error(
    jackknife_values: Tensor, full_value: Tensor, frame_counts: Tensor, min_blocks: int = MIN_BLOCKS
) -> Tensor:
    """Standard error of an estimate from what it becomes as one block after the other is left out.

    The delete-m_j jackknife for blocks of unequal size (Busing, Meijer & van der Leeden 1999, Statistics and Computing
    9, 3-8): with h_j = n / m_j and the pseudo-values p_j = h_j whole - (h_j - 1) left_out_j,

        error^2 = 1/g sum_j (p_j - mean of the estimates)^2 / (h_j - 1).

    Args:
        jackknife_values: (g, ...) estimates without block j.
        full_value: (...) estimate from all blocks.
        frame_counts: (g,) steps m_j of each block, all above 0.
        min_blocks: Fewer blocks than these give no error; 2 at least.

    Returns:
        (...) standard errors; NaN for too few blocks, and where an estimate is not finite.

    Example:
        >>> values = torch.arange(10.0, dtype=torch.float64)           # one step a block: the error of a mean
        >>> left_out = (values.sum() - values) / 9
        >>> error = compute_jackknife_error(left_out, values.mean(), torch.ones(10))
        >>> torch.isclose(error, values.std() / 10**0.5)
        tensor(True)
    """
    blocks = len(frame_counts)
    if blocks < min_blocks:
        return torch.full_like(full_value, math.nan)
    ratio = (frame_counts.sum() / frame_counts.double()).view(-1, *[1] * full_value.dim())
    pseudo = compute_pseudo_values(jackknife_values, full_value, frame_counts)
    centre = blocks * full_value - ((1 - 1 / ratio) * jackknife_values).sum(dim=0)
    error = (((pseudo - centre) ** 2 / (ratio - 1)).mean(dim=0)).sqrt()
    return error.where(full_value.isfinite(), math.nan)


def compute_pseudo_values(jackknife_values: Tensor, full_value: Tensor, frame_counts: Tensor) -> Tensor:
    """(g, ...) the p_j of `compute_jackknife_error`: what each block says by itself, had it been as long as all of them."""
    ratio = (frame_counts.sum() / frame_counts.double()).view(-1, *[1] * full_value.dim())
    return ratio * full_value - (ratio - 1) * jackknife_values


def estimate_ratio_errors(denominators: Tensor, numerators: Tensor, unit: Unit) -> Tensor:
    """Standard error of a ratio of sums in each cell: of a mean over steps, or over square metres.

    For R = S / A, sums over blocks of s_j and of a_j, the variance is to first order that of the sum of s_j - R a_j,
    divided by A^2 (Cochran 1977, Sampling Techniques, section 6.4).

    A few blocks that all say the same do not prove that others would. Therefore two more are imagined, each with as
    much of A as the others have on average: in one the rig sees all of the cell, in the other next to nothing of it,
    as Agresti & Coull (1998, The American Statistician 52, 119-126) add successes and failures. No error is 0.

    Args:
        denominators: (B, ...) the a_j: steps that probed the cell in each block, or square metres that were seen in it.
        numerators: (B, ...) the s_j.
        unit: "share", so that the imagined ratios are 1 and 0; or "m": 0 and five times R.

    Returns:
        (...) standard errors; NaN in cells that fewer than 8 blocks know, or that nothing is known of but a radius
        of 0.

    Example:
        >>> m2 = torch.full((16,), 2.0, dtype=torch.float64)
        >>> half = torch.tensor([2.0, 0.0] * 8, dtype=torch.float64)
        >>> [round(float(estimate_ratio_errors(m2, sums, "share")), 3) for sums in (half, m2)]
        [0.121, 0.057]
    """
    denominators = denominators.double()
    known = (denominators > 0).sum(dim=0)
    whole = denominators.sum(dim=0).where(known > 0, 1.0)
    ratio = numerators.sum(dim=0) / whole
    imagined = whole / known.clamp(min=1)
    seen_or_not = ratio**2 + (1 - ratio) ** 2 if unit == "share" else ratio**2 + (IMAGINED_RADIUS * ratio - ratio) ** 2
    squares = (numerators - ratio * denominators).square().sum(dim=0) + imagined**2 * seen_or_not
    variance = squares * (known + 2) / (known + 1) / (whole + 2 * imagined) ** 2
    return variance.sqrt().where((known >= MIN_BLOCKS_OF_A_CELL) & (variance > 0) & variance.isfinite(), math.nan)


class ErrorModel(NamedTuple):
    """The error of a number after some steps: error^2 = bias^2 + a / steps.

    Args:
        error_coefficient: Variance of the number times the steps that it comes from, as worlds differ within and among each other.
        bias: What is left after any number of steps: by how much the setting is off, such as fewer rays.

    Example:
        >>> model = ErrorModel.from_error(error=0.02, num_frames=64)
        >>> model.estimate_error(256), model.estimate_num_frames(0.01)
        (0.01, 256)
        >>> ErrorModel(error_coefficient=1.0, bias=0.1).estimate_num_frames(0.1) is None
        True
    """

    error_coefficient: float
    bias: float = 0.0

    @classmethod
    def from_error(cls, error: float, num_frames: int, bias: float = 0.0) -> "ErrorModel":
        """From the standard error of a run; of an unknown error nothing is known."""
        return cls(error**2 * num_frames, bias)

    def estimate_error(self, num_frames: int) -> float:
        """The error after so many steps."""
        return math.sqrt(self.bias**2 + self.error_coefficient / num_frames)

    def estimate_num_frames(self, target_error: float) -> int | None:
        """The fewest steps after which it is at most this; None if there are none, or that is unknown."""
        room = target_error**2 - self.bias**2
        if math.isnan(self.error_coefficient) or not room > 0:
            return None
        return max(1, math.ceil(self.error_coefficient / room * (1 - 1e-12)))  # which rounding would make one more


# Scenes in which a rig is all but blind are rare and missing from most short runs, so that the true mean of a length
# lies on that side more often than on the other (docs/measured/accuracy.md).
BLIND_SIDE = 1.25
# exp of more is no float64.
MOST = 700.0


def compute_interval95(
    value: float, error: float, degrees_of_freedom: int, quantity: Quantity, *, is_difference: bool = False
) -> tuple[float, float]:
    """The 95 % interval around a number, or around a difference of two.

    With Student's t: of a length on the scale of the logarithm, of a share on that of the logit, so that neither leaves
    its range; of any other unit, and of differences, value plus and minus t errors. Of lengths 1.25 times as far on the
    side of scenes in which a rig is all but blind: the worse one, of differences that away from 0.

    Args:
        value: In the unit of the quantity.
        error: Its standard error.
        degrees_of_freedom: Blocks that the error comes from, less one.
        quantity: Its unit decides the scale, its direction the worse side.
        is_difference: Of two such numbers. The interval holds 0 just where Student's test finds nothing.

    Returns:
        Its ends; NaN if the error is, or 0: blocks that all say the same do not prove that others would.

    Example:
        >>> radius = Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True)
        >>> detection = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)
        >>> [round(end, 3) for end in compute_interval95(2.0, 0.1, 10, radius)]
        [1.789, 2.299]
        >>> [round(end, 3) for end in compute_interval95(0.9, 0.02, 10, detection)]
        [0.846, 0.937]
        >>> [round(end, 3) for end in compute_interval95(-0.3, 0.1, 10, radius, is_difference=True)]
        [-0.579, -0.077]
    """
    t, unit = compute_student_t95(degrees_of_freedom), quantity.unit
    if math.isnan(error) or error <= ROUND_OFF or (unit == "m" and not is_difference and value <= 0):
        return math.nan, math.nan
    below = above = t * error
    if unit == "m":
        farther_above = value > 0 if is_difference else quantity.lower_is_better
        below, above = (below, BLIND_SIDE * above) if farther_above else (BLIND_SIDE * below, above)
    if is_difference or unit not in ("m", "share"):
        return value - below, value + above
    if unit == "m":
        return value * math.exp(-below / value), value * math.exp(min(above / value, MOST))
    if not 0 < value < 1:  # rounding may have put it there; nothing is known of the other side
        return 0.0, 1.0
    against, slope = (1 - value) / value, value * (1 - value)
    return 1 / (1 + against * math.exp(min(below / slope, MOST))), 1 / (1 + against * math.exp(-above / slope))


def compute_student_t95(degrees_of_freedom: int) -> float:
    """Return the t that Student's distribution exceeds to either side with 5 %.

    Args:
        degrees_of_freedom: 1 or more; NaN for fewer.

    Example:
        >>> round(compute_student_t95(2), 3), round(compute_student_t95(7), 3), round(compute_student_t95(15), 3), round(compute_student_t95(1000), 3)
        (4.303, 2.365, 2.131, 1.962)
    """
    from scipy.special import stdtrit  # 0.15 s, which only results with errors need

    return float(stdtrit(degrees_of_freedom, 0.975)) if degrees_of_freedom >= 1 else math.nan


def compute_student_p(t_statistic: float, degrees_of_freedom: int) -> float:
    """Return the probability that Student's t lies farther from 0 than some value, to either side.

    Args:
        t_statistic: The value; NaN gives NaN.
        degrees_of_freedom: 1 or more.

    Example:
        >>> round(compute_student_p(2.131, 15), 3), round(compute_student_p(1.0, 1), 3)
        (0.05, 0.5)
    """
    from scipy.special import stdtr

    return float(2 * stdtr(degrees_of_freedom, -abs(t_statistic)))


def is_significant(difference: float, error: float, degrees_of_freedom: int) -> bool | None:
    """Whether a difference is more than chance, by Student's t at 95 %; None if its standard error is NaN."""
    if math.isnan(error):
        return None
    return abs(difference) > max(compute_student_t95(degrees_of_freedom) * error, ROUND_OFF)
