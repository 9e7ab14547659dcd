"""Quantities, standard errors from blocks of contiguous frames (block jackknife), and 95 % confidence intervals."""

import math
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

# "m" for meters, "m2" for square meters, "sensors" for a count of sensors, "nats" for an entropy, ...; a "share" lies
# in [0, 1], and tables and maps show it in percent.
Unit: TypeAlias = str

# With fewer blocks, the error itself is off by more than a quarter: 1 / sqrt(2 (blocks - 1)).
MIN_BLOCKS = 8
# Smaller errors are rounding in sums of float64: the estimate does not depend on which block is left out.
ROUND_OFF = 1e-12
# Scenes in which a rig is nearly blind are rare and missing from most short runs: the true mean of a length lies on
# that side more often than on the other, and intervals reach farther there (docs/measured/accuracy.md).
BLIND_SIDE_FACTOR = 1.25


# A named tuple, because torchmetrics walks through the results of `compute` and refuses frozen dataclasses.
class Quantity(NamedTuple):
    """Meaning of a number, or of every cell of a map.

    Args:
        key: Name in files, dicts and loggers; the key of the standard error ends in `_error`.
        title: Name in tables and on maps, without the unit.
        unit: "m", "share" for a number in [0, 1], "sensors", "nats", ...
        lower_is_better: Direction of improvement, which all code reads here.

    Example:
        >>> Quantity("radius_m", "mean blind spot radius", "m", lower_is_better=True).compute_improvement(-0.1)
        0.1
    """

    key: str
    title: str
    unit: Unit
    lower_is_better: bool

    def compute_improvement(self, difference: float) -> float:
        """Return a difference of two values with the sign chosen so that positive is better.

        Args:
            difference: Value minus baseline, in the unit of the quantity.
        """
        return -difference if self.lower_is_better else difference


def estimate_blocks_needed(
    num_blocks: int, effective_blocks: float, *, min_effective_ratio: float = 1.25, margin: float = 1.1
) -> int:
    """Estimate how many blocks give confidence intervals, which need 8 effective blocks.

    Further blocks are assumed to be as unequal as those of the run.

    Args:
        num_blocks: Blocks of the run.
        effective_blocks: Number of equally weighted blocks with the same information; see `Estimate`.
        min_effective_ratio: Smallest ratio of blocks to effective blocks that fewer than 4 blocks are trusted with; the
            default was measured in streets of a city.
        margin: Factor on the expected number, since other blocks may be less equal.

    Example:
        >>> estimate_blocks_needed(4, 4.0), estimate_blocks_needed(4, 3.5), estimate_blocks_needed(1, 1.0)
        (9, 11, 11)
    """
    ratio = num_blocks / effective_blocks if effective_blocks > 0 else 1.0
    if num_blocks < 4:
        ratio = max(ratio, min_effective_ratio)
    return math.ceil(margin * MIN_BLOCKS * ratio)


def compute_jackknife_error(
    jackknife_values: Tensor, full_value: Tensor, frame_counts: Tensor, min_blocks: int = MIN_BLOCKS
) -> Tensor:
    """Compute the standard error of an estimate by the delete-m_j jackknife for blocks of unequal size.

    With h_j = n / m_j and the pseudo-values p_j = h_j full - (h_j - 1) jackknife_j (Busing, Meijer & van der Leeden
    1999, Statistics and Computing 9, 3-8):

        error^2 = 1/g sum_j (p_j - mean of the estimates)^2 / (h_j - 1).

    Args:
        jackknife_values: (g, ...) estimates without block j.
        full_value: (...) estimate from all blocks.
        frame_counts: (g,) frames m_j of each block, all above 0.
        min_blocks: Smallest number of blocks with an error; at least 2.

    Returns:
        (...) standard errors; NaN for too few blocks, and where an estimate is not finite.

    Example:
        >>> values = torch.arange(10.0, dtype=torch.float64)  # one frame per block: the standard error of a mean
        >>> jackknife_values = (values.sum() - values) / 9
        >>> error = compute_jackknife_error(jackknife_values, values.mean(), torch.ones(10))
        >>> torch.isclose(error, values.std() / 10**0.5)
        tensor(True)
    """
    blocks = len(frame_counts)
    if blocks < min_blocks:
        return torch.full_like(full_value, math.nan)
    ratio = (frame_counts.sum() / frame_counts.double()).view(-1, *[1] * full_value.dim())
    pseudo_values = compute_pseudo_values(jackknife_values, full_value, frame_counts)
    center = blocks * full_value - ((1 - 1 / ratio) * jackknife_values).sum(dim=0)
    error = (((pseudo_values - center) ** 2 / (ratio - 1)).mean(dim=0)).sqrt()
    return error.where(full_value.isfinite(), math.nan)


