"""When rigs detected whom they met, by encounter and speed: numbers, tables, CSV."""

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.encounters.criterion import Criterion
from torchcover.encounters.sighting import Sighting
from torchcover.estimation import student_t95
from torchcover.report import PageTable, Words

Float64 = NDArray[np.float64]


class EncounterRow(NamedTuple):
    """A rig in one encounter at one speed, or in all that were drawn; times to collision are 0 if it was too late.

    `ttc_s_low` and `ttc_s_high` are the least and the most over phases and draws; `ttc_s` is their mean, and
    `interval_low` and `interval_high` its 95 % interval over the draws, NaN without. `needed_s` is the most of any
    draw, `in_time` the share of phases and draws, `from_the_beginning` that in which it was seen as soon as it began,
    and may have been before. `first` is the sensor that alone is first in the mean; of the sensors that may fail, one
    at a time, `worst` is that without which the least time is left, `without_worst_s`.
    """

    rig: str
    encounter: str
    speed_kmh: float
    draws: int
    phases: int
    needed_s: float
    ttc_s: float
    ttc_s_low: float
    ttc_s_high: float
    interval_low: float
    interval_high: float
    in_time: float
    from_the_beginning: float
    first: str
    worst: str
    without_worst_s: float


@dataclass(frozen=True, eq=False)
class Sightings:
    """What some rigs had of a set of encounters.

    Args:
        name: Of the set.
        criterion: What is detected, and what is in time.
        phases: Of the looks.
        seed: Of noise and drop-out.
        sensors: Name of each rig -> those of its sensors.
        sightings: Of each rig in each encounter; the encounters of one rig follow each other.
    """

    name: str
    criterion: Criterion
    phases: int
    seed: int
    sensors: dict[str, tuple[str, ...]]
    sightings: Sequence[Sighting]

    @property
    def rows(self) -> list[EncounterRow]:
        """By encounter, then speed, then rig."""
        order = {name: k for k, name in enumerate(dict.fromkeys(one.encounter.name for one in self.sightings))}
        rigs = list(self.sensors)

        def key(one: Sighting) -> tuple[int, float, int]:
            swept = one.encounter.speed_is_swept
            speed_kmh = one.encounter.ego.speed_kmh if swept else -math.inf
            return order[one.encounter.name], speed_kmh, rigs.index(one.rig)

        return [self._row(list(group)) for _, group in groupby(sorted(self.sightings, key=key), key)]

    def _row(self, draws: list[Sighting]) -> EncounterRow:
        first, criterion = draws[0], self.criterion
        ttc_s = np.stack([one.ttc_s for one in draws])
        needed_s = np.array([criterion.needed_s(one.encounter.closing_mps) for one in draws])
        alone_s = np.mean([one.sensor_ttc_s for one in draws], axis=(0, 2))
        without_s = np.min([one.without_ttc_s for one in draws], axis=(0, 2))
        of_draws_s, sensors = ttc_s.mean(axis=1), self.sensors[first.rig]
        error_s = of_draws_s.std(ddof=1) / math.sqrt(len(draws)) if len(draws) > 1 else math.nan
        margin_s = student_t95(len(draws) - 1) * error_s if error_s > 0 else math.nan
        mean_s, swept = float(of_draws_s.mean()), first.encounter.speed_is_swept
        return EncounterRow(
            rig=first.rig,
            encounter=first.encounter.name,
            speed_kmh=first.encounter.ego.speed_kmh if swept else math.nan,
            draws=len(draws),
            phases=self.phases,
            needed_s=float(needed_s.max()),
            ttc_s=mean_s,
            ttc_s_low=float(ttc_s.min()),
            ttc_s_high=float(ttc_s.max()),
            interval_low=mean_s - margin_s,
            interval_high=mean_s + margin_s,
            in_time=float((ttc_s >= needed_s[:, None]).mean()),
            from_the_beginning=float(np.mean([one.from_the_beginning for one in draws])),
            first=sensors[int(alone_s.argmax())] if alone_s.any() else "",
            worst=sensors[int(without_s.argmin())],
            without_worst_s=float(without_s.min()),
        )

    def up_to_kmh(self) -> dict[tuple[str, str], float]:
        """Encounter and rig -> the speed up to which it is in time in every phase and draw, of those that were swept.

        0 if it is too late at the least; NaN where the speed was drawn.
        """
        found: dict[tuple[str, str], float] = {}
        late = set[tuple[str, str]]()
        for row in sorted(self.rows, key=lambda row: abs(row.speed_kmh)):
            key = row.encounter, row.rig
            found.setdefault(key, math.nan if math.isnan(row.speed_kmh) else 0.0)
            if row.in_time < 1:
                late.add(key)
            elif key not in late:
                found[key] = row.speed_kmh
        return found

    def settings(self) -> dict[str, Any]:
        """What it is of, for JSON."""
        rigs = {name: list(sensors) for name, sensors in self.sensors.items()}
        return {"set": self.name, **asdict(self.criterion), "phases": self.phases, "seed": self.seed, "rigs": rigs}

    def tables(self) -> list[PageTable]:
        """Up to which speed, when, and by which sensor."""
        rows, rigs = self.rows, list(self.sensors)
        tables = [self._times(rows, rigs)]
        if any(one.encounter.speed_is_swept for one in self.sightings):
            tables.insert(0, _speeds(self.up_to_kmh(), rigs))
        several = [row for row in rows if len(self.sensors[row.rig]) > 1]
        return [*tables, _sensors(several)] if several else tables

    def _times(self, rows: Sequence[EncounterRow], rigs: Sequence[str]) -> PageTable:
        cells = []
        for (encounter, speed), group in groupby(rows, key=lambda row: (row.encounter, _speed(row))):
            of_rigs = {row.rig: row for row in group}
            needed_s = next(iter(of_rigs.values())).needed_s
            cells.append(tuple(map(Words, (encounter, speed, f"{needed_s:.2f}", *(_time(of_rigs[r]) for r in rigs)))))
        unsure = any(row.from_the_beginning for row in rows)
        notes = [
            "The least and the most over the phases of the looks and what was drawn, of that the mean with its 95 % "
            "interval; - is not before the collision.",
            *(["> was seen as soon as the encounter began, and may have been before."] if unsure else []),
            self.criterion.words,
        ]
        headings = ("encounter", "km/h", "needed\n(s)", *(f"{rig}\n(s)" for rig in rigs))
        return PageTable("Time to collision at detection", headings, cells, notes=notes)

    def write_csv(self, path: Path) -> None:
        """Rows as of `rows`; empty where nothing is known."""
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(EncounterRow._fields)
            writer.writerows(map(_cells, self.rows))

    def bands(self) -> Iterator[tuple[str, dict[str, list[tuple[float, float, float]]], list[tuple[float, float]]]]:
        """For the picture: each encounter; of each rig speed (km/h), least and most time to collision; the needed."""
        by_name = sorted(self.sightings, key=lambda one: one.encounter.name)
        of_names = {name: list(group) for name, group in groupby(by_name, key=lambda one: one.encounter.name)}
        for name in dict.fromkeys(one.encounter.name for one in self.sightings):
            bands: dict[str, list[tuple[float, float, float]]] = {}
            for rig in self.sensors:
                times: dict[float, list[float]] = {}
                for one in of_names[name]:
                    if one.rig == rig:
                        times.setdefault(abs(one.encounter.ego.speed_kmh), []).extend(one.ttc_s.tolist())
                bands[rig] = [(speed, min(each), max(each)) for speed, each in sorted(times.items())]
            cases = {abs(one.encounter.ego.speed_kmh): one.encounter.closing_mps for one in of_names[name]}
            yield name, bands, [(speed, self.criterion.needed_s(mps)) for speed, mps in sorted(cases.items())]


