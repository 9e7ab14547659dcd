"""Scans around an instant, thinned, in one frame that does not move: what references and the ground are made of."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from operator import itemgetter

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, find_points_in_boxes
from torchcover.frames.source import BadFrameError
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.free_space import FreeSpaceCounter, RangeImage, ScanKey
from torchcover.recordings.ground_model import GroundModel, extract_low_surfaces
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.recordings.recording import Recording, Scan

# What is slower stands: between a time before and one after.
MOVES_MPS, MOVED_S = 0.5, 0.5
# Voxels are numbered with so many bits an axis: 200 km at 0.1 m.
VOXEL_BITS = 21
# Boxes that were drawn by hand leave out mirrors and corners: what is so near to the sides belongs to the object, as in
# the published scene flow of Argoverse 2 (0.2 m in length and width).
BESIDE_BOX_M = 0.1
# What lies in the window is judged by scans so much before and after it, too; by the rays of one in so much time.
MARGIN_S, RAYS_EVERY_S = 1.0, 0.2
# Of a drive with so few instants, those of all.
SHORT = 20
# Cells in which a thing that stands is seen again.
CELL_M = 0.6
# A pose has jumped if a step is so far off those before and after, beside what tyres can do: the median of so many. A
# turn counts as what it moves so far ahead.
JUMP_M, HARDEST_MPS2, STEPS, AHEAD_M = 0.3, 12.0, 5, 10.0


@dataclass(frozen=True)
class ThinnedScan:
    """A scan, one point a voxel.

    Args:
        static_points_m: (N, 3) float64 points of what stands, or has no box, in the world, from the recording's first place.
        voxel_indices: (N,) int64 number of the voxel of each, ascending.
        object_points_m: Name of each object that moves -> (M, 3) float64 points in the frame of its box: x along its heading,
            its centre in the middle.
        unnamed_object_point_count: Points in boxes without a name, which cannot be found again.
        excluded_counts: As `VehicleCloud.dropped`.
        vehicle_position_m: (3,) where the vehicle was, likewise.
        range_image: How far the scan has seen; None if its rays are not asked for.
    """

    static_points_m: NDArray[np.float64]
    voxel_indices: NDArray[np.int64]
    object_points_m: Mapping[str, NDArray[np.float64]]
    unnamed_object_point_count: int
    excluded_counts: Counter[str]
    vehicle_position_m: NDArray[np.float64]
    range_image: RangeImage | None

    @cached_property
    def occupied_cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(K,) numbers of the cells in which it has points, and (N,) in which of these each of `still_m` is."""
        return np.unique(compute_voxel_indices(self.static_points_m, CELL_M), return_inverse=True)

    @cached_property
    def low_surfaces(self) -> NDArray[np.float64]:
        """(K, 4) what it says about the ground."""
        return extract_low_surfaces(self.static_points_m, self.vehicle_position_m)


