"""The table: regions, bands, quantities and rigs as data. How it is written down is the business of the renderers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from torchcover.coverage import (
    OF_BODIES,
    PARTS,
    BevGrid,
    Coverage,
    CoverageMixture,
    Region,
    RegionSummary,
    check_paired,
    compute_differences,
    list_region_bands,
)
from torchcover.coverage.measures import Average
from torchcover.coverage.paired import EstimatorGetters, find_leaders
from torchcover.estimation import MIN_BLOCKS, ROUND_OFF, Difference, Quantity


@dataclass(frozen=True)
class Row:
    """The numbers of one rig in one region and height band.

    Args:
        rig: Name of the rig.
        region: The region.
        summary: Its numbers by the key of their quantity, and how many of its cells are known.
        leading_keys: Keys of the quantities in which it leads here, and its lead over the next rig is more than chance.
        differences: Key of the quantity -> difference to the first rig; empty if there is no other rig.
    """

    rig: str
    region: Region
    summary: RegionSummary
    leading_keys: frozenset[str]
    differences: Mapping[str, Difference]


class Conditions(NamedTuple):
    """What the numbers of one rig hold under: what happened, as in `Coverage.counts`, and how many points there were.

    Errors come from so many blocks of contiguous steps, None without errors; of a mixture with too few, `smallest_scene_kind` is the
    kind of world that has the fewest. `effective_blocks` are the least and the most of `Estimate.effective` in its regions.
    """

    counts: Mapping[str, int]
    blocks: int | None
    frames_per_block: int | None
    point_count: int
    smallest_scene_kind: str = ""
    effective_blocks: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class CoverageTable:
    """What a run has found, for one rig or for several over the same frames.

    Args:
        quantities: What there is a number of: the means, then what other aggregations say.
        grid: Cells and height bands.
        thresholds_m: Detection thresholds in metres.
        max_radius_m: Saturation of the radius in metres.
        average: What the numbers of the rows are means over: "area", the visible surface, or "cells", the known cells.
        rows: Name of the rig -> its rows in the order of the regions, then of the bands.
        conditions: Name of the rig -> what its numbers hold under.
        notes: What else they hold under, in words of the caller.
        source: What carried the rigs, `vehicle`, and what sensors make of their hits, `sensor_model` by rig; if known.
        target_rows: Name of the rig -> its rows of bodies beside the vehicle, if any were put there.
        block_ends: Frames of the source after which one block after the other is complete, as far as is known.
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
    ) -> "CoverageTable":
        """Make the table of one rig, or of several that were measured together.

        Args:
            coverages: What `CoverageMetric.compute` returned, or mixtures of that, by the name of the rig.
            regions: Regions within the grid.
            notes: What else the numbers hold under.
            source: Where they come from; see above.
            block_ends: See above.

        Raises:
            ValueError: No rig; several that are not paired, as in `check_paired`; regions that `Coverage.summary`
                refuses.
        """
        if not coverages:
            raise ValueError("a table needs at least one rig; got none")
        for of_one_world in zip(*(_parts(coverage) for coverage in coverages.values()), strict=True):
            if len(coverages) > 1:
                check_paired(dict(zip(coverages, of_one_world, strict=True)))
        first = next(iter(coverages.values()))
        summaries = {rig: coverage.summary(regions) for rig, coverage in coverages.items()}
        rows = _rows(coverages, list_region_bands(regions, first.grid), summaries)
        bodies = []
        if first.target_sums:
            each = {
                rig: coverage.target_sums.summarize() for rig, coverage in coverages.items() if coverage.target_sums
            }
            bodies = _rows(coverages, first.target_sums.region_targets, each, OF_BODIES)
        return cls(
            quantities=(*first.quantities, *(first.aggregated_numbers.quantities if first.aggregated_numbers else ())),
            grid=first.grid,
            thresholds_m=first.thresholds_m,
            max_radius_m=first.max_radius_m,
            average=first.average,
            rows={rig: tuple(row[rig] for row in rows) for rig in coverages},
            conditions={rig: _conditions(coverage, regions) for rig, coverage in coverages.items()},
            notes=tuple(notes),
            source=source or {},
            target_rows={rig: tuple(row[rig] for row in bodies) for rig in coverages},
            block_ends=block_ends,
        )

    @property
    def mean_quantities(self) -> tuple[Quantity, ...]:
        """The mean radius, then the detection at each threshold."""
        return self.quantities[: 1 + len(self.thresholds_m)]

    @property
    def rigs(self) -> tuple[str, ...]:
        """Names of the rigs."""
        return tuple(self.rows)

    @property
    def first_conditions(self) -> Conditions:
        """The conditions of the first rig; steps and blocks are those of every rig."""
        return self.conditions[self.rigs[0]]

    @property
    def has_intervals(self) -> bool:
        """Whether enough blocks are in effect for intervals in any region."""
        return self.first_conditions.effective_blocks[1] > MIN_BLOCKS - ROUND_OFF

    @property
    def rows_by_region(self) -> list[tuple[Row, ...]]:
        """The rows of each region and band: one for each rig."""
        return list(zip(*self.rows.values(), strict=True))

    @property
    def target_quantities(self) -> tuple[Quantity, ...]:
        """What there is a number of for each body in each region."""
        row = next((row for rows in self.target_rows.values() for row in rows), None)
        return tuple(number.quantity for number in row.summary.numbers.values()) if row else ()


