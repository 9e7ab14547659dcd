"""Labeled objects of recordings over time: states of annotations, interpolation and tracks."""

import hashlib
import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import torch

from torchcover.detection.boxes import Boxes, build_upright_rows
from torchcover.files import load_road_user_classes, report_bad_file
from torchcover.geometry import build_transform, convert_euler_to_rotation, convert_rotation_to_euler, transform_points
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.recording import Recording


class ObjectState(NamedTuple):
    """State of one object at one time.

    Args:
        name: Identifier of the object in the recording.
        time_s: Time of the label.
        world_T_box: (4, 4) pose of the box: origin at its center, x along its length, z up.
        size_m: Length, width and height.
        category: Class name as the recording spells it.
        visibility: Visible share as in `Boxes`; NaN if unknown.
    """

    name: str
    time_s: float
    world_T_box: Matrix
    size_m: tuple[float, float, float]
    category: str
    visibility: float = math.nan


def group_by_name(states: Iterable[ObjectState]) -> dict[str, list[ObjectState]]:
    """Group states by object.

    Args:
        states: States in any order.

    Returns:
        Name of each object and its states, ordered by time.
    """
    states_by_name: dict[str, list[ObjectState]] = {}
    for state in sorted(states, key=attrgetter("time_s")):
        states_by_name.setdefault(state.name, []).append(state)
    return states_by_name


class ObjectInterpolator:
    """Boxes of objects at any time, interpolated linearly between their states.

    Args:
        states: States in any order.
        max_gap_s: An object is unknown between two states that are further apart.
    """

    def __init__(self, states: Sequence[ObjectState], max_gap_s: float = 1.0) -> None:
        ordered = group_by_name(states)
        first_mentions = dict.fromkeys(state.name for state in states)
        self._states = {name: ordered[name] for name in first_mentions}
        self._times_s = {name: [state.time_s for state in ordered[name]] for name in self._states}
        self._max_gap_s = max_gap_s

    def interpolate_boxes(self, time_s: float, vehicle_T_world: Matrix) -> Boxes:
        """Interpolate the objects whose states enclose a time.

        Args:
            time_s: Time of the boxes.
            vehicle_T_world: (4, 4) transform from the world to the vehicle frame at that time.

        Returns:
            Boxes in the vehicle frame, in the order in which objects were given.
        """
        states = []
        for name, known_states in self._states.items():
            state = self._interpolate(known_states, self._times_s[name], time_s)
            if state is not None:
                states.append(state)
        poses = np.array([state.world_T_box for state in states]).reshape(-1, 4, 4)
        rows = build_upright_rows(
            transform_points(vehicle_T_world, poses[:, :3, 3]),
            np.array([state.size_m for state in states]).reshape(-1, 3),
            poses[:, :3, 0] @ vehicle_T_world[:3, :3].T,
            None,
        )
        return Boxes.from_rows(
            rows,
            ids=tuple(state.name for state in states),
            categories=tuple(state.category for state in states),
            visibility=torch.tensor([state.visibility for state in states], dtype=torch.float32, device="cpu"),
        )

    def _interpolate(
        self, states: Sequence[ObjectState], times_s: Sequence[float], time_s: float
    ) -> ObjectState | None:
        """Interpolate one object; None before its first state, after its last one and in gaps."""
        tolerance_s = 1e-3  # rounding of times between tables of one data set
        after = bisect_left(times_s, time_s - tolerance_s)
        if after == len(states):
            return None
        if abs(times_s[after] - time_s) <= tolerance_s:
            return states[after]
        if after == 0 or times_s[after] - times_s[after - 1] > self._max_gap_s:
            return None
        first, second = states[after - 1], states[after]
        fraction = (time_s - first.time_s) / (second.time_s - first.time_s)
        world_T_box = _interpolate_pose(first.world_T_box, second.world_T_box, fraction)
        return first._replace(time_s=time_s, world_T_box=world_T_box)


