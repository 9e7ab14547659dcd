"""KITTI (Geiger et al., IJRR 2013): text files of calibrations, labels and poses, and the 3D object benchmark."""

import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchcover.cameras.calibration import Calibration, read_kitti, split_matrix, split_projection
from torchcover.detection.boxes import Boxes
from torchcover.files import BadFileError, check_memory, decode_utf8, guard_reader, read_short_text, report_bad_file
from torchcover.geometry import BoundingBox, build_transform, check_rigid, convert_euler_to_rotation, invert
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.formats.frame_files import check_same_names, find_frame_files
from torchcover.recordings.recording import Recording, Scan, SensorCalibrations

# Semi-major axis of the WGS84 ellipsoid, as in the development kit.
EARTH_RADIUS_M = 6_378_137.0
# The LiDAR is 0.76 m in front of the rear axle and 1.73 m above the ground, the center of the car 1.337 m in front of
# the axle. The rig `kitti` names the sources.
vehicle_T_velodyne = build_transform(np.eye(3), [-0.577, 0.0, 1.73])
# Outline of a Volkswagen Passat B6 estate (4.77 x 1.82 m), up to a little above the LiDAR.
BODY = BoundingBox((-2.387, -0.91, 0.05), (2.387, 0.91, 1.93))


@guard_reader("a KITTI calibration")
def read_calibration(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read lines `KEY: numbers`; lines without numbers, such as `calib_time`, are skipped.

    Args:
        path: Text file.

    Returns:
        Numbers of each key.

    Raises:
        BadFileError: A key is repeated, numbers are not finite, or no line has numbers.
    """
    calibration: dict[str, NDArray[np.float64]] = {}
    for number, line in enumerate(read_short_text(path).splitlines(), start=1):
        key, colon, text = line.partition(":")
        if not colon or not text.strip():
            continue
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            continue
        if key.strip() in calibration:
            raise ValueError(f"{key.strip()} is there twice, again in line {number}")
        if not np.isfinite(values).all():
            raise ValueError(f"line {number}: {key.strip()} has NaN or infinite numbers")
        calibration[key.strip()] = values
    if not calibration:
        raise ValueError("lines of a key, a colon and numbers are needed; there are none")
    return calibration


def parse_transform(calibration: dict[str, NDArray[np.float64]], key: str, path: Path) -> Matrix:
    """Parse a rigid transform.

    Args:
        calibration: Numbers of each key.
        key: Key with 12 numbers (3 x 4), or 9 of a rotation.
        path: File, for messages.

    Returns:
        (4, 4) transform.

    Raises:
        ValueError: The key is missing, or its numbers are no rigid transform.
    """
    numbers = calibration.get(key)
    if numbers is None or numbers.size not in (9, 12):
        arrived = "none" if numbers is None else f"{numbers.size} numbers"
        raise ValueError(f"{path}: {key} with 12 numbers, or 9 of a rotation, is needed; got {arrived}")
    matrix = np.eye(4)
    matrix[:3, : numbers.size // 3] = numbers.reshape(3, -1)
    return check_rigid(matrix, f"{path}: {key}")


def read_transform(path: Path) -> Matrix:
    """Read the transform of a file with `R` and `T`, such as `calib_velo_to_cam.txt`.

    Args:
        path: Text file.

    Returns:
        (4, 4) transform.

    Raises:
        BadFileError: A key is missing or invalid.
    """
    numbers = read_calibration(path)
    translation_m = numbers.get("T", np.empty(0))
    if translation_m.size != 3:
        raise BadFileError(f"{path}: T with 3 numbers is needed; got {translation_m.size}")
    return build_transform(parse_transform(numbers, "R", path)[:3, :3], translation_m)


def read_rectified_cameras(path: Path, vehicle_T_camera0: Matrix) -> tuple[Calibration, ...]:
    """Read the cameras of `calib_cam_to_cam.txt` after rectification, which are pinholes.

    Args:
        path: Text file.
        vehicle_T_camera0: (4, 4) extrinsics of camera 0.

    Returns:
        Four cameras.

    Raises:
        BadFileError: An entry is missing or invalid.
    """
    numbers = read_calibration(path)
    vehicle_T_rectified = vehicle_T_camera0 @ invert(parse_transform(numbers, "R_rect_00", path))
    cameras = []
    for number in range(4):
        name = f"{number:02d}"
        matrix, size = numbers.get(f"P_rect_{name}", np.empty(0)), numbers.get(f"S_rect_{name}", np.empty(0))
        if matrix.size != 12 or size.size != 2:
            arrived = f"{matrix.size} and {size.size}"
            raise BadFileError(f"{path}: 12 numbers of P_rect_{name} and 2 of S_rect_{name} are needed; got {arrived}")
        with report_bad_file(path, "a KITTI calibration"):
            intrinsics, camera_T_rectified = split_projection(matrix, f"P_rect_{name}")
        pose = vehicle_T_rectified @ invert(camera_T_rectified)
        cameras.append(
            Calibration(int(size[0]), int(size[1]), *intrinsics, vehicle_T_camera=pose, name=f"image_{name}")
        )
    return tuple(cameras)


def read_distorted_cameras(path: Path, vehicle_T_camera0: Matrix) -> tuple[Calibration, ...]:
    """Read the cameras of `calib_cam_to_cam.txt` before rectification.

    Args:
        path: Text file with `S_NN`, `K_NN`, `D_NN` (k1, k2, p1, p2, k3), `R_NN` and `T_NN` of each camera.
        vehicle_T_camera0: (4, 4) extrinsics of camera 0.

    Returns:
        Four Brown-Conrady cameras.

    Raises:
        BadFileError: An entry is missing or invalid.
    """
    numbers = read_calibration(path)
    cameras = []
    for number in range(4):
        name = f"{number:02d}"
        size, matrix, lens, position_m = (numbers.get(f"{key}_{name}", np.empty(0)) for key in "SKDT")
        if (size.size, matrix.size, lens.size, position_m.size) != (2, 9, 5, 3):
            arrived = f"{size.size}, {matrix.size}, {lens.size} and {position_m.size}"
            raise BadFileError(f"{path}: 2, 9, 5 and 3 numbers of S, K, D and T_{name} are needed; got {arrived}")
        with report_bad_file(path, "a KITTI calibration"):
            intrinsics = split_matrix(matrix.reshape(3, 3), f"K_{name}")
        camera_T_camera0 = build_transform(parse_transform(numbers, f"R_{name}", path)[:3, :3], position_m)
        cameras.append(
            Calibration(
                int(size[0]),
                int(size[1]),
                *intrinsics,
                model="brown_conrady",
                coefficients=tuple(lens.tolist()),
                vehicle_T_camera=vehicle_T_camera0 @ invert(camera_T_camera0),
                name=f"image_{name}",
            )
        )
    return tuple(cameras)


@guard_reader("a PNG image")
def read_png_size(path: Path) -> tuple[int, int]:
    """Read the width and height of an image from its header.

    Args:
        path: PNG file.

    Returns:
        Width and height in pixels.

    Raises:
        BadFileError: The file is no PNG.
    """
    with path.open("rb") as file:
        head = file.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError("not a PNG image")
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:], "big")


@guard_reader("KITTI labels")
def read_labels(path: Path) -> list[tuple[str, NDArray[np.float64]]]:
    """Read the objects of a `label_2` file, except those marked `DontCare`.

    Args:
        path: Text file.

    Returns:
        Category in lower case and 14 numbers of each object.

    Raises:
        BadFileError: A line has another number of columns, or no numbers.
    """
    labels = []
    for number, line in enumerate(read_short_text(path).splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        if len(words) not in (15, 16):
            raise ValueError(f"line {number}: 15 columns are needed, or 16 with a score; got {len(words)}")
        if words[0] != "DontCare":
            labels.append((words[0].lower(), np.array([float(word) for word in words[1:15]])))
    return labels


@guard_reader("a record of the GPS and IMU")
def read_oxts(path: Path) -> NDArray[np.float64]:
    """Read the GPS/IMU record of one frame.

    Args:
        path: Text file.

    Returns:
        (6,) latitude, longitude (degrees), altitude (m), roll, pitch and yaw (radians).

    Raises:
        BadFileError: The number of values is wrong, or they are not finite.
    """
    num_columns = 30  # followed by velocities, accelerations, rates, accuracies and status
    numbers = np.array([float(word) for word in read_short_text(path).split()])
    if len(numbers) != num_columns:
        raise ValueError(f"{num_columns} numbers are needed; got {len(numbers)}")
    if not np.isfinite(numbers[:6]).all() or abs(numbers[0]) >= 90:
        raise ValueError(f"a latitude below 90 degrees and finite numbers are needed; got {numbers[:6].tolist()}")
    return numbers[:6]


def compute_world_T_imu(oxts: NDArray[np.float64], latitude_deg: float) -> Matrix:
    """Compute the pose of the IMU in a Mercator projection, as in the development kit.

    Args:
        oxts: (6,) record of `read_oxts`.
        latitude_deg: Latitude of the first record of the drive, which sets the scale.

    Returns:
        (4, 4) transform; x points east, y north, z up.

    Example:
        >>> compute_world_T_imu(np.array([49.0, 8.0, 110.0, 0.0, 0.0, np.pi / 2]), 49.0)[:3, 1].round(6)
        array([-1.,  0.,  0.])
    """
    latitude, longitude, altitude_m, roll, pitch, yaw = oxts
    scale = math.cos(math.radians(latitude_deg))
    east_m = scale * EARTH_RADIUS_M * math.radians(longitude)
    north_m = scale * EARTH_RADIUS_M * math.log(math.tan(math.pi / 4 + math.radians(latitude) / 2))
    rotation = convert_euler_to_rotation(*np.rad2deg([yaw, pitch, roll]))
    return build_transform(rotation, [east_m, north_m, altitude_m])


@guard_reader("time stamps")
def read_timestamps(path: Path, frame_numbers: Sequence[int]) -> NDArray[np.datetime64]:
    """Read time stamps such as `2011-09-26 13:02:25.964389445`.

    Line n belongs to frame n and is blank without a scan. A file that ends before the last frame (part of a drive) has
    one line for each scan instead.

    Args:
        path: File `timestamps.txt`.
        frame_numbers: Ascending frame numbers that have a scan.

    Returns:
        (F,) datetime64[ns].

    Raises:
        BadFileError: A line is no date and time, or the number of lines fits neither frames nor scans.
    """
    bytes_per_byte = 8  # size of a line as a Python object
    check_memory(bytes_per_byte * path.stat().st_size)
    lines = [line.strip().replace(" ", "T") for line in decode_utf8(path.read_bytes()).rstrip().split("\n")]
    stamps = [line for line in lines if line]
    if len(lines) > frame_numbers[-1]:
        stamps = [lines[number] for number in frame_numbers]
        if "" in stamps:
            raise ValueError(f"line {frame_numbers[stamps.index('')] + 1} is blank, but there is a scan of this frame")
    if len(stamps) != len(frame_numbers):
        raise ValueError(
            f"a line for each frame up to {frame_numbers[-1]} or one for each of {len(frame_numbers)} scans is needed; "
            f"got {len(lines)}"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy ignores time zones with a warning
            return np.array(stamps, dtype="datetime64[ns]")
    except (ValueError, UserWarning) as error:
        raise ValueError(f"lines of date and time are needed: {error}") from error


class KittiObject(Recording):
    """3D object benchmark with `velodyne/FRAME.bin`, `calib/FRAME.txt` and optional `label_2/FRAME.txt`.

    Frames are not consecutive, so no reference can be accumulated; an additional folder `reference/FRAME.*` may hold
    reference points in the LiDAR frame.

    Args:
        path: `training`, `testing`, or the folder that holds `training`.

    Raises:
        FileNotFoundError: The folder of clouds is missing.
        ValueError: There are no clouds, or reference frames differ from them.
    """

    layout: ClassVar[str] = "velodyne/FRAME.bin, calib/FRAME.txt, label_2/FRAME.txt"
    sensors = ("velodyne",)
    ego_box: BoundingBox | None = BODY

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = _find_split(Path(path))
        self._clouds = find_frame_files(self.path / "velodyne")
        check_same_names(self.path, {"velodyne": self._clouds})
        self.frame_names = tuple(self._clouds)
        self.rigs = {"kitti": self.sensors}
        self.reference_sensors = ("reference",) if (self.path / "reference").is_dir() else ()
        self._references: dict[str, Path] = {}
        if self.reference_sensors:
            self._references = find_frame_files(self.path / "reference", expected_names=self.frame_names)

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a folder with clouds and calibrations.

        Args:
            path: Existing path.
        """
        split = _find_split(path)
        return (split / "velodyne").is_dir() and (split / "calib").is_dir()

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud of the LiDAR or the reference.

        Args:
            sensor: `velodyne` or `reference`.
            index: Index of the frame.

        Returns:
            The scan.
        """
        path = (self._references if sensor == "reference" else self._clouds)[self.frame_names[index]]
        return Scan(read_cloud(path), vehicle_T_velodyne, str(path))

    def read_calibrations(self) -> SensorCalibrations:
        """Read the rectified cameras of the first frame; their sizes are those of its images, if there are any."""
        name = self.frame_names[0]
        calibration = self.path / "calib" / f"{name}.txt"
        images = [self.path / f"image_{number}" / f"{name}.png" for number in range(4)]
        images = [path for path in images if path.exists()]
        width, height = read_png_size(images[0]) if images else (1242, 375)  # sizes differ by a few pixels between days
        cameras = [
            read_kitti(calibration, number, width=width, height=height, vehicle_T_lidar=vehicle_T_velodyne)
            for number in range(4)
        ]
        size_source = f"{images[0].parent.name}/{name}.png" if images else "default of the data set, without images"
        source = f"calib/{name}.txt, extrinsics of KITTI's LiDAR, image size {width} x {height} ({size_source})"
        return SensorCalibrations(source, {"velodyne": vehicle_T_velodyne}, tuple(cameras))

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the labels of a frame; None without the folder `label_2`."""
        if not (self.path / "label_2").is_dir():
            return None
        name = f"{self.frame_names[index]}.txt"
        path = self.path / "calib" / name
        calibration = read_calibration(path)
        rectified_T_camera = parse_transform(calibration, "R0_rect", path)
        camera_T_velodyne = rectified_T_camera @ parse_transform(calibration, "Tr_velo_to_cam", path)
        labels = read_labels(self.path / "label_2" / name)
        numbers = np.array([row for _, row in labels]).reshape(-1, 14)
        return Boxes.from_kitti_label(
            numbers,
            vehicle_T_velodyne @ invert(camera_T_velodyne),
            categories=tuple(category for category, _ in labels),
        )


def _find_split(path: Path) -> Path:
    """Find the folder `training` below a path, else the path itself."""
    return path / "training" if (path / "training" / "velodyne").is_dir() else path
