"""Drives of KITTI's raw data: scans with GPS/IMU poses and tracklets."""

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
    Recording,
    Scan,
    SensorCalibrations,
    check_times,
    warn_about_missing_poses,
)


class KittiRaw(Recording):
    """Drive `DATE/DATE_drive_NUMBER_sync` with `velodyne_points`, `oxts` and optional `tracklet_labels.xml`.

    Calibrations are in the folder `DATE`.

    Args:
        path: Folder of the drive.

    Raises:
        FileNotFoundError: A file or folder is missing.
        ValueError: There are no frames, times do not fit frames or scans or are not ascending, or a calibration is
            invalid.

    Warns:
        UserWarning: Scans without a GPS/IMU record are excluded.
    """

    layout: ClassVar[str] = "DATE/DRIVE/velodyne_points/data/FRAME.bin, oxts/data/FRAME.txt"
    sensors = ("velodyne",)
    ego_box: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._clouds = find_frame_files(self.path / "velodyne_points" / "data")
        check_same_names(self.path, {"velodyne_points/data": self._clouds})
        missing = [name for name in self._clouds if not self._get_oxts_path(name).exists()]
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
        """Test whether a path is a folder with scans and GPS/IMU records.

        Args:
            path: Existing path.
        """
        return (path / "velodyne_points").is_dir() and (path / "oxts").is_dir()

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a motion-compensated cloud.

        Args:
            sensor: `velodyne`.
            index: Index of the frame.

        Returns:
            The scan.
        """
        path = self._clouds[self.frame_names[index]]
        return Scan(read_cloud(path), vehicle_T_velodyne, str(path))

    def get_world_T_vehicle(self, index: int) -> Matrix:
        """Return the (4, 4) pose of the vehicle from the GPS/IMU record, which is read once."""
        if index not in self._poses:
            self._poses[index] = compute_world_T_imu(self._read_oxts(index), self._latitude_deg) @ self._imu_T_vehicle
        return self._poses[index]

    def read_calibrations(self) -> SensorCalibrations:
        """Read the rectified cameras of the day, if it has a `calib_cam_to_cam.txt`."""
        day = self.path.parent
        cameras = day / "calib_cam_to_cam.txt"
        mounts = {"velodyne": vehicle_T_velodyne}
        if not cameras.exists():
            return SensorCalibrations(f"extrinsics of KITTI's LiDAR; no cameras without {cameras.name}", mounts)
        rectified_cameras = read_rectified_cameras(cameras, self._read_vehicle_T_camera0())
        return SensorCalibrations(f"extrinsics of KITTI's LiDAR, {cameras.name}", mounts, rectified_cameras)

    def read_raw_cameras(self) -> tuple[Calibration, ...]:
        """Read the cameras before rectification, with their distortion."""
        return read_distorted_cameras(self.path.parent / "calib_cam_to_cam.txt", self._read_vehicle_T_camera0())

    def _read_vehicle_T_camera0(self) -> Matrix:
        """Read the extrinsics of camera 0 from the calibration of the LiDAR."""
        camera_T_velodyne = read_transform(self.path.parent / "calib_velo_to_cam.txt")
        return np.asarray(vehicle_T_velodyne @ invert(camera_T_velodyne))

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the tracklets of a frame; None without the file."""
        if not self._tracklets.exists():
            return None
        return self._boxes_by_frame.get(self._numbers[index], Boxes.from_rows(torch.empty(0, 7, device="cpu")))

    def _read_times(self, scanned: Sequence[int]) -> NDArray[np.float64]:
        """Read the times of scans with a pose, relative to the first; `scanned` holds the numbers of all scans."""
        max_gap_s = 0.1  # GPS/IMU records and scans of synchronized drives are some milliseconds apart
        stamps, poses = self.path / "velodyne_points" / "timestamps.txt", self.path / "oxts" / "timestamps.txt"
        times = read_timestamps(stamps, scanned)[np.isin(scanned, self._numbers)]
        second = np.timedelta64(1, "s")
        if poses.exists():
            gap_s = float(np.abs((read_timestamps(poses, self._numbers) - times) / second).max())
            if gap_s > max_gap_s:
                raise ValueError(
                    f"{poses}: records of the GPS and IMU and scans of the same frame number are up to {gap_s:g} s "
                    "apart; take the drive's synced+rectified data (_sync), not _extract"
                )
        return check_times(np.asarray((times - times[0]) / second), len(self.frame_names), str(stamps))

    def _read_oxts(self, index: int) -> NDArray[np.float64]:
        """Read the GPS/IMU record of a frame."""
        return read_oxts(self._get_oxts_path(self.frame_names[index]))

    def _get_oxts_path(self, name: str) -> Path:
        """Get the file of the GPS/IMU record of a frame, which may be missing."""
        return self.path / "oxts" / "data" / f"{name}.txt"

    @cached_property
    def _latitude_deg(self) -> float:
        """Latitude of the first record, which sets the scale of the projection."""
        return float(self._read_oxts(0)[0])

    @cached_property
    def _boxes_by_frame(self) -> dict[int, Boxes]:
        """Tracklets in the vehicle frame by frame number."""
        return read_tracklets(self._tracklets, vehicle_T_velodyne)


