"""Effects of sensor failures: cells of their table, and the single point of failure of a rig."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill

from torchcover.coverage import RegionRedundancy
from torchcover.coverage.quantities import RADIUS, make_redundancy_quantity, make_sensor_count_quantity
from torchcover.estimation import Quantity
from torchcover.report.number_format import (
    UNKNOWN,
    format_difference,
    format_difference_heading,
    format_number,
    format_value,
)
from torchcover.report.table import CoverageTable, Row

MAX_HEADING_CHARS = 16  # headings of columns are wrapped at this width


def get_main_quantity(table: CoverageTable) -> Quantity:
    """Return the quantity by which sensors are compared: detection at the first threshold, or the radius without one.

    Args:
        table: The table.
    """
    return table.mean_quantities[min(1, len(table.thresholds_m))]


def get_failure_sensors(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the sensors whose failure was evaluated.

    Args:
        rows: Rows of one rig.

    Returns:
        Names of the sensors; empty without redundancy.
    """
    for row in rows:
        if row.summary.redundancy:
            return tuple(row.summary.redundancy.failure_numbers)
    return ()


def format_failure_title(table: CoverageTable, rig: str) -> str:
    """Format the title of the table of sensor failures.

    Args:
        table: The table.
        rig: Name of the rig.
    """
    prefix = f"{rig}: change" if len(table.rigs) > 1 else "Change"
    return f"{prefix} of {format_difference_heading(get_main_quantity(table))} when one sensor fails"


def format_failure_headings(table: CoverageTable, rig: str) -> list[str]:
    """Format the headings of the table of sensor failures, without region and band.

    Args:
        table: The table.
        rig: Name of the rig.
    """
    redundancy = [fill(heading, MAX_HEADING_CHARS) for heading in ("detecting sensors", "by two or more (%)")]
    return [
        *(redundancy if table.thresholds_m else ()),
        *get_failure_sensors(table.rows[rig]),
        fill("largest effect", MAX_HEADING_CHARS),
    ]


def format_failure_cells(table: CoverageTable, row: Row) -> list[tuple[str, bool]]:
    """Format a row of the table of sensor failures.

    Args:
        table: The table.
        row: One row of a rig.

    Returns:
        Text of each cell, and whether it is a significant change.
    """
    redundancy, key = row.summary.redundancy, get_main_quantity(table).key
    sensors = get_failure_sensors(table.rows[row.rig])
    if redundancy is None:
        return [(UNKNOWN, False)] * len(format_failure_headings(table, row.rig))
    cells = []
    for threshold_m in table.thresholds_m[:1]:
        for quantity in (make_sensor_count_quantity(threshold_m), make_redundancy_quantity(threshold_m)):
            cells.append((format_number(redundancy.detecting_sensors[quantity.key]), False))
    for sensor in sensors:
        change = redundancy.failure_effects[sensor][key]
        cells.append((format_difference(change), bool(change.is_significant)))
    no_sensor = UNKNOWN if math.isnan(row.summary.numbers[key].value) else "none"
    return [*cells, (redundancy.most_critical_sensor or no_sensor, False)]


@dataclass(frozen=True)
class FailureParams:
    """Parameters of the test for a single point of failure.

    Args:
        min_share: Minimum share of the detection rate that is lost, or by which the radius grows. The default of a
            tenth exceeds the influence of settings on a number, see docs/accuracy.md.
    """

    min_share: float = 0.1


def describe_single_point_of_failure(table: CoverageTable, rig: str, params: FailureParams = FailureParams()) -> str:
    """Describe the failure of a sensor with the largest loss, if the loss is large and significant.

    Args:
        table: The table.
        rig: Name of the rig.
        params: Criterion of a single point of failure.

    Returns:
        A sentence; empty without redundancy.
    """
    quantity, rows = get_main_quantity(table), table.rows[rig]
    sensors = get_failure_sensors(rows)
    if not sensors:
        return ""
    values = [row.summary.numbers[quantity.key].value for row in rows]
    if all(math.isnan(value) for value in values):
        return "Single point of failure unknown: no surface in the regions was observed."
    if quantity.key != RADIUS.key and not any(value > 0.0 for value in values):
        return "Single point of failure unknown: nothing in the regions is detected with all sensors."
    if len(sensors) == 1:
        return f"Single point of failure: {sensors[0]} is the only sensor."
    worst, is_significant = _find_worst_failure(rows, quantity, params.min_share)
    if worst is None or (redundancy := worst.summary.redundancy) is None or redundancy.most_critical_sensor is None:
        min_share = f"{100 * params.min_share:g} %"
        return (
            f"No single point of failure: no failure of a sensor changes a number significantly by {min_share} or more."
        )
    sensor = redundancy.most_critical_sensor
    before = format_value(worst.summary.numbers[quantity.key].value, quantity.unit)
    after = format_value(redundancy.failure_numbers[sensor][quantity.key].value, quantity.unit)
    unit = "m" if quantity.unit == "m" else "%"
    region = f"{worst.summary.region} {worst.summary.band}"
    change = f"{quantity.title} in {region} changes from {before} to {after} {unit}"
    if is_significant:
        return f"Single point of failure: {sensor}; without it, {change}."
    return f"Largest effect of a failure: without {sensor}, {change}; its significance is unknown."


def _find_worst_failure(rows: Sequence[Row], quantity: Quantity, min_share: float) -> tuple[Row | None, bool]:
    """Find the row with the largest loss, and whether it is significant; significant losses come first."""
    candidates = []
    for row in rows:
        if _compute_lost_share(row, quantity) >= min_share and _is_significant(row, quantity) is not False:
            candidates.append(row)
    significant = [row for row in candidates if _is_significant(row, quantity)]
    worst: Row | None = None
    for row in significant or candidates:
        if worst is None or _get_loss(row.summary.redundancy, quantity) > _get_loss(worst.summary.redundancy, quantity):
            worst = row
    return worst, bool(significant)


def _compute_lost_share(row: Row, quantity: Quantity) -> float:
    """Compute the loss without the most critical sensor, as a share of the number with all sensors."""
    loss, value = _get_loss(row.summary.redundancy, quantity), row.summary.numbers[quantity.key].value
    return loss / value if loss > 0 and value > 0 else 0.0


def _is_significant(row: Row, quantity: Quantity) -> bool | None:
    """Return whether the loss without the most critical sensor is significant; None if unknown."""
    redundancy = row.summary.redundancy
    if redundancy is None or redundancy.most_critical_sensor is None:
        return None
    return redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].is_significant


def _get_loss(redundancy: RegionRedundancy | None, quantity: Quantity) -> float:
    """Return the loss without the most critical sensor; 0 without redundancy or effect."""
    if redundancy is None or redundancy.most_critical_sensor is None:
        return 0.0
    return -redundancy.failure_effects[redundancy.most_critical_sensor][quantity.key].improvement
