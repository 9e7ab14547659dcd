"""Comparisons are paired: rigs at the same instants, measured against the same reference."""

import math
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import TypeAlias

import torch

from torchcover.coverage.mixture import CoverageMixture
from torchcover.coverage.regions import Region
from torchcover.coverage.result import Coverage
from torchcover.estimation import Difference, Estimate

EstimatorGetters: TypeAlias = tuple[Callable[[Coverage | CoverageMixture], Callable[[Region, str], Estimate]], ...]

# What there is an estimate of, in each region and band, and in each region of each body.
PARTS = attrgetter("estimate"), attrgetter("estimate_aggregated")
OF_BODIES = (attrgetter("target_sums.estimate"),)


def check_paired(coverages: Mapping[str, Coverage]) -> None:
    """Check that the coverages, by the names of their rigs, may be compared cell by cell.

    Raises:
        ValueError: Fewer than two, or two that differ in the grid, its band frame, the thresholds, the limit of the
            radius, the steps or the reference points of any cell, and so in the cells that they know.
    """
    if len(coverages) < 2:
        raise ValueError(f"a comparison needs at least two rigs; got {', '.join(coverages) or 'none'}")
    (first, expected), *others = coverages.items()
    for name, coverage in others:
        for what in ("band_frame", "grid", "thresholds_m", "max_radius_m"):
            if getattr(coverage, what) != getattr(expected, what):
                raise ValueError(f"{first!r} and {name!r} cannot be compared: they differ in their {what}")
        if (coverage.target_sums and coverage.target_sums.region_targets) != (
            expected.target_sums and expected.target_sums.region_targets
        ):
            raise ValueError(f"{first!r} and {name!r} cannot be compared: other bodies were put beside them")
        if coverage.average != expected.average or coverage.layers.keys() != expected.layers.keys():
            raise ValueError(f"{first!r} and {name!r} cannot be compared: they have different layers")
        if not _same_steps(coverage, expected):
            raise ValueError(
                f"{first!r} and {name!r} cannot be compared: they were measured against different reference points; "
                "evaluate both in one run; of one rig on two vehicles, give it what only one vehicle has as `bodies`"
            )


def _same_steps(a: Coverage, b: Coverage) -> bool:
    same = torch.equal(a.observed_cells.cell_indices, b.observed_cells.cell_indices) and torch.equal(
        a.observed_cells.point_counts, b.observed_cells.point_counts
    )
    same = same and a.counts["num_frames"] == b.counts["num_frames"]
    if a.block_sums is None or b.block_sums is None:
        return same and a.block_sums is b.block_sums
    return same and torch.equal(a.block_sums.frame_counts, b.block_sums.frame_counts)


def compute_differences(
    coverages: Mapping[str, Coverage | CoverageMixture],
    region: Region,
    band: str,
    estimator_getters: EstimatorGetters = PARTS,
) -> dict[str, dict[str, Difference]]:
    """The differences of every rig, the first one too, to the first.

    Args:
        coverages: By the name of the rig, from the same frames.
        region: A region within the grid.
        band: Name of the band, or of a body.
        estimator_getters: What there is an estimate of there.

    Returns:
        Name of the rig -> key of the quantity -> difference.
    """
    first = next(iter(coverages.values()))
    found: dict[str, dict[str, Difference]] = {name: {} for name in coverages}
    for part in estimator_getters:
        expected = part(first)(region, band)
        for name, coverage in coverages.items():
            found[name] |= part(coverage)(region, band).compute_differences(expected)
    return found


def find_leaders(
    coverages: Mapping[str, Coverage | CoverageMixture],
    region: Region,
    band: str,
    estimator_getters: EstimatorGetters = PARTS,
) -> dict[str, str]:
    """Key of a quantity -> the rig that is best in it, where its lead over the next is more than chance."""
    found = {}
    for part in estimator_getters:
        each = {rig: part(coverage)(region, band) for rig, coverage in coverages.items()}
        for at, quantity in enumerate(next(iter(each.values())).quantities):
            gains = {rig: quantity.compute_improvement(float(estimate.value[at])) for rig, estimate in each.items()}
            ranked = sorted((rig for rig in gains if not math.isnan(gains[rig])), key=gains.__getitem__)
            if len(ranked) > 1:
                best, following = (each[rig][at : at + 1] for rig in (ranked[-1], ranked[-2]))
                if best.compute_differences(following)[quantity.key].is_significant:
                    found[quantity.key] = ranked[-1]
    return found