def _interpolate_pose(first: Matrix, second: Matrix, fraction: float) -> Matrix:
    """Interpolate the position linearly and the yaw along the shorter way."""
    position_m = first[:3, 3] + fraction * (second[:3, 3] - first[:3, 3])
    turn = first[:3, :3].T @ second[:3, :3]
    angle = fraction * np.arctan2(turn[1, 0], turn[0, 0])
    about_z = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return build_transform(first[:3, :3] @ about_z, position_m)


class Track(NamedTuple):
    """Object over time.

    Args:
        name: Identifier of the object.
        category: Class name as the recording spells it.
        vehicle_class: SUMO's vehicle class, such as "passenger" or "pedestrian"; None if it is no road user.
        size_m: Length, width and height; the height is NaN if it was not recorded.
        trajectory: Poses of the center of the bottom of the box; transient unless the object is always present.
    """

    name: str
    category: str
    vehicle_class: str | None
    size_m: tuple[float, float, float]
    trajectory: Trajectory


class Ego(NamedTuple):
    """Ego vehicle of a recording over time.

    Args:
        name: Identifier.
        times_s: (K,) ascending times of its poses.
        world_T_ego: (K, 4, 4) poses.
        ego_T_vehicle: (4, 4) pose of the vehicle frame (on the ground below the center of the body) in the ego frame.
        size_m: Published length, width and height of the body; None if unknown.
    """

    name: str
    times_s: Float64
    world_T_ego: Matrix
    ego_T_vehicle: Matrix
    size_m: tuple[float, float, float] | None = None


class RecordedObjects(NamedTuple):
    """Objects and ego vehicles of a recording, with times of one clock.

    Args:
        tracks: All objects except the ego vehicles.
        egos: Ego vehicles; the first one is the default.
    """

    tracks: tuple[Track, ...]
    egos: tuple[Ego, ...] = ()

    def compute_digest(self) -> str:
        """Compute a SHA-256 hash of all tracks and egos."""
        digest = hashlib.sha256()
        for track in self.tracks:
            trajectory = track.trajectory
            digest.update(repr((*track[:4], trajectory.is_transient)).encode())
            columns = [trajectory.times_s, trajectory.positions_m, trajectory.angles_deg]
            digest.update(np.column_stack(columns).tobytes())
        for ego in self.egos:
            digest.update(repr((ego.name, ego.ego_T_vehicle.tolist(), ego.size_m, ego.times_s.tolist())).encode())
            digest.update(ego.world_T_ego.tobytes())
        return digest.hexdigest()


def build_track(
    states: Sequence[ObjectState], vehicle_class: str | None, world_T_source: Matrix | None = None
) -> Track:
    """Build the track of one object; its size is the median of the sizes of its states.

    Args:
        states: States of the object, ordered by time.
        vehicle_class: SUMO's vehicle class; None if it is no road user.
        world_T_source: (K, 4, 4) pose of the frame in which each state was labeled; None for the world frame.

    Returns:
        The track.

    Raises:
        ValueError: A size is not positive, times do not ascend or numbers are not finite; the message names the object.
    """
    name = states[0].name
    sizes_m = np.array([state.size_m for state in states], dtype=np.float64)
    world_T_box = np.stack([state.world_T_box for state in states])
    if world_T_source is not None:
        world_T_box = world_T_source @ world_T_box
    for size_m in sizes_m:
        check_box_size(name, size_m)
    length_m, width_m, height_m = check_box_size(name, np.median(sizes_m, axis=0))
    bottoms_m = world_T_box[:, :3, 3] - sizes_m[:, 2:] / 2 * world_T_box[:, :3, 2]
    angles_deg = convert_rotation_to_euler(world_T_box[:, :3, :3])
    trajectory = build_trajectory(name, np.array([state.time_s for state in states]), bottoms_m, angles_deg)
    return Track(name, states[0].category, vehicle_class, (length_m, width_m, height_m), trajectory)


def check_box_size(name: str, size_m: Float64) -> tuple[float, ...]:
    """Check that all sizes are positive and finite.

    Args:
        name: Identifier of the object, for the message.
        size_m: (2,) or (3,) length, width and, if recorded, height.

    Returns:
        The sizes as a tuple.

    Raises:
        ValueError: A size is not positive or not finite.
    """
    if not (np.isfinite(size_m).all() and (size_m > 0).all()):
        raise ValueError(f"id {name}: a box needs a positive length, width and height; got {size_m.tolist()}")
    return tuple(size_m.tolist())


