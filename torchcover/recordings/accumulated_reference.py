"""A reference made of a recording itself: what all sensors saw within some time."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, points_in_boxes
from torchcover.geometry import BoundingBox, invert, rigid, rotation_from_euler, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.in_vehicle import InVehicle, in_vehicle, within
from torchcover.recordings.recording import Recording

# Voxels are numbered with so many bits an axis: 200 km at 0.1 m.
VOXEL_BITS = 21
# Boxes that were drawn by hand leave out mirrors and corners: what is so near to the sides belongs to the object, as in
# the published scene flow of Argoverse 2 (0.2 m in length and width).
BESIDE_BOX_M = 0.1


@dataclass(frozen=True)
class Thinned:
    """A scan, one point a voxel.

    Args:
        still_m: (N, 3) float64 points that belong to no box, in the world, from the recording's first place.
        voxel: (N,) int64 number of the voxel of each, ascending.
        of_box: Name of each object -> (M, 3) float64 points in the frame of its box: x along its heading, its centre in
            the middle.
        unnamed: Points in boxes without a name, which cannot be found again.
        dropped: As `InVehicle.dropped`.
    """

    still_m: NDArray[np.float64]
    voxel: NDArray[np.int64]
    of_box: Mapping[str, NDArray[np.float64]]
    unnamed: int
    dropped: Counter[str]


class AccumulatedReference:
    """What all sensors of a recording saw around an instant, moved to where it is at that instant.

    Scans are moved by the poses of the vehicle, and points in labelled boxes, or within 0.1 m of their sides, with
    their boxes. Points of an object that has no box at the instant are left out. One point a voxel is kept, of the scan
    that is nearest in time, so that a place counts by its surface and not by how long it was looked at.

    A sensor that is judged takes no part at the instant itself, for its points would be 0 m from themselves. At other
    instants it does: what it never sees, this reference does not know either.

    Args:
        window_s: Time between the first scan and the last, half of it before the instant. 0: only the other sensors, at
            that instant.
        voxel_m: Side of a voxel in metres.
        sensors: Names of the sensors that take part; all if not given. Leave out those that are judged for an answer
            that does not depend on them.

    Raises:
        ValueError: A negative time, or a side that is not positive.
    """

    def __init__(self, window_s: float = 2.0, *, voxel_m: float = 0.1, sensors: Collection[str] | None = None) -> None:
        if not 0 <= window_s < np.inf:
            raise ValueError(f"window_s: seconds, 0 or more, are needed; got {window_s}")
        if not 0 < voxel_m < np.inf:
            raise ValueError(f"voxel_m: a positive length is needed; got {voxel_m}")
        self.window_s = window_s
        self.voxel_m = voxel_m
        self.sensors = None if sensors is None else tuple(sensors)
        # Of the recording and the window that were asked for last: the next window is much alike.
        self._kept: dict[tuple[str, int], Thinned] = {}
        self._kept_of: Recording | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_kept": {}, "_kept_of": None}

    def check(self, recording: Recording, judged: Collection[str]) -> None:
        """Whether the recording says when and where its scans were made.

        Raises:
            ValueError: It does not, or has no such sensors, or nothing would be left at any instant.
        """
        unknown = set(self.sensors or ()) - {*recording.sensors, *recording.reference_sensors}
        if unknown:
            raise ValueError(
                f"reference: {recording.path} has no sensor {', '.join(sorted(unknown))}; it has "
                f"{', '.join(recording.sensors)}"
            )
        if self.window_s == 0:
            if not set(self._taking_part(recording)) - set(judged):
                raise ValueError(
                    f"{recording.path}: the reference of an instant (window 0 s) needs a sensor that is not judged; "
                    f"all are ({', '.join(judged)}): choose some with --sensors, or a longer window"
                )
            return
        if recording.times_s is None or recording.world_T_vehicle(0) is None:
            missing = "when its scans were made" if recording.times_s is None else "where the vehicle was"
            raise ValueError(
                f"{recording.path}: a reference cannot be accumulated, for the recording does not say {missing}; add "
                "it, or a recorded reference"
            )

    def cloud(self, recording: Recording, index: int, judged: Collection[str]) -> InVehicle:
        """The reference cloud of an instant.

        Raises:
            OSError, ValueError: A scan cannot be read, or no point is left.
        """
        origin_m, world_T_vehicle = _first_place(recording), _pose(recording, index)
        vehicle_T_local = invert(world_T_vehicle) @ rigid(np.eye(3), origin_m)
        boxes = _by_name(recording.boxes(index))
        still, voxels, moved, dropped = [], [], [], Counter[str]()
        of_box: dict[str, list[NDArray[np.float64]]] = {}
        taken = list(self._scans(recording, index, judged))
        of_recording = self._kept if recording is self._kept_of else {}
        self._kept_of, self._kept = recording, {key: scan for key, scan in of_recording.items() if key in taken}
        for sensor, instant in taken:
            scan = self._thinned(recording, sensor, instant, origin_m)
            still.append(scan.still_m)
            voxels.append(scan.voxel)
            dropped += scan.dropped
            dropped["gone"] += scan.unnamed
            for name, points_m in scan.of_box.items():
                of_box.setdefault(name, []).append(points_m)
        for name, parts in of_box.items():
            points_m = np.concatenate(parts)
            if name not in boxes:
                dropped["gone"] += len(points_m)
                continue
            moved.append(transform(boxes[name], points_m[_first_of_each(self._voxel(points_m))]))
        first = np.sort(_first_of_each(np.concatenate([np.empty(0, np.int64), *voxels])))
        ends = np.cumsum([0, *map(len, still)])
        kept = np.split(first, np.searchsorted(first, ends[1:-1]))
        placed = [
            transform(vehicle_T_local, points_m.take(own - start, axis=0))
            for points_m, own, start in zip(still, kept, ends[:-1], strict=False)
        ]
        parts = [np.empty((0, 3), np.float32)]
        for points_m in (*placed, *moved):
            own = _beneath_or_in(points_m, recording.body)
            dropped["own_vehicle"] += len(own)
            parts.append((np.delete(points_m, own, axis=0) if len(own) else points_m).astype(np.float32))
        reference_m: NDArray[np.float32] = np.concatenate(parts)
        if not len(reference_m):
            raise ValueError(f"no reference point is left of the scans within {self.window_s / 2:g} s of this instant")
        return InVehicle(reference_m, dropped)

    def square_metres(self, recording: Recording) -> bool:
        """No: one point a voxel, which all count the same."""
        return False

    def record(self, recording: Recording, judged: Collection[str]) -> Mapping[str, object]:
        """Settings, and what such a reference cannot know."""
        taking_part = self._taking_part(recording)
        among = [sensor for sensor in taking_part if sensor in judged] if self.window_s else []
        notes = [
            f"Reference: accumulated from {', '.join(taking_part)} over {self.window_s:g} s, one point in "
            f"{self.voxel_m:g} m.",
            "What none of them saw in that time is unknown, and in no number.",
        ]
        if among:
            notes.append(
                f"{', '.join(among)} took part, which cannot show what it never sees: it is blinder than this."
            )
        return {
            "sensor": "accumulated",
            "sensors": list(taking_part),
            "judged_among_them": among,
            "window_s": self.window_s,
            "voxel_m": self.voxel_m,
            "notes": notes,
        }

    def _taking_part(self, recording: Recording) -> tuple[str, ...]:
        return tuple(recording.sensors) if self.sensors is None else self.sensors

    def _scans(self, recording: Recording, index: int, judged: Collection[str]) -> Iterator[tuple[str, int]]:
        """Sensor and instant of each scan, the nearest in time first."""
        instants = [index]
        if self.window_s:
            assert recording.times_s is not None  # see check
            apart_s = np.abs(recording.times_s - recording.times_s[index])
            near = np.flatnonzero(apart_s <= self.window_s / 2 * (1 + 1e-9))
            instants = near[np.argsort(apart_s[near], kind="stable")].tolist()
        for instant in instants:
            for sensor in self._taking_part(recording):
                if instant != index or sensor not in judged:
                    yield sensor, instant

    def _thinned(self, recording: Recording, sensor: str, index: int, origin_m: NDArray[np.float64]) -> Thinned:
        key = (sensor, index)
        if key in self._kept:
            return self._kept[key]
        scan = in_vehicle(recording.scan(sensor, index), recording.body)
        points_m = scan.points_m.astype(np.float64)
        boxes = recording.boxes(index)
        in_box = np.zeros(len(points_m), dtype=bool)
        of_box, unnamed = {}, 0
        if boxes is not None:
            inside = points_in_boxes(torch.from_numpy(scan.points_m), _grown(boxes))
            in_box[inside.point.numpy()] = True
            for number, name in enumerate(boxes.ids):
                own_m = points_m[inside.point[inside.box == number].numpy()]
                if name and len(own_m):
                    own_m = transform(invert(_pose_of(boxes, number)), own_m)
                    of_box[name] = own_m[_first_of_each(self._voxel(own_m))]
                else:
                    unnamed += len(own_m)
        local_T_vehicle = rigid(np.eye(3), -origin_m) @ _pose(recording, index)
        still_m = transform(local_T_vehicle, points_m[~in_box])
        voxel = self._voxel(still_m)
        first = _first_of_each(voxel)
        thinned = Thinned(still_m[first], voxel[first], of_box, unnamed, scan.dropped)
        self._kept[key] = thinned
        return thinned

    def _voxel(self, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
        x, y, z = (np.floor(points_m / self.voxel_m).astype(np.int64) & ((1 << VOXEL_BITS) - 1)).T
        numbers: NDArray[np.int64] = (x << 2 * VOXEL_BITS) | (y << VOXEL_BITS) | z
        return numbers


def _first_of_each(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each number is seen first, by ascending number; fast where ascending runs follow each other."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    first: NDArray[np.int64] = order[np.append(True, ordered[1:] != ordered[:-1])[: len(order)]]
    return first


def _first_place(recording: Recording) -> NDArray[np.float64]:
    """Where the drive begins: world coordinates may be too large to be counted in voxels."""
    return _pose(recording, 0)[:3, 3]


def _pose(recording: Recording, index: int) -> Matrix:
    """Where the vehicle was; it has not moved where that is unknown."""
    pose = recording.world_T_vehicle(index)
    return np.eye(4) if pose is None else pose


def _pose_of(boxes: Boxes, number: int) -> Matrix:
    yaw_deg = float(np.rad2deg(boxes.yaw_rad[number].item()))
    return rigid(rotation_from_euler(yaw_deg, 0.0, 0.0), boxes.centre_m[number].double().numpy())


def _grown(boxes: Boxes) -> Boxes:
    return replace(boxes, size_m=boxes.size_m + boxes.size_m.new_tensor([2 * BESIDE_BOX_M, 2 * BESIDE_BOX_M, 0.0]))


def _by_name(boxes: Boxes | None) -> dict[str, Matrix]:
    """Name of each object -> vehicle_T_box."""
    return {} if boxes is None else {name: _pose_of(boxes, number) for number, name in enumerate(boxes.ids)}


def _beneath_or_in(points_m: NDArray[np.float64], body: BoundingBox | None) -> NDArray[np.intp]:
    """Numbers of the points where the vehicle stands; no other sensor could see them at that instant."""
    if body is None:
        return np.empty(0, np.intp)
    return within(points_m, BoundingBox((*body.lower_m[:2], -np.inf), body.upper_m))
