"""A drive of KITTI's raw data: scans with the poses of the GPS and IMU, and tracklets."""

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.cameras.calibration import Calibration
from torchcover.detection.boxes import Boxes
from torchcover.files import guard_reader, parse_xml
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import (
    Matrix,
    convert_euler_to_rotation,
    convert_rotation_to_euler,
    invert,
    transform_points,
)
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.formats.frame_files import check_same_names, find_frame_files, format_names
from torchcover.recordings.formats.kitti import (
    BODY,
    compute_world_T_imu,
    read_distorted_cameras,
    read_oxts,
    read_rectified_cameras,
    read_timestamps,
    read_transform,
    vehicle_T_velodyne,
)
from torchcover.recordings.recording import (
    RecordingBase,
    Scan,
    SensorCalibrations,
    check_times,
    warn_about_missing_poses,
)

# In synchronized drives, the GPS and IMU's record of a frame and its scan are some milliseconds apart.
MAX_CLOCK_GAP_S = 0.1


class KittiRaw(RecordingBase):
    """A folder `DATE/DATE_drive_NUMBER_sync` with `velodyne_points` and `oxts`; calibrations are in `DATE`.

    Boxes are those of `tracklet_labels.xml`, if it is there.

    Raises:
        FileNotFoundError: A part is missing.
        ValueError: No frames, another number of times than of frames or scans, times out of order, a bad calibration.

    Warns:
        UserWarning: Scans without a record of the GPS and IMU are left out.
    """

    layout: ClassVar[str] = "DATE/DRIVE/velodyne_points/data/FRAME.bin, oxts/data/FRAME.txt"
    sensors = ("velodyne",)
    ego_box: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._clouds = find_frame_files(self.path / "velodyne_points" / "data")
        check_same_names(self.path, {"velodyne_points/data": self._clouds})
        missing = [name for name in self._clouds if not self._oxts_path(name).exists()]
        warn_about_missing_poses(self.path / "oxts" / "data", missing, len(self._clouds))
        self.rigs = {"kitti": self.sensors}
        scanned = parse_frame_numbers(self.path, tuple(self._clouds))
        self.frame_names = tuple(name for name in self._clouds if name not in set(missing))
        self._numbers = parse_frame_numbers(self.path, self.frame_names)
        self.times_s = self._read_times(scanned)
        velodyne_T_imu = read_transform(self.path.parent / "calib_imu_to_velo.txt")
        self._imu_T_vehicle = invert(velodyne_T_imu) @ invert(vehicle_T_velodyne)
        self._tracklets = self.path / "tracklet_labels.xml"
        self._poses: dict[int, Matrix] = {}

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether it has scans and records of the GPS and IMU."""
        return all((path / place).is_dir() for place in ("velodyne_points", "oxts"))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud, which the development kit has corrected for the motion within a turn."""
        path = self._clouds[self.frame_names[index]]
        return Scan(read_cloud(path), vehicle_T_velodyne, str(path))

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """Where the vehicle was, by the GPS and IMU; a file each, which is read once."""
        if index not in self._poses:
            self._poses[index] = compute_world_T_imu(self._oxts(index), self._latitude_deg) @ self._imu_T_vehicle
        return self._poses[index]

    def read_calibrations(self) -> SensorCalibrations:
        """The rectified cameras of the day, where its `calib_cam_to_cam.txt` is there."""
        day = self.path.parent
        cameras = day / "calib_cam_to_cam.txt"
        mounts = {"velodyne": vehicle_T_velodyne}
        if not cameras.exists():
            return SensorCalibrations(f"the LiDAR where KITTI's is; no cameras, for there is no {cameras.name}", mounts)
        placed = read_rectified_cameras(cameras, self._vehicle_T_camera0())
        return SensorCalibrations(f"the LiDAR where KITTI's is, {cameras.name}", mounts, placed)

    def read_raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras before rectification, with the distortion of their lenses."""
        return read_distorted_cameras(self.path.parent / "calib_cam_to_cam.txt", self._vehicle_T_camera0())

    def _vehicle_T_camera0(self) -> Matrix:
        camera_T_velodyne = read_transform(self.path.parent / "calib_velo_to_cam.txt")
        return np.asarray(vehicle_T_velodyne @ invert(camera_T_velodyne))

    def read_boxes(self, index: int) -> Boxes | None:
        """Return the tracklets of the frame number of a scan; None without the file."""
        if not self._tracklets.exists():
            return None
        return self._tracked.get(self._numbers[index], Boxes.from_rows(torch.empty(0, 7, device="cpu")))

    def _read_times(self, scanned: Sequence[int]) -> NDArray[np.float64]:
        """Return the times of the scans with a pose in seconds after the first; `scanned`: frame numbers of all."""
        stamps, poses = self.path / "velodyne_points" / "timestamps.txt", self.path / "oxts" / "timestamps.txt"
        times = read_timestamps(stamps, scanned)[np.isin(scanned, self._numbers)]
        second = np.timedelta64(1, "s")
        if poses.exists():
            gap_s = float(np.abs((read_timestamps(poses, self._numbers) - times) / second).max())
            if gap_s > MAX_CLOCK_GAP_S:
                raise ValueError(
                    f"{poses}: records of the GPS and IMU and scans of the same frame number are up to {gap_s:g} s "
                    "apart; take the drive's synced+rectified data (_sync), not _extract"
                )
        return check_times(np.asarray((times - times[0]) / second), len(self.frame_names), str(stamps))

    def _oxts(self, index: int) -> NDArray[np.float64]:
        return read_oxts(self._oxts_path(self.frame_names[index]))

    def _oxts_path(self, name: str) -> Path:
        return self.path / "oxts" / "data" / f"{name}.txt"

    @cached_property
    def _latitude_deg(self) -> float:
        return float(self._oxts(0)[0])

    @cached_property
    def _tracked(self) -> dict[int, Boxes]:
        return read_tracklets(self._tracklets, vehicle_T_velodyne)


def parse_frame_numbers(folder: Path, names: Sequence[str]) -> list[int]:
    """Return the frame numbers that scans are named by; tracklets and time stamps count frames without a scan, too.

    Raises:
        ValueError: A name that is not a number.
    """
    other = [name for name in names if not name.isdecimal()]
    if other:
        raise ValueError(f"{folder}: scans of KITTI raw are named by frame numbers; got {format_names(other)}")
    return [int(name) for name in names]


@guard_reader("KITTI tracklets")
def read_tracklets(path: Path, vehicle_T_velodyne: Matrix) -> dict[int, Boxes]:
    """Read the boxes of every frame that has any, by frame number.

    The origin of a tracklet is the middle of the bottom of its box, in the frame of the LiDAR. Its name is its number
    in the file.
    """
    root = parse_xml(path)
    frames: dict[int, list[tuple[list[float], str, str]]] = {}
    for number, item in enumerate(root.findall("./tracklets/item")):
        category = (item.findtext("objectType") or "").strip().lower()
        length, width, height = (_number(item, name) for name in "lwh")
        start = int(_number(item, "first_frame"))
        for step, pose in enumerate(item.findall("./poses/item")):
            x, y, z = (_number(pose, f"t{axis}") for axis in "xyz")
            row = [x, y, z + height / 2, length, width, height, _number(pose, "rz")]
            frames.setdefault(start + step, []).append((row, str(number), category))
    return {frame: _boxes(found, vehicle_T_velodyne) for frame, found in frames.items()}


def _boxes(found: list[tuple[list[float], str, str]], vehicle_T_velodyne: Matrix) -> Boxes:
    rows = np.array([row for row, _, _ in found])
    rows[:, :3] = transform_points(vehicle_T_velodyne, rows[:, :3])
    turned = [vehicle_T_velodyne[:3, :3] @ convert_euler_to_rotation(np.rad2deg(yaw), 0.0, 0.0) for yaw in rows[:, 6]]
    rows[:, 6] = np.deg2rad(convert_rotation_to_euler(np.stack(turned))[:, 0])
    return Boxes.from_rows(
        torch.from_numpy(rows).float(),
        ids=tuple(name for _, name, _ in found),
        categories=tuple(category for _, _, category in found),
    )


def _number(element: ElementTree.Element, name: str) -> float:
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"a tracklet without <{name}>")
    return float(text)
