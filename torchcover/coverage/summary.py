"""Numbers of a region for tables and loggers."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torchcover.coverage.aggregations import MeanOfMeans
from torchcover.coverage.averages import Average
from torchcover.coverage.quantities import make_failure_quantity
from torchcover.coverage.redundancy import list_redundancy_quantities
from torchcover.estimation import Difference, Estimate, Number


@dataclass(frozen=True)
class RegionRedundancy:
    """Number of sensors that detect points of a region in a height band, and the effect of the failure of each sensor.

    Args:
        detecting_sensors: Numbers by key: `"sensors_0.4m"`, the mean number of sensors that detect a point within the
            threshold, and `"detected_by_two_0.4m"`, the share of points that two or more sensors detect.
        failure_numbers: For each sensor, the numbers of the rig without it, by key as in `RegionSummary.numbers`.
        failure_effects: For each sensor, the rig without it minus the whole rig: at most 0 for detection rates, at
            least 0 for the radius.
        most_critical_sensor: Sensor whose failure costs most, in the detection rate at the first threshold, or in the
            radius without thresholds; None if no failure changes a number, or nothing is known.
    """

    detecting_sensors: Mapping[str, Number]
    failure_numbers: Mapping[str, Mapping[str, Number]]
    failure_effects: Mapping[str, Mapping[str, Difference]]
    most_critical_sensor: str | None


@dataclass(frozen=True)
class RegionSummary:
    """Numbers of one region in one height band.

    Args:
        region: Name of the region.
        band: Name of the height band.
        num_cells: Number of cells in the region.
        observed_cells: Number of them that contained a reference point.
        average: "area" for means over the visible surface, "cells" over observed cells, or "target_positions" of a test
            target. In the last case `band` is the name of the target, `num_cells` the number of tried positions and
            `observed_cells` the number of free ones.
        numbers: Numbers by key, such as `"radius_m"` or `"detection_0.4m"`, those of other aggregations last. Errors
            are NaN without blocks, or with too few frames.
        cell_averages: Radius and detection rates over observed cells; equal to `numbers` if that is their average.
        visible_m2: Mean over frames of the area of the region that the reference sensor observes, in square meters; NaN
            without area weights.
        redundancy: Effect of each sensor; None if the metric does not distinguish sensors.
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
        """Share of the region's cells that are observed. Averages over cells are biased if it is low."""
        return self.observed_cells / self.num_cells if self.num_cells else math.nan

    def to_scalars(self, *, include_errors: bool) -> dict[str, float]:
        """Convert to entries of `Coverage.scalars`, with region and band in the keys.

        Args:
            include_errors: Add standard errors.
        """
        values = self.to_dict(include_errors=include_errors)
        return {f"{key}/{self.region}/{self.band}": value for key, value in values.items()}

    def to_dict(self, *, include_errors: bool) -> dict[str, float]:
        """Convert to values by key, without the names of region and band.

        Args:
            include_errors: Add standard errors, with keys that end in `_error`.
        """
        values = {}
        for key, number in self.numbers.items():
            values[key] = number.value
            if include_errors:
                values[f"{key}_error"] = number.error
        values["observed_share"] = self.observed_share
        if self.average == "area":
            values["visible_m2"] = self.visible_m2
        return values


def convert_to_cell_numbers(estimates: Sequence[Estimate], observed_cells: int) -> list[dict[str, Number]]:
    """Convert estimates of a region to numbers that name the count of observed cells.

    Args:
        estimates: Estimates of one region.
        observed_cells: Number of its observed cells.
    """
    return [estimate.to_numbers(count=observed_cells, counted_items="observed cells") for estimate in estimates]


def summarize_redundancy(
    sensor_names: Sequence[str], thresholds_m: tuple[float, ...], estimate: Estimate
) -> RegionRedundancy:
    """Compute the effect of the failure of each sensor on the numbers of a region.

    Args:
        sensor_names: Names of the sensors.
        thresholds_m: Detection thresholds in meters.
        estimate: Result of `Coverage.estimate_redundancy`.
    """
    rig_quantities = MeanOfMeans(tuple(thresholds_m)).quantities
    count_quantities = list_redundancy_quantities((), thresholds_m)
    numbers, count = estimate.to_numbers(), len(rig_quantities)
    failure_numbers, failure_effects, losses = {}, {}, {}
    deciding_quantity = rig_quantities[min(1, count - 1)]
    for sensor_index, sensor in enumerate(sensor_names):
        start = count + len(count_quantities) + sensor_index * count
        without_sensor = replace(estimate[start : start + count], quantities=rig_quantities)
        failure_numbers[sensor] = {
            quantity.key: numbers[make_failure_quantity(sensor, quantity).key] for quantity in rig_quantities
        }
        failure_effects[sensor] = without_sensor.compute_differences(estimate[:count])
        improvement = failure_effects[sensor][deciding_quantity.key].improvement
        losses[sensor] = 0.0 if math.isnan(improvement) else -improvement
    most_critical = max(losses, key=losses.__getitem__)
    return RegionRedundancy(
        detecting_sensors={quantity.key: numbers[quantity.key] for quantity in count_quantities},
        failure_numbers=failure_numbers,
        failure_effects=failure_effects,
        most_critical_sensor=most_critical if losses[most_critical] > 0 else None,
    )
