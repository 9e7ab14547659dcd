"""The numbers of a region, as tables and loggers take them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.measures import Measure, area_in_blocks, estimate_redundancy
from torchcover.coverage.quantity import without
from torchcover.coverage.redundancy import redundancy_quantities
from torchcover.coverage.regions import Region
from torchcover.estimation import Difference, Estimate, Number

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage


@dataclass(frozen=True)
class RegionRedundancy:
    """By how many sensors one region is seen in one height band, and what is lost with each.

    Args:
        seen_by: Key of the quantity, `"sensors_0.4m"`: mean number of sensors that see a point within the threshold,
            or `"seen_by_two_0.4m"`: share that two or more see -> its number. By one or more: the detection.
        without: Name of the sensor -> key of the quantity, as in `RegionSummary.numbers` -> its number without it.
        change: The same less the number with all sensors; of detection at most 0, of the radius at least 0.
        indispensable: The sensor without which most is lost: of the detection at the first threshold, or of the radius
            where there is no threshold; None where no sensor's failure changes a number, or nothing is known.
    """

    seen_by: Mapping[str, Number]
    without: Mapping[str, Mapping[str, Number]]
    change: Mapping[str, Mapping[str, Difference]]
    indispensable: str | None


@dataclass(frozen=True)
class RegionSummary:
    """The numbers of one region in one height band.

    Args:
        region: Name of the region.
        height: Name of the height band.
        cells: Number of cells in the region.
        observed_cells: How many of them a reference point has probed.
        measure: What `numbers` are means over: "area", the visible surface, "cells", the known cells, or "target_positions" of a
            body, which is then the `height`, the places that were tried the cells, and the free ones the known ones.
        numbers: Key of the quantity, such as `"radius_m"` or `"detection_0.4m"` -> its number, those of other
            aggregations last; the error is NaN if it was not asked for, or if there are not enough steps.
        known: Radius and detections over the known cells, every cell weighing the same; as in `numbers` if that is its
            measure.
        visible_m2: Mean over the steps of the square metres of the region's surface that the reference sees; NaN where
            its points have none.
        redundancy: What each sensor adds; None if that was not asked for.
    """

    region: str
    height: str
    cells: int
    observed_cells: int
    measure: Measure
    numbers: Mapping[str, Number]
    known: Mapping[str, Number]
    visible_m2: float
    redundancy: RegionRedundancy | None = None

    @property
    def observed_share(self) -> float:
        """Share of the region's cells that are known. `known` is about this share, and biased when it is low."""
        return self.observed_cells / self.cells if self.cells else math.nan

    def scalars(self, *, errors: bool) -> dict[str, float]:
        """As `Coverage.scalars` has them, with or without errors."""
        return {f"{key}/{self.region}/{self.height}": value for key, value in self.flat(errors=errors).items()}

    def flat(self, *, errors: bool) -> dict[str, float]:
        """The same without the names of the region and the band."""
        flat = {}
        for key, number in self.numbers.items():
            flat[key] = number.value
            if errors:
                flat[f"{key}_error"] = number.error
        flat["observed_share"] = self.observed_share
        if self.measure == "area":
            flat["visible_m2"] = self.visible_m2
        return flat


def summarise(coverage: "Coverage", region: Region, height: str) -> RegionSummary:
    """The numbers of one region in one band."""
    cells, observed_cells = (int(each.sum()) for each in (coverage.cells_of(region), coverage.known_in(region, height)))
    numbers = partial(Estimate.numbers, count=observed_cells, count_of="known cells")
    by_area, steps = coverage.measure == "area", coverage.counts["frames"]
    redundancy = None  # by area it is known of the regions only that the metric was told of
    if coverage.redundancy is not None and (not by_area or region in coverage.regions):
        estimate = estimate_redundancy(coverage, region, height)
        redundancy = region_redundancy(coverage.redundancy.sensors, coverage.thresholds, estimate)
    return RegionSummary(
        region=region.name,
        height=height,
        cells=cells,
        observed_cells=observed_cells,
        measure=coverage.measure,
        numbers=numbers(coverage.estimate(region, height)) | numbers(coverage.estimate_aggregated(region, height)),
        known=numbers(coverage.estimate(region, height, "cells")),
        visible_m2=float(area_in_blocks(coverage, region, height)[1][:, 0].sum()) / steps
        if by_area and steps
        else math.nan,
        redundancy=redundancy,
    )


def region_redundancy(sensors: Sequence[str], thresholds: tuple[float, ...], estimate: Estimate) -> RegionRedundancy:
    """The numbers of a region without each sensor, from what `estimate_redundancy` gives."""
    single, several = MeanOfMeans(tuple(thresholds)).quantities, redundancy_quantities((), thresholds)
    numbers, count = estimate.numbers(), len(single)
    each, change = {}, {}
    for at, sensor in enumerate(sensors):
        start = count + len(several) + at * count
        own = estimate[start : start + count]
        each[sensor] = {quantity.key: numbers[without(sensor, quantity).key] for quantity in single}
        change[sensor] = replace(own, quantities=single).differences(estimate[:count])
    decisive = single[min(1, count - 1)]
    losses = {sensor: _loss(changes[decisive.key].gain) for sensor, changes in change.items()}
    worst = max(losses, key=losses.__getitem__)
    seen_by = {quantity.key: numbers[quantity.key] for quantity in several}
    return RegionRedundancy(seen_by, each, change, worst if losses[worst] > 0 else None)


def _loss(gain: float) -> float:
    return 0.0 if math.isnan(gain) else -gain
