"""Correct points, poses and times of a recording as its user asks."""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover import geometry
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.las import read_las_scale
from torchcover.recordings.recording import Recording, Scan
from torchcover.recordings.settings import RecordingSettings

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}


class CorrectedRecording:
    """A recording whose points, poses and times are corrected; other attributes are those of the recording."""

    def __init__(self, recording: Recording, settings: RecordingSettings) -> None:
        self.recording, self.settings = recording, settings

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (what the recording has)
        if name == "recording":  # while it is made from a pickle
            raise AttributeError(name)
        return getattr(self.recording, name)

    def read_scan(self, sensor: str, index: int) -> Scan:
        """What the recording has, put right. ValueError: a LAS file says its unit, and a unit is set, too."""
        scan, columns = self.recording.read_scan(sensor, index), ["xyz".index(axis) for axis in self.settings.axes]
        unit, path = self.settings.units, Path(scan.source)
        if unit != "m" and path.suffix.lower() in (".las", ".laz") and (read_las_scale(path) != 1.0).any():
            raise ValueError(f"{path}: it is converted to meters, as the file says; leave out recording.units={unit}")
        return replace(scan, points_m=scan.points_m[:, columns] * METRES[unit])

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was, put right."""
        return None if self._poses is None else self._poses[index]

    @cached_property
    def _poses(self) -> Matrix | None:
        poses = [self.recording.get_world_T_vehicle(instant) for instant in range(len(self.recording.frame_names))]
        if any(pose is None for pose in poses):
            return None
        times_s = self.recording.times_s
        if times_s is None and (self.settings.time_offset_s or self.settings.poses == "held"):
            raise ValueError(
                f"{self.recording.path}: {self.settings.command_line_options} needs the times of its instants"
            )
        return correct_poses(np.array(poses), np.arange(0.0, len(poses)) if times_s is None else times_s, self.settings)


def correct_recording(recording: Recording, settings: RecordingSettings) -> Recording:
    """Return a recording with the corrections of its settings; the same one if there are none."""
    corrected: Any = CorrectedRecording(recording, settings)  # has the attributes of the recording, too
    result: Recording = corrected if settings.corrections else recording
    return result


def correct_poses(world_T_vehicle: Matrix, times_s: NDArray[np.float64], settings: RecordingSettings) -> Matrix:
    """(N, 4, 4) poses of N instants in a row, put right; beyond the first and the last they go on as before."""
    poses = world_T_vehicle.copy()
    if settings.quaternions == "xyzw":  # what was read as w, x, y, z
        wxyz = [geometry.convert_rotation_to_quaternion(rotation) for rotation in poses[:, :3, :3]]
        poses[:, :3, :3] = geometry.convert_quaternion_to_rotation(np.roll(wxyz, 1, axis=1))
    if settings.poses == "inverse":
        poses = geometry.invert(poses)
    elif settings.poses == "yx":
        poses[:, :3, 3] = poses[:, [1, 0, 2], 3]
    new = np.append(True, (np.diff(poses, axis=0) != 0).any(axis=(1, 2)) | (settings.poses != "held"))
    if (settings.poses != "held" and not settings.time_offset_s) or new.sum() < 2:
        return poses
    known, known_s, wanted_s = poses[new], times_s[new], times_s + settings.time_offset_s
    after = np.searchsorted(known_s, wanted_s, side="right").clip(1, len(known) - 1)
    share = ((wanted_s - known_s[after - 1]) / np.diff(known_s)[after - 1])[:, None]
    angles_deg, places_m = geometry.convert_rotation_to_euler(known[:, :3, :3]), known[:, :3, 3]
    turns_deg = ((np.diff(angles_deg, axis=0) + 180) % 360 - 180)[after - 1]
    rotations = geometry.convert_euler_to_rotation(*(angles_deg[after - 1] + share * turns_deg).T)
    return geometry.build_transform(rotations, places_m[after - 1] + share * np.diff(places_m, axis=0)[after - 1])