def compute_pseudo_values(jackknife_values: Tensor, full_value: Tensor, frame_counts: Tensor) -> Tensor:
    """Compute the pseudo-values p_j of the jackknife: the estimate of each block alone.

    Args:
        jackknife_values: As in `compute_jackknife_error`.
        full_value: As in `compute_jackknife_error`.
        frame_counts: As in `compute_jackknife_error`.

    Returns:
        (g, ...) pseudo-values.
    """
    ratio = (frame_counts.sum() / frame_counts.double()).view(-1, *[1] * full_value.dim())
    return ratio * full_value - (ratio - 1) * jackknife_values


def estimate_ratio_errors(denominators: Tensor, numerators: Tensor, unit: Unit) -> Tensor:
    """Estimate the standard error of a ratio of sums in each cell: of a mean over frames or over square meters.

    For R = S / A, sums over blocks of s_j and of a_j, the variance is to first order that of the sum of s_j - R a_j,
    divided by A^2 (Cochran 1977, Sampling Techniques, section 6.4).

    A few equal blocks do not prove that others would be equal. Therefore two pseudo-blocks are added, each with the
    mean a_j of the observed blocks: in one the rig detects the whole cell, in the other almost nothing, as Agresti &
    Coull (1998, The American Statistician 52, 119-126) add successes and failures. No error is 0.

    Args:
        denominators: (B, ...) a_j: frames that observed the cell in each block, or square meters observed in it.
        numerators: (B, ...) s_j.
        unit: "share" for pseudo-blocks with ratios 1 and 0; otherwise, for a length, their ratios are 0 and 5 R.

    Returns:
        (...) standard errors; NaN in cells that fewer than 8 blocks observed, and where the ratio is a radius of 0.

    Example:
        >>> m2 = torch.full((16,), 2.0, dtype=torch.float64)
        >>> half = torch.tensor([2.0, 0.0] * 8, dtype=torch.float64)
        >>> [round(float(estimate_ratio_errors(m2, sums, "share")), 3) for sums in (half, m2)]
        [0.121, 0.057]
    """
    denominators = denominators.double()
    observed_blocks = (denominators > 0).sum(dim=0)
    total = denominators.sum(dim=0).where(observed_blocks > 0, 1.0)
    ratio = numerators.sum(dim=0) / total
    pseudo_denominator = total / observed_blocks.clamp(min=1)
    pseudo_squares = ratio**2 + ((1 - ratio) ** 2 if unit == "share" else (5.0 * ratio - ratio) ** 2)
    squares = (numerators - ratio * denominators).square().sum(dim=0) + pseudo_denominator**2 * pseudo_squares
    variance = squares * (observed_blocks + 2) / (observed_blocks + 1) / (total + 2 * pseudo_denominator) ** 2
    is_known = (observed_blocks >= MIN_BLOCKS) & (variance > 0) & variance.isfinite()
    return variance.sqrt().where(is_known, math.nan)


