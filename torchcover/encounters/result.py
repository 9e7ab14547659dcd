"""Results of encounters: rows by encounter, speed and rig, tables, plots and CSV files."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure

from torchcover.encounters.criterion import Criterion
from torchcover.encounters.detection import EncounterDetection
from torchcover.encounters.rows import (
    EncounterRow,
    build_sensor_table,
    build_speed_table,
    format_csv_value,
    format_detected_share,
    format_time,
    format_with_interval,
)
from torchcover.encounters.traffic import ROAD_USER_GROUPS, Approach
from torchcover.estimation import Estimate, Number, Quantity
from torchcover.files import format_csv
from torchcover.notebooks import build_dataframe, build_result_html
from torchcover.report import PageTable, build_text_cells, format_percent, plot_encounters, to_json_record

if TYPE_CHECKING:
    import pandas

# Speed in km/h, smallest and largest time to collision in seconds.
PlotBand = tuple[float, float, float]

# Name of the row over all encounters in traffic.
TOTAL_ROW = "all"


@dataclass(frozen=True, eq=False, repr=False)
class EncounterResults:
    """Results of rigs in a set of encounters, or in encounters in traffic.

    Args:
        name: Name of the set, of the scenario, or of the recording.
        criterion: Criterion of detection and braking.
        num_start_offsets: Number of start offsets of the scans.
        seed: Seed of noise, drop-out and traffic.
        sensor_names: Names of the sensors of each rig.
        detections: Detections of all rigs, rig by rig.
        scene_durations_h: Duration of each traffic scene; empty for a set.
    """

    name: str
    criterion: Criterion
    num_start_offsets: int
    seed: int
    sensor_names: dict[str, tuple[str, ...]]
    detections: Sequence[EncounterDetection]
    scene_durations_h: Mapping[str, float] = field(default_factory=dict)

    @property
    def rows(self) -> list[EncounterRow]:
        """Rows by encounter, then speed, then rig; in traffic, the last rows are over all encounters."""
        names = ROAD_USER_GROUPS if self.scene_durations_h else [item.encounter.name for item in self.detections]
        row_names = list(dict.fromkeys([*names, TOTAL_ROW]))
        rigs = list(self.sensor_names)
        groups: dict[tuple[int, float, int], list[EncounterDetection]] = {}
        for detection in self.detections:
            encounter = detection.encounter
            speed_kmh = abs(encounter.speed_kmh) if encounter.is_speed_swept else -math.inf
            key = row_names.index(encounter.name), speed_kmh, rigs.index(detection.rig)
            groups.setdefault(key, []).append(detection)
        if self.scene_durations_h:
            for rig_index, rig in enumerate(rigs):
                rig_detections = [detection for detection in self.detections if detection.rig == rig]
                groups[row_names.index(TOTAL_ROW), -math.inf, rig_index] = rig_detections
        rows = []
        for key in sorted(groups):
            name_index, _, rig_index = key
            rows.append(self._build_row(row_names[name_index], rigs[rig_index], groups[key]))
        return rows

    def _build_row(self, name: str, rig: str, detections: list[EncounterDetection]) -> EncounterRow:
        """Build the row of one group of detections, which may be empty."""
        sensors = self.sensor_names[rig]
        # A group without encounters has a row, too.
        no_detection = np.zeros((1, len(sensors), self.num_start_offsets))
        ttc_s = np.stack([item.ttc_s for item in detections] or [no_detection[0, 0]])
        sensor_ttc_s = np.mean([item.sensor_ttc_s for item in detections] or no_detection, axis=(0, 2))
        # The worst encounter of a set counts; in traffic, the mean is more robust.
        reduce = np.mean if self.scene_durations_h else np.min
        ttc_without_s = reduce([item.ttc_without_sensor_s for item in detections] or no_detection, axis=(0, 2))
        numbers = self._compute_numbers(detections)
        ttc, at_start = numbers["ttc_s"], numbers["detected_at_start_share"]
        per_hour = numbers["encounters_per_hour"]
        in_time = np.array([item.in_time for item in detections if not np.isnan(item.in_time).any()])
        is_swept = bool(detections) and detections[0].encounter.is_speed_swept
        return EncounterRow(
            rig=rig,
            encounter=name,
            speed_kmh=detections[0].encounter.speed_kmh if is_swept else math.nan,
            sample_count=len(detections),
            num_start_offsets=self.num_start_offsets,
            braking_time_s=max((item.braking_time_s for item in detections), default=math.nan),
            ttc_s=ttc.value,
            min_ttc_s=float(ttc_s.min()),
            max_ttc_s=float(ttc_s.max()),
            interval_low=ttc.low,
            interval_high=ttc.high,
            braking_count=len(in_time),
            in_time_share=float(in_time.mean()) if len(in_time) else math.nan,
            undetected_share=float((ttc_s == 0).mean()),
            detected_at_start_share=at_start.value,
            detected_at_start_share_low=at_start.low,
            detected_at_start_share_high=at_start.high,
            encounters_per_hour=per_hour.value,
            encounters_per_hour_low=per_hour.low,
            encounters_per_hour_high=per_hour.high,
            first_sensor=sensors[int(sensor_ttc_s.argmax())] if sensor_ttc_s.any() else "",
            most_critical_sensor=sensors[int(ttc_without_s.argmin())],
            ttc_without_most_critical_s=float(ttc_without_s.min()),
        )

    def _compute_numbers(self, detections: Sequence[EncounterDetection]) -> dict[str, Number]:
        """Compute the numbers with confidence intervals; each scene, or each sample, is a block."""
        quantities = (
            Quantity("ttc_s", "time to collision at detection", "s", lower_is_better=False),
            Quantity("detected_at_start_share", "detected from the beginning", "share", lower_is_better=False),
            Quantity("encounters_per_hour", "encounters per hour", "1/h", lower_is_better=True),
        )
        scene_ids = list(self.scene_durations_h)
        num_blocks = len(scene_ids) or len(detections)
        sums = torch.zeros(num_blocks, len(quantities), dtype=torch.float64, device="cpu")
        for index, detection in enumerate(detections):
            block = scene_ids.index(detection.scene_id) if scene_ids else index
            is_at_start = detection.ttc_s >= detection.censoring_ttc_s
            values = [detection.ttc_s.mean(), is_at_start.mean(), 1.0]
            sums[block] += torch.tensor(values, dtype=torch.float64, device="cpu")
        # The first two numbers are per encounter, the last is per hour.
        weights = sums[:, [2, 2, 2]]
        durations_h = list(self.scene_durations_h.values()) or [math.nan] * num_blocks
        weights[:, 2] = torch.tensor(durations_h, device="cpu")
        frame_counts = torch.ones(num_blocks, dtype=torch.int64, device="cpu")
        return Estimate.from_ratios(quantities, weights, sums, frame_counts).to_numbers()

    def find_max_speeds_kmh(self) -> dict[tuple[str, str], float]:
        """Find the highest tested speed up to which a rig detects in time with all start offsets and samples.

        Returns:
            Speed by encounter and rig, for swept speeds; NaN if even the lowest speed is too high.
        """
        max_speeds_kmh: dict[tuple[str, str], float] = {}
        too_late = set[tuple[str, str]]()
        for row in self.rows:
            # Rows of sampled speeds have no speed.
            if math.isnan(row.speed_kmh):
                continue
            key = row.encounter, row.rig
            max_speeds_kmh.setdefault(key, math.nan)
            if row.in_time_share < 1:
                too_late.add(key)
            # Rows ascend in speed: a higher speed does not count once a lower one was too late.
            elif key not in too_late:
                max_speeds_kmh[key] = row.speed_kmh
        return max_speeds_kmh

    def get_settings(self) -> dict[str, Any]:
        """Get the settings, for JSON."""
        if self.scene_durations_h:
            source = {"traffic": self.name, "duration_h": sum(self.scene_durations_h.values())}
        else:
            source = {"set": self.name}
        settings = {**source, **asdict(self.criterion)}
        settings |= {"num_start_offsets": self.num_start_offsets, "seed": self.seed}
        return settings | {"rigs": {name: list(sensors) for name, sensors in self.sensor_names.items()}}

    def to_record(self) -> dict[str, Any]:
        """Convert to a record with settings, rows, highest speeds, and encounters in traffic, for JSON."""
        speeds = []
        for (name, rig), speed_kmh in self.find_max_speeds_kmh().items():
            speeds.append({"encounter": name, "rig": rig, "max_speed_kmh": speed_kmh})
        approaches = []
        for detection in self.detections:
            encounter, in_time = detection.encounter, detection.in_time[0]
            if isinstance(encounter, Approach):
                approaches.append({
                    "rig": detection.rig, "scene_id": detection.scene_id, "encounter": encounter.name,
                    "name": encounter.track.name, "frame_index": encounter.frame_index,
                    "min_ttc_s": float(encounter.ttc_s.min()), "ttc_s": float(detection.ttc_s[0]),
                    "in_time": None if np.isnan(in_time) else bool(in_time),
                })  # fmt: skip
        lists = {"rows": [row._asdict() for row in self.rows], "speeds": speeds, "encounters": approaches}
        return self.get_settings() | {name: [to_json_record(item) for item in items] for name, items in lists.items()}

    def build_tables(self) -> list[PageTable]:
        """Build the tables: highest timely speed, time to collision at detection, and most important sensors."""
        rows, rigs = self.rows, list(self.sensor_names)
        tables = [
            self._build_traffic_table(rows, rigs) if self.scene_durations_h else self._build_time_table(rows, rigs)
        ]
        if max_speeds_kmh := self.find_max_speeds_kmh():
            tables.insert(0, build_speed_table(max_speeds_kmh, rigs))
        if rows_with_sensors := [row for row in rows if len(self.sensor_names[row.rig]) > 1]:
            tables.append(build_sensor_table(rows_with_sensors))
        return tables

    def _build_time_table(self, rows: Sequence[EncounterRow], rigs: Sequence[str]) -> PageTable:
        """Build the table of the times to collision in a set of encounters."""
        cells = []
        for (encounter, speed), group in groupby(rows, key=attrgetter("encounter", "speed_label")):
            row_by_rig = {row.rig: row for row in group}
            # The braking time does not depend on the rig.
            braking_time_s = next(iter(row_by_rig.values())).braking_time_s
            times = [format_time(row_by_rig[rig]) for rig in rigs]
            cells.append(build_text_cells(encounter, speed, f"{braking_time_s:.2f}", *times))
        notes = [
            "Minimum and maximum over start offsets of the scans and samples; mean over samples with its 95 % "
            "confidence interval; - means not detected before the collision."
        ]
        if any(row.detected_at_start_share for row in rows):
            notes.append("> means detected as soon as the encounter began; the road user may have been visible before.")
        notes.append(self.criterion.description)
        headings = ("encounter", "km/h", "braking time\n(s)", *(f"{rig}\n(s)" for rig in rigs))
        return PageTable("Time to collision at first detection", headings, cells, notes=notes)

    def _build_traffic_table(self, rows: Sequence[EncounterRow], rigs: Sequence[str]) -> PageTable:
        """Build the table of encounters in traffic."""
        cells = []
        for first in range(0, len(rows), len(rigs)):
            rig_rows = rows[first : first + len(rigs)]
            row = rig_rows[0]
            per_hour = format_with_interval(row, "encounters_per_hour", "{:.0f}".format)
            shares = [format_detected_share(rig_row) for rig_row in rig_rows]
            cells.append(build_text_cells(row.encounter, str(row.sample_count), per_hour, *shares))
        minutes = 60 * sum(self.scene_durations_h.values())
        notes = [
            f"Encounter: time to collision below {self.criterion.max_ttc_s:g} s at constant velocities, in "
            f"{minutes:.0f} minutes. The share is detected before that moment, with a 95 % confidence interval over "
            f"{len(self.scene_durations_h)} scenes (at least 8); min is the smallest time to collision at detection.",
            f"{self.criterion.description} Braking was needed in {rows[-1].braking_count} encounters; too late: "
            "detected after that.",
        ]
        if not self.detections:
            notes.append("No encounters: simulate more scenes (--num-scenes), or another scenario.")
        headings = ("road users", "encounters", "per hour", *rigs)
        return PageTable("Encounters in traffic, and share detected before", headings, cells, notes=notes)

    def __repr__(self) -> str:
        rigs = ", ".join(self.sensor_names)
        return f"EncounterResults of {rigs} in {self.name}: {len(self.detections)} encounters"

    def _repr_html_(self) -> str:
        results = {(row.encounter, row.rig): f"{format_percent(row.in_time_share)} %" for row in self.rows}
        for key, speed_kmh in self.find_max_speeds_kmh().items():
            results[key] = "at no speed" if math.isnan(speed_kmh) else f"up to {speed_kmh:g} km/h"
        sentences = [f"{rig} in time, {name}: {result}." for (name, rig), result in results.items()]
        return build_result_html([repr(self), *sentences], None if self.scene_durations_h else self.plot())

    def plot(self) -> Figure:
        """Plot the time to collision at detection against speed as a band for each rig, with the braking time.

        Returns:
            A new figure, outside pyplot.

        Raises:
            ValueError: The encounters are from traffic, where speeds are not swept.
        """
        if self.scene_durations_h:
            raise ValueError("no plot of encounters in traffic: the numbers are in `rows` and `to_dataframe()`")
        return plot_encounters(list(self.compute_plot_bands()), title=f"{self.name}: time to collision at detection")

    def to_dataframe(self) -> "pandas.DataFrame":
        """Convert `rows` to a table with a column for each field of `EncounterRow`.

        Returns:
            The table.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        return build_dataframe(self.rows)

    def write_csv(self, path: Path) -> None:
        """Write `rows` to a CSV file; undefined values are empty.

        Args:
            path: File to write.
        """
        lines = [list(EncounterRow._fields)]
        for row in self.rows:
            lines.append([format_csv_value(value) for value in row])
        path.write_text(format_csv(lines), encoding="utf-8")

    def compute_plot_bands(self) -> Iterator[tuple[str, dict[str, list[PlotBand]], list[tuple[float, float]]]]:
        """Compute the contents of the plot.

        Yields:
            Name of each encounter; for each rig the speeds with smallest and largest time to collision; speeds with
            the largest braking time.
        """
        for name in dict.fromkeys(detection.encounter.name for detection in self.detections):
            bands: dict[str, list[PlotBand]] = {}
            braking_times_s: dict[float, float] = {}
            ttc_s: dict[tuple[str, float], list[float]] = {}
            for detection in self.detections:
                if detection.encounter.name == name:
                    speed_kmh = abs(detection.encounter.speed_kmh)
                    ttc_s.setdefault((detection.rig, speed_kmh), []).extend(detection.ttc_s.tolist())
                    max_braking_time_s = braking_times_s.get(speed_kmh, detection.braking_time_s)
                    braking_times_s[speed_kmh] = max(max_braking_time_s, detection.braking_time_s)
            for rig in self.sensor_names:
                speeds_kmh = sorted(speed_kmh for detecting_rig, speed_kmh in ttc_s if detecting_rig == rig)
                bands[rig] = [(speed, min(ttc_s[rig, speed]), max(ttc_s[rig, speed])) for speed in speeds_kmh]
            yield name, bands, sorted(braking_times_s.items())
