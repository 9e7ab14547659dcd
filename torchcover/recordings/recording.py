"""Interface of recordings: scans of named sensors, poses and labels by frame."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import Calibration
from torchcover.detection.boxes import Boxes
from torchcover.files import RECORDING, WRITING, guard_reader, read_manifest
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float32, Float64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import Points

# Drivers store zeros for rays without a return, so points this close to the origin are no returns.
NO_RETURN_M = 1e-3
# Points below this height under the vehicle belong to the ground, not to the vehicle.
GROUND_CLEARANCE_M = 0.05


@dataclass(frozen=True)
class Scan:
    """Points of one sensor in one frame, as stored.

    Args:
        points_m: (N, 3) points in the sensor frame; points that are not finite or at the origin are missing returns.
        vehicle_T_sensor: (4, 4) extrinsics of the sensor; None if the points are in the vehicle frame.
        source: File or message that the scan was read from, for messages.
        min_range_m: Points closer to the sensor are missing returns.
        weights: (N,) positive area weights of reference points; None if all points count the same.
        heights_m: (N,) heights of reference points above the local ground, NaN where there is no ground; None if
            unknown.
        rings: (N,) channel of each point; None if unknown.
        offsets_s: (N,) measurement time of each point minus the time to which motion compensation moved it; None if
            unknown or not compensated.
    """

    points_m: Points
    vehicle_T_sensor: Matrix | None
    source: str
    min_range_m: float = 0.0
    weights: Float64 | None = None
    heights_m: Float32 | None = None
    rings: NDArray[np.integer] | None = None
    offsets_s: Float64 | None = None


@dataclass(frozen=True)
class TimeCheckParams:
    """Limits of plausible times in seconds.

    Args:
        max_interval_s: Longer median intervals are counts of milliseconds, microseconds or nanoseconds.
        max_slow_interval_s: Longer median intervals are implausible for a vehicle slower than `min_speed_mps`.
        min_speed_mps: A moving vehicle that seems slower has times in milliseconds.
        max_rounding_share: Times may be rounded by this share of the median interval.
    """

    max_interval_s: float = 3600.0
    max_slow_interval_s: float = 10.0
    min_speed_mps: float = 0.2
    max_rounding_share: float = 0.01


def check_times(times_s: Float64, num_frames: int, source: str) -> Float64:
    """Check that there is one time per frame, ascending and in seconds.

    Args:
        times_s: (F,) times of the frames.
        num_frames: Number of frames of the recording.
        source: File or topic of the times, for messages.

    Returns:
        `times_s`.

    Raises:
        ValueError: The number of times is wrong, they do not ascend, or their unit is not the second.
    """
    if len(times_s) != num_frames:
        raise ValueError(f"{source}: {len(times_s):,} times for {num_frames:,} scans; each scan needs one time")
    bad = np.flatnonzero(~(np.diff(times_s) > 0))
    if len(bad):
        first = int(bad[0])
        raise ValueError(
            f"{source}: times have to ascend; {len(bad)} do not, the first after frame {first}: "
            f"{times_s[first]:.6f} s, then {times_s[first + 1]:.6f} s; remove such frames, or correct their times"
        )
    check_seconds(times_s, f"{source}: ")
    return times_s


def check_seconds(
    times_s: NDArray[np.floating],
    source: str = "",
    positions_m: NDArray[np.floating] | None = None,
) -> None:
    """Check that ascending times are in seconds and not rounded too coarsely.

    Args:
        times_s: (K,) times as stored.
        source: Prefix of the message.
        positions_m: (K, 3) positions at these times; their speed distinguishes milliseconds from seconds.

    Raises:
        ValueError: The median interval is longer than an hour, or than 10 s at a crawl, or float32 rounds the times.
    """
    params, speed_mps = TimeCheckParams(), 0.0
    interval_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    if positions_m is not None and interval_s:
        speed_mps = float(np.median(np.linalg.norm(np.diff(positions_m, axis=0), axis=1) / np.diff(times_s)))
    is_slow = 0.0 < speed_mps < params.min_speed_mps
    if interval_s > params.max_interval_s or (interval_s > params.max_slow_interval_s and is_slow):
        raise ValueError(
            f"{source}times in seconds are needed; their median interval is {interval_s:g}: divide them by 1e3, 1e6 "
            "or 1e9 if they count milliseconds, microseconds or nanoseconds"
        )
    rounding_s = float(np.spacing(np.abs(times_s).max(initial=0.0)))
    if interval_s and rounding_s > params.max_rounding_share * interval_s:
        raise ValueError(
            f"{source}times of {times_s.dtype} are rounded to {rounding_s:g} s, with a median interval of "
            f"{interval_s:g} s; store them as float64, or relative to the first one"
        )


class SensorCalibrations(NamedTuple):
    """Extrinsics of LiDARs and calibrations of cameras.

    Args:
        source: Origin of the calibrations, for messages.
        mounts: Name of a LiDAR and its (4, 4) `vehicle_T_lidar`.
        cameras: Cameras with their extrinsics in the vehicle frame.
    """

    source: str = ""
    mounts: Mapping[str, Matrix] = {}
    cameras: tuple[Calibration, ...] = ()


class Recording:
    """Logged sensor data with poses; the reader of a format is a subclass, see `FORMATS`.

    Frames are ordered by time. A reader loads names, times and calibrations when it is created, and scans on request.

    Args:
        path: Folder or file of the recording.
        frame_names: Name of each frame.
        times_s: (F,) ascending times of the frames; None if unknown.
        sensors: Names of the sensors on the vehicle.
        rigs: Default rigs: name and sensors of each.
        reference_sensors: Sensors that were recorded as the reference; empty if there are none.
        has_area_weights: True if the scans of the reference sensors have area weights.
        block_indices: `Frame.block_index` of each frame for standard errors; None: every frame is its own block.
        ego_box: Bounding box of the ego vehicle in the vehicle frame; None if unknown. Callers may set it.
    """

    path: Path
    frame_names: Sequence[str]
    times_s: Float64 | None = None
    sensors: Sequence[str]
    rigs: Mapping[str, Sequence[str]]
    reference_sensors: Sequence[str] = ()
    has_area_weights = False
    block_indices: Sequence[int] | None = None
    ego_box: BoundingBox | None = None

    @cached_property
    def key_frames(self) -> Sequence[int]:
        """Ascending indices of the frames to evaluate; other frames only contribute to the reference."""
        return range(len(self.frame_names))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read the scan of a sensor in a frame.

        Args:
            sensor: Name of the sensor.
            index: Index of the frame.

        Returns:
            The scan.

        Raises:
            OSError: The file is missing.
            ValueError: The file is invalid.
        """
        raise NotImplementedError

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Return the (4, 4) pose of the vehicle in a fixed world frame; None if unknown."""
        return None

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the labeled objects of a frame in the vehicle frame; None if the frame has no labels."""
        return None

    def read_calibrations(self) -> SensorCalibrations:
        """Read the calibrations of the sensors, if there are any; cameras match the images that the data set ships.

        Raises:
            OSError: A calibration file is missing.
            ValueError: A calibration file is invalid.
        """
        return SensorCalibrations()

    def read_raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras with their distortion before images were undistorted.

        Raises:
            OSError: A calibration file is missing.
            ValueError: A calibration file is invalid, or the recording has no other lenses than those of its images.
        """
        raise ValueError(
            f"{self.path}: this recording has one model of each lens, that of its images; leave out --raw-images"
        )


def warn_about_missing_poses(path: Path, frames_without_pose: Sequence[str], num_frames: int) -> None:
    """Warn about sweeps that are excluded because the pose of the vehicle at their time is unknown.

    Args:
        path: File or folder of the poses.
        frames_without_pose: Names of these sweeps.
        num_frames: Number of all sweeps.

    Raises:
        ValueError: No sweep has a pose.
    """
    if len(frames_without_pose) == num_frames:
        raise ValueError(
            f"{path}: none of {num_frames:,} sweeps has a pose, the first is {frames_without_pose[0]}; is it one log?"
        )
    if frames_without_pose:
        warnings.warn(
            f"{path}: {len(frames_without_pose):,} of {num_frames:,} sweeps are excluded, since there is no pose at "
            f"their time; the first is {frames_without_pose[0]}",
            stacklevel=3,
        )


@guard_reader("the manifest of a recording")
def read_recording_manifest(path: Path) -> dict[str, Any]:
    """Read `recording.json`, which lists the `files` of a recording that torchcover wrote, and its `frames`.

    While a recording is being written, `writing` is true and `steps` holds the complete frames.

    Args:
        path: Manifest file.

    Returns:
        The manifest, with defaults for missing keys.

    Raises:
        BadFileError: The content is not a manifest.
    """
    manifest = {"content": {}, "steps": [], "frames": None, **(read_manifest(path.resolve()) or {})}
    if not isinstance(manifest["steps"] if manifest.get(WRITING) else manifest["frames"], list):
        raise ValueError("a list of files with their sizes, and the names of the frames, are needed; record it again")
    return manifest


def read_complete_manifest(folder: Path) -> dict[str, Any] | None:
    """Read the manifest of a recording that torchcover wrote completely.

    Args:
        folder: Folder of the recording.

    Returns:
        The manifest; None if another program wrote the recording.

    Raises:
        BadFileError: `recording.json` is invalid.
        ValueError: The recording is incomplete.
    """
    if not (folder / RECORDING).exists():
        return None
    manifest = read_recording_manifest(folder / RECORDING)
    if manifest.get(WRITING):
        raise ValueError(
            f"{folder}: an incomplete recording with {len(manifest['steps']):,} frames; continue it with "
            "`torchcover record --resume`"
        )
    return manifest