class ErrorModel(NamedTuple):
    """Error of a number as a function of the number of frames: error^2 = bias^2 + error_coefficient / frames.

    Args:
        error_coefficient: Variance of the number times the number of frames; it includes differences between scenes.
        bias: Error that more frames do not reduce, for example of fewer rays, in the unit of the number.

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
        """Fit the model to the standard error of a run.

        Args:
            error: Standard error of the run; NaN if unknown.
            num_frames: Frames of the run.
            bias: As in the class.
        """
        return cls(error**2 * num_frames, bias)

    def estimate_error(self, num_frames: int) -> float:
        """Estimate the error after a number of frames.

        Args:
            num_frames: Frames, at least 1.
        """
        return math.sqrt(self.bias**2 + self.error_coefficient / num_frames)

    def estimate_num_frames(self, target_error: float) -> int | None:
        """Estimate the smallest number of frames that reaches a target error.

        Args:
            target_error: Largest acceptable error.

        Returns:
            Number of frames; None if the bias exceeds the target or the error is unknown.
        """
        target_variance = target_error**2 - self.bias**2
        if math.isnan(self.error_coefficient) or not target_variance > 0:
            return None
        # Without the tolerance, rounding would add a frame.
        return max(1, math.ceil(self.error_coefficient / target_variance * (1 - 1e-12)))


def compute_interval95(
    value: float, error: float, degrees_of_freedom: int, quantity: Quantity, *, is_difference: bool = False
) -> tuple[float, float]:
    """Compute the 95 % confidence interval of a number, or of a difference of two numbers.

    Intervals use Student's t: of a length on the scale of the logarithm and of a share on that of the logit, so that
    neither leaves its range; of any other unit, and of differences, value plus and minus t errors. Intervals of lengths
    reach 1.25 times as far towards scenes in which a rig is nearly blind: to the worse side, and of differences to the
    side away from 0.

    Args:
        value: In the unit of the quantity.
        error: Standard error of the value.
        degrees_of_freedom: Number of blocks minus one.
        quantity: Its unit determines the scale, its direction the worse side.
        is_difference: The value is a difference. The interval contains 0 exactly if Student's test is not significant.

    Returns:
        Lower and upper end; NaN if the error is NaN or 0, since equal blocks do not prove that others would be equal.

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
    unit = quantity.unit
    if math.isnan(error) or error <= ROUND_OFF or (unit == "m" and not is_difference and value <= 0):
        return math.nan, math.nan
    below = above = compute_student_t95(degrees_of_freedom) * error
    if unit == "m":
        is_blind_side_above = value > 0 if is_difference else quantity.lower_is_better
        if is_blind_side_above:
            above = BLIND_SIDE_FACTOR * above
        else:
            below = BLIND_SIDE_FACTOR * below
    if is_difference or unit not in ("m", "share"):
        return value - below, value + above
    max_exponent = 700.0  # exp of a larger number overflows float64
    if unit == "m":
        return value * math.exp(-below / value), value * math.exp(min(above / value, max_exponent))
    if not 0 < value < 1:  # 0 or 1 by rounding, so that the scale has no slope
        return 0.0, 1.0
    odds_against, slope = (1 - value) / value, value * (1 - value)
    low = 1 / (1 + odds_against * math.exp(min(below / slope, max_exponent)))
    return low, 1 / (1 + odds_against * math.exp(-above / slope))


def compute_student_t95(degrees_of_freedom: int) -> float:
    """Compute the absolute value that Student's t exceeds with probability 5 %.

    Args:
        degrees_of_freedom: 1 or more; NaN for fewer.

    Example:
        >>> [round(compute_student_t95(degrees), 3) for degrees in (2, 7, 15, 1000)]
        [4.303, 2.365, 2.131, 1.962]
    """
    from scipy.special import stdtrit  # the import takes 0.15 s, which only results with errors need

    return float(stdtrit(degrees_of_freedom, 0.975)) if degrees_of_freedom >= 1 else math.nan


def compute_student_p(t_statistic: float, degrees_of_freedom: int) -> float:
    """Compute the two-sided p-value of Student's t.

    Args:
        t_statistic: Value of t; NaN gives NaN.
        degrees_of_freedom: 1 or more.

    Example:
        >>> round(compute_student_p(2.131, 15), 3), round(compute_student_p(1.0, 1), 3)
        (0.05, 0.5)
    """
    from scipy.special import stdtr

    return float(2 * stdtr(degrees_of_freedom, -abs(t_statistic)))


def is_significant(difference: float, error: float, degrees_of_freedom: int) -> bool | None:
    """Test whether a difference is significant by Student's t at 95 %.

    Args:
        difference: Difference of two numbers.
        error: Its standard error.
        degrees_of_freedom: Number of blocks minus one.

    Returns:
        None if the error is NaN.
    """
    if math.isnan(error):
        return None
    return abs(difference) > max(compute_student_t95(degrees_of_freedom) * error, ROUND_OFF)