class SweepWindow:
    """Scans within some time around an instant; those of the recording and the instant that were asked for last stay.

    Args:
        window_s: Time between the first scan and the last, half of it before the instant; 0: of the instant alone.
        voxel_m: Side of a voxel in metres.

    Attributes:
        skip_unreadable: Whether a scan that cannot be read is one without points, counted, and not an error.
    """

    def __init__(self, window_s: float = 2.0, voxel_m: float = 0.1) -> None:
        self.skip_unreadable = False
        self.window_s = window_s
        self.voxel_m = voxel_m
        self._forget()

    def _forget(self) -> None:
        self._kept: dict[ScanKey, ThinnedScan] = {}
        self._kept_of: Recording | None = None
        self._places: dict[int, dict[str, NDArray[np.float64]]] = {}
        self._votes = FreeSpaceCounter()
        self._ground: tuple[int, GroundModel | None] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._forget()

    def find_frames_in_window(self, recording: Recording, index: int, margin_s: float = 0.0) -> list[int]:
        """The instants of the window, the nearest in time first: the one alone where times or poses are unknown.

        `recording`: the recording; `index`: the instant; `margin_s`: so much before and after the window, too.
        """
        if not self.window_s or recording.times_s is None or recording.get_world_T_vehicle(index) is None:
            return [index]
        apart_s = np.abs(recording.times_s - recording.times_s[index])
        near = np.flatnonzero(apart_s <= (self.window_s / 2 + margin_s) * (1 + 1e-9))
        jumps = find_pose_discontinuities(
            recording.times_s[near], np.array([_pose(recording, int(one)) for one in near])
        )
        own = int(np.searchsorted(near, index))
        near = near[max(jumps[jumps < own] + 1, default=0) : min(jumps[jumps >= own] + 1, default=len(near))]
        return [int(instant) for instant in near[np.argsort(apart_s[near], kind="stable")]]

    def count_skipped_frames(self, recording: Recording, index: int) -> int:
        """How many instants of the window are left out, for the pose jumps between them and this one."""
        if recording.times_s is None:
            return 0
        apart_s = np.abs(recording.times_s - recording.times_s[index])
        return int((apart_s <= self.window_s / 2 * (1 + 1e-9)).sum()) - len(
            self.find_frames_in_window(recording, index)
        )

    def keep_frames(self, recording: Recording, frame_indices: Sequence[int]) -> None:
        """Forget all scans but those of some instants."""
        if recording is not self._kept_of:
            self._forget()
        near = set(frame_indices)
        self._kept_of, self._kept = recording, {key: scan for key, scan in self._kept.items() if key[1] in near}
        self._places = {instant: places for instant, places in self._places.items() if instant in near}

    def count_free_space_votes(
        self, recording: Recording, sensors: Sequence[str], index: int
    ) -> dict[ScanKey, NDArray[np.int16]]:
        """How many scans see past each point, of the scans of the window and its margins."""
        instants = self.find_frames_in_window(recording, index, MARGIN_S)
        self.keep_frames(recording, instants)
        scans = {
            (sensor, instant): self.get_thinned_scan(recording, sensor, instant)
            for instant in instants
            for sensor in sensors
        }
        images = {key: scan.range_image for key, scan in scans.items() if scan.range_image is not None}
        return self._votes.update({key: scan.static_points_m for key, scan in scans.items()}, images)

    def compute_local_T_vehicle(self, recording: Recording, index: int) -> Matrix:
        """Where the vehicle was: in the world, from the first place of the drive, for coordinates may be too large."""
        return build_transform(np.eye(3), -_pose(recording, 0)[:3, 3]) @ _pose(recording, index)

    def get_ground_model(self, recording: Recording, index: int) -> GroundModel | None:
        """What all sensors have seen of the ground within the window; None where there is none near the vehicle."""
        sensors = (*recording.sensors, *recording.reference_sensors)
        if self._kept_of is not recording or self._ground is None or self._ground[0] != index:
            instants = self.find_frames_in_window(recording, index)
            if self._kept_of is not recording or not {key[1] for key in self._kept} >= set(instants):
                self.keep_frames(recording, instants)
            scans = [self.get_thinned_scan(recording, sensor, instant) for instant in instants for sensor in sensors]
            surfaces = [scan.low_surfaces for scan in scans]
            self._ground = (
                index,
                GroundModel.from_surfaces(surfaces, self.compute_local_T_vehicle(recording, index)[:3, 3]),
            )
        return self._ground[1]

    def get_thinned_scan(self, recording: Recording, sensor: str, index: int) -> ThinnedScan:
        """A scan of the window."""
        key = (sensor, index)
        if key in self._kept:
            return self._kept[key]
        try:
            stored = recording.read_scan(sensor, index)
            scan, boxes = transform_to_vehicle(stored, recording.ego_box), self._moving(recording, index)
        except (OSError, ValueError) as error:
            if not self.skip_unreadable:
                raise BadFrameError(f"{recording.frame_names[index]}: {error}") from error
            stored, boxes = Scan(np.empty((0, 3)), None, ""), None
            scan = transform_to_vehicle(stored)
            scan.excluded_counts["sweeps_skipped"] = 1
        points_m = scan.points_m.astype(np.float64)
        in_box = np.zeros(len(points_m), dtype=bool)
        of_box, unnamed = {}, 0
        if boxes is not None:
            beside_m = boxes.size_m.new_tensor([2 * BESIDE_BOX_M, 2 * BESIDE_BOX_M, 0.0])
            grown = replace(boxes, size_m=boxes.size_m + beside_m)
            inside = find_points_in_boxes(torch.from_numpy(scan.points_m), grown)
            in_box[inside.point_indices.numpy()] = True
            for number, name in enumerate(boxes.ids):
                own_m = points_m[inside.point_indices[inside.box_indices == number].numpy()]
                if name and len(own_m):
                    own_m = transform_points(invert(get_vehicle_T_box(boxes, number)), own_m)
                    of_box[name] = own_m[find_first_occurrences(self.compute_voxel_indices(own_m))]
                else:
                    unnamed += len(own_m)
        local_T_vehicle = self.compute_local_T_vehicle(recording, index)
        still_m = transform_points(local_T_vehicle, points_m[~in_box])
        voxel = self.compute_voxel_indices(still_m)
        first = find_first_occurrences(voxel)
        image = None
        if self.window_s and _casts_rays(recording, index):
            mount = np.eye(4) if stored.vehicle_T_sensor is None else stored.vehicle_T_sensor
            seen_m = transform_points(invert(mount), points_m)
            image = RangeImage.from_points(seen_m, invert(local_T_vehicle @ mount))
        place_m = local_T_vehicle[:3, 3]
        thinned = ThinnedScan(still_m[first], voxel[first], of_box, unnamed, scan.excluded_counts, place_m, image)
        self._kept[key] = thinned
        return thinned

    def _moving(self, recording: Recording, index: int) -> Boxes | None:
        """The boxes that move, or have no name, or are seen at no other time."""
        boxes, times_s = recording.read_boxes(index), recording.times_s
        if boxes is None or times_s is None or not self.window_s:
            return boxes
        ends = np.searchsorted(times_s, times_s[index] + np.array([-MOVED_S, MOVED_S])).clip(0, len(times_s) - 1)
        instants = [index, *map(int, ends)]
        self._places[index] = _places_m(recording, index, boxes)
        places_m = [self._places_of(recording, instant) for instant in instants]
        moving = []
        for name in boxes.ids:
            known = [(times_s[at], of[name]) for at, of in zip(instants, places_m, strict=True) if name in of]
            (first_s, first_m), (last_s, last_m) = min(known, key=itemgetter(0)), max(known, key=itemgetter(0))
            is_known = name and last_s > first_s
            moving.append(not is_known or np.linalg.norm(last_m - first_m) > MOVES_MPS * (last_s - first_s))
        return boxes.select(torch.tensor(moving, dtype=torch.bool, device="cpu"))

    def _places_of(self, recording: Recording, index: int) -> dict[str, NDArray[np.float64]]:
        """As `_places_m`; nothing where labels cannot be read, which is the fault of that instant alone."""
        if index not in self._places:
            self._places[index] = {}
            with suppress(OSError, ValueError):
                self._places[index] = _places_m(recording, index, recording.read_boxes(index))
        return self._places[index]

    def compute_voxel_indices(self, points_m: NDArray[np.float64]) -> NDArray[np.int64]:
        """(N,) number of the voxel of each point."""
        return compute_voxel_indices(points_m, self.voxel_m)


