"""Detection of road users in traffic by the sensors of a simulation or a recording."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection.inside import SKIN_M
from torchcover.encounters.criterion import Criterion
from torchcover.encounters.detection import (
    NEVER,
    DetectionTest,
    EncounterDetection,
    find_detection_frames,
    find_first_run,
    get_min_points,
)
from torchcover.encounters.traffic import Approach, Drive
from torchcover.geometry import invert
from torchcover.geometry.arrays import Int64
from torchcover.recordings.objects import Track
from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.simulator import Simulator

Clouds = Sequence[NDArray[np.floating]]


class DriveSensors(NamedTuple):
    """Sensors of a rig in one drive.

    Args:
        scan_periods: Frames between two scans of each sensor, as in `group_sensors`.
        min_points: Number of points of each sensor that is enough.
        pixels_per_sample: Number of pixels that each point of the sensor represents.
        frame_strides: Frames between two scans of each sensor.
        read_clouds: Reads the (N, 3) points of each sensor in one frame, in the vehicle frame; it may omit points
            outside the spheres.
    """

    scan_periods: Sequence[float | None]
    min_points: Sequence[int]
    pixels_per_sample: Sequence[int]
    frame_strides: Sequence[int]
    read_clouds: Callable[[int, SearchSpheres], Clouds]

    @classmethod
    def from_simulator(cls, simulator: Simulator, first_frame: int, criterion: Criterion) -> Self:
        """Create the sensors of the only rig of a simulator.

        Args:
            simulator: The simulator.
            first_frame: Frame of the simulator in which the scene begins.
            criterion: Number of points that is enough.

        Returns:
            The sensors; only points with a small range error count, as in frames.
        """
        (rig,) = simulator.rigs.values()

        def read_clouds(frame_index: int, spheres: SearchSpheres) -> Clouds:
            (scans,) = simulator.simulate_scans(first_frame + frame_index, spheres).values()
            clouds = []
            for scan in scans:
                points = scan.points
                # A point with a large range error is not on the object that it hit.
                if scan.range_error_m is not None:
                    points = points[np.abs(scan.range_error_m) <= MEASURED_WITHIN_M]
                clouds.append(points)
            return clouds

        scan_periods, frame_strides = list[float | None](), []
        min_points, pixels_per_sample = [], []
        for sensor in rig.sensors:
            min_points.append(get_min_points(criterion, sensor))
            pixels_per_sample.append(sensor.pixels_per_sample)
            frame_stride = max(1, round(1 / (sensor.rate_hz * simulator.frame_interval_s)))
            frame_strides.append(frame_stride)
            scan_periods.append(frame_stride if isinstance(sensor, Lidar) else None)
        return cls(scan_periods, min_points, pixels_per_sample, frame_strides, read_clouds)

    @classmethod
    def from_recording(cls, recording: Recording, sensors: Sequence[str], criterion: Criterion) -> Self:
        """Create the sensors of a recording, all LiDARs that are counted together.

        Args:
            recording: The recording.
            sensors: Names of the LiDARs.
            criterion: Number of points that is enough.

        Returns:
            The sensors.
        """

        # The last scans are kept, because several approaches at the same time need them.
        @lru_cache(maxsize=8)
        def read_frame(frame_index: int) -> Clouds:
            clouds = []
            for sensor in sensors:
                scan = recording.read_scan(sensor, frame_index)
                clouds.append(transform_to_vehicle(scan, recording.ego_box).points_m)
            return clouds

        def read_clouds(frame_index: int, _: SearchSpheres) -> Clouds:
            return read_frame(frame_index)

        ones = [1] * len(sensors)
        return cls(ones, [criterion.points] * len(sensors), ones, ones, read_clouds)


class ApproachPointCounter:
    """Count points of each sensor on one road user, in any frame and each only once.

    Args:
        drive: The drive.
        track: Track of the road user.
        drive_sensors: The sensors.
    """

    def __init__(self, drive: Drive, track: Track, drive_sensors: DriveSensors) -> None:
        self._drive, self._track, self._sensors = drive, track, drive_sensors
        self._points_by_frame: dict[int, Int64] = {}

    def count_points(self, sensor_indices: Sequence[int], frame_indices: Int64) -> Int64:
        """Count the points of some sensors together.

        Args:
            sensor_indices: The sensors.
            frame_indices: (N,) frames.

        Returns:
            (N,) number of points.
        """
        totals = []
        for frame_index in frame_indices.tolist():
            if frame_index not in self._points_by_frame:
                self._points_by_frame[frame_index] = self._count_frame_points(frame_index)
            totals.append(self._points_by_frame[frame_index][list(sensor_indices)].sum())
        return np.array(totals)

    def _count_frame_points(self, frame_index: int) -> Int64:
        """Count the (S,) points in the upright box of the road user, with margins as in `find_points_in_boxes`."""
        time_s, trajectory = self._drive.times_s[frame_index], self._track.trajectory
        size_m = np.array(self._track.size_m)
        # The road user is absent in this frame.
        if np.isnan(trajectory.interpolate_positions_m(np.array([time_s]))).any():
            return np.zeros(len(self._sensors.scan_periods), dtype=np.int64)
        pose = invert(self._drive.world_T_ego[frame_index]) @ trajectory.interpolate(time_s)
        center_m = pose[:3, 3] + size_m[2] / 2 * pose[:3, 2]
        sphere = SearchSpheres(center_m[None], float(np.linalg.norm(size_m / 2 + SKIN_M)))
        clouds = self._sensors.read_clouds(frame_index, sphere)
        counts = []
        for cloud_m, pixels_per_sample in zip(clouds, self._sensors.pixels_per_sample, strict=True):
            offsets_m = (cloud_m - pose[:3, 3]) @ pose[:3, :3]
            is_inside = (np.abs(offsets_m[:, :2]) <= size_m[:2] / 2 + SKIN_M).all(axis=1)
            # Points at the bottom belong to the ground.
            is_inside &= (offsets_m[:, 2] > SKIN_M) & (offsets_m[:, 2] <= size_m[2] + SKIN_M)
            counts.append(pixels_per_sample * np.count_nonzero(is_inside))
        return np.array(counts, dtype=np.int64)


def detect_approach(
    rig_name: str, drive: Drive, approach: Approach, drive_sensors: DriveSensors, criterion: Criterion
) -> EncounterDetection:
    """Find out when a rig detects an approaching road user.

    The search begins `max_ttc_s` before the approach, or with the last scans of a slow sensor. The time to collision
    at detection is the smallest until then, or `max_ttc_s` for a detection before the approach. Whether the detection
    is in time is undecided if braking was never needed, or was needed before the approach began.

    Args:
        rig_name: Name of the rig.
        drive: The drive.
        approach: The road user.
        drive_sensors: Sensors of the rig.
        criterion: Criterion of detection and braking.

    Returns:
        The detection, for one start offset.
    """
    begin, end = approach.frame_index, approach.frame_index + len(approach.ttc_s)
    search_begin = int(np.searchsorted(drive.times_s, drive.times_s[begin] - criterion.max_ttc_s))
    counter = ApproachPointCounter(drive, approach.track, drive_sensors)

    def find_first(is_detected: DetectionTest, sensor_index: int) -> Int64:
        scan_frames = np.arange(0, end, drive_sensors.frame_strides[sensor_index])
        # Most road users are detected at the begin: testing the last scans before it saves all earlier ones.
        last_scans = scan_frames[scan_frames <= begin][-criterion.consecutive_scans :]
        if find_first_run(is_detected, last_scans[None], criterion.consecutive_scans)[0] < NEVER:
            return np.array([begin])
        searched_scans = scan_frames[scan_frames >= min(search_begin, last_scans[0])]
        return np.maximum(find_first_run(is_detected, searched_scans[None], criterion.consecutive_scans), begin)

    detection_frames = find_detection_frames(
        drive_sensors.scan_periods, drive_sensors.min_points, counter.count_points, find_first
    )
    # Index 0 is a detection before the approach, the last index no detection.
    min_ttc_s = np.append(np.minimum.accumulate(approach.ttc_s), 0.0)
    min_ttc_s[0] = criterion.max_ttc_s
    ttc_s, sensor_ttc_s, ttc_without_sensor_s = (
        min_ttc_s[np.minimum(frames, end) - begin] for frames in detection_frames
    )
    detection_frame = int(detection_frames[0][0])
    num_undetected = min(detection_frame - begin + 1, len(approach.ttc_s)) if detection_frame > begin else 0
    is_late = approach.ttc_s < approach.braking_times_s
    was_needed_before = detection_frame == begin and approach.braking_times_s[0] > criterion.max_ttc_s
    is_undecided = not is_late.any() or was_needed_before
    in_time = np.array([np.nan if is_undecided else float(not is_late[:num_undetected].any())])
    braking_time_s = float(approach.braking_times_s.max())
    return EncounterDetection(
        approach, rig_name, braking_time_s, ttc_s, in_time, sensor_ttc_s, ttc_without_sensor_s, criterion.max_ttc_s,
        drive.name,
    )  # fmt: skip
