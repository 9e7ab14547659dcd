"""From tracks to bodies: which of ours stands for a type of SUMO, who is the ego, and who comes near it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchcover.files import guard_reader
from torchcover.simulation.sumo.floating import FloatingCarData, SumoTrack
from torchcover.simulation.sumo.motion import RoadUser
from torchcover.simulation.sumo.network import pair_attributes, parse_xml_stream, read_chunks
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, Fleet, VehicleType

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


def get_vehicle_type(name: str, known_types: Mapping[str, VehicleType]) -> VehicleType:
    """A type by its name: one that is known, else what its name says.

    Example:
        >>> get_vehicle_type("DEFAULT_BIKETYPE", {}).vehicle_class
        'bicycle'
    """
    if name in known_types:
        return known_types[name]
    vehicle_class = next((found for word, found in WORDS if word in name.lower()), "passenger")
    return VehicleType(vehicle_class, USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M))


@guard_reader("routes of SUMO")
def read_vehicle_types(path: Path) -> dict[str, VehicleType]:
    """The types that a file of routes declares."""
    found: dict[str, VehicleType] = {}

    def start(name: str, names_and_values: list[str]) -> None:
        attributes = pair_attributes(names_and_values)
        if name == "vType" and "id" in attributes:
            vehicle_class = attributes.get("vClass", "passenger")
            length_m = float(attributes.get("length", USUAL_LENGTH_M.get(vehicle_class, CAR_LENGTH_M)))
            if not length_m > 0:
                raise ValueError(f"type {attributes['id']!r}: a positive length is needed; got {length_m:g}")
            found[attributes["id"]] = VehicleType(vehicle_class, length_m)

    parse_xml_stream(read_chunks(path), start)
    return found


def select_road_users(
    floating_car_data: FloatingCarData,
    known_types: Mapping[str, VehicleType],
    fleet: Fleet,
    ego_id: str | None,
    ego_type: str | None,
    duration_s: float,
    generator: np.random.Generator,
) -> tuple[RoadUser, list[RoadUser]]:
    """Choose the ego, and those of the others who come near to it.

    The ego is the one of a name; else it is drawn in proportion to the ways that vehicles drive, of one type or of all
    cars.

    ValueError: nobody who may be the ego is there for the whole run.
    """
    lengths_m = {kind: fleet.get_length_m(kind) for kind in CATEGORIES}
    users: list[RoadUser] = []
    for track in floating_car_data.tracks:
        found = get_vehicle_type(track.type_name, known_types)
        kind = found.find_body(lengths_m)
        if track.is_pedestrian:  # all have one length; those that were drawn are called as their bodies are
            named = "child" if "child" in track.type_name.lower() else "adult"
            kind = track.type_name if CATEGORIES.get(track.type_name) == "pedestrian" else named
        if kind is not None:
            users.append(RoadUser(track, kind, found.length_m, fleet.get_sizes_m(kind)))
    ego = _ego(users, floating_car_data, ego_id, ego_type, duration_s, generator)
    others = [other for other in users if other is not ego and _comes_near(other.track, ego.track)]
    return ego._replace(kind=EGO, part_sizes_m=fleet.get_sizes_m(EGO)), others


def _ego(
    users: Sequence[RoadUser],
    recorded: FloatingCarData,
    name: str | None,
    kind: str | None,
    duration_s: float,
    generator: np.random.Generator,
) -> RoadUser:
    """Who is the ego: by name, or drawn."""
    begin_s, end_s = recorded.begin_s, recorded.begin_s + duration_s
    when = f"from t = {begin_s:g} to {end_s:g} s"
    if name is not None:
        own = [user for user in users if user.track.name == name and not user.track.is_pedestrian]
        there = [user for user in own if user.track.is_present_for(duration_s)]
        if there:
            return there[0]
        if not own:
            raise ValueError(f"ego_id: no vehicle {name!r} up to t = {recorded.last_time_s:g} s, where the data end")
        gone_s = begin_s + float(own[0].track.times_s[-1])
        raise ValueError(
            f"ego_id: {name!r} is not there all the time {when}: it leaves the network, teleports or has a gap after "
            f"t = {gone_s:g} s; shorten duration_s to {max(gone_s - begin_s, 0.0):g}, or take another ego"
        )
    drivers = [
        user for user in users if (user.track.type_name == kind if kind is not None else CATEGORIES[user.kind] == "car")
    ]
    there = [user for user in drivers if user.track.is_present_for(duration_s) and not user.track.is_pedestrian]
    if not there:
        longest = max((float(np.ptp(user.track.times_s)) for user in drivers), default=0.0)
        who = f"vehicle of type {kind!r}" if kind is not None else "car"
        raise ValueError(
            f"no {who} that could be the ego is there all the time {when}: of {len(drivers)}, the longest drives "
            f"for {longest:g} s (data end at t = {recorded.last_time_s:g} s); change duration_s or begin_s"
        )
    ways_m = [np.linalg.norm(np.diff(user.track.front_positions_m[:, :2], axis=0), axis=1).sum() for user in there]
    shares = np.array(ways_m) + 1e-3
    return there[int(generator.choice(len(there), p=shares / shares.sum()))]


def _comes_near(other: SumoTrack, ego: SumoTrack) -> bool:
    """Whether the two are ever within the range of sensors, at the times of the other."""
    ego_m = ego.front_positions_m[:, :2]
    if other.times_s is not ego.times_s:
        ego_m = np.stack([np.interp(other.times_s, ego.times_s, axis, np.nan, np.nan) for axis in ego_m.T], axis=1)
    return bool((np.linalg.norm(other.front_positions_m[:, :2] - ego_m, axis=1) < HORIZON_M).any())
