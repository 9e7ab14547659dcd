"""Objects of recordings over time: as annotators saw them at some instants, and as tracks."""

import hashlib
import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection.boxes import Boxes, build_upright_rows
from torchcover.files import load_road_user_classes, report_bad_file
from torchcover.geometry import build_transform, convert_euler_to_rotation, convert_rotation_to_euler, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.recording import Recording

# A key frame of a label that is nearer than this is that of the instant.
SAME_TIME_S = 1e-3


class ObjectState(NamedTuple):
    """An object at an instant: `world_T_box` is its centre, x along its length; length, width, height are its size.

    `visibility` as `Boxes` has it.
    """

    name: str
    time_s: float
    world_T_box: Matrix
    size_m: tuple[float, float, float]
    category: str
    visibility: float = math.nan


def group_by_name(states: Iterable[ObjectState]) -> dict[str, list[ObjectState]]:
    """Those of each object, in the order of time."""
    found: dict[str, list[ObjectState]] = {}
    for one in sorted(states, key=lambda one: one.time_s):
        found.setdefault(one.name, []).append(one)
    return found


class ObjectInterpolator:
    """Objects at any time; between two of theirs they move evenly.

    `seen`: when and where they were seen, in any order; `max_gap_s`: where one was unseen for longer, it is unknown
    where it was.
    """

    def __init__(self, states: Sequence[ObjectState], max_gap_s: float = 1.0) -> None:
        ordered = group_by_name(states)
        self._seen = {name: ordered[name] for name in dict.fromkeys(one.name for one in states)}
        self._times = {name: [one.time_s for one in of] for name, of in self._seen.items()}
        self._longest_gap_s = max_gap_s

    def interpolate_boxes(self, time_s: float, vehicle_T_world: Matrix) -> Boxes:
        """The objects of an instant that lies within their times, in the vehicle frame."""
        between = (self._between(seen, self._times[name], time_s) for name, seen in self._seen.items())
        found = [one for one in between if one is not None]
        poses = np.array([one.world_T_box for one in found]).reshape(-1, 4, 4)
        rows = build_upright_rows(
            transform_points(vehicle_T_world, poses[:, :3, 3]),
            np.array([one.size_m for one in found]).reshape(-1, 3),
            poses[:, :3, 0] @ vehicle_T_world[:3, :3].T,
            None,
        )
        return Boxes.from_rows(
            rows,
            ids=tuple(one.name for one in found),
            categories=tuple(one.category for one in found),
            visibility=torch.tensor([one.visibility for one in found], dtype=torch.float32, device="cpu"),
        )

    def _between(self, seen: Sequence[ObjectState], times_s: Sequence[float], time_s: float) -> ObjectState | None:
        after = bisect_left(times_s, time_s - SAME_TIME_S)
        if after == len(seen):
            return None
        if abs(times_s[after] - time_s) <= SAME_TIME_S:
            return seen[after]
        if after == 0 or times_s[after] - times_s[after - 1] > self._longest_gap_s:
            return None
        first, second = seen[after - 1], seen[after]
        share = (time_s - first.time_s) / (second.time_s - first.time_s)
        return first._replace(time_s=time_s, world_T_box=_blend(first.world_T_box, second.world_T_box, share))


def _blend(first: Matrix, second: Matrix, share: float) -> Matrix:
    """Between two poses: the places evenly, the heading about z the shorter way."""
    place_m = first[:3, 3] + share * (second[:3, 3] - first[:3, 3])
    turn = first[:3, :3].T @ second[:3, :3]
    angle = share * np.arctan2(turn[1, 0], turn[0, 0])
    about_z = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return build_transform(first[:3, :3] @ about_z, place_m)


class Track(NamedTuple):
    """A box over time, by its id and by what the recording calls its category; its class is by SUMO's names.

    That is "passenger" or "pedestrian" for example, None if it is no road user. Of length, width and height the last is
    NaN if it was not recorded. The trajectory, of the middle of its bottom, is transient unless it is there always.
    """

    name: str
    category: str
    vehicle_class: str | None
    size_m: tuple[float, float, float]
    trajectory: Trajectory


class Ego(NamedTuple):
    """A recording's own ego: its id, where it was, (K, 4, 4), and when; the size of its body, as published, if known.

    `ego_T_vehicle` (4, 4) is the vehicle frame in that of these poses: on the ground under the middle of its body.
    """

    name: str
    times_s: NDArray[np.float64]
    world_T_ego: Matrix
    ego_T_vehicle: Matrix
    size_m: tuple[float, float, float] | None = None


