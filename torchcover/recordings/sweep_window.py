"""Scans in a time window around a frame, thinned and moved into one fixed frame.

Accumulated references and ground models are built from them.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes, find_points_in_boxes
from torchcover.frames.source import BadFrameError
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.free_space import Float64, FreeSpaceCounter, RangeImage, ScanKey, Votes
from torchcover.recordings.ground_model import GroundModel, extract_low_surfaces
from torchcover.recordings.recording import Recording, Scan
from torchcover.recordings.vehicle_cloud import VehicleCloud, transform_to_vehicle

# Farther from the first position, indices of voxels and columns would overflow; UTM coordinates in mm are smaller.
MAX_DISTANCE_M = 1e10


@dataclass(frozen=True)
class SweepParams:
    """Parameters of the scans in a window.

    Args:
        min_object_speed_mps: Slower objects are treated as static.
        object_motion_s: Motion of an object is measured from this long before the frame to this long after it.
        box_margin_m: Points this near to the sides of a box belong to its object, because labelers leave out mirrors
            and corners; the published scene flow of Argoverse 2 adds 0.2 m in length and width likewise.
        free_space_margin_s: Scans this long before and after the window contradict points of the window too.
        ray_interval_s: One scan in this time provides rays.
        max_frames_with_all_rays: Every scan provides rays in a recording of at most this many frames.
        cell_m: Side of the cells in which a static surface must be observed again.
    """

    min_object_speed_mps: float = 0.5
    object_motion_s: float = 0.5
    box_margin_m: float = 0.1
    free_space_margin_s: float = 1.0
    ray_interval_s: float = 0.2
    max_frames_with_all_rays: int = 20
    cell_m: float = 0.6


@dataclass(frozen=True)
class DiscontinuityParams:
    """Parameters of the search for discontinuities of poses.

    Args:
        min_jump_m: A pose jumps if it deviates this much from the motion before and after,
        max_acceleration_mps2: plus what the vehicle can move by this acceleration, the limit of tires.
        num_steps: The usual velocity is the median over this many steps.
        lever_m: A rotation counts as the motion of a point this far ahead.
    """

    min_jump_m: float = 0.3
    max_acceleration_mps2: float = 12.0
    num_steps: int = 5
    lever_m: float = 10.0


@dataclass(frozen=True)
class ThinnedScan:
    """Scan with one point per voxel.

    The local frame is the world frame, shifted to the first position of the vehicle in the recording.

    Args:
        static_points_m: (N, 3) points that are static, or in no box, in the local frame.
        voxel_indices: (N,) int64 index of the voxel of each point, ascending.
        object_points_m: Name of each moving object -> (M, 3) points in the frame of its box: x along its heading,
            origin at the center.
        unnamed_object_point_count: Points in boxes without a name, which cannot be associated over time.
        excluded_counts: As `VehicleCloud.excluded_counts`.
        vehicle_position_m: (3,) position of the vehicle in the local frame.
        range_image: Free space that the scan observed; None if the scan provides no rays.
        cell_m: Side of `occupied_cells`.
    """

    static_points_m: Float64
    voxel_indices: NDArray[np.int64]
    object_points_m: Mapping[str, Float64]
    unnamed_object_point_count: int
    excluded_counts: Counter[str]
    vehicle_position_m: Float64
    range_image: RangeImage | None
    cell_m: float

    @cached_property
    def occupied_cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(K,) indices of the cells with points, and (N,) position of the cell of each static point among them."""
        return np.unique(compute_voxel_indices(self.static_points_m, self.cell_m), return_inverse=True)

    @cached_property
    def low_surfaces(self) -> Float64:
        """(K, 4) ground candidates of the scan, see `extract_low_surfaces`."""
        return extract_low_surfaces(self.static_points_m, self.vehicle_position_m)


