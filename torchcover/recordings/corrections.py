"""Correction of points, poses and times of a recording, on request of its user."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from torchcover import geometry
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.las import read_las_scale
from torchcover.recordings.recording import Recording, Scan
from torchcover.recordings.settings import RecordingSettings


class CorrectedRecording:
    """Recording with corrected points, poses and times; other attributes are those of the wrapped recording.

    Args:
        recording: Recording as its reader delivers it.
        settings: Corrections to apply.
    """

    def __init__(self, recording: Recording, settings: RecordingSettings) -> None:
        self.recording = recording
        self.settings = settings

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (any attribute of the recording)
        if name == "recording":  # pickle asks before `recording` is set
            raise AttributeError(name)
        return getattr(self.recording, name)

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a scan and convert its points to meters in the order x, y, z.

        Args:
            sensor: Name of the sensor.
            index: Index of the frame.

        Returns:
            The corrected scan.

        Raises:
            ValueError: A unit is set although the LAS file states its own unit.
        """
        scan = self.recording.read_scan(sensor, index)
        unit = self.settings.units
        path = Path(scan.source)
        if unit != "m" and path.suffix.lower() in (".las", ".laz") and (read_las_scale(path) != 1.0).any():
            raise ValueError(f"{path}: it is converted to meters, as the file says; leave out recording.units={unit}")
        columns = ["xyz".index(axis) for axis in self.settings.axis_order]
        meters_per_unit = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}[unit]
        return replace(scan, points_m=scan.points_m[:, columns] * meters_per_unit)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Return the corrected pose of the vehicle in a frame.

        Args:
            index: Index of the frame.

        Returns:
            (4, 4) transform; None if any frame of the recording has no pose.
        """
        return None if self._poses is None else self._poses[index]

    @cached_property
    def _poses(self) -> Matrix | None:
        """Corrected poses of all frames; None if any pose is missing."""
        poses = [self.recording.get_world_T_vehicle(index) for index in range(len(self.recording.frame_names))]
        if any(pose is None for pose in poses):
            return None
        times_s = self.recording.times_s
        if times_s is None and (self.settings.time_offset_s or self.settings.interpolate_poses):
            raise ValueError(
                f"{self.recording.path}: {self.settings.command_line_options} needs the times of its frames"
            )
        return correct_poses(np.array(poses), np.arange(0.0, len(poses)) if times_s is None else times_s, self.settings)


def correct_recording(recording: Recording, settings: RecordingSettings) -> Recording:
    """Apply the corrections of settings to a recording.

    Args:
        recording: Recording as its reader delivers it.
        settings: Corrections to apply.

    Returns:
        The corrected recording, or `recording` itself if there is nothing to correct.
    """
    # mypy does not know the attributes that a corrected recording passes on.
    return cast(Recording, CorrectedRecording(recording, settings)) if settings.corrections else recording


def correct_poses(world_T_vehicle: Matrix, times_s: Float64, settings: RecordingSettings) -> Matrix:
    """Correct the poses of consecutive frames.

    Args:
        world_T_vehicle: (N, 4, 4) poses as stored.
        times_s: (N,) times of the frames, ascending.
        settings: Order of quaternions, convention, interpolation and time offset of the poses.

    Returns:
        (N, 4, 4) `world_T_vehicle`; poses before the first and after the last are extrapolated.
    """
    poses = world_T_vehicle.copy()
    if settings.quaternion_order == "xyzw":  # the reader took these numbers for w, x, y, z
        wxyz = [geometry.convert_rotation_to_quaternion(rotation) for rotation in poses[:, :3, :3]]
        poses[:, :3, :3] = geometry.convert_quaternion_to_rotation(np.roll(wxyz, 1, axis=1))
    if settings.pose_convention == "vehicle_T_world":
        poses = geometry.invert(poses)
    elif settings.pose_convention == "swapped_xy":
        poses[:, :3, 3] = poses[:, [1, 0, 2], 3]
    is_support = np.ones(len(poses), np.bool_)
    if settings.interpolate_poses:
        is_support[1:] = (np.diff(poses, axis=0) != 0).any(axis=(1, 2))
    if (not settings.interpolate_poses and not settings.time_offset_s) or is_support.sum() < 2:
        return poses
    return _interpolate_poses(poses[is_support], times_s[is_support], times_s + settings.time_offset_s)


def _interpolate_poses(poses: Matrix, times_s: Float64, query_s: Float64) -> Matrix:
    """Interpolate positions and Euler angles linearly at other times; extrapolate with the two outermost poses."""
    after = np.searchsorted(times_s, query_s, side="right").clip(1, len(poses) - 1)
    fraction = ((query_s - times_s[after - 1]) / np.diff(times_s)[after - 1])[:, None]
    angles_deg = geometry.convert_rotation_to_euler(poses[:, :3, :3])
    positions_m = poses[:, :3, 3]
    turns_deg = ((np.diff(angles_deg, axis=0) + 180) % 360 - 180)[after - 1]  # the shorter way around
    rotations = geometry.convert_euler_to_rotation(*(angles_deg[after - 1] + fraction * turns_deg).T)
    steps_m = np.diff(positions_m, axis=0)[after - 1]
    return geometry.build_transform(rotations, positions_m[after - 1] + fraction * steps_m)
