"""Rows of the results of encounters, and the texts and tables of them."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchcover.report import PageTable, build_text_cells, format_percent


class EncounterRow(NamedTuple):
    """Results of a rig in one encounter at one speed, or over all sampled encounters or encounters in traffic.

    Times to collision are 0 without detection before the collision. 95 % confidence intervals are over samples or
    scenes, NaN for fewer than 8.

    Args:
        rig: Name of the rig.
        encounter: Name of the encounter.
        speed_kmh: Speed of the ego vehicle; NaN if it is not swept.
        sample_count: Number of encounters.
        num_start_offsets: Number of start offsets of the scans.
        braking_time_s: Largest braking time of any sample.
        ttc_s: Mean time to collision at detection over start offsets and samples.
        min_ttc_s: Smallest of them.
        max_ttc_s: Largest of them.
        interval_low: Lower limit of the confidence interval of `ttc_s`.
        interval_high: Upper limit.
        braking_count: Encounters in which braking was needed.
        in_time_share: Share of start offsets and samples with detection in time; in traffic of `braking_count`.
        undetected_share: Share without detection.
        detected_at_start_share: Share with detection from the beginning, where the road user may have been visible
            before.
        detected_at_start_share_low: Lower limit of its confidence interval.
        detected_at_start_share_high: Upper limit.
        encounters_per_hour: Encounters per hour, in traffic.
        encounters_per_hour_low: Lower limit of its confidence interval.
        encounters_per_hour_high: Upper limit.
        first_sensor: Sensor that alone detects first, on average.
        most_critical_sensor: Sensor whose failure leaves the smallest time to collision.
        ttc_without_most_critical_s: Time to collision without it: the minimum, in traffic the mean.
    """

    rig: str
    encounter: str
    speed_kmh: float
    sample_count: int
    num_start_offsets: int
    braking_time_s: float
    ttc_s: float
    min_ttc_s: float
    max_ttc_s: float
    interval_low: float
    interval_high: float
    braking_count: int
    in_time_share: float
    undetected_share: float
    detected_at_start_share: float
    detected_at_start_share_low: float
    detected_at_start_share_high: float
    encounters_per_hour: float
    encounters_per_hour_low: float
    encounters_per_hour_high: float
    first_sensor: str
    most_critical_sensor: str
    ttc_without_most_critical_s: float

    @property
    def speed_label(self) -> str:
        """Speed for tables."""
        if not math.isnan(self.speed_kmh):
            return f"{self.speed_kmh:g}"
        return "sampled" if math.isnan(self.encounters_per_hour) else "any"


def format_csv_value(value: str | float) -> str:
    """Format a value for a CSV file; NaN is empty."""
    if not isinstance(value, float):
        return str(value)
    return "" if math.isnan(value) else f"{value:.9g}"


def format_time(row: EncounterRow) -> str:
    """Format the times to collision of a row for the table, such as `1.23 to 1.34, 60 % in time`."""
    if row.max_ttc_s == 0:
        return "-, too late"
    low, high = (f"{value:.2f}" if value else "-" for value in (row.min_ttc_s, row.max_ttc_s))
    text = low if low == high else f"{low} to {high}"
    if row.detected_at_start_share:
        text = f">{text}"
    if row.sample_count > 1:
        text += f", mean {row.ttc_s:.2f}"
    if row.interval_high > row.interval_low:
        text += f" ({row.interval_low:.2f} to {row.interval_high:.2f})"
    # Rows that are always in time need no remark.
    if row.in_time_share == 1:
        return text
    return text + (f", {100 * row.in_time_share:.0f} % in time" if row.in_time_share else ", too late")


def format_with_interval(row: EncounterRow, name: str, format_value: Callable[[float], str]) -> str:
    """Format a number of a row with its confidence interval, if there is one.

    Args:
        row: The row.
        name: Field of the number; the limits are the fields with `_low` and `_high`.
        format_value: Formats one value.

    Returns:
        Text such as `12 (8 to 16)`.
    """
    value, low, high = (getattr(row, f"{name}{suffix}") for suffix in ("", "_low", "_high"))
    if math.isnan(low):
        return format_value(value)
    return f"{format_value(value)} ({format_value(max(low, 0.0))} to {format_value(high)})"


def format_detected_share(row: EncounterRow) -> str:
    """Format the share that is detected from the beginning for the table of encounters in traffic."""
    if row.sample_count == 0:
        return "-"
    text = f"{format_with_interval(row, 'detected_at_start_share', format_percent)} %"
    if row.detected_at_start_share < 1 and row.undetected_share == 0:
        text += f", min {row.min_ttc_s:.2f} s"
    if row.undetected_share:
        text += f", {round(row.undetected_share * row.sample_count)} undetected"
    if row.in_time_share < 1:
        text += f", {round((1 - row.in_time_share) * row.braking_count)} of {row.braking_count} too late"
    return text


def build_speed_table(max_speeds_kmh: dict[tuple[str, str], float], rigs: Sequence[str]) -> PageTable:
    """Build the table of the highest speeds with timely detection.

    Args:
        max_speeds_kmh: Result of `find_max_speeds_kmh`.
        rigs: Names of the rigs, one column each.

    Returns:
        The table.
    """
    rows = []
    for name in dict.fromkeys(name for name, _ in max_speeds_kmh):
        speeds = []
        for rig in rigs:
            speed_kmh = max_speeds_kmh[name, rig]
            speeds.append("none" if math.isnan(speed_kmh) else f"{speed_kmh:g}")
        rows.append(build_text_cells(name, *speeds))
    headings = ("encounter", *(f"{rig}\n(km/h)" for rig in rigs))
    return PageTable("Highest tested speed with timely detection", headings, rows)


def build_sensor_table(rows: Sequence[EncounterRow]) -> PageTable:
    """Build the table of the first and the most critical sensor of each row."""
    cells = []
    for row in rows:
        ttc_s = f"{row.ttc_without_most_critical_s:.2f}" if row.ttc_without_most_critical_s else "-"
        sensors = row.first_sensor or "none", row.most_critical_sensor
        cells.append(
            build_text_cells(row.rig, row.encounter, row.speed_label, *sensors, ttc_s, f"{row.braking_time_s:.2f}")
        )
    headings = (
        "rig", "encounter", "km/h", "first sensor\nto detect", "most critical\nsensor", "without\n(s)",
        "braking time\n(s)",
    )  # fmt: skip
    return PageTable("First sensor to detect, and time left without one sensor", headings, cells, num_text_columns=2)