class SweepWindow:
    """Sliding window of scans; scans of the last recording and window stay in memory.

    Args:
        window_s: Time between the first scan and the last, half of it before the frame; 0: the frame alone.
        voxel_m: Side of a voxel in meters.
        params: Parameters of the scans.

    Attributes:
        skip_unreadable: Whether an unreadable scan counts as one without points instead of raising an error.
    """

    def __init__(self, window_s: float = 2.0, voxel_m: float = 0.1, params: SweepParams = SweepParams()) -> None:
        self.skip_unreadable = False
        self.window_s = window_s
        self.voxel_m = voxel_m
        self.params = params
        self._clear_cache()

    def _clear_cache(self) -> None:
        self._recording: Recording | None = None
        self._scans: dict[ScanKey, ThinnedScan] = {}
        self._object_positions: dict[int, dict[str, Float64]] = {}
        self._counter = FreeSpaceCounter()
        self._ground: tuple[int, GroundModel | None] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if not name.startswith("_")}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._clear_cache()

    def find_frames_in_window(self, recording: Recording, index: int, margin_s: float = 0.0) -> list[int]:
        """Find the frames of a window; a discontinuity of the poses ends it.

        Args:
            recording: The recording.
            index: Frame in the middle of the window.
            margin_s: Time by which the window is extended on both sides.

        Returns:
            Indices of frames, the nearest in time first; only `index` if times or poses are unknown.
        """
        if not self.window_s or recording.times_s is None or recording.get_world_T_vehicle(index) is None:
            return [index]
        distance_s = np.abs(recording.times_s - recording.times_s[index])
        frames = np.flatnonzero(distance_s <= (self.window_s / 2 + margin_s) * (1 + 1e-9))
        poses = np.array([_get_pose_or_identity(recording, int(frame)) for frame in frames])
        jumps = find_pose_discontinuities(recording.times_s[frames], poses)
        position = int(np.searchsorted(frames, index))
        begin = max(jumps[jumps < position] + 1, default=0)
        end = min(jumps[jumps >= position] + 1, default=len(frames))
        frames = frames[begin:end]
        nearest_first: list[int] = frames[np.argsort(distance_s[frames], kind="stable")].tolist()
        return nearest_first

    def count_skipped_frames(self, recording: Recording, index: int) -> int:
        """Count the frames within the time of a window that discontinuities of the poses exclude.

        Args:
            recording: The recording.
            index: Frame in the middle of the window.
        """
        if recording.times_s is None:
            return 0
        distance_s = np.abs(recording.times_s - recording.times_s[index])
        frame_count = int((distance_s <= self.window_s / 2 * (1 + 1e-9)).sum())
        return frame_count - len(self.find_frames_in_window(recording, index))

    def keep_frames(self, recording: Recording, frame_indices: Sequence[int]) -> None:
        """Release the scans of all other frames and recordings.

        Args:
            recording: The recording.
            frame_indices: Frames whose scans stay in memory.
        """
        if recording is not self._recording:
            self._clear_cache()
        frames = set(frame_indices)
        self._recording = recording
        self._scans = {key: scan for key, scan in self._scans.items() if key[1] in frames}
        self._object_positions = {frame: value for frame, value in self._object_positions.items() if frame in frames}

    def count_free_space_votes(self, recording: Recording, sensors: Sequence[str], index: int) -> dict[ScanKey, Votes]:
        """Count the scans that contradict each static point in a window and its margins.

        Args:
            recording: The recording.
            sensors: Sensors whose scans are used.
            index: Frame in the middle of the window.

        Returns:
            (N,) number of contradicting scans for each point of each scan.
        """
        frames = self.find_frames_in_window(recording, index, self.params.free_space_margin_s)
        self.keep_frames(recording, frames)
        points_m: dict[ScanKey, Float64] = {}
        images: dict[ScanKey, RangeImage] = {}
        for frame in frames:
            for sensor in sensors:
                scan = self.get_thinned_scan(recording, sensor, frame)
                points_m[sensor, frame] = scan.static_points_m
                if scan.range_image is not None:
                    images[sensor, frame] = scan.range_image
        return self._counter.update(points_m, images)

    def compute_local_T_vehicle(self, recording: Recording, index: int) -> Matrix:
        """Compute the (4, 4) pose of the vehicle in the local frame, whose coordinates stay small.

        Args:
            recording: The recording.
            index: Index of the frame.

        Raises:
            BadFrameError: The vehicle is more than `MAX_DISTANCE_M` from its first position.
        """
        first_position_m = _get_pose_or_identity(recording, 0)[:3, 3]
        pose = _get_pose_or_identity(recording, index)
        offset_m = pose[:3, 3] / 2 - first_position_m / 2  # half of the offset, which cannot overflow
        distance_m = 2.0 * float(np.abs(offset_m).max())
        if not distance_m <= MAX_DISTANCE_M:
            name = recording.frame_names[index]
            raise BadFrameError(
                f"{name}: the vehicle is {distance_m:.3g} m from its position in {recording.frame_names[0]}; "
                "correct its poses, which need meters"
            )
        return build_transform(np.eye(3), -first_position_m) @ pose

    def get_ground_model(self, recording: Recording, index: int) -> GroundModel | None:
        """Get the ground that all sensors observed within the window.

        Args:
            recording: The recording.
            index: Frame in the middle of the window.

        Returns:
            The ground in the local frame; None if there is none near the vehicle.
        """
        if self._recording is recording and self._ground is not None and self._ground[0] == index:
            return self._ground[1]
        frames = self.find_frames_in_window(recording, index)
        cached_frames = {frame for _, frame in self._scans}
        if self._recording is not recording or not cached_frames >= set(frames):
            self.keep_frames(recording, frames)
        surfaces = []
        for frame in frames:
            for sensor in (*recording.sensors, *recording.reference_sensors):
                surfaces.append(self.get_thinned_scan(recording, sensor, frame).low_surfaces)
        vehicle_position_m = self.compute_local_T_vehicle(recording, index)[:3, 3]
        ground = GroundModel.from_surfaces(surfaces, vehicle_position_m)
        self._ground = (index, ground)
        return ground

    def get_thinned_scan(self, recording: Recording, sensor: str, index: int) -> ThinnedScan:
        """Get a scan with one point per voxel, from memory or from the recording.

        Args:
            recording: The recording.
            sensor: Name of the sensor.
            index: Index of the frame.

        Raises:
            BadFrameError: The scan or its labels cannot be read.
        """
        key = (sensor, index)
        if key not in self._scans:
            self._scans[key] = self._read_thinned_scan(recording, sensor, index)
        return self._scans[key]

    def _read_thinned_scan(self, recording: Recording, sensor: str, index: int) -> ThinnedScan:
        try:
            scan = recording.read_scan(sensor, index)
            cloud, boxes = transform_to_vehicle(scan, recording.ego_box), self._read_moving_boxes(recording, index)
        except (OSError, ValueError) as error:
            if not self.skip_unreadable:
                raise BadFrameError(f"{recording.frame_names[index]}: {error}") from error
            scan, boxes = Scan(np.empty((0, 3)), None, ""), None
            cloud = transform_to_vehicle(scan)
            cloud.excluded_counts["sweeps_skipped"] = 1
        points_m = cloud.points_m.astype(np.float64)
        is_static, object_points_m, unnamed_count = self._separate_objects(cloud, points_m, boxes)
        local_T_vehicle = self.compute_local_T_vehicle(recording, index)
        static_points_m = transform_points(local_T_vehicle, points_m[is_static])
        voxel_indices = compute_voxel_indices(static_points_m, self.voxel_m)
        first = find_first_occurrences(voxel_indices)
        range_image = None
        if self.window_s and self._provides_rays(recording, index):
            vehicle_T_sensor = np.eye(4) if scan.vehicle_T_sensor is None else scan.vehicle_T_sensor
            returns_m = transform_points(invert(vehicle_T_sensor), points_m)
            range_image = RangeImage.from_points(returns_m, invert(local_T_vehicle @ vehicle_T_sensor))
        return ThinnedScan(
            static_points_m[first],
            voxel_indices[first],
            object_points_m,
            unnamed_count,
            cloud.excluded_counts,
            local_T_vehicle[:3, 3],
            range_image,
            self.params.cell_m,
        )

    def _separate_objects(
        self, cloud: VehicleCloud, points_m: Float64, moving_boxes: Boxes | None
    ) -> tuple[NDArray[np.bool_], dict[str, Float64], int]:
        """Separate the points in moving boxes from (N, 3) points in the vehicle frame.

        Returns:
            (N,) marks of the points in no box, the thinned points of each object in the frame of its box, and the
            number of points in boxes without a name.
        """
        is_static = np.ones(len(points_m), dtype=bool)
        object_points_m: dict[str, Float64] = {}
        unnamed_count = 0
        if moving_boxes is None:
            return is_static, object_points_m, unnamed_count
        margin_m = 2 * self.params.box_margin_m
        grown_size_m = moving_boxes.size_m + moving_boxes.size_m.new_tensor([margin_m, margin_m, 0.0])
        pairs = find_points_in_boxes(torch.from_numpy(cloud.points_m), replace(moving_boxes, size_m=grown_size_m))
        is_static[pairs.point_indices.numpy()] = False
        for box_index, name in enumerate(moving_boxes.ids):
            points_in_box_m = points_m[pairs.point_indices[pairs.box_indices == box_index].numpy()]
            if name and len(points_in_box_m):
                box_T_vehicle = invert(get_vehicle_T_box(moving_boxes, box_index))
                points_in_box_m = transform_points(box_T_vehicle, points_in_box_m)
                first = find_first_occurrences(compute_voxel_indices(points_in_box_m, self.voxel_m))
                object_points_m[name] = points_in_box_m[first]
            else:
                unnamed_count += len(points_in_box_m)
        return is_static, object_points_m, unnamed_count

    def _read_moving_boxes(self, recording: Recording, index: int) -> Boxes | None:
        """Read the boxes that move, have no name, or are labeled in no other frame nearby."""
        boxes, times_s = recording.read_boxes(index), recording.times_s
        if boxes is None or times_s is None or not self.window_s:
            return boxes
        window_s = times_s[index] + np.array([-self.params.object_motion_s, self.params.object_motion_s])
        ends = np.searchsorted(times_s, window_s).clip(0, len(times_s) - 1)
        frames = [index, *ends.tolist()]
        self._object_positions[index] = _compute_object_positions(recording, index, boxes)
        positions_of_frames = [self._get_object_positions(recording, frame) for frame in frames]
        is_moving = []
        for name in boxes.ids:
            labeled_times_s, positions_m = [], []
            for frame, positions in zip(frames, positions_of_frames, strict=True):
                if name in positions:
                    labeled_times_s.append(times_s[frame])
                    positions_m.append(positions[name])
            first, last = int(np.argmin(labeled_times_s)), int(np.argmax(labeled_times_s))
            duration_s = labeled_times_s[last] - labeled_times_s[first]
            distance_m = np.linalg.norm(positions_m[last] - positions_m[first])
            is_static = name and duration_s > 0 and distance_m <= self.params.min_object_speed_mps * duration_s
            is_moving.append(not is_static)
        return boxes.select(torch.tensor(is_moving, dtype=torch.bool, device="cpu"))

    def _get_object_positions(self, recording: Recording, index: int) -> dict[str, Float64]:
        """Get object positions; none if labels cannot be read, which only that frame reports."""
        if index not in self._object_positions:
            self._object_positions[index] = {}
            with suppress(OSError, ValueError):
                boxes = recording.read_boxes(index)
                self._object_positions[index] = _compute_object_positions(recording, index, boxes)
        return self._object_positions[index]

    def _provides_rays(self, recording: Recording, index: int) -> bool:
        """Test whether the frame is the first one of its interval; this does not depend on the window."""
        times_s = recording.times_s
        if times_s is None or index == 0 or len(times_s) <= self.params.max_frames_with_all_rays:
            return True
        interval = np.floor((times_s[index - 1 : index + 1] - times_s[0]) / self.params.ray_interval_s + 1e-6)
        return bool(np.diff(interval)[0])