def find_pose_discontinuities(times_s: NDArray[np.float64], world_T_vehicle: Matrix) -> NDArray[np.intp]:
    """After which of (N, 4, 4) poses the next lies, or points, elsewhere than those before and after say."""
    if len(times_s) < 3:
        return np.empty(0, np.intp)
    step_s = np.diff(times_s)[:, None]
    turned = world_T_vehicle[:-1, :3, :3].swapaxes(1, 2) @ world_T_vehicle[1:, :3, :3]
    ahead_m = AHEAD_M * np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    velocity_mps = np.column_stack([np.diff(world_T_vehicle[:, :3, 3], axis=0), ahead_m]) / step_s
    near = min(STEPS, len(step_s))
    first = np.clip(np.arange(len(step_s)) - near // 2, 0, len(step_s) - near)
    usual_mps = np.median(velocity_mps[first[:, None] + np.arange(near)], axis=1)
    off_m = np.linalg.norm((velocity_mps - usual_mps) * step_s, axis=1)
    return np.flatnonzero(off_m > JUMP_M + near // 2 * HARDEST_MPS2 * step_s[:, 0] ** 2)


def compute_voxel_indices(points_m: NDArray[np.float64], voxel_m: float) -> NDArray[np.int64]:
    """(N,) number of the voxel of each of (N, 3) points."""
    x, y, z = (np.floor(points_m / voxel_m).astype(np.int64) & ((1 << VOXEL_BITS) - 1)).T
    return np.asarray((x << 2 * VOXEL_BITS) | (y << VOXEL_BITS) | z)


def find_first_occurrences(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where each number is seen first, by ascending number; fast where ascending runs follow each other."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    return np.asarray(order[np.append(True, ordered[1:] != ordered[:-1])[: len(order)]])


def get_vehicle_T_box(boxes: Boxes, box_index: int) -> Matrix:
    """`vehicle_T_box` of one of them."""
    yaw_deg = float(np.rad2deg(boxes.yaw_rad[box_index].item()))
    return build_transform(convert_euler_to_rotation(yaw_deg, 0.0, 0.0), boxes.center_m[box_index].double().numpy())


def _places_m(recording: Recording, index: int, boxes: Boxes | None) -> dict[str, NDArray[np.float64]]:
    """Where the boxes of an instant are in the world, by their names."""
    if boxes is None:
        return {}
    return dict(zip(boxes.ids, transform_points(_pose(recording, index), boxes.center_m.double().numpy()), strict=True))


def _casts_rays(recording: Recording, index: int) -> bool:
    """Whether it is the first instant of its time, so that it does not depend on which one is asked about."""
    times_s = recording.times_s
    if times_s is None or index == 0 or len(times_s) <= SHORT:
        return True
    return bool(np.diff(np.floor((times_s[index - 1 : index + 1] - times_s[0]) / RAYS_EVERY_S + 1e-6))[0])


def _pose(recording: Recording, index: int) -> Matrix:
    """Where the vehicle was; it has not moved where that is unknown."""
    pose = recording.get_world_T_vehicle(index)
    return np.eye(4) if pose is None else pose
