"""Floating car data of SUMO: positions of all vehicles and people at each time, from a running simulation or a file."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcover.files import guard_reader
from torchcover.geometry.arrays import Float64
from torchcover.simulation.sumo.xml_stream import parse_xml_stream, read_chunks

ATTRIBUTES = "id,x,y,z,angle,slope,type"  # attributes to be written by SUMO
TIME_SLACK_S = 1e-6  # tolerance of comparisons of times


class SumoTrack(NamedTuple):
    """Positions of a vehicle or person, for as long as it was present without a gap.

    Args:
        name: Name in the simulation.
        type_name: Name of its type.
        is_pedestrian: True for a person.
        times_s: (K,) times from the start of the window.
        front_positions_m: (K, 3) float64 positions of the middle of the front, since coordinates may be UTM.
        yaw_deg: (K,) headings, counterclockwise from x; SUMO's angles are clockwise from north.
        slope_deg: (K,) slopes, positive uphill.
    """

    name: str
    type_name: str
    is_pedestrian: bool
    times_s: Float64
    front_positions_m: Float64
    yaw_deg: Float64
    slope_deg: Float64

    def is_present_for(self, duration_s: float) -> bool:
        """Test whether the track lasts from the start of the window on.

        Args:
            duration_s: Duration for which the road user must be present.
        """
        return bool(self.times_s[0] <= TIME_SLACK_S and self.times_s[-1] >= duration_s - TIME_SLACK_S)


class TimeWindow(NamedTuple):
    """Part of a simulation.

    Args:
        begin_s: Earliest start.
        duration_s: Duration.
        start_vehicle_id: Vehicle at whose first appearance the window starts, if it is later.
    """

    begin_s: float
    duration_s: float
    start_vehicle_id: str | None = None


class _WindowEndError(Exception):
    """Signal that the window is complete."""


class FloatingCarDataParser:
    """Collector of the rows of a window, from tags.

    Args:
        window: Part of the simulation.

    Attributes:
        begin_s: Start of the window; NaN before.
        last_s: Last time in the data; -inf before.
        indices: Index of each road user by its name and whether it is a person.
        type_names: Name of the type of each road user.
        times_s: Times in the window.
        row_counts: Number of rows at each time.
        row_indices: Index of the road user of each row.
        rows: Arrays (N, 6) of x, y, angle, z, slope and speed; the speed is NaN where it is missing.
        has_more_digits: Whether x always has as many decimals as degrees have, and angles have fewer.
    """

    def __init__(self, window: TimeWindow) -> None:
        self._window = window
        self.begin_s, self.last_s, self._end_s = np.nan, -np.inf, np.inf
        self._vehicles: list[list[str]] = []
        self._people: list[list[str]] = []
        self.indices: dict[tuple[bool, str], int] = {}
        self.type_names: list[str] = []
        self.times_s: list[float] = []
        self.row_counts: list[int] = []
        self.row_indices: list[int] = []
        self.rows: list[Float64] = []
        self.has_more_digits = True

    def start_element(self, name: str, attributes: list[str]) -> None:
        """Process a start tag from `parse_xml_stream`.

        Args:
            name: Name of the element.
            attributes: Names and values of its attributes, in turn.
        """
        if name == "vehicle":
            self._vehicles.append(attributes)
        elif name == "person":
            self._people.append(attributes)
        elif name == "timestep":
            self.end_time_step()
            time_s = float(attributes[attributes.index("time") + 1])
            if time_s <= self.last_s:
                raise ValueError(f"times of <timestep> must ascend; {time_s:g} s follows {self.last_s:g} s")
            if time_s > self._end_s + TIME_SLACK_S:
                raise _WindowEndError
            self.last_s = time_s

    def end_time_step(self) -> None:
        """Store the rows of the last time step if it is in the window."""
        vehicles, people = self._vehicles, self._people
        self._vehicles, self._people = [], []
        if np.isnan(self.begin_s):
            if not self._is_window_start(vehicles):
                return
            self.begin_s, self._end_s = self.last_s, self.last_s + self._window.duration_s
        self.times_s.append(self.last_s)
        self.row_counts.append(0)
        columns = self._parse_columns(vehicles)
        vehicle_positions = set(zip(columns["x"], columns["y"], strict=True))
        self._store_rows(columns, is_person=False)
        # SUMO reports passengers at the position of their vehicle.
        columns = self._parse_columns(people)
        positions = list(zip(columns["x"], columns["y"], strict=True))
        if not vehicle_positions.isdisjoint(positions):
            outside = []
            for person, position in zip(people, positions, strict=True):
                if position not in vehicle_positions:
                    outside.append(person)
            columns = self._parse_columns(outside)
        self._store_rows(columns, is_person=True)

    def _is_window_start(self, vehicles: Sequence[list[str]]) -> bool:
        """Test whether the window starts at the last time step."""
        if self.last_s < self._window.begin_s - TIME_SLACK_S or not np.isfinite(self.last_s):
            return False
        vehicle_id = self._window.start_vehicle_id
        if vehicle_id is None:
            return True
        return any(("id", vehicle_id) in zip(row[::2], row[1::2], strict=True) for row in vehicles)

    def _parse_columns(self, rows: list[list[str]]) -> dict[str, tuple[str, ...]]:
        """Parse the values of all attributes that the rows share."""
        if not rows:
            return {"id": (), "x": (), "y": (), "angle": ()}
        # Usually all rows have the same attributes; then their values are transposed without a dict for each row.
        names = rows[0][::2]
        if any(row[::2] != names for row in rows):
            dicts = [dict(zip(row[::2], row[1::2], strict=True)) for row in rows]
            names = sorted(set(names).intersection(*dicts))
            values = [tuple(row[name] for row in dicts) for name in names]
        else:
            values = list(zip(*rows, strict=True))[1::2]
        missing = [name for name in ("id", "x", "y", "angle") if name not in names]
        if missing:
            raise ValueError(
                f"t = {self.last_s:g} s: a vehicle or person without {', '.join(missing)}; id, x, y and angle are "
                f"needed (sumo --fcd-output.attributes {ATTRIBUTES})"
            )
        return dict(zip(names, values, strict=True))

    def _store_rows(self, columns: dict[str, tuple[str, ...]], is_person: bool) -> None:
        """Store the rows of the vehicles or of the people of a time step."""
        num_rows = len(columns["id"])
        if not num_rows:
            return
        self.row_counts[-1] += num_rows
        for name, type_name in zip(columns["id"], columns.get("type", ("",) * num_rows), strict=True):
            index = self.indices.setdefault((is_person, name), len(self.type_names))
            if index == len(self.type_names):
                self.type_names.append(type_name)
            self.row_indices.append(index)
        geo_digits = 5  # SUMO writes degrees with six decimals by default, and other numbers with two
        x_digits, angle_digits = count_decimals(columns["x"]), count_decimals(columns["angle"])
        self.has_more_digits &= x_digits >= geo_digits > angle_digits
        numbers = []
        for name, default in (("x", ""), ("y", ""), ("angle", ""), ("z", "0"), ("slope", "0"), ("speed", "nan")):
            texts = columns.get(name, (default,) * num_rows)
            numbers.append([float(text) for text in texts])
        self.rows.append(np.array(numbers).T)


class FloatingCarData(NamedTuple):
    """Tracks of all road users in a window.

    Args:
        tracks: Tracks in the order of their first appearance; a road user with gaps has several.
        begin_s: Start of the window in the simulation.
        last_time_s: Last time in the data; -inf without any.
    """

    tracks: tuple[SumoTrack, ...]
    begin_s: float
    last_time_s: float


def parse_floating_car_data(chunks: Iterable[bytes], window: TimeWindow) -> FloatingCarData:
    """Parse floating car data from chunks of XML, and stop after the window.

    Args:
        chunks: Content of the file.
        window: Part of the simulation.

    Raises:
        ValueError: The content is no floating car data, or has no angles.
    """
    parser = FloatingCarDataParser(window)
    with suppress(_WindowEndError):
        parse_xml_stream(chunks, parser.start_element)
        parser.end_time_step()
    return FloatingCarData(tuple(_iterate_tracks(parser)), parser.begin_s, parser.last_s)


@guard_reader("floating car data of SUMO")
def read_floating_car_data(path: Path, window: TimeWindow) -> FloatingCarData:
    """Read floating car data from a file.

    Args:
        path: The file.
        window: Part of the simulation.

    Raises:
        BadFileError: The file is no floating car data, or has no angles or time steps.
    """
    data = parse_floating_car_data(read_chunks(path), window)
    if not np.isfinite(data.last_time_s):
        raise ValueError("floating car data of SUMO with at least one <timestep> is needed")
    return data


def count_decimals(numbers: tuple[str, ...]) -> int:
    """Count the decimals of the first number."""
    return len(numbers[0].partition(".")[2])


def check_meters(positions: Float64, speed_mps: Float64, times_s: Float64, has_more_digits: bool) -> None:
    """Check that positions are not degrees: road users in one square degree must not drive farther than it is wide.

    Args:
        positions: (N, 2) x and y of all road users at all times.
        speed_mps: (N,) speeds; NaN where they are missing.
        times_s: (K,) times of the window.
        has_more_digits: Whether x is written with the decimals of degrees, and angles with fewer.

    Raises:
        ValueError: The positions are longitude and latitude.
    """
    max_degrees = (180.0, 90.0)
    if not len(positions) or (np.abs(positions) > max_degrees).any() or (np.ptp(positions, axis=0) >= 1.0).any():
        return
    min_driven_m = 2.0  # a road user that drove this far left a square of 1 m
    driven_m = float(np.nan_to_num(speed_mps).max(initial=0.0)) * float(np.ptp(times_s))
    are_degrees = driven_m > min_driven_m if np.isfinite(speed_mps).any() else has_more_digits
    if are_degrees:
        raise ValueError(
            f"x and y are degrees of longitude and latitude, such as {positions[0, 0]:g}, {positions[0, 1]:g}; meters "
            "of the network are needed: write it without --fcd-output.geo"
        )


def _iterate_tracks(parser: FloatingCarDataParser) -> Iterator[SumoTrack]:
    """Iterate over the tracks, split where a road user is absent or is moved by the simulation."""
    max_missing_steps = 1.5  # longer gaps, in median time steps, split a track
    max_speed_mps = 90.0  # larger distances between two rows split a track
    times_s = np.array(parser.times_s) - parser.begin_s
    row_indices = np.array(parser.row_indices, dtype=np.int64)
    time_indices = np.repeat(np.arange(len(times_s)), parser.row_counts)
    all_rows = np.concatenate([*parser.rows, np.empty((0, 6))])
    rows, speed_mps = all_rows[:, :5], all_rows[:, 5]
    is_finite = np.isfinite(rows)
    if not is_finite.all():
        raise ValueError(f"{int((~is_finite).any(axis=1).sum())} of {len(rows)} positions are NaN or infinite")
    check_meters(rows[:, :2], speed_mps, times_s, parser.has_more_digits)
    median_step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    # The rows of each road user, in the order of time.
    order = np.argsort(row_indices, kind="stable")
    ends = np.cumsum(np.bincount(row_indices, minlength=len(parser.type_names))).tolist()
    for (is_person, name), index in parser.indices.items():
        selection = order[ends[index - 1] if index else 0 : ends[index]]
        is_always_present = len(selection) == len(times_s)
        # Road users that are always present share one array of times.
        track_times_s = times_s if is_always_present else times_s[time_indices[selection]]
        steps_s = np.diff(track_times_s)
        steps_m = np.linalg.norm(np.diff(rows[selection, :2], axis=0), axis=1)
        if (steps_s <= 0).any():
            time_s = parser.begin_s + track_times_s[steps_s.argmin()]
            raise ValueError(f"{name!r} appears twice at t = {time_s:g} s")
        is_gap = steps_s > max_missing_steps * median_step_s + TIME_SLACK_S
        breaks = np.flatnonzero(is_gap | (steps_m > max_speed_mps * steps_s)) + 1
        for first, end in pairwise([0, *breaks.tolist(), len(selection)]):
            x_m, y_m, angle_deg, z_m, slope_deg = rows[selection[first:end]].T
            yield SumoTrack(
                name=name,
                type_name=parser.type_names[index],
                is_pedestrian=is_person,
                times_s=track_times_s if end - first == len(selection) else track_times_s[first:end],
                front_positions_m=np.stack([x_m, y_m, z_m], axis=1),
                yaw_deg=90.0 - angle_deg,
                slope_deg=slope_deg,
            )