def find_pose_discontinuities(times_s: Float64, world_T_vehicle: Matrix) -> NDArray[np.intp]:
    """Find the poses after which the position or heading jumps.

    Args:
        times_s: (N,) times, ascending.
        world_T_vehicle: (N, 4, 4) poses.

    Returns:
        Indices of the last poses before a jump.
    """
    if len(times_s) < 3:
        return np.empty(0, np.intp)
    params, interval_s = DiscontinuityParams(), np.diff(times_s)[:, None]
    rotation = world_T_vehicle[:-1, :3, :3].swapaxes(1, 2) @ world_T_vehicle[1:, :3, :3]
    lever_motion_m = params.lever_m * np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    motion_m = np.column_stack([np.diff(world_T_vehicle[:, :3, 3], axis=0), lever_motion_m])
    velocity_mps = motion_m / interval_s
    num_steps = min(params.num_steps, len(interval_s))
    first = np.clip(np.arange(len(interval_s)) - num_steps // 2, 0, len(interval_s) - num_steps)
    usual_mps = np.median(velocity_mps[first[:, None] + np.arange(num_steps)], axis=1)
    deviation_m = np.linalg.norm((velocity_mps - usual_mps) * interval_s, axis=1)
    possible_m = num_steps // 2 * params.max_acceleration_mps2 * interval_s[:, 0] ** 2
    return np.flatnonzero(deviation_m > params.min_jump_m + possible_m)


def compute_voxel_indices(points_m: NDArray[np.float64], voxel_m: float) -> NDArray[np.int64]:
    """Compute an index for the voxel of each point.

    Args:
        points_m: (N, 3) points.
        voxel_m: Side of a voxel.

    Returns:
        (N,) indices, unique within 2^21 voxels per axis (200 km at 0.1 m).
    """
    bits = 21
    x, y, z = (np.floor(points_m / voxel_m).astype(np.int64) & ((1 << bits) - 1)).T
    return np.asarray((x << 2 * bits) | (y << bits) | z)


def find_first_occurrences(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find the first position of each value.

    Args:
        values: (N,) numbers; fast if they consist of ascending runs.

    Returns:
        (K,) positions, sorted by value.
    """
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    return np.asarray(order[np.append(True, ordered[1:] != ordered[:-1])[: len(order)]])


def get_vehicle_T_box(boxes: Boxes, box_index: int) -> Matrix:
    """Get the (4, 4) pose of a box in the vehicle frame.

    Args:
        boxes: Boxes in the vehicle frame.
        box_index: Index of the box.
    """
    yaw_deg = float(np.rad2deg(boxes.yaw_rad[box_index].item()))
    rotation = convert_euler_to_rotation(yaw_deg, 0.0, 0.0)
    return build_transform(rotation, boxes.center_m[box_index].double().numpy())


def _compute_object_positions(recording: Recording, index: int, boxes: Boxes | None) -> dict[str, Float64]:
    """Compute the position of each named box of a frame in the world frame."""
    if boxes is None:
        return {}
    world_T_vehicle = _get_pose_or_identity(recording, index)
    return dict(zip(boxes.ids, transform_points(world_T_vehicle, boxes.center_m.double().numpy()), strict=True))


def _get_pose_or_identity(recording: Recording, index: int) -> Matrix:
    """Get the pose of the vehicle; the identity if it is unknown."""
    pose = recording.get_world_T_vehicle(index)
    return np.eye(4) if pose is None else pose
