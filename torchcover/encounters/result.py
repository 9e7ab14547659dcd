"""When rigs detected whom they met, by encounter and speed: numbers, tables, CSV."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from torchcover.encounters.criterion import Criterion
from torchcover.encounters.sighting import EncounterDetection
from torchcover.encounters.traffic import WHO, Approach
from torchcover.estimation import Estimate, Number, Quantity
from torchcover.files import format_csv
from torchcover.notebooks import build_dataframe, build_result_html
from torchcover.report import PageTable, TextCell, format_percent, plot_encounters, to_json_record

if TYPE_CHECKING:
    import pandas

NUMBERS = (
    Quantity("ttc_s", "time to collision at detection", "s", lower_is_better=False),
    Quantity("detected_at_start_share", "seen from the beginning", "share", lower_is_better=False),
    Quantity("encounters_per_hour", "met an hour", "1/h", lower_is_better=True),
)
ALL = "all"


class EncounterRow(NamedTuple):
    """A rig in one encounter at one speed, or in all that were drawn or met; 0 s if it was too late.

    `ttc_s` is the mean time to collision at detection over phases and draws, of which `min_ttc_s` is the least and
    `max_ttc_s` the most. `braking_time_s` is the most of any draw, `in_time_share` the share of phases and draws, in traffic of
    the `braking_count` for whom braking was needed; `undetected_share` the share without detection, `detected_at_start_share` that in which
    it was seen as soon as it began, and may have been before.
    `first_sensor` is the sensor that alone is first in the mean; of the sensors that may fail, one at a time, `most_critical_sensor` is that
    without which the least time is left, `ttc_without_most_critical_s`: the least of all, of traffic the mean. Of traffic,
    `encounters_per_hour` says how many were met. Intervals of 95 % are over draws or worlds, NaN of fewer than 8: `interval_low`
    and `interval_high` that of `ttc_s`.
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