def _cells(row: EncounterRow) -> list[str]:
    return ["" if value != value else f"{value:.9g}" if isinstance(value, float) else str(value) for value in row]


def _speed(row: EncounterRow) -> str:
    return "drawn" if math.isnan(row.speed_kmh) else f"{row.speed_kmh:g}"


def _time(row: EncounterRow) -> str:
    if row.ttc_s_high == 0:
        return "-, too late"
    low, high = (f"{value:.2f}" if value else "-" for value in (row.ttc_s_low, row.ttc_s_high))
    late = "" if row.in_time == 1 else f", {100 * row.in_time:.0f} % in time" if row.in_time else ", too late"
    mean = f", mean {row.ttc_s:.2f}" if row.draws > 1 else ""
    interval = f" ({row.interval_low:.2f} to {row.interval_high:.2f})" if row.interval_high > row.interval_low else ""
    return f"{'>' if row.from_the_beginning else ''}{low if low == high else f'{low} to {high}'}{mean}{interval}{late}"


def _speeds(up_to_kmh: dict[tuple[str, str], float], rigs: Sequence[str]) -> PageTable:
    def words(kmh: float) -> str:
        return "drawn" if math.isnan(kmh) else f"{kmh:g}" if kmh else "none"

    names = dict.fromkeys(name for name, _ in up_to_kmh)
    rows = [tuple(map(Words, (name, *(words(up_to_kmh[name, rig]) for rig in rigs)))) for name in names]
    headings = ("encounter", *(f"{rig}\n(km/h)" for rig in rigs))
    return PageTable("In time up to, of the speeds that were swept", headings, rows)


def _sensors(rows: Sequence[EncounterRow]) -> PageTable:
    cells = [
        tuple(map(Words, (row.rig, row.encounter, _speed(row), row.first or "none", row.worst,
                          f"{row.without_worst_s:.2f}" if row.without_worst_s else "-", f"{row.needed_s:.2f}")))
        for row in rows
    ]  # fmt: skip
    headings = ("rig", "encounter", "km/h", "first", "worst to lose", "least without\n(s)", "needed\n(s)")
    return PageTable("Sensors: which alone is first, and what is left without one", headings, cells, words_first=2)
