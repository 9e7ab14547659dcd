"""A reference made of a recording itself: what all sensors saw within some time."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from torchcover.detection import Boxes
from torchcover.geometry import BoundingBox, invert, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.in_vehicle import InVehicle, within
from torchcover.recordings.recording import Recording
from torchcover.recordings.sweeps import Sweeps, first_of_each, pose_of


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
        self._sweeps = Sweeps(window_s, voxel_m)

    @property
    def sweeps(self) -> Sweeps:
        """What it is made of."""
        return self._sweeps

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
        sweeps, vehicle_T_local = self._sweeps, invert(self._sweeps.local_T_vehicle(recording, index))
        boxes = _by_name(recording.boxes(index))
        still, voxels, moved, dropped = [], [], [], Counter[str]()
        of_box: dict[str, list[NDArray[np.float64]]] = {}
        for sensor, instant in self._scans(recording, index, judged):
            scan = sweeps.thinned(recording, sensor, instant)
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
            moved.append(transform(boxes[name], points_m[first_of_each(sweeps.voxel(points_m))]))
        first = np.sort(first_of_each(np.concatenate([np.empty(0, np.int64), *voxels])))
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
        for instant in self._sweeps.instants(recording, index):
            for sensor in self._taking_part(recording):
                if instant != index or sensor not in judged:
                    yield sensor, instant


def _by_name(boxes: Boxes | None) -> dict[str, Matrix]:
    """Name of each object -> vehicle_T_box."""
    return {} if boxes is None else {name: pose_of(boxes, number) for number, name in enumerate(boxes.ids)}


def _beneath_or_in(points_m: NDArray[np.float64], body: BoundingBox | None) -> NDArray[np.intp]:
    """Numbers of the points where the vehicle stands; no other sensor could see them at that instant."""
    if body is None:
        return np.empty(0, np.intp)
    return within(points_m, BoundingBox((*body.lower_m[:2], -np.inf), body.upper_m))
