"""Coverage of one rig over several scenarios with weights."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from torchcover.coverage.regions import Region, list_region_bands
from torchcover.coverage.result import Coverage
from torchcover.coverage.summary import RegionSummary, convert_to_cell_numbers, summarize_redundancy
from torchcover.estimation import Estimate


class CoverageMixture:
    """Numbers of `Coverage` as weighted means over scenarios; a mixture has no maps.

    The scenarios are fixed, not sampled: errors describe the random variation within each (`Estimate.from_strata`).

    Args:
        scenario_coverages: Weight and result by the name of the scenario; weights are above 0 and sum to 1.

    Raises:
        ValueError: Two results differ in grid, thresholds, average or regions.
    """

    def __init__(self, scenario_coverages: Mapping[str, tuple[float, Coverage]]) -> None:
        self.scenario_names = tuple(scenario_coverages)
        self.weighted_coverages = tuple(scenario_coverages.values())
        (_, first), *others = self.weighted_coverages
        for attribute in ("band_frame", "grid", "thresholds_m", "max_radius_m", "average", "regions"):
            if any(getattr(coverage, attribute) != getattr(first, attribute) for _, coverage in others):
                raise ValueError(f"scenarios cannot be mixed: they differ in their {attribute}; use the same in all")
        self.grid, self.thresholds_m, self.max_radius_m = first.grid, first.thresholds_m, first.max_radius_m
        self.average, self.quantities = first.average, first.quantities
        self.aggregated_numbers = first.aggregated_numbers

    def _mix(self, estimate: Callable[[Coverage], Estimate]) -> Estimate:
        """Combine the estimates of all scenarios."""
        return Estimate.from_strata([(weight, estimate(coverage)) for weight, coverage in self.weighted_coverages])

    def estimate(self, region: Region, band: str) -> Estimate:
        """Estimate the weighted mean of `Coverage.estimate`.

        Args:
            region: As in `Coverage.estimate`.
            band: As in `Coverage.estimate`.
        """
        return self._mix(lambda coverage: coverage.estimate(region, band))

    def estimate_aggregated(self, region: Region, band: str) -> Estimate:
        """Estimate the weighted mean of `Coverage.estimate_aggregated`.

        Args:
            region: As in `Coverage.estimate_aggregated`.
            band: As in `Coverage.estimate_aggregated`.
        """
        return self._mix(lambda coverage: coverage.estimate_aggregated(region, band))

    @property
    def counts(self) -> dict[str, int]:
        """Sum of `Coverage.counts` over all scenarios."""
        return {name: sum(coverage.counts[name] for _, coverage in self.weighted_coverages) for name in Coverage.COUNTS}

    def summary(self, regions: Sequence[Region]) -> list[RegionSummary]:
        """Summarize regions as `Coverage.summary`; cell counts, areas and redundancy are weighted means, too.

        Args:
            regions: Regions within the grid.
        """
        region_bands = list_region_bands(regions, self.grid)
        rows = zip(*(coverage.summary(regions) for _, coverage in self.weighted_coverages), strict=True)
        return [self._mix_rows(*region_band, row) for region_band, row in zip(region_bands, rows, strict=True)]

    def _mix_rows(self, region: Region, band: str, rows: Sequence[RegionSummary]) -> RegionSummary:
        weighted_rows = [(weight, row) for (weight, _), row in zip(self.weighted_coverages, rows, strict=True)]
        observed_cells = round(sum(weight * row.observed_cells for weight, row in weighted_rows))
        estimates = (
            self.estimate(region, band),
            self.estimate_aggregated(region, band),
            self._mix(lambda coverage: coverage.paper_mean(region, band)),
        )
        numbers, aggregated_numbers, cell_averages = convert_to_cell_numbers(estimates, observed_cells)
        redundancy = None
        if rows[0].redundancy and rows[0].redundancy.failure_numbers:
            estimate = self._mix(lambda coverage: coverage.estimate_redundancy(region, band))
            redundancy = summarize_redundancy(tuple(rows[0].redundancy.failure_numbers), self.thresholds_m, estimate)
        return replace(
            rows[0],
            observed_cells=observed_cells,
            numbers=numbers | aggregated_numbers,
            cell_averages=cell_averages,
            visible_m2=sum(weight * row.visible_m2 for weight, row in weighted_rows),
            redundancy=redundancy,
        )
