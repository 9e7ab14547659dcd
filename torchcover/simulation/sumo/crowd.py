"""From tracks to bodies: which of ours stands for a type of SUMO, who is the ego, and who comes near it."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import feed_xml, reads
from torchcover.simulation.sumo.floating import Recorded, SumoTrack
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import CATEGORIES, Fleet
from torchcover.simulation.traffic.vehicle_class import VehicleType

Numbers = NDArray[np.float64]

# Bodies are kept apart in plan; that much more lets them tilt.
APART_M = 0.15
# Egos that are tried, until one meets nobody.
TRIES = 8
PIECE_BYTES = 1 << 18

# What SUMO takes for the length of a type that has none.
USUAL_LENGTH_M = {
    "pedestrian": 0.215, "bicycle": 1.6, "scooter": 1.2, "moped": 2.1, "motorcycle": 2.2, "truck": 7.1,
    "trailer": 16.5, "bus": 12.0, "coach": 14.0, "tram": 22.0, "delivery": 6.5, "emergency": 6.5,
}  # fmt: skip
CAR_LENGTH_M = 5.0
# In floating car data alone a type is but a name.
WORDS = (
    ("ped", "pedestrian"), ("person", "pedestrian"), ("motorcycle", "motorcycle"), ("moped", "moped"),
    ("bike", "bicycle"), ("bicycle", "bicycle"), ("cycl", "bicycle"), ("bus", "bus"), ("coach", "coach"),
    ("truck", "truck"), ("trailer", "trailer"), ("lorry", "truck"), ("tram", "tram"), ("rail", "rail"),
    ("train", "rail"), ("subway", "subway"), ("ship", "ship"), ("van", "delivery"), ("delivery", "delivery"),
)  # fmt: skip


def type_of(name: str, on_foot: bool, known: Mapping[str, VehicleType]) -> VehicleType:
    """A type by its name: one that is known, else what its name says.

    Example:
        >>> type_of("DEFAULT_BIKETYPE", False, {}).vehicle_class
        'bicycle'
    """
    if on_foot:  # all have one class, and the same length
        return VehicleType("child" if "child" in name.lower() else "pedestrian", USUAL_LENGTH_M["pedestrian"])
    if name in known:
        return known[name]
    vehicle_class = next((found for word, found in WORDS if word in name.lower()), "passenger")
    return VehicleType(vehicle_class, USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M))


@reads("routes of SUMO")
def read_types(path: Path) -> dict[str, VehicleType]:
    """The types that a file of routes declares."""
    found: dict[str, VehicleType] = {}

    def start(name: str, names_and_values: list[str]) -> None:
        attributes = dict(zip(names_and_values[::2], names_and_values[1::2], strict=True))
        if name == "vType" and "id" in attributes:
            vehicle_class = attributes.get("vClass", "passenger")
            length_m = float(attributes.get("length", USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M)))
            if not length_m > 0:
                raise ValueError(f"type {attributes['id']!r}: a positive length is needed; got {length_m:g}")
            found[attributes["id"]] = VehicleType(vehicle_class, length_m)

    with path.open("rb") as file:
        feed_xml(iter(lambda: file.read(PIECE_BYTES), b""), start)
    return found


def types_of(paths: Sequence[Path]) -> dict[str, VehicleType]:
    """The types that several files declare together."""
    return {name: found for path in paths for name, found in read_types(path).items()}


class Walker(NamedTuple):
    """Somebody as a body in plan.

    Args:
        track: Where it is.
        kind: Of its body.
        middle_m: (K, 2) its middle, at the times of the track.
        size_m: Length and width.
    """

    track: SumoTrack
    kind: str
    middle_m: Numbers
    size_m: tuple[float, float]

    @classmethod
    def of(cls, track: SumoTrack, kind: str, length_m: float, size_m: tuple[float, float]) -> "Walker":
        """Its middle lies half of the simulation's length behind its front; people's places are their middles."""
        yaw = np.deg2rad(track.yaw_deg)
        back_m = 0.0 if track.on_foot else length_m / 2
        middle_m = track.places_m[:, :2] - back_m * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        return cls(track, kind, middle_m, size_m)

    def at(self, times_s: Numbers) -> tuple[Numbers, Numbers]:
        """(T, 2) places and (T,) headings; NaN where it is not there."""
        own_s = self.track.times_s
        yaw = np.unwrap(np.deg2rad(self.track.yaw_deg))
        columns = [np.interp(times_s, own_s, axis, np.nan, np.nan) for axis in (*self.middle_m.T, yaw)]
        return np.stack(columns[:2], axis=1), columns[2]


class Crowd(NamedTuple):
    """The ego, and who comes near to it."""

    ego: Walker
    others: list[Walker]


def crowd(
    recorded: Recorded,
    known: Mapping[str, VehicleType],
    fleet: Fleet,
    ego_name: str | None,
    ego_type: str | None,
    times_s: Numbers,
    generator: np.random.Generator,
) -> Crowd:
    """Choose the ego, and leave out whoever never comes near or is where the ego is.

    Args:
        recorded: What the simulation had.
        known: Its types.
        fleet: Our bodies.
        ego_name: Which one the ego is; drawn if not given.
        ego_type: Of which type it is, if it is drawn; any car if not given.
        times_s: (T,) the instants of the run.
        generator: Draws the ego, in proportion to the ways that vehicles drive.

    Raises:
        ValueError: Nobody who may be the ego is there for the whole run.
    """
    lengths_m = {kind: fleet.length_m(kind) for kind in CATEGORIES}
    walkers: list[Walker] = []
    for track in recorded.tracks:
        found = type_of(track.kind, track.on_foot, known)
        kind = found.body(lengths_m)
        if kind is not None:
            walkers.append(Walker.of(track, kind, found.length_m, (fleet.length_m(kind), fleet.width_m(kind))))
    candidates = _candidates(walkers, recorded, ego_name, ego_type, float(times_s[-1]), generator)
    best: tuple[Walker, list[Walker], list[Walker]] | None = None
    for candidate in candidates[:TRIES]:
        ego = candidate._replace(size_m=(fleet.length_m("ego"), fleet.width_m("ego")))
        near = [other for other in walkers if other is not candidate and _comes_near(other, ego)]
        met = [other for other in near if _overlap(ego, other, times_s)]
        if best is None or len(met) < len(best[2]):
            best = ego, near, met
        if not met:
            break
    assert best is not None  # there is a candidate
    ego, near, met = best
    if met:
        warnings.warn(
            f"the simulation has {len(met)} of {len(near)} road users where the ego is at some time "
            f"({', '.join(repr(other.track.name) for other in met[:3])}); they are left out",
            stacklevel=2,
        )
    names = {other.track.name for other in met}
    return Crowd(ego, [other for other in near if other.track.name not in names])


def _candidates(
    walkers: Sequence[Walker],
    recorded: Recorded,
    name: str | None,
    kind: str | None,
    duration_s: float,
    generator: np.random.Generator,
) -> list[Walker]:
    """Who may be the ego, in the order in which they are tried."""
    begin_s, end_s = recorded.begin_s, recorded.begin_s + duration_s
    when = f"from t = {begin_s:g} to {end_s:g} s"
    if name is not None:
        own = [walker for walker in walkers if walker.track.name == name and not walker.track.on_foot]
        there = [walker for walker in own if walker.track.covers(duration_s)]
        if there:
            return there[:1]
        if not own:
            raise ValueError(f"ego_id: no vehicle {name!r} up to t = {recorded.last_s:g} s, where the data end")
        gone_s = begin_s + float(own[0].track.times_s[-1])
        raise ValueError(
            f"ego_id: {name!r} is not there all the time {when}: it leaves the network, teleports or has a gap after "
            f"t = {gone_s:g} s; shorten duration_s to {max(gone_s - begin_s, 0.0):g}, or take another ego"
        )
    drivers = [
        walker
        for walker in walkers
        if (walker.track.kind == kind if kind is not None else CATEGORIES[walker.kind] == "car")
    ]
    there = [walker for walker in drivers if walker.track.covers(duration_s) and not walker.track.on_foot]
    if not there:
        longest = max((float(np.ptp(walker.track.times_s)) for walker in drivers), default=0.0)
        who = f"vehicle of type {kind!r}" if kind is not None else "car"
        raise ValueError(
            f"no {who} that could be the ego is there all the time {when}: of {len(drivers)}, the longest drives "
            f"for {longest:g} s (data end at t = {recorded.last_s:g} s); change duration_s or begin_s"
        )
    ways_m = np.array([np.linalg.norm(np.diff(walker.middle_m, axis=0), axis=1).sum() for walker in there]) + 1e-3
    order = generator.choice(len(there), size=len(there), replace=False, p=ways_m / ways_m.sum())
    return [there[number] for number in order.tolist()]


def _comes_near(other: Walker, ego: Walker) -> bool:
    """Whether the two are ever within the range of sensors, at the times of the other."""
    if other.track.times_s is ego.track.times_s:
        ego_m = ego.middle_m
    else:
        ego_m, _ = ego.at(other.track.times_s)
    distance_m = np.linalg.norm(other.middle_m - ego_m, axis=1)
    return bool((distance_m < HORIZON_M).any())


def _overlap(ego: Walker, other: Walker, times_s: Numbers) -> bool:
    """Whether two rectangles in plan do at any of some times, as no axis of either separates them."""
    (ego_m, ego_yaw), (other_m, other_yaw) = ego.at(times_s), other.at(times_s)
    between_m = other_m - ego_m
    reach_m = (np.hypot(*ego.size_m) + np.hypot(*other.size_m)) / 2 + APART_M
    close = np.flatnonzero(np.linalg.norm(between_m, axis=1) < reach_m)
    if len(close) == 0:
        return False
    between_m, turn = between_m[close], (other_yaw - ego_yaw)[close]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    apart = np.zeros(len(close), dtype=bool)
    for yaw, own, its in ((ego_yaw[close], ego.size_m, other.size_m), (other_yaw[close], other.size_m, ego.size_m)):
        forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
        length_m, width_m = its
        for axis, half_m, reach in (
            (forward, own[0] / 2, (length_m * cos + width_m * sin) / 2),
            (left, own[1] / 2, (length_m * sin + width_m * cos) / 2),
        ):
            apart |= np.abs((between_m * axis).sum(axis=1)) > half_m + reach + APART_M
    return bool(not apart.all())