class RecordedObjects(NamedTuple):
    """Who was recorded, at times of one clock.

    `tracks`: everybody but its egos; `egos`: its own; the first is meant if none is named.
    """

    tracks: tuple[Track, ...]
    egos: tuple[Ego, ...] = ()

    def compute_digest(self) -> str:
        """A hash of all of it."""
        found = hashlib.sha256()
        for track in self.tracks:
            way = track.trajectory
            found.update(repr((*track[:4], way.is_transient)).encode())
            found.update(np.column_stack([way.times_s, way.positions_m, way.angles_deg]).tobytes())
        for ego in self.egos:
            found.update(repr((ego.name, ego.ego_T_vehicle.tolist(), ego.size_m, ego.times_s.tolist())).encode())
            found.update(ego.world_T_ego.tobytes())
        return found.hexdigest()


def build_track(
    states: Sequence[ObjectState], vehicle_class: str | None, world_T_source: Matrix | None = None
) -> Track:
    """A track from boxes about their middles, in the order of time; of the sizes the median counts.

    `world_T_source` (K, 4, 4) is the frame in which it was seen each time; None: the world. ValueError: no size, times
    that do not ascend, numbers that are none; the message names the id.
    """
    name = states[0].name
    sizes_m = np.array([one.size_m for one in states], dtype=np.float64)
    world_T_box = np.stack([one.world_T_box for one in states])
    if world_T_source is not None:
        world_T_box = world_T_source @ world_T_box
    for size_m in sizes_m:
        check_box_size(name, size_m)
    length, width, height = check_box_size(name, np.median(sizes_m, axis=0))
    places_m = world_T_box[:, :3, 3] - sizes_m[:, 2:] / 2 * world_T_box[:, :3, 2]
    angles_deg = convert_rotation_to_euler(world_T_box[:, :3, :3])
    trajectory = build_trajectory(name, np.array([one.time_s for one in states]), places_m, angles_deg)
    return Track(name, states[0].category, vehicle_class, (length, width, height), trajectory)


def check_box_size(name: str, size_m: Matrix) -> tuple[float, ...]:
    """A size that a body can have, as far as it was recorded."""
    if not (np.isfinite(size_m).all() and (size_m > 0).all()):
        raise ValueError(f"id {name}: a box needs a positive length, width and height; got {size_m.tolist()}")
    return tuple(size_m.tolist())


def build_trajectory(name: str, times_s: Matrix, positions_m: Matrix, angles_deg: Matrix) -> Trajectory:
    """A trajectory that is there within its times."""
    try:
        return Trajectory(times_s, positions_m, angles_deg, is_transient=True)
    except ValueError as error:
        raise ValueError(f"id {name}: {error}") from error


def extract_objects(recording: Recording) -> RecordedObjects:
    """The labelled objects of a recording, and the drive of its vehicle, in the world of its poses."""
    with report_bad_file(recording.path, "objects of a recording"):
        poses = [recording.get_world_T_vehicle(index) for index in range(len(recording.frame_names))]
        world_T_vehicle = np.stack([pose for pose in poses if pose is not None] or [np.eye(4)])
        if recording.times_s is None or len(world_T_vehicle) < len(poses):
            raise ValueError("its vehicle has no poses with times, without which its objects have no way")
        times_s = recording.times_s - recording.times_s[0]
        seen = group_by_name(_labelled(recording, times_s, world_T_vehicle))
        known = getattr(recording, "classes", None)  # of formats whose words mean other things
        tracks = tuple(
            build_track(of, find_vehicle_class(of[0].category) if known is None else known.get(of[0].category.lower()))
            for of in seen.values()
        )
    body = recording.ego_box
    size_m = None if body is None else (*body.size_m[:2], body.upper_m[2])
    return RecordedObjects(tracks, (Ego("ego", times_s, world_T_vehicle, np.eye(4), size_m),))


def find_vehicle_class(category: str) -> str | None:
    """The class of a road user by a word of its category, the last that is known: of `vehicle.car` that of a car.

    Example:
        >>> find_vehicle_class("Car"), find_vehicle_class("walker.pedestrian.0007"), find_vehicle_class("static.barrier")
        ('passenger', 'pedestrian', None)
    """
    classes = load_road_user_classes()["usual"]
    return next((classes[word] for word in reversed(category.strip().lower().split(".")) if word in classes), None)


def _labelled(recording: Recording, times_s: NDArray[np.float64], world_T_vehicle: Matrix) -> Iterator[ObjectState]:
    labelled = False
    for index, (name, time_s) in enumerate(zip(recording.frame_names, times_s.tolist(), strict=True)):
        boxes = recording.read_boxes(index)
        if boxes is None:
            continue
        labelled = True
        if "" in boxes.ids:
            raise ValueError(f"an object of {name} has no id, by which it would be found again in other instants")
        rows = boxes.rows.double().numpy()
        turned = convert_euler_to_rotation(np.rad2deg(rows[:, 6]), np.zeros(len(rows)), np.zeros(len(rows)))
        placed = world_T_vehicle[index] @ build_transform(turned, rows[:, :3])
        for own, world_T_box, row, category in zip(boxes.ids, placed, rows, boxes.categories, strict=True):
            yield ObjectState(own, time_s, world_T_box, tuple(row[3:6].tolist()), category)
    if not labelled:
        raise ValueError("no instant of it has labelled objects")
