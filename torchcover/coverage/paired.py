"""Comparisons are paired: rigs at the same instants, measured against the same reference."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch

from torchcover.coverage.errors import ROUND_OFF
from torchcover.coverage.intervals import student_t95
from torchcover.coverage.regions import Region
from torchcover.coverage.result import Coverage


def check_paired(coverages: Mapping[str, Coverage]) -> None:
    """Check that the coverages may be compared cell by cell.

    Args:
        coverages: By the name of the rig.

    Raises:
        ValueError: Fewer than two, or two that differ in the grid, the thresholds, the limit of the radius, the steps
            or the reference points of any cell, and so in the cells that they know.
    """
    if len(coverages) < 2:
        raise ValueError(f"a comparison needs at least two rigs; got {', '.join(coverages) or 'none'}")
    (first, expected), *others = coverages.items()
    for name, coverage in others:
        for what in ("grid", "thresholds", "max_radius"):
            if getattr(coverage, what) != getattr(expected, what):
                raise ValueError(f"{first!r} and {name!r} cannot be compared: they differ in their {what}")
        if coverage.measure != expected.measure or coverage.layers.keys() != expected.layers.keys():
            raise ValueError(f"{first!r} and {name!r} cannot be compared: they have different layers")
        if not _same_steps(coverage, expected):
            raise ValueError(
                f"{first!r} and {name!r} cannot be compared: they were measured against different reference points; "
                "evaluate both in one run"
            )


def _same_steps(a: Coverage, b: Coverage) -> bool:
    same = torch.equal(a.points, b.points) and a.counts["steps"] == b.counts["steps"]
    if a.blocks is None or b.blocks is None:
        return same and a.blocks is b.blocks
    return same and torch.equal(a.blocks.steps, b.blocks.steps)


class Difference(NamedTuple):
    """What a rig has more than the first one, in the same steps and against the same reference points.

    Args:
        value: Metres, or a share in [-1, 1]; NaN if unknown.
        error: Standard error of `value` itself, which is less than that of the two numbers: what makes a step easy or
            hard for both rigs cancels out. NaN if there are not enough blocks.
        significant: Whether the difference is more than chance, by Student's t at 95 %; None if that is unknown.
    """

    value: float
    error: float
    significant: bool | None


def differences(coverages: Mapping[str, Coverage], region: Region, height: str) -> dict[str, dict[str, Difference]]:
    """The differences of every rig, the first one too, to the first.

    Args:
        coverages: By the name of the rig, from the same frames.
        region: A region within the grid.
        height: Name of the band.

    Returns:
        Name of the rig -> key of the quantity -> difference.
    """
    estimates = {name: coverage.estimate(region, height) for name, coverage in coverages.items()}
    first, quantities = next(iter(estimates.values())), next(iter(coverages.values())).quantities
    found = {}
    for name, estimate in estimates.items():
        # Two infinite numbers are equal; their difference would be NaN, which means unknown.
        values = (estimate.value - first.value).where(estimate.value != first.value, 0.0)
        errors = estimate.minus(first).error
        freedom = len(estimate.steps) - 1
        found[name] = {
            quantity.key: Difference(value, error, is_significant(value, error, freedom))
            for quantity, value, error in zip(quantities, values.tolist(), errors.tolist(), strict=True)
        }
    return found


def is_significant(difference: float, error: float, degrees_of_freedom: int) -> bool | None:
    """Whether a difference is more than chance, by Student's t at 95 %.

    Args:
        difference: The difference.
        error: Its standard error; NaN if unknown.
        degrees_of_freedom: Blocks that the error comes from, less one.

    Returns:
        None if the error is unknown.

    Example:
        >>> is_significant(0.3, 0.1, 15), is_significant(0.2, 0.1, 15), is_significant(0.2, float("nan"), 3)
        (True, False, None)
    """
    if math.isnan(error):
        return None
    return abs(difference) > max(student_t95(degrees_of_freedom) * error, ROUND_OFF)
