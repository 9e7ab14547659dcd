"""Scans around an instant, thinned, in one frame that does not move: what references and the ground are made of."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, points_in_boxes
from torchcover.geometry import invert, rigid, rotation_from_euler, transform
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.ground_model import GroundModel, low_surfaces
from torchcover.recordings.in_vehicle import in_vehicle
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
        place_m: (3,) where the vehicle was, likewise.
    """

    still_m: NDArray[np.float64]
    voxel: NDArray[np.int64]
    of_box: Mapping[str, NDArray[np.float64]]
    unnamed: int
    dropped: Counter[str]
    place_m: NDArray[np.float64]

    @cached_property
    def low_surfaces(self) -> NDArray[np.float64]:
        """(K, 4) what it says about the ground."""
        return low_surfaces(self.still_m, self.place_m)


class Sweeps:
    """Scans within some time around an instant; those of the recording and the instant that were asked for last stay.

    Args:
        window_s: Time between the first scan and the last, half of it before the instant; 0: of the instant alone.
        voxel_m: Side of a voxel in metres.
    """

    def __init__(self, window_s: float = 2.0, voxel_m: float = 0.1) -> None:
        self.window_s = window_s
        self.voxel_m = voxel_m
        self._kept: dict[tuple[str, int], Thinned] = {}
        self._kept_of: Recording | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**vars(self), "_kept": {}, "_kept_of": None}

    def instants(self, recording: Recording, index: int) -> list[int]:
        """The instants of the window, the nearest in time first: the one alone where times or poses are unknown."""
        near = [index]
        if self.window_s and recording.times_s is not None and recording.world_T_vehicle(index) is not None:
            apart_s = np.abs(recording.times_s - recording.times_s[index])
            within = np.flatnonzero(apart_s <= self.window_s / 2 * (1 + 1e-9))
            near = within[np.argsort(apart_s[within], kind="stable")].tolist()
        of_recording = self._kept if recording is self._kept_of else {}
        self._kept_of, self._kept = recording, {key: scan for key, scan in of_recording.items() if key[1] in near}
        return near

    def local_T_vehicle(self, recording: Recording, index: int) -> Matrix:
        """Where the vehicle was: in the world, from the first place of the drive, for coordinates may be too large."""
        return rigid(np.eye(3), -_pose(recording, 0)[:3, 3]) @ _pose(recording, index)

    def ground(self, recording: Recording, index: int) -> GroundModel | None:
        """What all sensors have seen of the ground within the window; None where there is none near the vehicle."""
        sensors = (*recording.sensors, *recording.reference_sensors)
        scans = [
            self.thinned(recording, sensor, instant)
            for instant in self.instants(recording, index)
            for sensor in sensors
        ]
        return GroundModel.below([scan.low_surfaces for scan in scans], self.local_T_vehicle(recording, index)[:3, 3])

    def thinned(self, recording: Recording, sensor: str, index: int) -> Thinned:
        """A scan of the window."""
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
                    own_m = transform(invert(pose_of(boxes, number)), own_m)
                    of_box[name] = own_m[first_of_each(self.voxel(own_m))]
                else:
                    unnamed += len(own_m)
        local_T_vehicle = self.local_T_vehicle(recording, index)
        still_m = transform(local_T_vehicle, points_m[~in_box])
        voxel = self.voxel(still_m)
        first = first_of_each(voxel)
        thinned = Thinned(still_m[first], voxel[first], of_box, unnamed, scan.dropped, local_T_vehicle[:3, 3])
        self._kept[key] = thinned
        return thinned

    def voxel(self, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """(N,) number of the voxel of each point."""
        x, y, z = (np.floor(points_m / self.voxel_m).astype(np.int64) & ((1 << VOXEL_BITS) - 1)).T
        numbers: NDArray[np.int64] = (x << 2 * VOXEL_BITS) | (y << VOXEL_BITS) | z
        return numbers


def first_of_each(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each number is seen first, by ascending number; fast where ascending runs follow each other."""
    order = np.argsort(numbers, kind="stable")
    ordered = numbers[order]
    first: NDArray[np.int64] = order[np.append(True, ordered[1:] != ordered[:-1])[: len(order)]]
    return first


def pose_of(boxes: Boxes, number: int) -> Matrix:
    """`vehicle_T_box` of one of them."""
    yaw_deg = float(np.rad2deg(boxes.yaw_rad[number].item()))
    return rigid(rotation_from_euler(yaw_deg, 0.0, 0.0), boxes.centre_m[number].double().numpy())


def _pose(recording: Recording, index: int) -> Matrix:
    """Where the vehicle was; it has not moved where that is unknown."""
    pose = recording.world_T_vehicle(index)
    return np.eye(4) if pose is None else pose


def _grown(boxes: Boxes) -> Boxes:
    return replace(boxes, size_m=boxes.size_m + boxes.size_m.new_tensor([2 * BESIDE_BOX_M, 2 * BESIDE_BOX_M, 0.0]))
