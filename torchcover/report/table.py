"""Coverage table: numbers of regions, height bands and rigs as data, independent of its renderers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from torchcover.coverage import (
    BevGrid,
    Coverage,
    CoverageMixture,
    Region,
    RegionSummary,
    check_paired,
    compute_differences,
    list_region_bands,
)
from torchcover.coverage.averages import Average
from torchcover.coverage.paired import MeasuredRig, find_leaders
from torchcover.coverage.target_sums import TargetMixture, TargetSums
from torchcover.estimation import MIN_BLOCKS, ROUND_OFF, Difference, Quantity


@dataclass(frozen=True)
class Row:
    """Numbers of one rig in one region and height band.

    Args:
        rig: Name of the rig.
        region: The region.
        summary: Numbers by the key of their quantity, and number of observed cells.
        leading_keys: Keys of the quantities in which the rig leads by a significant difference to the next rig.
        differences: Key of the quantity -> difference to the first rig; empty without another rig.
    """

    rig: str
    region: Region
    summary: RegionSummary
    leading_keys: frozenset[str]
    differences: Mapping[str, Difference]


class Conditions(NamedTuple):
    """Conditions of the numbers of one rig.

    Args:
        counts: Counts of frames and points, as in `Coverage.counts`.
        blocks: Number of blocks of contiguous frames for standard errors; None without errors.
        frames_per_block: Maximum number of frames of a block; None without errors.
        point_count: Number of reference points in the grid.
        smallest_scene_kind: Scenario of a mixture that has too few blocks; else empty.
        effective_blocks: Smallest and largest effective number of blocks of the regions.
    """

    counts: Mapping[str, int]
    blocks: int | None
    frames_per_block: int | None
    point_count: int
    smallest_scene_kind: str = ""
    effective_blocks: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class CoverageTable:
    """Numbers of one rig, or of several rigs over the same frames.

    Args:
        quantities: Quantities of the rows: the means, then those of other aggregations.
        grid: Cells and height bands.
        thresholds_m: Detection thresholds in meters.
        max_radius_m: Maximum radius in meters.
        average: Average of the numbers: "area" over visible surface, "cells" over observed cells.
        rows: Name of the rig -> its rows, by region, then by band.
        conditions: Name of the rig -> conditions of its numbers.
        notes: Further conditions, in sentences of the caller.
        source: `vehicle`, and `sensor_model` by rig, as far as known.
        target_rows: Name of the rig -> its rows of test targets near the vehicle.
        block_ends: Numbers of frames after which each block of the source is complete, as far as known.
    """

    quantities: tuple[Quantity, ...]
    grid: BevGrid
    thresholds_m: tuple[float, ...]
    max_radius_m: float
    average: Average
    rows: Mapping[str, tuple[Row, ...]]
    conditions: Mapping[str, Conditions]
    notes: tuple[str, ...]
    source: Mapping[str, object] = field(default_factory=dict)
    target_rows: Mapping[str, tuple[Row, ...]] = field(default_factory=dict)
    block_ends: Sequence[int] = ()

    @classmethod
    def from_coverages(
        cls,
        coverages: Mapping[str, Coverage | CoverageMixture],
        regions: Sequence[Region],
        notes: Sequence[str] = (),
        source: Mapping[str, object] | None = None,
        block_ends: Sequence[int] = (),
        target_sums: Mapping[str, TargetSums | TargetMixture] | None = None,
    ) -> "CoverageTable":
        """Build the table of one rig, or of several rigs that were measured together.

        Args:
            coverages: Name of the rig -> result of `CoverageMetric.compute`, or a mixture of results.
            regions: Regions within the grid.
            notes: Further conditions of the numbers.
            source: Source of the numbers, see `CoverageTable`.
            block_ends: Ends of the blocks, see `CoverageTable`.
            target_sums: Name of the rig -> its visibility of test targets; by default there are none.

        Raises:
            ValueError: There is no rig, the rigs are not paired (`check_paired`), have different test targets, or
                `Coverage.summary` rejects a region.
        """
        if not coverages:
            raise ValueError("coverages: got none; give at least one rig")
        _check_same_targets(coverages, target_sums or {})
        scenario_coverages = [_split_mixture(coverage) for coverage in coverages.values()]
        for rigs_in_scenario in zip(*scenario_coverages, strict=True):
            if len(coverages) > 1:
                check_paired(dict(zip(coverages, rigs_in_scenario, strict=True)))
        first = next(iter(coverages.values()))
        summaries = {rig: coverage.summary(regions) for rig, coverage in coverages.items()}
        rows = _build_rows(coverages, list_region_bands(regions, first.grid), summaries)
        target_rows: list[dict[str, Row]] = []
        if target_sums:
            region_targets = next(iter(target_sums.values())).region_targets
            target_summaries = {rig: sums.summarize() for rig, sums in target_sums.items()}
            target_rows = _build_rows(target_sums, region_targets, target_summaries)
        return cls(
            quantities=(*first.quantities, *(first.aggregated_numbers.quantities if first.aggregated_numbers else ())),
            grid=first.grid,
            thresholds_m=first.thresholds_m,
            max_radius_m=first.max_radius_m,
            average=first.average,
            rows=_group_by_rig(rows, coverages),
            conditions={rig: _build_conditions(coverage, regions) for rig, coverage in coverages.items()},
            notes=tuple(notes),
            source=source or {},
            target_rows=_group_by_rig(target_rows, coverages),
            block_ends=block_ends,
        )

    @property
    def mean_quantities(self) -> tuple[Quantity, ...]:
        """Mean radius, then detection rate at each threshold."""
        return self.quantities[: 1 + len(self.thresholds_m)]

    @property
    def rigs(self) -> tuple[str, ...]:
        """Names of the rigs."""
        return tuple(self.rows)

    @property
    def first_conditions(self) -> Conditions:
        """Conditions of the first rig; all rigs have the same frames and blocks."""
        return self.conditions[self.rigs[0]]

    @property
    def has_intervals(self) -> bool:
        """True if some region has enough effective blocks for confidence intervals."""
        return self.first_conditions.effective_blocks[1] > MIN_BLOCKS - ROUND_OFF

    @property
    def rows_by_region(self) -> list[tuple[Row, ...]]:
        """Rows of each region and band, one for each rig."""
        return list(zip(*self.rows.values(), strict=True))

    @property
    def target_quantities(self) -> tuple[Quantity, ...]:
        """Quantities of each test target in each region."""
        for rows in self.target_rows.values():
            if rows:
                return tuple(number.quantity for number in rows[0].summary.numbers.values())
        return ()


def _check_same_targets(rigs: Iterable[str], target_sums: Mapping[str, TargetSums | TargetMixture]) -> None:
    """Raise ValueError unless all rigs were measured with the same test targets, or all without any."""
    first, *others = rigs
    for rig in others:
        targets = [target_sums[name].region_targets if name in target_sums else None for name in (first, rig)]
        if targets[0] != targets[1]:
            raise ValueError(
                f"{first!r} and {rig!r} cannot be compared: they were measured with different test targets"
            )


def _group_by_rig(rows: Sequence[Mapping[str, Row]], rigs: Iterable[str]) -> dict[str, tuple[Row, ...]]:
    """Group the rows of each region by rig."""
    rows_by_rig = {}
    for rig in rigs:
        rows_by_rig[rig] = tuple(row[rig] for row in rows)
    return rows_by_rig


def _build_rows(
    results: Mapping[str, MeasuredRig],
    region_bands: Sequence[tuple[Region, str]],
    summaries: Mapping[str, Sequence[RegionSummary]],
) -> list[dict[str, Row]]:
    """Build the rows of each region and band (or test target), by rig."""
    rows = []
    for (region, band), rig_summaries in zip(region_bands, zip(*summaries.values(), strict=True), strict=True):
        differences: dict[str, dict[str, Difference]] = {}
        if len(results) > 1:
            differences = compute_differences(results, region, band)
        leaders = find_leaders(results, region, band)
        row = {}
        for rig, summary in zip(results, rig_summaries, strict=True):
            leading_keys = frozenset(key for key in leaders if leaders[key] == rig)
            row[rig] = Row(rig, region, summary, leading_keys, differences.get(rig, {}))
        rows.append(row)
    return rows


def _split_mixture(coverage: Coverage | CoverageMixture) -> list[Coverage]:
    """Return the coverage of each scenario of a mixture, or the only coverage."""
    return [coverage] if isinstance(coverage, Coverage) else [part for _, part in coverage.weighted_coverages]


def _find_effective_blocks(
    coverage: Coverage | CoverageMixture, regions: Sequence[Region], num_blocks: int
) -> tuple[float, float]:
    """Find the smallest and largest effective number of blocks of observed regions; all blocks if there are none."""
    counts: list[float] = []
    for region, band in list_region_bands(regions, coverage.grid):
        effective_blocks = coverage.estimate(region, band).effective_blocks
        counts += [float(count) for count in effective_blocks if count > 0]
    return (min(counts), max(counts)) if counts else (float(num_blocks), float(num_blocks))


def _build_conditions(coverage: Coverage | CoverageMixture, regions: Sequence[Region]) -> Conditions:
    """Build the conditions of a rig; a mixture has too few blocks if any of its scenarios has too few."""
    used_blocks: list[int] = []
    longest_blocks: list[int] = []
    for part in _split_mixture(coverage):
        sums = part.block_sums and (part.region_sums or part.block_sums)  # by area the blocks of regions are shorter
        if sums:
            used_blocks.append(int((sums.frame_counts > 0).sum()))
            longest_blocks.append(int(sums.frame_counts.max()))
    counts = dict(coverage.counts)
    conditions = Conditions(counts, sum(used_blocks), max(longest_blocks, default=None), counts["inside_points"])
    if used_blocks:
        effective_blocks = _find_effective_blocks(coverage, regions, min(used_blocks))
        conditions = conditions._replace(effective_blocks=effective_blocks)
    if min(used_blocks, default=0) >= MIN_BLOCKS:
        return conditions
    smallest = ""
    if used_blocks and isinstance(coverage, CoverageMixture):
        smallest = coverage.scenario_names[used_blocks.index(min(used_blocks))]
    return conditions._replace(blocks=min(used_blocks, default=None), smallest_scene_kind=smallest)
