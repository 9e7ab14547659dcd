"""Paired comparisons: rigs at the same frames, measured against the same reference points."""

import math
from collections.abc import Mapping

import torch

from torchcover.coverage.mixture import CoverageMixture
from torchcover.coverage.regions import Region
from torchcover.coverage.result import Coverage
from torchcover.coverage.target_sums import TargetMixture, TargetSums
from torchcover.estimation import Difference, Estimate

# Results of one rig that are compared with the results of other rigs.
MeasuredRig = Coverage | CoverageMixture | TargetSums | TargetMixture


def check_paired(coverages: Mapping[str, Coverage]) -> None:
    """Check that coverages may be compared cell by cell.

    Args:
        coverages: Results by the name of the rig.

    Raises:
        ValueError: There are fewer than two, or two differ in grid, band frame, thresholds, maximum radius, frames,
            or reference points of any cell.
    """
    if len(coverages) < 2:
        raise ValueError(f"a comparison needs at least two rigs; got {', '.join(coverages) or 'none'}")
    (first, expected), *others = coverages.items()
    for name, coverage in others:
        subject = f"{first!r} and {name!r} cannot be compared"
        for attribute in ("band_frame", "grid", "thresholds_m", "max_radius_m"):
            if getattr(coverage, attribute) != getattr(expected, attribute):
                raise ValueError(f"{subject}: they differ in their {attribute}")
        if coverage.average != expected.average or coverage.layers.keys() != expected.layers.keys():
            raise ValueError(f"{subject}: they have different layers")
        if not _has_same_points(coverage, expected):
            raise ValueError(
                f"{subject}: they were measured against different reference points; evaluate both in one run; for one "
                "rig on two vehicles, put the parts of a single vehicle into its `bodies`"
            )


def _has_same_points(a: Coverage, b: Coverage) -> bool:
    """Return whether two results have equal frames and reference points in every cell and block."""
    has_same_cells = torch.equal(a.observed_cells.cell_indices, b.observed_cells.cell_indices)
    has_same_counts = torch.equal(a.observed_cells.point_counts, b.observed_cells.point_counts)
    if not (has_same_cells and has_same_counts and a.counts["num_frames"] == b.counts["num_frames"]):
        return False
    if a.block_sums is None or b.block_sums is None:
        return a.block_sums is b.block_sums
    return torch.equal(a.block_sums.frame_counts, b.block_sums.frame_counts)


def _list_estimates(result: MeasuredRig, region: Region, band: str) -> list[Estimate]:
    """List the estimates of a region in a band, or of a test target in a region."""
    if isinstance(result, Coverage | CoverageMixture):
        return [result.estimate(region, band), result.estimate_aggregated(region, band)]
    return [result.estimate(region, band)]


def compute_differences(
    results: Mapping[str, MeasuredRig], region: Region, band: str
) -> dict[str, dict[str, Difference]]:
    """Compute the difference of every rig, including the first, to the first.

    Args:
        results: Coverages or sums of test targets by the name of the rig, from the same frames.
        region: Region within the grid.
        band: Name of a height band; for sums of test targets, the name of a target.

    Returns:
        For each rig, the differences by the key of their quantity.
    """
    baselines = _list_estimates(next(iter(results.values())), region, band)
    differences: dict[str, dict[str, Difference]] = {}
    for name, result in results.items():
        differences[name] = {}
        estimates = _list_estimates(result, region, band)
        for estimate, baseline in zip(estimates, baselines, strict=True):
            differences[name] |= estimate.compute_differences(baseline)
    return differences


def find_leaders(results: Mapping[str, MeasuredRig], region: Region, band: str) -> dict[str, str]:
    """Find the best rig of each quantity, where its difference to the second is significant.

    Args:
        results: As in `compute_differences`.
        region: As in `compute_differences`.
        band: As in `compute_differences`.

    Returns:
        Name of the rig by the key of the quantity; quantities without a significant leader are missing.
    """
    estimates = [_list_estimates(result, region, band) for result in results.values()]
    leaders = {}
    for rig_estimates in zip(*estimates, strict=True):
        estimate_by_rig = dict(zip(results, rig_estimates, strict=True))
        for index, quantity in enumerate(rig_estimates[0].quantities):
            scores = {}
            for rig, estimate in estimate_by_rig.items():
                score = quantity.compute_improvement(float(estimate.value[index]))
                if not math.isnan(score):
                    scores[rig] = score
            if len(scores) > 1:
                second, best = sorted(scores, key=scores.__getitem__)[-2:]
                best_estimate = estimate_by_rig[best][index : index + 1]
                differences = best_estimate.compute_differences(estimate_by_rig[second][index : index + 1])
                if differences[quantity.key].is_significant:
                    leaders[quantity.key] = best
    return leaders