@dataclass(frozen=True, eq=False, repr=False)
class EncounterResults:
    """What some rigs had of a set of encounters, or of those that happened in traffic.

    Args:
        name: Of the set, of the scenario, or of the recording.
        criterion: What is detected, and what is in time.
        num_start_offsets: Of the looks.
        seed: Of noise and drop-out, and of traffic.
        sensor_names: Name of each rig -> those of its sensors.
        detections: Of each rig in each encounter; the encounters of one rig follow each other.
        scene_durations_h: Name of each world of the traffic -> how long it was; none of a set.
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
        """By encounter, then speed, then rig; of traffic also of all together, whoever was met."""
        names = dict.fromkeys(one.encounter.name for one in self.detections)
        order = {name: k for k, name in enumerate((*(WHO if self.scene_durations_h else names), ALL))}
        groups: dict[tuple[int, float, int], list[EncounterDetection]] = {}
        rigs = {name: k for k, name in enumerate(self.sensor_names)}
        for one in self.detections:
            speed_kmh = abs(one.encounter.speed_kmh) if one.encounter.is_speed_swept else -math.inf
            groups.setdefault((order[one.encounter.name], speed_kmh, rigs[one.rig]), []).append(one)
        if self.scene_durations_h:
            together = [[one for one in self.detections if one.rig == rig] for rig in rigs]
            groups |= {(order[ALL], -math.inf, k): of_rig for k, of_rig in enumerate(together)}
        return [self._row(list(order)[key[0]], list(rigs)[key[2]], groups[key]) for key in sorted(groups)]

    def _row(self, name: str, rig: str, draws: list[EncounterDetection]) -> EncounterRow:
        sensors = self.sensor_names[rig]
        none = np.zeros((1, len(sensors), self.num_start_offsets))
        ttc_s = np.stack([one.ttc_s for one in draws] or [none[0, 0]])
        alone_s = np.mean([one.sensor_ttc_s for one in draws] or none, axis=(0, 2))
        least = np.mean if self.scene_durations_h else np.min
        without_s = least([one.ttc_without_sensor_s for one in draws] or none, axis=(0, 2))
        numbers = self._numbers(draws)
        in_time = np.array([one.in_time for one in draws if not np.isnan(one.in_time).any()])
        swept = bool(draws) and draws[0].encounter.is_speed_swept
        return EncounterRow(
            rig=rig,
            encounter=name,
            speed_kmh=draws[0].encounter.speed_kmh if swept else math.nan,
            sample_count=len(draws),
            num_start_offsets=self.num_start_offsets,
            braking_time_s=max((one.braking_time_s for one in draws), default=math.nan),
            ttc_s=numbers["ttc_s"].value,
            min_ttc_s=float(ttc_s.min()),
            max_ttc_s=float(ttc_s.max()),
            interval_low=numbers["ttc_s"].low,
            interval_high=numbers["ttc_s"].high,
            braking_count=len(in_time),
            in_time_share=float(in_time.mean()) if len(in_time) else math.nan,
            undetected_share=float((ttc_s == 0).mean()),
            detected_at_start_share=numbers["detected_at_start_share"].value,
            detected_at_start_share_low=numbers["detected_at_start_share"].low,
            detected_at_start_share_high=numbers["detected_at_start_share"].high,
            encounters_per_hour=numbers["encounters_per_hour"].value,
            encounters_per_hour_low=numbers["encounters_per_hour"].low,
            encounters_per_hour_high=numbers["encounters_per_hour"].high,
            first_sensor=sensors[int(alone_s.argmax())] if alone_s.any() else "",
            most_critical_sensor=sensors[int(without_s.argmin())],
            ttc_without_most_critical_s=float(without_s.min()),
        )

    def _numbers(self, draws: Sequence[EncounterDetection]) -> dict[str, Number]:
        """Those of `NUMBERS`, of which each world is a block, or each draw."""
        blocks = {name: k for k, name in enumerate(self.scene_durations_h or map(str, range(len(draws))))}
        sums = torch.zeros(len(blocks), len(NUMBERS), dtype=torch.float64, device="cpu")
        for k, one in enumerate(draws):
            of_one = [one.ttc_s.mean(), (one.ttc_s >= one.censoring_ttc_s).mean(), 1.0]
            sums[blocks[one.scene_id if self.scene_durations_h else str(k)]] += torch.tensor(
                of_one, dtype=torch.float64, device="cpu"
            )
        base = sums[:, [2, 2, 2]]
        base[:, 2] = torch.tensor(list(self.scene_durations_h.values()) or [math.nan] * len(blocks), device="cpu")
        return Estimate.from_ratios(
            NUMBERS, base, sums, torch.ones(len(blocks), dtype=torch.int64, device="cpu")
        ).to_numbers()

    def find_max_speeds_kmh(self) -> dict[tuple[str, str], float]:
        """Encounter and rig -> the speed up to which it is in time in every phase and draw, where speeds were swept.

        NaN if it is too late at the least.
        """
        swept, late = [row for row in self.rows if row.speed_kmh == row.speed_kmh], set[tuple[str, str]]()
        found = dict.fromkeys(((row.encounter, row.rig) for row in swept), math.nan)
        for row in swept:
            key = row.encounter, row.rig
            if row.in_time_share < 1:
                late.add(key)
            elif key not in late:
                found[key] = row.speed_kmh
        return found

    def get_settings(self) -> dict[str, Any]:
        """What it is of, for JSON."""
        rigs = {name: list(sensors) for name, sensors in self.sensor_names.items()}
        what = (
            {"traffic": self.name, "duration_h": sum(self.scene_durations_h.values())}
            if self.scene_durations_h
            else {"set": self.name}
        )
        return {**what, **asdict(self.criterion), "num_start_offsets": self.num_start_offsets, "seed": self.seed, "rigs": rigs}

    def to_record(self) -> dict[str, Any]:
        """All of it, for JSON."""
        up_to = [
            {"encounter": name, "rig": rig, "max_speed_kmh": v}
            for (name, rig), v in self.find_max_speeds_kmh().items()
        ]
        rows = [row._asdict() for row in self.rows]
        met = [{"rig": one.rig, "scene_id": one.scene_id, "encounter": one.encounter.name, "name": one.encounter.track.name,
                "frame_index": one.encounter.frame_index, "min_ttc_s": float(one.encounter.ttc_s.min()),
                "ttc_s": float(one.ttc_s[0]), "in_time": None if np.isnan(one.in_time[0]) else bool(one.in_time[0])}
               for one in self.detections if isinstance(one.encounter, Approach)]  # fmt: skip
        listed = {"rows": rows, "speeds": up_to, "encounters": met}
        return self.get_settings() | {name: list(map(to_json_record, each)) for name, each in listed.items()}

    def build_tables(self) -> list[PageTable]:
        """Up to which speed, when, and by which sensor."""
        rows, rigs = self.rows, list(self.sensor_names)
        tables = [self._met(rows, rigs) if self.scene_durations_h else self._times(rows, rigs)]
        if up_to_kmh := self.find_max_speeds_kmh():
            tables.insert(0, _speeds(up_to_kmh, rigs))
        several = [row for row in rows if len(self.sensor_names[row.rig]) > 1]
        return [*tables, _sensors(several)] if several else tables

    def _times(self, rows: Sequence[EncounterRow], rigs: Sequence[str]) -> PageTable:
        cells = []
        for (encounter, speed), group in groupby(rows, key=lambda row: (row.encounter, _speed(row))):
            of_rigs = {row.rig: row for row in group}
            needed_s = next(iter(of_rigs.values())).braking_time_s
            cells.append(
                tuple(map(TextCell, (encounter, speed, f"{needed_s:.2f}", *(_time(of_rigs[r]) for r in rigs))))
            )
        unsure = any(row.detected_at_start_share for row in rows)
        notes = [
            "The least and the most over the phases of the looks and what was drawn, of that the mean with its 95 % "
            "interval; - is not before the collision.",
            *(["> was seen as soon as the encounter began, and may have been before."] if unsure else []),
            self.criterion.description,
        ]
        headings = ("encounter", "km/h", "braking time\n(s)", *(f"{rig}\n(s)" for rig in rigs))
        return PageTable("Time to collision at first detection", headings, cells, notes=notes)

    def _met(self, rows: Sequence[EncounterRow], rigs: Sequence[str]) -> PageTable:
        within_s, cells = self.criterion.max_ttc_s, []
        for first in range(0, len(rows), len(rigs)):
            of_rigs = rows[first : first + len(rigs)]
            often = _with_interval(of_rigs[0], "encounters_per_hour", "{:.0f}".format)
            cells.append(
                tuple(map(TextCell, (of_rigs[0].encounter, str(of_rigs[0].sample_count), often, *map(_met, of_rigs))))
            )
        notes = [
            f"Met: came within {within_s:g} s of a collision, if both had gone straight on, in "
            f"{60 * sum(self.scene_durations_h.values()):.0f} minutes. Detected before that, with a 95 % interval over "
            f"{len(self.scene_durations_h)} worlds (of 8 or more), or at the least time to collision, or never.",
            f"{self.criterion.description} Braking was needed for {rows[-1].braking_count} of them; too late: before detection.",
            *([] if self.detections else ["Nobody was met: drive longer (--num-scenes), or elsewhere."]),
        ]
        return PageTable("Met, and detected before", ("road users", "encounters", "per hour", *rigs), cells, notes=notes)

    def __repr__(self) -> str:
        return f"Sightings of {', '.join(self.sensor_names)} in {self.name}: {len(self.detections)} encounters"

    def _repr_html_(self) -> str:
        of_rows = {(row.encounter, row.rig): f"{format_percent(row.in_time_share)} %" for row in self.rows}
        up_to = {
            key: "at no speed" if kmh != kmh else f"up to {kmh:g} km/h"
            for key, kmh in self.find_max_speeds_kmh().items()
        }
        told = (f"{rig} in time, {name}: {words}." for (name, rig), words in (of_rows | up_to).items())
        return build_result_html([repr(self), *told], None if self.scene_durations_h else self.plot())

    def plot(self) -> Figure:
        """Time to collision at detection against the speed, a band for each rig, and what is needed.

        Returns:
            A figure of its own, outside pyplot.

        Raises:
            ValueError: Of traffic, where speeds are whatever they were.
        """
        if self.scene_durations_h:
            raise ValueError("no picture of what was met in traffic: its numbers are in `rows` and `to_dataframe()`")
        return plot_encounters(list(self.compute_plot_bands()), title=f"{self.name}: time to collision at detection")

    def to_dataframe(self) -> "pandas.DataFrame":
        """`rows`, a column for each field of `EncounterRow`.

        Raises:
            ModuleNotFoundError: pandas is not there.
        """
        return build_dataframe(self.rows)

    def write_csv(self, path: Path) -> None:
        """Rows as of `rows`; empty where nothing is known."""
        path.write_text(format_csv([EncounterRow._fields, *map(_cells, self.rows)]), encoding="utf-8")

    def compute_plot_bands(
        self,
    ) -> Iterator[tuple[str, dict[str, list[tuple[float, float, float]]], list[tuple[float, float]]]]:
        """For the picture: each encounter; of each rig speed (km/h), least and most time to collision; the needed."""
        by_name = sorted(self.detections, key=lambda one: one.encounter.name)
        of_names = {name: list(group) for name, group in groupby(by_name, key=lambda one: one.encounter.name)}
        for name in dict.fromkeys(one.encounter.name for one in self.detections):
            bands: dict[str, list[tuple[float, float, float]]] = {}
            for rig in self.sensor_names:
                times: dict[float, list[float]] = {}
                for one in of_names[name]:
                    if one.rig == rig:
                        times.setdefault(abs(one.encounter.speed_kmh), []).extend(one.ttc_s.tolist())
                bands[rig] = [(speed, min(each), max(each)) for speed, each in sorted(times.items())]
            most_last = sorted(of_names[name], key=lambda one: one.braking_time_s)
            yield name, bands, sorted({abs(one.encounter.speed_kmh): one.braking_time_s for one in most_last}.items())


def _cells(row: EncounterRow) -> list[str]:
    return ["" if value != value else f"{value:.9g}" if isinstance(value, float) else str(value) for value in row]


def _speed(row: EncounterRow) -> str:
    return (
        f"{row.speed_kmh:g}"
        if row.speed_kmh == row.speed_kmh
        else "drawn"
        if math.isnan(row.encounters_per_hour)
        else "any"
    )


def _time(row: EncounterRow) -> str:
    if row.max_ttc_s == 0:
        return "-, too late"
    low, high = (f"{value:.2f}" if value else "-" for value in (row.min_ttc_s, row.max_ttc_s))
    late = (
        ""
        if row.in_time_share == 1
        else f", {100 * row.in_time_share:.0f} % in time"
        if row.in_time_share
        else ", too late"
    )
    mean = f", mean {row.ttc_s:.2f}" if row.sample_count > 1 else ""
    interval = f" ({row.interval_low:.2f} to {row.interval_high:.2f})" if row.interval_high > row.interval_low else ""
    return f"{'>' if row.detected_at_start_share else ''}{low if low == high else f'{low} to {high}'}{mean}{interval}{late}"


def _with_interval(row: EncounterRow, key: str, words: Callable[[float], str]) -> str:
    value, low, high = (getattr(row, f"{key}{end}") for end in ("", "_low", "_high"))
    return words(value) + ("" if math.isnan(low) else f" ({words(max(low, 0.0))} to {words(high)})")


def _met(row: EncounterRow) -> str:
    if row.sample_count == 0:
        return "-"
    least = f", least {row.min_ttc_s:.2f} s" if row.detected_at_start_share < 1 and row.undetected_share == 0 else ""
    never = f", {round(row.undetected_share * row.sample_count)} never" if row.undetected_share else ""
    late = (
        f", {round((1 - row.in_time_share) * row.braking_count)} of {row.braking_count} too late"
        if row.in_time_share < 1
        else ""
    )
    return f"{_with_interval(row, 'detected_at_start_share', format_percent)} %{least}{never}{late}"


def _speeds(up_to_kmh: dict[tuple[str, str], float], rigs: Sequence[str]) -> PageTable:
    names = dict.fromkeys(name for name, _ in up_to_kmh)
    speeds = {key: "none" if math.isnan(kmh) else f"{kmh:g}" for key, kmh in up_to_kmh.items()}
    rows = [tuple(map(TextCell, (name, *(speeds[name, rig] for rig in rigs)))) for name in names]
    headings = ("encounter", *(f"{rig}\n(km/h)" for rig in rigs))
    return PageTable("Highest tested speed with timely detection", headings, rows)


def _sensors(rows: Sequence[EncounterRow]) -> PageTable:
    cells = [
        tuple(map(TextCell, (row.rig, row.encounter, _speed(row), row.first_sensor or "none", row.most_critical_sensor,
                          f"{row.ttc_without_most_critical_s:.2f}" if row.ttc_without_most_critical_s else "-", f"{row.braking_time_s:.2f}")))
        for row in rows
    ]  # fmt: skip
    headings = ("rig", "encounter", "km/h", "first sensor\nto detect", "most critical\nsensor", "without\n(s)", "braking time\n(s)")
    return PageTable("Sensors: which alone is first, and what is left without one", headings, cells, num_text_columns=2)
