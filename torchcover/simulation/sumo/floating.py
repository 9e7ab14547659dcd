"""Floating car data: where everybody is at each time, as SUMO writes it while it runs, or into a file."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcover.files import guard_reader
from torchcover.geometry.arrays import Float64
from torchcover.simulation.sumo.network import parse_xml_stream, read_chunks

ATTRIBUTES = "id,x,y,z,angle,slope,type"
# Who is not heard of for longer than this many usual steps, or moves faster than this from one to the next, is gone in
# between, or was moved by the simulation.
MAX_STEPS = 1.5
FASTEST_MPS = 90.0
TIME_SLACK_S = 1e-6
# Largest longitude and latitude.
DEGREES = (180.0, 90.0)
# SUMO writes degrees with six decimals unless told otherwise, and all else with two.
GEO_DIGITS = 5
# By its speed, a road user gets farther than the degree that all positions lie within.
MIN_DRIVEN_M = 2.0


class SumoTrack(NamedTuple):
    """One vehicle or person, for as long as it was there without a gap; `type_name` is the name of its type.

    At (K,) times from the first of the run: (K, 3) the middle of its front, float64, for they may be of UTM size; its
    heading, counter-clockwise from x, where SUMO's own angles are clockwise from north; and its slope upwards.
    """

    name: str
    type_name: str
    is_pedestrian: bool
    times_s: Float64
    front_positions_m: Float64
    yaw_deg: Float64
    slope_deg: Float64

    def is_present_for(self, duration_s: float) -> bool:
        """Whether it is there from the first time to so much later."""
        return bool(self.times_s[0] <= TIME_SLACK_S and self.times_s[-1] >= duration_s - TIME_SLACK_S)


class TimeWindow(NamedTuple):
    """What of the data is meant: from `begin_s` of the simulation, or from when `start_vehicle_id` is heard of, if later."""

    begin_s: float
    duration_s: float
    start_vehicle_id: str | None = None


class _Enough(Exception):  # noqa: N818  (no error: the window is over)
    pass


class _Collector:
    """Keeps the rows of a window, as start tags come in."""

    def __init__(self, window: TimeWindow) -> None:
        self._window = window
        self.begin_s, self.last_s, self._end_s = np.nan, -np.inf, np.inf
        self._now: dict[str, list[list[str]]] = {"vehicle": [], "person": []}
        self.number: dict[tuple[bool, str], int] = {}
        self.kinds: list[str] = []
        self.times_s: list[float] = []
        self.of: list[int] = []
        self.rows: list[Float64] = []
        # Whether x always has the decimals of degrees, and angles fewer.
        self.has_more_digits = True
        self.counts: list[int] = []

    def start(self, name: str, attributes: list[str]) -> None:
        """A tag; see `parse_xml_stream`."""
        if name in self._now:
            self._now[name].append(attributes)
        elif name == "timestep":
            self.end_step()
            time_s = float(attributes[attributes.index("time") + 1])
            if time_s <= self.last_s:
                raise ValueError(f"the times of its steps must ascend; {time_s:g} s follows {self.last_s:g} s")
            if time_s > self._end_s + TIME_SLACK_S:
                raise _Enough
            self.last_s = time_s

    def end_step(self) -> None:
        """Keep what was told of the step, if it is in the window."""
        now = {name: rows for name, rows in self._now.items() if rows}
        self._now = {"vehicle": [], "person": []}
        if np.isnan(self.begin_s):
            waits = self._window.start_vehicle_id is not None and not any(
                ("id", self._window.start_vehicle_id) in zip(row[::2], row[1::2], strict=True)
                for row in now.get("vehicle", ())
            )
            if waits or self.last_s < self._window.begin_s - TIME_SLACK_S or not np.isfinite(self.last_s):
                return
            self.begin_s, self._end_s = self.last_s, self.last_s + self._window.duration_s
        self.times_s.append(self.last_s)
        self.counts.append(0)
        driven: set[tuple[str, str]] = set()
        for name, rows in now.items():
            columns = self._columns(rows)
            places = list(zip(columns["x"], columns["y"], strict=True))
            if name == "vehicle":
                driven = set(places)
            elif not driven.isdisjoint(places):  # who rides is told of where the vehicle is
                rows = [row for row, place in zip(rows, places, strict=True) if place not in driven]  # noqa: PLW2901
                if not rows:
                    continue
                columns = self._columns(rows)
            self.counts[-1] += len(rows)
            for who, kind in zip(columns["id"], columns.get("type", ("",) * len(rows)), strict=True):
                number = self.number.setdefault((name == "person", who), len(self.kinds))
                if number == len(self.kinds):
                    self.kinds.append(kind)
                self.of.append(number)
            zeros = ("0",) * len(rows)
            numbers = [columns[name] for name in ("x", "y", "angle")]
            numbers += [columns.get(name, zeros) for name in ("z", "slope")]
            numbers.append(columns.get("speed", ("nan",) * len(rows)))
            self.has_more_digits &= _digits(columns["x"]) >= GEO_DIGITS > _digits(columns["angle"])
            self.rows.append(np.array([list(map(float, column)) for column in numbers]).T)

    def _columns(self, rows: list[list[str]]) -> dict[str, tuple[str, ...]]:
        """The values of each attribute; all rows have the same ones."""
        names = rows[0][::2]
        if any(row[::2] != names for row in rows):
            shared = sorted(set(names).intersection(*(row[::2] for row in rows)))
            rows = [[part for name in shared for part in (name, row[2 * row[::2].index(name) + 1])] for row in rows]
            names = shared
        missing = [name for name in ("id", "x", "y", "angle") if name not in names]
        if missing:
            raise ValueError(
                f"t = {self.last_s:g} s: a vehicle or person without {', '.join(missing)}; id, x, y and angle are "
                f"needed of each (sumo --fcd-output.attributes {ATTRIBUTES})"
            )
        return dict(zip(names, list(zip(*rows, strict=True))[1::2], strict=True))


class FloatingCarData(NamedTuple):
    """What there is in a window that begins at `begin_s` of the simulation; `last_time_s` is the last time read, or -inf.

    The tracks are in the order of their first appearance; somebody who was gone in between has several.
    """

    tracks: tuple[SumoTrack, ...]
    begin_s: float
    last_time_s: float


def parse_floating_car_data(chunks: Iterable[bytes], window: TimeWindow) -> FloatingCarData:
    """Read floating car data from pieces of XML, no more of which are asked for than the window needs.

    ValueError: not such data, or without angles.
    """
    collector = _Collector(window)
    with suppress(_Enough):
        parse_xml_stream(chunks, collector.start)
        collector.end_step()
    return FloatingCarData(tuple(_tracks(collector)), collector.begin_s, collector.last_s)


@guard_reader("floating car data of SUMO")
def read_floating_car_data(path: Path, window: TimeWindow) -> FloatingCarData:
    """Read it from a file; see `record`."""
    recorded = parse_floating_car_data(read_chunks(path), window)
    if not np.isfinite(recorded.last_time_s):
        raise ValueError("floating car data of SUMO with at least one <timestep> is needed")
    return recorded


def _digits(numbers: tuple[str, ...]) -> int:
    """Return how many decimals the first of these numbers has."""
    return len(numbers[0].partition(".")[2])


def _check_meters(places: Float64, speed_mps: Float64, times_s: Float64, has_more_digits: bool) -> None:
    """Refuse longitude and latitude: everything lies within a degree, although it drives.

    Args:
        places: (N, 2) x and y of everybody at all times.
        speed_mps: (N,) NaN where the file does not say it.
        times_s: (K,) times of the window.
        has_more_digits: Whether x is written with the decimals of degrees, and angles with fewer.

    Raises:
        ValueError: They are degrees.
    """
    if not len(places) or (np.abs(places) > DEGREES).any() or (np.ptp(places, axis=0) >= 1.0).any():
        return
    driven_m = float(np.nan_to_num(speed_mps).max(initial=0.0)) * float(np.ptp(times_s))
    if driven_m > MIN_DRIVEN_M if np.isfinite(speed_mps).any() else has_more_digits:
        raise ValueError(
            f"x and y are degrees of longitude and latitude, such as {places[0, 0]:g}, {places[0, 1]:g}; meters of the "
            "network are needed: write it without --fcd-output.geo"
        )


def _tracks(collector: _Collector) -> Iterator[SumoTrack]:
    times_s = np.array(collector.times_s) - collector.begin_s
    of = np.array(collector.of, dtype=np.int64)
    step = np.repeat(np.arange(len(times_s)), collector.counts)
    rows = np.concatenate([*collector.rows, np.empty((0, 6))])
    rows, speed_mps = rows[:, :5], rows[:, 5]
    if not np.isfinite(rows).all():
        raise ValueError(f"{int((~np.isfinite(rows)).any(axis=1).sum())} of {len(rows)} positions are NaN or infinite")
    _check_meters(rows[:, :2], speed_mps, times_s, collector.has_more_digits)
    usual_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    order = np.argsort(of, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=len(collector.kinds)))])
    for (on_foot, name), number in collector.number.items():
        own = order[ends[number] : ends[number + 1]]
        if len(own) == 0:
            continue
        # Bodies that are there all the time share their times.
        own_s = times_s if len(own) == len(times_s) else times_s[step[own]]
        taken_s, way_m = np.diff(own_s), np.linalg.norm(np.diff(rows[own, :2], axis=0), axis=1)
        if (taken_s <= 0).any():
            raise ValueError(f"{name!r} is there twice at t = {collector.begin_s + own_s[taken_s.argmin()]:g} s")
        breaks = np.flatnonzero((taken_s > MAX_STEPS * usual_s + TIME_SLACK_S) | (way_m > FASTEST_MPS * taken_s)) + 1
        for first, end in pairwise([0, *breaks.tolist(), len(own)]):
            x_m, y_m, angle_deg, z_m, slope_deg = rows[own[first:end]].T
            yield SumoTrack(
                name=name,
                type_name=collector.kinds[number],
                is_pedestrian=on_foot,
                times_s=own_s if end - first == len(own) else own_s[first:end],
                front_positions_m=np.stack([x_m, y_m, z_m], axis=1),
                yaw_deg=90.0 - angle_deg,
                slope_deg=slope_deg,
            )
