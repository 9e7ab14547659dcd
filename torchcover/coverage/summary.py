"""The numbers of a region, as tables and loggers take them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.averages import Average, estimate_redundancy, sum_area_by_block
from torchcover.coverage.quantities import make_failure_quantity
from torchcover.coverage.redundancy import list_redundancy_quantities
from torchcover.coverage.regions import Region
from torchcover.estimation import Difference, Estimate, Number

if TYPE_CHECKING:
    from torchcover.coverage.result import Coverage


@dataclass(frozen=True)
class RegionRedundancy:
    """By how many sensors one region is seen in one height band, and what is lost with each.

    Args:
        detecting_sensors: Key of the quantity, `"sensors_0.4m"`: mean number of sensors that see a point within the threshold,
            or `"detected_by_two_0.4m"`: share that two or more see -> its number. By one or more: the detection.
        failure_numbers: Name of the sensor -> key of the quantity, as in `RegionSummary.numbers` -> its number without it.
        failure_effects: The same less the number with all sensors; of detection at most 0, of the radius at least 0.
        most_critical_sensor: The sensor without which most is lost: of the detection at the first threshold, or of the radius
            where there is no threshold; None where no sensor's failure changes a number, or nothing is known.
    """

    detecting_sensors: Mapping[str, Number]
    failure_numbers: Mapping[str, Mapping[str, Number]]
    failure_effects: Mapping[str, Mapping[str, Difference]]
    most_critical_sensor: str | None


@dataclass(frozen=True)
class RegionSummary:
    """The numbers of one region in one height band.

    Args:
        region: Name of the region.
        band: Name of the height band.
        num_cells: Number of cells in the region.
        observed_cells: How many of them a reference point has probed.
        average: What `numbers` are means over: "area", the visible surface, "cells", the known cells, or "target_positions" of a
            body, which is then the `band`, the places that were tried the cells, and the free ones the known ones.
        numbers: Key of the quantity, such as `"radius_m"` or `"detection_0.4m"` -> its number, those of other
            aggregations last; the error is NaN if it was not asked for, or if there are not enough steps.
        cell_averages: Radius and detections over the known cells, every cell weighing the same; as in `numbers` if that is its
            measure.
        visible_m2: Mean over the steps of the square metres of the region's surface that the reference sees; NaN where
            its points have none.
        redundancy: What each sensor adds; None if that was not asked for.
    """

    region: str
    band: str
    num_cells: int
    observed_cells: int
    average: Average
    numbers: Mapping[str, Number]
    cell_averages: Mapping[str, Number]
    visible_m2: float
    redundancy: RegionRedundancy | None = None

    @property
    def observed_share(self) -> float:
        """Share of the region's cells that are known. `known` is about this share, and biased when it is low."""
        return self.observed_cells / self.num_cells if self.num_cells else math.nan

    def to_scalars(self, *, include_errors: bool) -> dict[str, float]:
        """As `Coverage.scalars` has them, with or without errors."""
        return {
            f"{key}/{self.region}/{self.band}": value
            for key, value in self.to_dict(include_errors=include_errors).items()
        }

    def to_dict(self, *, include_errors: bool) -> dict[str, float]:
        """The same without the names of the region and the band."""
        flat = {}
        for key, number in self.numbers.items():
            flat[key] = number.value
            if include_errors:
                flat[f"{key}_error"] = number.error
        flat["observed_share"] = self.observed_share
        if self.average == "area":
            flat["visible_m2"] = self.visible_m2
        return flat


def summarize_region(coverage: "Coverage", region: Region, band: str) -> RegionSummary:
    """The numbers of one region in one band."""
    cells, observed_cells = (
        int(each.sum()) for each in (coverage.get_cell_mask(region), coverage.mask_observed_cells(region, band))
    )
    numbers = partial(Estimate.to_numbers, count=observed_cells, counted_items="known cells")
    by_area, steps = coverage.average == "area", coverage.counts["num_frames"]
    redundancy = None  # by area it is known of the regions only that the metric was told of
    if coverage.redundancy is not None and (not by_area or region in coverage.regions):
        estimate = estimate_redundancy(coverage, region, band)
        redundancy = summarize_redundancy(coverage.redundancy.sensor_names, coverage.thresholds_m, estimate)
    return RegionSummary(
        region=region.name,
        band=band,
        num_cells=cells,
        observed_cells=observed_cells,
        average=coverage.average,
        numbers=numbers(coverage.estimate(region, band)) | numbers(coverage.estimate_aggregated(region, band)),
        cell_averages=numbers(coverage.estimate(region, band, "cells")),
        visible_m2=float(sum_area_by_block(coverage, region, band)[1][:, 0].sum()) / steps
        if by_area and steps
        else math.nan,
        redundancy=redundancy,
    )


def summarize_redundancy(
    sensor_names: Sequence[str], thresholds_m: tuple[float, ...], estimate: Estimate
) -> RegionRedundancy:
    """The numbers of a region without each sensor, from what `estimate_redundancy` gives."""
    single, several = MeanOfMeans(tuple(thresholds_m)).quantities, list_redundancy_quantities((), thresholds_m)
    numbers, count = estimate.to_numbers(), len(single)
    each, change = {}, {}
    for at, sensor in enumerate(sensor_names):
        start = count + len(several) + at * count
        own = estimate[start : start + count]
        each[sensor] = {quantity.key: numbers[make_failure_quantity(sensor, quantity).key] for quantity in single}
        change[sensor] = replace(own, quantities=single).compute_differences(estimate[:count])
    decisive = single[min(1, count - 1)]
    losses = {sensor: _loss(changes[decisive.key].improvement) for sensor, changes in change.items()}
    worst = max(losses, key=losses.__getitem__)
    seen_by = {quantity.key: numbers[quantity.key] for quantity in several}
    return RegionRedundancy(seen_by, each, change, worst if losses[worst] > 0 else None)


def _loss(gain: float) -> float:
    return 0.0 if math.isnan(gain) else -gain
