"""The numbers of one rig over several kinds of world, each with its share."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from torchcover.coverage.bodies import BodyMixture
from torchcover.coverage.measures import Measure, estimate_redundancy
from torchcover.coverage.regions import Region, shown_places
from torchcover.coverage.result import Coverage
from torchcover.coverage.summary import RegionSummary, region_redundancy
from torchcover.estimation import Estimate

SAME = ("band_frame", "grid", "thresholds", "max_radius", "measure", "regions")


class Mixture:
    """What `Coverage` says of one kind of world, of a mixture of kinds; maps it has none.

    The kinds are given, not drawn: errors are about what happens by chance within each (`Estimate.mixed`).

    Args:
        kinds: What was measured in each kind of world, by its name, with its weight: above 0, and they sum to 1.

    Raises:
        ValueError: Two that were not asked about the same.
    """

    def __init__(self, kinds: Mapping[str, tuple[float, Coverage]]) -> None:
        self.kinds = tuple(kinds)
        self.parts = tuple(kinds.values())
        (_, first), *others = self.parts
        for what in SAME:
            if any(getattr(coverage, what) != getattr(first, what) for _, coverage in others):
                raise ValueError(f"kinds of world cannot be mixed: they differ in their {what}; ask about the same")
        self.grid, self.thresholds, self.max_radius = first.grid, first.thresholds, first.max_radius
        self.measure, self.quantities, self.aggregated = first.measure, first.quantities, first.aggregated
        each = [(weight, part.bodies) for weight, part in self.parts if part.bodies]
        if any(bodies.places != each[0][1].places for _, bodies in each) or 0 < len(each) < len(self.parts):
            raise ValueError("kinds of world cannot be mixed: other bodies were put beside the vehicle in one of them")
        self.bodies = BodyMixture(each, each[0][1].places) if each else None

    def estimate(self, region: Region, height: str, measure: Measure | None = None) -> Estimate:
        """As `Coverage.estimate`."""
        return Estimate.mixed([(weight, part.estimate(region, height, measure)) for weight, part in self.parts])

    def estimate_aggregated(self, region: Region, height: str) -> Estimate:
        """As `Coverage.estimate_aggregated`."""
        return Estimate.mixed([(weight, part.estimate_aggregated(region, height)) for weight, part in self.parts])

    @property
    def counts(self) -> dict[str, int]:
        """As `Coverage.counts`, of all kinds together."""
        return {name: sum(part.counts[name] for _, part in self.parts) for name in Coverage.COUNTS}

    def summary(self, regions: Sequence[Region]) -> list[RegionSummary]:
        """As `Coverage.summary`; of cells and square metres, means with the same weights, redundancy's too."""
        places = shown_places(regions, self.grid)
        rows = zip(*(part.summary(regions) for _, part in self.parts), strict=True)
        return [self._row(place, row) for place, row in zip(places, rows, strict=True)]

    def _row(self, place: tuple[Region, str], rows: Sequence[RegionSummary]) -> RegionSummary:
        weights = [weight for weight, _ in self.parts]
        observed_cells = round(sum(weight * row.observed_cells for weight, row in zip(weights, rows, strict=True)))
        estimates = self.estimate(*place), self.estimate_aggregated(*place), self.estimate(*place, "cells")
        numbers = [estimate.numbers(count=observed_cells, count_of="known cells") for estimate in estimates]
        redundancy = None
        if sensors := rows[0].redundancy and tuple(rows[0].redundancy.without):
            each = [(weight, estimate_redundancy(part, *place)) for weight, part in self.parts]
            redundancy = region_redundancy(sensors, self.thresholds, Estimate.mixed(each))
        return replace(
            rows[0],
            observed_cells=observed_cells,
            numbers=numbers[0] | numbers[1],
            known=numbers[2],
            visible_m2=sum(weight * row.visible_m2 for weight, row in zip(weights, rows, strict=True)),
            redundancy=redundancy,
        )
