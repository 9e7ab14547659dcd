"""Selection of road users: their bodies, the ego vehicle, those that come near it, and removal of overlapping ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import shapely

from torchcover.files import guard_reader
from torchcover.geometry.arrays import Bools
from torchcover.simulation.sumo.floating import FloatingCarData, SumoTrack
from torchcover.simulation.sumo.motion import Motion, RoadUser
from torchcover.simulation.sumo.paths import find_overlapping_rectangles
from torchcover.simulation.sumo.xml_stream import pair_attributes, parse_xml_stream, read_chunks
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, Fleet, VehicleType

# SUMO's default lengths by vehicle class; other classes have the length of a car.
CAR_LENGTH_M = 5.0
DEFAULT_LENGTHS_M = {
    "pedestrian": 0.215, "bicycle": 1.6, "scooter": 1.2, "moped": 2.1, "motorcycle": 2.2, "truck": 7.1,
    "trailer": 16.5, "bus": 12.0, "coach": 14.0, "tram": 22.0, "delivery": 6.5, "emergency": 6.5,
}  # fmt: skip
# Vehicle class of types of which only the name is known, by the first of these words in it.
CLASSES_BY_WORD = {
    "ped": "pedestrian", "person": "pedestrian", "motorcycle": "motorcycle", "moped": "moped", "bike": "bicycle",
    "bicycle": "bicycle", "cycl": "bicycle", "bus": "bus", "coach": "coach", "truck": "truck", "trailer": "trailer",
    "lorry": "truck", "tram": "tram", "rail": "rail", "train": "rail", "subway": "subway", "ship": "ship",
    "van": "delivery", "delivery": "delivery",
}  # fmt: skip


def get_vehicle_type(name: str, known_types: Mapping[str, VehicleType]) -> VehicleType:
    """Return a vehicle type by its name.

    Args:
        name: Name of the type.
        known_types: Types that are declared; the class of all others is guessed from their names.

    Example:
        >>> get_vehicle_type("DEFAULT_BIKETYPE", {}).vehicle_class
        'bicycle'
    """
    if name in known_types:
        return known_types[name]
    vehicle_class = "passenger"
    for word, class_of_word in CLASSES_BY_WORD.items():
        if word in name.lower():
            vehicle_class = class_of_word
            break
    return VehicleType(vehicle_class, DEFAULT_LENGTHS_M.get(vehicle_class, CAR_LENGTH_M))


@guard_reader("routes of SUMO")
def read_vehicle_types(path: Path) -> dict[str, VehicleType]:
    """Read the vehicle types that a file of routes declares.

    Args:
        path: The file.

    Returns:
        Types by their names.

    Raises:
        BadFileError: It is not XML, or a length is not positive.
    """
    types: dict[str, VehicleType] = {}

    def start_element(name: str, names_and_values: list[str]) -> None:
        """Store the type if the tag declares one."""
        attributes = pair_attributes(names_and_values)
        if name != "vType" or "id" not in attributes:
            return
        vehicle_class = attributes.get("vClass", "passenger")
        length_m = float(attributes.get("length", DEFAULT_LENGTHS_M.get(vehicle_class, CAR_LENGTH_M)))
        if not length_m > 0:
            raise ValueError(f"type {attributes['id']!r}: a positive length is needed; got {length_m:g}")
        types[attributes["id"]] = VehicleType(vehicle_class, length_m)

    parse_xml_stream(read_chunks(path), start_element)
    return types


def select_road_users(
    floating_car_data: FloatingCarData,
    known_types: Mapping[str, VehicleType],
    fleet: Fleet,
    ego_id: str | None,
    ego_type: str | None,
    duration_s: float,
    generator: np.random.Generator,
) -> tuple[RoadUser, list[RoadUser]]:
    """Select the ego vehicle and all road users that come near it.

    Args:
        floating_car_data: Tracks.
        known_types: Declared vehicle types.
        fleet: Bodies.
        ego_id: Name of the ego vehicle; if None, it is sampled with probabilities proportional to driven distances.
        ego_type: Name of the type from which it is sampled; all cars if None.
        duration_s: Duration for which the ego vehicle must be present.
        generator: Random generator.

    Raises:
        ValueError: No vehicle that can be the ego vehicle is present for the whole duration.
    """
    lengths_m = {kind: fleet.get_length_m(kind) for kind in CATEGORIES}
    users: list[RoadUser] = []
    for track in floating_car_data.tracks:
        vehicle_type = get_vehicle_type(track.type_name, known_types)
        kind = vehicle_type.find_body(lengths_m)
        if track.is_pedestrian:
            # Types of sampled pedestrians are named after their bodies.
            is_body = CATEGORIES.get(track.type_name) == "pedestrian"
            kind = "child" if "child" in track.type_name.lower() else "adult"
            kind = track.type_name if is_body else kind
        if kind is not None:
            users.append(RoadUser(track, kind, vehicle_type.length_m, fleet.get_sizes_m(kind)))
    if ego_id is not None:
        ego = _find_ego(users, floating_car_data, ego_id, duration_s)
    else:
        ego = _sample_ego(users, floating_car_data, ego_type, duration_s, generator)
    nearby = [user for user in users if user is not ego and is_ever_near(user.track, ego.track)]
    return ego._replace(kind=EGO, part_sizes_m=fleet.get_sizes_m(EGO)), nearby


def _format_window(data: FloatingCarData, duration_s: float) -> str:
    """Format the times between which the ego vehicle must be present."""
    return f"from t = {data.begin_s:g} to {data.begin_s + duration_s:g} s"


def _find_ego(users: Sequence[RoadUser], data: FloatingCarData, ego_id: str, duration_s: float) -> RoadUser:
    """Find the ego vehicle by its name."""
    tracks = [user for user in users if user.track.name == ego_id and not user.track.is_pedestrian]
    for user in tracks:
        if user.track.is_present_for(duration_s):
            return user
    if not tracks:
        raise ValueError(f"ego_id: no vehicle {ego_id!r} up to t = {data.last_time_s:g} s, where the data end")
    # The message proposes the duration of the first track with this name.
    end_s = data.begin_s + float(tracks[0].track.times_s[-1])
    possible_s = max(end_s - data.begin_s, 0.0)
    raise ValueError(
        f"ego_id: {ego_id!r} is not present {_format_window(data, duration_s)}: it leaves the network, teleports or "
        f"has a gap after t = {end_s:g} s; shorten duration_s to {possible_s:g}, or choose another ego vehicle"
    )


def _sample_ego(
    users: Sequence[RoadUser],
    data: FloatingCarData,
    ego_type: str | None,
    duration_s: float,
    generator: np.random.Generator,
) -> RoadUser:
    """Sample the ego vehicle with probabilities proportional to driven distances."""
    vehicles = []
    for user in users:
        is_candidate = CATEGORIES[user.kind] == "car" if ego_type is None else user.track.type_name == ego_type
        if is_candidate:
            vehicles.append(user)
    candidates = [user for user in vehicles if user.track.is_present_for(duration_s) and not user.track.is_pedestrian]
    if not candidates:
        longest_s = max((float(np.ptp(user.track.times_s)) for user in vehicles), default=0.0)
        description = "car" if ego_type is None else f"vehicle of type {ego_type!r}"
        raise ValueError(
            f"no {description} for the ego vehicle is present {_format_window(data, duration_s)}: the longest of "
            f"{len(vehicles)} drives for {longest_s:g} s (data end at t = {data.last_time_s:g} s); change "
            "duration_s or begin_s"
        )
    weights = []
    # A vehicle that stands has a small probability, too, so that the sum is never 0.
    for user in candidates:
        steps_m = np.linalg.norm(np.diff(user.track.front_positions_m[:, :2], axis=0), axis=1)
        weights.append(steps_m.sum() + 1e-3)
    shares = np.array(weights)
    return candidates[int(generator.choice(len(candidates), p=shares / shares.sum()))]


def is_ever_near(track: SumoTrack, ego_track: SumoTrack) -> bool:
    """Test whether a road user ever comes within `HORIZON_M` of the ego vehicle.

    Args:
        track: Track of the road user.
        ego_track: Track of the ego vehicle.
    """
    ego_m = ego_track.front_positions_m[:, :2]
    # Road users that are always present share their times.
    if track.times_s is not ego_track.times_s:
        x_m = np.interp(track.times_s, ego_track.times_s, ego_m[:, 0], np.nan, np.nan)
        y_m = np.interp(track.times_s, ego_track.times_s, ego_m[:, 1], np.nan, np.nan)
        ego_m = np.column_stack([x_m, y_m])
    return bool((np.linalg.norm(track.front_positions_m[:, :2] - ego_m, axis=1) < HORIZON_M).any())


def drop_colliding_users(motions: Sequence[Motion]) -> list[Motion]:
    """Drop road users that are not plausible or overlap others; of two that overlap, the one with more overlaps.

    Args:
        motions: Motions; the first one, the ego vehicle, is always present and stays.

    Returns:
        The remaining motions in the same order.
    """
    motions = [motions[0], *(motion for motion in motions[1:] if motion.is_plausible)]
    overlaps = _find_overlapping_users(motions)
    counts = overlaps.sum(axis=1)
    counts[0] = -1
    stays = np.ones(len(motions), dtype=bool)
    # Road users with few overlaps decide first, beginning with the ego vehicle.
    for index in np.argsort(counts, kind="stable").tolist():
        if stays[index]:
            stays[overlaps[index]] = False
    return [motions[index] for index in np.flatnonzero(stays).tolist()]


def _find_overlapping_users(
    motions: Sequence[Motion], gap_m: float = 0.05, min_level_distance_m: float = 3.0, chunk_frames: int = 20
) -> Bools:
    """Find pairs of road users whose outlines ever overlap.

    Args:
        motions: N motions; the first one is always present.
        gap_m: Smallest gap between outlines.
        min_level_distance_m: Difference of the heights in the simulation from which two are on different road levels.
        chunk_frames: Number of poses that are compared together.

    Returns:
        (N, N) True for pairs that overlap.
    """
    overlaps = np.zeros((len(motions), len(motions)), dtype=bool)
    time_step_s = float(motions[0].times_s[1])
    part_users, part_first_frames, part_sizes_m, part_poses = [], [], [], []
    for index, motion in enumerate(motions):
        track = motion.road_user.track
        heights_m = np.interp(motion.times_s, track.times_s, track.front_positions_m[:, 2])
        for poses, size_m in motion.parts:
            part_users.append(index)
            part_first_frames.append(round(float(motion.times_s[0]) / time_step_s))
            part_sizes_m.append(size_m)
            part_poses.append(np.column_stack([poses, heights_m]))
    users, sizes_m = np.array(part_users), np.array(part_sizes_m) + gap_m
    radii_m = np.linalg.norm(sizes_m, axis=1)[:, None] / 2
    for begin in range(0, len(motions[0].times_s), chunk_frames):
        poses = np.full((chunk_frames, len(part_poses), 4), np.nan)
        for part, all_poses in enumerate(part_poses):
            start = begin - part_first_frames[part]
            chunk = all_poses[max(start, 0) : max(start + chunk_frames, 0)]
            poses[max(-start, 0) :, part][: len(chunk)] = chunk
        # Only bodies whose bounding boxes overlap within these frames are compared.
        present = np.flatnonzero(np.isfinite(poses[..., 0]).any(axis=0))
        positions_m = poses[:, present, :2]
        lower_m = np.fmin.reduce(positions_m) - radii_m[present]
        upper_m = np.fmax.reduce(positions_m) + radii_m[present]
        boxes = shapely.box(*lower_m.T, *upper_m.T)
        pairs = present[shapely.STRtree(boxes).query(boxes)]
        first, second = pairs[:, users[pairs[0]] < users[pairs[1]]]
        is_overlapping = find_overlapping_rectangles(poses[:, first], sizes_m[first], poses[:, second], sizes_m[second])
        is_same_level = np.abs(poses[:, first, 3] - poses[:, second, 3]) < min_level_distance_m
        is_colliding = (is_overlapping & is_same_level).any(axis=0)
        first_users, second_users = users[first[is_colliding]], users[second[is_colliding]]
        overlaps[first_users, second_users] = overlaps[second_users, first_users] = True
    return overlaps