def build_trajectory(name: str, times_s: Float64, positions_m: Float64, angles_deg: Float64) -> Trajectory:
    """Build the trajectory of an object that exists only within its times.

    Args:
        name: Identifier of the object, for messages.
        times_s: (K,) ascending times.
        positions_m: (K, 3) positions in the world frame.
        angles_deg: (K, 3) yaw, pitch and roll.

    Returns:
        A transient trajectory.

    Raises:
        ValueError: Times do not ascend or numbers are not finite; the message names the object.
    """
    try:
        return Trajectory(times_s, positions_m, angles_deg, is_transient=True)
    except ValueError as error:
        raise ValueError(f"id {name}: {error}") from error


def extract_objects(recording: Recording) -> RecordedObjects:
    """Extract the labeled objects and the drive of the ego vehicle from a recording.

    Args:
        recording: Recording with poses, times and labels.

    Returns:
        Tracks and the ego vehicle in the world frame of the poses, with times relative to the first frame.

    Raises:
        BadFileError: Poses, times or labels are missing or invalid.
    """
    with report_bad_file(recording.path, "objects of a recording"):
        poses = [recording.get_world_T_vehicle(index) for index in range(len(recording.frame_names))]
        world_T_vehicle = np.stack([pose for pose in poses if pose is not None] or [np.eye(4)])
        if recording.times_s is None or len(world_T_vehicle) < len(poses):
            raise ValueError("the vehicle has no poses with times, without which objects have no trajectory")
        times_s = recording.times_s - recording.times_s[0]
        # The class names of some formats have a meaning of their own.
        vehicle_classes = getattr(recording, "vehicle_classes", None)
        tracks = []
        for states in group_by_name(_read_states(recording, times_s, world_T_vehicle)).values():
            category = states[0].category
            if vehicle_classes is None:
                vehicle_class = find_vehicle_class(category)
            else:
                vehicle_class = vehicle_classes.get(category.lower())
            tracks.append(build_track(states, vehicle_class))
    ego_box = recording.ego_box
    size_m = None if ego_box is None else (*ego_box.size_m[:2], ego_box.upper_m[2])
    return RecordedObjects(tuple(tracks), (Ego("ego", times_s, world_T_vehicle, np.eye(4), size_m),))


def find_vehicle_class(category: str) -> str | None:
    """Find the vehicle class of a category by its last known word: `vehicle.car` is a car.

    Args:
        category: Words separated by dots, in any case.

    Returns:
        SUMO's vehicle class; None if no word is known.

    Example:
        >>> find_vehicle_class("Car"), find_vehicle_class("walker.pedestrian.07"), find_vehicle_class("static.barrier")
        ('passenger', 'pedestrian', None)
    """
    classes: Mapping[str, str] = load_road_user_classes()["usual"]
    for word in reversed(category.strip().lower().split(".")):
        if word in classes:
            return classes[word]
    return None


def _read_states(recording: Recording, times_s: Float64, world_T_vehicle: Matrix) -> Iterator[ObjectState]:
    """Read the labels of all frames as states in the world frame."""
    has_labels = False
    for index, (frame_name, time_s) in enumerate(zip(recording.frame_names, times_s.tolist(), strict=True)):
        boxes = recording.read_boxes(index)
        if boxes is None:
            continue
        has_labels = True
        if "" in boxes.ids:
            raise ValueError(f"an object of {frame_name} has no id, which identifies it in other frames")
        rows = boxes.rows.double().numpy()
        zeros = np.zeros(len(rows))
        rotations = convert_euler_to_rotation(np.rad2deg(rows[:, 6]), zeros, zeros)
        poses = world_T_vehicle[index] @ build_transform(rotations, rows[:, :3])
        for name, world_T_box, row, category in zip(boxes.ids, poses, rows, boxes.categories, strict=True):
            yield ObjectState(name, time_s, world_T_box, tuple(row[3:6].tolist()), category)
    if not has_labels:
        raise ValueError("no frame has labeled objects")
