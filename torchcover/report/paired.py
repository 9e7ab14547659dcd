"""Comparisons are paired: rigs at the same instants, measured against the same reference."""

from collections.abc import Mapping

import torch

from torchcover.coverage import Coverage


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
        for what in ("grid", "thresholds", "max_radius", "quantile_levels"):
            if getattr(coverage, what) != getattr(expected, what):
                raise ValueError(f"{first!r} and {name!r} cannot be compared: they differ in their {what}")
        same_points = torch.equal(coverage.points, expected.points)
        if not same_points or coverage.counts["steps"] != expected.counts["steps"]:
            raise ValueError(
                f"{first!r} and {name!r} cannot be compared: they were measured against different reference points; "
                "evaluate both in one run"
            )
