"""The numbers of one rig over several kinds of world, each with its share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from torchcover.coverage.averages import Average, estimate_redundancy
from torchcover.coverage.regions import Region, list_region_bands
from torchcover.coverage.result import Coverage
from torchcover.coverage.summary import RegionSummary, summarize_redundancy
from torchcover.coverage.target_sums import TargetMixture
from torchcover.estimation import Estimate

SAME = ("band_frame", "grid", "thresholds_m", "max_radius_m", "average", "regions")


class CoverageMixture:
    """What `Coverage` says of one kind of world, of a mixture of kinds; maps it has none.

    The kinds are given, not drawn: errors are about what happens by chance within each (`Estimate.mixed`).

    Args:
        scenario_names: What was measured in each kind of world, by its name, with its weight: above 0, and they sum to 1.

    Raises:
        ValueError: Two that were not asked about the same.
    """

    def __init__(self, scenario_coverages: Mapping[str, tuple[float, Coverage]]) -> None:
        self.scenario_names = tuple(scenario_coverages)
        self.weighted_coverages = tuple(scenario_coverages.values())
        (_, first), *others = self.weighted_coverages
        for what in SAME:
            if any(getattr(coverage, what) != getattr(first, what) for _, coverage in others):
                raise ValueError(f"kinds of world cannot be mixed: they differ in their {what}; ask about the same")
        self.grid, self.thresholds_m, self.max_radius_m = first.grid, first.thresholds_m, first.max_radius_m
        self.average, self.quantities, self.aggregated_numbers = (
            first.average,
            first.quantities,
            first.aggregated_numbers,
        )
        each = [(weight, part.target_sums) for weight, part in self.weighted_coverages if part.target_sums]
        if any(bodies.region_targets != each[0][1].region_targets for _, bodies in each) or 0 < len(each) < len(
            self.weighted_coverages
        ):
            raise ValueError("kinds of world cannot be mixed: other bodies were put beside the vehicle in one of them")
        self.target_sums = TargetMixture(each, each[0][1].region_targets) if each else None

    def estimate(self, region: Region, band: str, average: Average | None = None) -> Estimate:
        """As `Coverage.estimate`."""
        return Estimate.from_strata(
            [(weight, part.estimate(region, band, average)) for weight, part in self.weighted_coverages]
        )

    def estimate_aggregated(self, region: Region, band: str) -> Estimate:
        """As `Coverage.estimate_aggregated`."""
        return Estimate.from_strata(
            [(weight, part.estimate_aggregated(region, band)) for weight, part in self.weighted_coverages]
        )

    @property
    def counts(self) -> dict[str, int]:
        """As `Coverage.counts`, of all kinds together."""
        return {name: sum(part.counts[name] for _, part in self.weighted_coverages) for name in Coverage.COUNTS}

    def summary(self, regions: Sequence[Region]) -> list[RegionSummary]:
        """As `Coverage.summary`; of cells and square metres, means with the same weights, redundancy's too."""
        places = list_region_bands(regions, self.grid)
        rows = zip(*(part.summary(regions) for _, part in self.weighted_coverages), strict=True)
        return [self._row(place, row) for place, row in zip(places, rows, strict=True)]

    def _row(self, place: tuple[Region, str], rows: Sequence[RegionSummary]) -> RegionSummary:
        weights = [weight for weight, _ in self.weighted_coverages]
        observed_cells = round(sum(weight * row.observed_cells for weight, row in zip(weights, rows, strict=True)))
        estimates = self.estimate(*place), self.estimate_aggregated(*place), self.estimate(*place, "cells")
        numbers = [estimate.to_numbers(count=observed_cells, counted_items="known cells") for estimate in estimates]
        redundancy = None
        if sensors := rows[0].redundancy and tuple(rows[0].redundancy.failure_numbers):
            each = [(weight, estimate_redundancy(part, *place)) for weight, part in self.weighted_coverages]
            redundancy = summarize_redundancy(sensors, self.thresholds_m, Estimate.from_strata(each))
        return replace(
            rows[0],
            observed_cells=observed_cells,
            numbers=numbers[0] | numbers[1],
            cell_averages=numbers[2],
            visible_m2=sum(weight * row.visible_m2 for weight, row in zip(weights, rows, strict=True)),
            redundancy=redundancy,
        )