def _rows(
    coverages: Mapping[str, Coverage | CoverageMixture],
    places: Sequence[tuple[Region, str]],
    summaries: Mapping[str, Sequence[RegionSummary]],
    parts: EstimatorGetters = PARTS,
) -> list[dict[str, Row]]:
    several = len(coverages) > 1
    rows = []
    for (region, height), of_rigs in zip(places, zip(*summaries.values(), strict=True), strict=True):
        compared = compute_differences(coverages, region, height, parts) if several else {}
        best = find_leaders(coverages, region, height, parts)
        row = {}
        for rig, summary in zip(coverages, of_rigs, strict=True):
            marked = frozenset(key for key, leader in best.items() if leader == rig)
            row[rig] = Row(rig, region, summary, marked, compared.get(rig, {}))
        rows.append(row)
    return rows


def _parts(coverage: Coverage | CoverageMixture) -> list[Coverage]:
    return [coverage] if isinstance(coverage, Coverage) else [part for _, part in coverage.weighted_coverages]


def _effective(coverage: Coverage | CoverageMixture, regions: Sequence[Region], blocks: int) -> tuple[float, float]:
    """The least and the most effective blocks of regions that were seen; the blocks themselves if none was."""
    places = list_region_bands(regions, coverage.grid)
    each = [float(one) for place in places for one in coverage.estimate(*place).effective_blocks if one > 0]
    return (min(each), max(each)) if each else (float(blocks), float(blocks))


def _conditions(coverage: Coverage | CoverageMixture, regions: Sequence[Region]) -> Conditions:
    """Of a mixture those of all kinds of world, but too few blocks of any of them are too few."""
    each = [
        part.block_sums and (part.region_sums or part.block_sums) for part in _parts(coverage)
    ]  # by area they are the fine ones
    used = [int((blocks.frame_counts > 0).sum()) for blocks in each if blocks]
    longest = [int(blocks.frame_counts.max()) for blocks in each if blocks]
    found = Conditions(dict(coverage.counts), sum(used), max(longest, default=None), coverage.counts["inside_points"])
    if used:
        found = found._replace(effective_blocks=_effective(coverage, regions, min(used)))
    if min(used, default=0) >= MIN_BLOCKS:
        return found
    fewest = coverage.scenario_names[used.index(min(used))] if used and isinstance(coverage, CoverageMixture) else ""
    return found._replace(blocks=min(used, default=None), smallest_scene_kind=fewest)
