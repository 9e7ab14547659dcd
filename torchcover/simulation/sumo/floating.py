"""Floating car data: where everybody is at each time, as SUMO writes it while it runs, or into a file."""

from array import array
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import feed_xml, reads

Numbers = NDArray[np.float64]

ATTRIBUTES = "id,x,y,z,angle,slope,type"
# Who is not heard of for longer than this many usual steps, or moves faster than this from one to the next, is gone in
# between, or was moved by the simulation.
MAX_STEPS = 1.5
FASTEST_MPS = 90.0
PIECE_BYTES = 1 << 18
TIME_SLACK_S = 1e-6


class Track(NamedTuple):
    """One vehicle or person, for as long as it was there without a gap.

    Args:
        name: Of the simulation.
        kind: Name of its type.
        on_foot: Whether it is a person.
        times_s: (K,) from the first time of the run.
        places_m: (K, 3) the middle of its front, float64: they may be of UTM size.
        yaw_deg: (K,) heading, counter-clockwise from x; SUMO's own angles are clockwise from north.
        slope_deg: (K,) upwards.
    """

    name: str
    kind: str
    on_foot: bool
    times_s: Numbers
    places_m: Numbers
    yaw_deg: Numbers
    slope_deg: Numbers

    def covers(self, duration_s: float) -> bool:
        """Whether it is there from the first time to so much later."""
        return bool(self.times_s[0] <= TIME_SLACK_S and self.times_s[-1] >= duration_s - TIME_SLACK_S)


class Window(NamedTuple):
    """What of the data is meant.

    Args:
        begin_s: Its first time, in that of the simulation.
        duration_s: Its length.
        from_name: It begins when this one is heard of, if that is later.
    """

    begin_s: float
    duration_s: float
    from_name: str | None = None


class _Enough(Exception):  # noqa: N818  (no error: the window is over)
    pass


class _Collector:
    """Keeps the rows of a window, as start tags come in."""

    def __init__(self, window: Window) -> None:
        self._window = window
        self._waits_for = window.from_name
        self.begin_s, self._time_s, self._keeps = window.begin_s, -np.inf, False
        self._end_s = np.inf
        self.number: dict[tuple[bool, str], int] = {}
        self.kinds: list[str] = []
        self.times_s: list[float] = []
        self.of = array("q")
        self.step = array("q")
        self.rows = array("d")
        self.seen_s: list[float] = []

    def start(self, name: str, attributes: dict[str, str]) -> None:
        """A tag; see `feed_xml`."""
        if name == "timestep":
            self._step(float(attributes["time"]))
        elif name in ("vehicle", "person") and self._time_s >= self._window.begin_s - TIME_SLACK_S:
            if self._waits_for is not None and attributes["id"] == self._waits_for:
                self._begin()
            if self._keeps or self._waits_for is not None:
                self._keep(name == "person", attributes)

    def _step(self, time_s: float) -> None:
        if time_s <= self._time_s:
            raise ValueError(f"the times of its steps must ascend; {time_s:g} s follows {self._time_s:g} s")
        self._time_s = time_s
        self.seen_s = [*self.seen_s[:1], time_s]
        if time_s > self._end_s + TIME_SLACK_S:
            raise _Enough
        if time_s < self._window.begin_s - TIME_SLACK_S:
            return
        if self._waits_for is not None:
            # Whoever is written before the one that is waited for belongs to the same step: kept until the next one.
            del self.of[:], self.step[:], self.rows[:], self.times_s[:]
        elif not self._keeps:
            self._begin()
        self.times_s.append(time_s)

    def _begin(self) -> None:
        self._waits_for, self._keeps = None, True
        self.begin_s, self._end_s = self._time_s, self._time_s + self._window.duration_s

    def _keep(self, on_foot: bool, attributes: dict[str, str]) -> None:
        try:
            name, kind = attributes["id"], attributes.get("type", "")
            self.rows.extend([
                float(attributes["x"]), float(attributes["y"]), float(attributes.get("z", 0.0)),
                float(attributes["angle"]), float(attributes.get("slope", 0.0)),
            ])  # fmt: skip
        except KeyError as error:
            raise ValueError(
                f"t = {self._time_s:g} s: a vehicle or person without {error.args[0]}; id, x, y and angle are needed "
                f"of each (sumo --fcd-output.attributes {ATTRIBUTES})"
            ) from error
        key = on_foot, name
        if key not in self.number:
            self.number[key] = len(self.kinds)
            self.kinds.append(kind)
        self.of.append(self.number[key])
        self.step.append(len(self.times_s) - 1)


class Recorded(NamedTuple):
    """What there is in a window.

    Args:
        tracks: All, in the order of their first appearance; somebody who was gone in between has several.
        begin_s: When it begins, in the time of the simulation.
        last_s: The last time that was read.
    """

    tracks: tuple[Track, ...]
    begin_s: float
    last_s: float


def record(pieces: Iterable[bytes], window: Window) -> Recorded:
    """Read floating car data.

    Args:
        pieces: XML as SUMO writes it; no more of it is asked for than the window needs.
        window: What is kept of it.

    Raises:
        ValueError: Not such data, or without angles.
    """
    collector = _Collector(window)
    with suppress(_Enough):
        feed_xml(pieces, collector.start)
    if not collector.seen_s:
        raise ValueError("floating car data of SUMO with at least one <timestep> is needed")
    return Recorded(tuple(_tracks(collector)), collector.begin_s, collector.seen_s[-1])


@reads("floating car data of SUMO")
def read_floating(path: Path, window: Window) -> Recorded:
    """Read it from a file; see `record`.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: As `record`.
    """
    with path.open("rb") as file:
        return record(iter(lambda: file.read(PIECE_BYTES), b""), window)


def _tracks(collector: _Collector) -> Iterator[Track]:
    times_s = np.array(collector.times_s) - collector.begin_s
    of, step = np.array(collector.of, dtype=np.int64), np.array(collector.step, dtype=np.int64)
    rows = np.array(collector.rows, dtype=np.float64).reshape(-1, 5)
    if not np.isfinite(rows).all():
        raise ValueError(f"{int((~np.isfinite(rows)).any(axis=1).sum())} of {len(rows)} positions are NaN or infinite")
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
            x_m, y_m, z_m, angle_deg, slope_deg = rows[own[first:end]].T
            yield Track(
                name=name,
                kind=collector.kinds[number],
                on_foot=on_foot,
                times_s=own_s if end - first == len(own) else own_s[first:end],
                places_m=np.stack([x_m, y_m, z_m], axis=1),
                yaw_deg=90.0 - angle_deg,
                slope_deg=slope_deg,
            )