def parse_frame_numbers(folder: Path, names: Sequence[str]) -> list[int]:
    """Parse the frame numbers of scans; tracklets and time stamps count frames without a scan, too.

    Args:
        folder: Drive, for messages.
        names: Names of scans.

    Returns:
        Their frame numbers.

    Raises:
        ValueError: A name is not a number.
    """
    invalid = [name for name in names if not name.isdecimal()]
    if invalid:
        raise ValueError(f"{folder}: scans of KITTI raw are named by frame numbers; got {format_names(invalid)}")
    return [int(name) for name in names]


@guard_reader("KITTI tracklets")
def read_tracklets(path: Path, vehicle_T_velodyne: Matrix) -> dict[int, Boxes]:
    """Read the boxes of all frames with tracklets.

    The origin of a tracklet is the center of the bottom of its box, in the LiDAR frame.

    Args:
        path: XML file.
        vehicle_T_velodyne: (4, 4) extrinsics of the LiDAR.

    Returns:
        Frame number and boxes in the vehicle frame; the id of an object is the number of its tracklet in the file.

    Raises:
        BadFileError: The file is invalid, or a tracklet is incomplete.
    """
    root = parse_xml(path)
    frames: dict[int, list[tuple[list[float], str, str]]] = {}
    for number, item in enumerate(root.findall("./tracklets/item")):
        category = (item.findtext("objectType") or "").strip().lower()
        length, width, height = (_parse_number(item, name) for name in "lwh")
        first_frame = int(_parse_number(item, "first_frame"))
        for frame, pose in enumerate(item.findall("./poses/item"), start=first_frame):
            x, y, z = (_parse_number(pose, f"t{axis}") for axis in "xyz")
            row = [x, y, z + height / 2, length, width, height, _parse_number(pose, "rz")]
            frames.setdefault(frame, []).append((row, str(number), category))
    return {frame: _build_boxes(entries, vehicle_T_velodyne) for frame, entries in frames.items()}


def _build_boxes(entries: list[tuple[list[float], str, str]], vehicle_T_velodyne: Matrix) -> Boxes:
    """Build boxes in the vehicle frame from rows in the LiDAR frame with name and category."""
    row_list, ids, categories = zip(*entries, strict=True)
    rows, zeros = np.array(row_list), np.zeros(len(entries))
    rows[:, :3] = transform_points(vehicle_T_velodyne, rows[:, :3])
    rotations = vehicle_T_velodyne[:3, :3] @ convert_euler_to_rotation(np.rad2deg(rows[:, 6]), zeros, zeros)
    rows[:, 6] = np.deg2rad(convert_rotation_to_euler(rotations)[:, 0])
    return Boxes.from_rows(torch.from_numpy(rows).float(), ids=ids, categories=categories)


def _parse_number(element: ElementTree.Element, name: str) -> float:
    """Parse a child element of a tracklet."""
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"a tracklet without <{name}>")
    return float(text)
