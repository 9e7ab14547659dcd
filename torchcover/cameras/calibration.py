"""Readers of calibration files of ROS, OpenCV, KITTI and nuScenes, each of which returns a `Calibration`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchcover.cameras.calibration_values import (
    describe_value,
    get_first_entry,
    get_integer,
    get_matrix,
    get_numbers,
    is_number_list,
)
from torchcover.cameras.lens import to_vector
from torchcover.cameras.models import check_image, check_model
from torchcover.files import (
    guard_reader,
    parse_yaml,
    parse_yaml_stream,
    read_json_table,
    read_short_text,
    report_bad_file,
)
from torchcover.geometry import (
    build_transform,
    check_rigid,
    convert_euler_to_rotation,
    convert_quaternion_to_rotation,
    invert,
)
from torchcover.geometry.rigid import Matrix

# Rotation of a camera (x right, y down, z forward) that faces the x axis of the vehicle (x forward, y left, z up).
LOOKING_FORWARD = build_transform([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], [0.0, 0.0, 0.0])

# Models by their names in ROS and OpenCV.
_MODEL_NAMES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}


@dataclass(frozen=True)
class Calibration:
    """Calibration of a camera, with the arguments of `Camera`.

    Args:
        width: Columns of the image.
        height: Rows of the image.
        fx: Focal length in pixels along x.
        fy: Focal length in pixels along y.
        cx: Column of the optical axis.
        cy: Row of the optical axis.
        model: Name of the lens model.
        coefficients: Coefficients of the model.
        vehicle_T_camera: (4, 4) extrinsics; None is the identity.
        name: Name for messages.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "pinhole"
    coefficients: Sequence[float] = ()
    vehicle_T_camera: ArrayLike | None = None
    name: str = "camera"


def split_matrix(matrix: ArrayLike, name: str) -> tuple[float, float, float, float]:
    """Split a camera matrix into fx, fy, cx, cy.

    Args:
        matrix: (3, 3) matrix without skew.
        name: Name of the camera for messages.

    Raises:
        ValueError: Another shape, a skew, another last row, or zeros.
    """
    K = np.asarray(matrix, dtype=np.float64)
    if K.shape != (3, 3):
        raise ValueError(f"{name}: a camera matrix has shape (3, 3); got {K.shape}")
    if not K.any():
        raise ValueError(f"{name}: the camera matrix is zero, so the camera was never calibrated; calibrate it first")
    if not np.array_equal(K[2], [0.0, 0.0, 1.0]) or K[0, 1] != 0.0 or K[1, 0] != 0.0:
        raise ValueError(f"{name}: a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], no skew; got {K.tolist()}")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def split_projection(numbers: Matrix, name: str) -> tuple[tuple[float, float, float, float], Matrix]:
    """Split a projection P = K [I | t] of KITTI, whose cameras are parallel.

    Args:
        numbers: (12,) numbers of P.
        name: Name of the camera for messages.

    Returns:
        fx, fy, cx, cy, and the (4, 4) `camera_T_rectified`.

    Raises:
        ValueError: The numbers are not such a projection.
    """
    P = numbers.reshape(3, 4)
    intrinsics = split_matrix(P[:, :3], name)
    if 0.0 in intrinsics[:2]:
        raise ValueError(f"{name} has no focal length; got {P.tolist()}")
    return intrinsics, build_transform(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))


def convert_carla_pose(
    location_m: Sequence[float], *, pitch_deg: float = 0.0, yaw_deg: float = 0.0, roll_deg: float = 0.0
) -> Matrix:
    """Convert the carla.Transform of a camera attached to a vehicle to `vehicle_T_camera`.

    CARLA is left-handed (x forward, y right, z up): y, yaw (positive to the right) and pitch (positive upwards) change
    their signs.

    Args:
        location_m: x, y, z in the axes of CARLA.
        pitch_deg: Upwards positive.
        yaw_deg: To the right positive.
        roll_deg: Right side down positive.

    Returns:
        (4, 4) float64 matrix.

    Example:
        >>> convert_carla_pose([0.0, 1.0, 2.8])[:3, 3]  # 1 m to the right
        array([ 0. , -1. ,  2.8])
    """
    x, y, z = location_m
    return build_transform(convert_euler_to_rotation(-yaw_deg, -pitch_deg, roll_deg), [x, -y, z]) @ LOOKING_FORWARD


@guard_reader("a camera_info file")
def read_ros(path: Path) -> Calibration:
    """Read a ROS `camera_info` file, as camera_calibration writes it or as `topic echo` prints the message.

    Args:
        path: A YAML file with size, matrix K, distortion model and coefficients of the unrectified image; R and P are
            not read. Region of interest and binning are applied, as by image_geometry. Several messages must be equal
            except for their headers.

    Returns:
        The calibration of the image as it is published; a file without coefficients is a pinhole.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing or invalid, messages differ, or the distortion model is none of
            `plumb_bob`, `rational_polynomial`, `equidistant` and `fisheye`.
    """
    messages = [_check_mapping(message) for message in parse_yaml_stream(read_short_text(path)) or [None]]
    content = messages[0]
    if any({**message, "header": None} != {**content, "header": None} for message in messages):
        raise ValueError(f"{len(messages)} messages of different content; keep one of them")
    size = get_integer(content, "image_width", "width"), get_integer(content, "image_height", "height")
    matrix = get_matrix(content, "camera_matrix", "k", "K")
    if matrix.size != 9:
        raise ValueError(f"the camera matrix has 9 numbers; got {matrix.size}")
    distortion = get_matrix(content, "distortion_coefficients", "d", "D")
    _, model = get_first_entry(content, "distortion_model")
    if not isinstance(model, str) or model not in _MODEL_NAMES:
        raise ValueError(f"distortion_model {describe_value(model)} is unknown; allowed: {', '.join(_MODEL_NAMES)}")
    name = content.get("camera_name")
    name = name if isinstance(name, str) else path.stem
    size, K = _apply_region_and_binning(content, size, matrix.reshape(3, 3))
    return _build_calibration(name, size, K, _MODEL_NAMES[model], distortion.ravel())


@guard_reader("an OpenCV calibration")
def read_opencv(
    path: Path,
    *,
    matrix_key: str = "camera_matrix",
    distortion_key: str = "distortion_coefficients",
    size: tuple[int, int] | None = None,
    model: str | None = None,
) -> Calibration:
    """Read an OpenCV FileStorage YAML file (`%YAML:1.0`, matrices tagged `!!opencv-matrix`).

    Args:
        path: The file.
        matrix_key: Name of the camera matrix in the file; M1 and M2 in stereo calibrations.
        distortion_key: Name of the coefficients in the file; D1 and D2 in stereo calibrations.
        size: (width, height); None takes image_width and image_height from the file.
        model: Name of the model; None is Brown-Conrady, or Kannala-Brandt if the file has `fisheye_model: 1`.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing or invalid; the message lists the entries of the file.
    """
    content = _check_mapping(parse_yaml(read_short_text(path)))
    required = [matrix_key, distortion_key] + ([] if size else ["image_width", "image_height"])
    missing = [key for key in required if key not in content]
    if missing:
        entries = ", ".join(str(key) for key in content)
        raise ValueError(f"{', '.join(missing)} not in the file; it contains {entries}")
    if "xi" in content:
        raise ValueError("xi: the omnidirectional model of OpenCV is not read; calibrate with its fisheye model")
    size = size or (get_integer(content, "image_width"), get_integer(content, "image_height"))
    model = model or ("kannala_brandt" if content.get("fisheye_model") else "brown_conrady")
    matrix, distortion = get_matrix(content, matrix_key), get_matrix(content, distortion_key)
    return _build_calibration(path.stem, size, matrix, model, distortion.ravel())


@guard_reader("a KITTI calibration")
def read_kitti(
    path: Path, camera: int, *, width: int, height: int, vehicle_T_lidar: ArrayLike | None = None
) -> Calibration:
    """Read one camera of a KITTI object or odometry calibration file. Its images are rectified: a pinhole.

    Args:
        path: The file, with P0 to P3 and Tr_velo_to_cam (or Tr).
        camera: 0 to 3; 2 is the left color camera.
        width: Columns of the images, which the file does not contain.
        height: Rows of the images.
        vehicle_T_lidar: (4, 4) extrinsics of the LiDAR, from which those of the camera follow; None is the identity, so
            that the vehicle frame is the LiDAR frame.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing, has another length, or is invalid.
    """
    lines = (line.split(":", 1) for line in read_short_text(path).splitlines() if ":" in line)
    table = {key.strip(): value.split() for key, value in lines}
    intrinsics, camera_T_rectified = split_projection(get_numbers(table, f"P{camera}", 12), f"P{camera}")
    rotation = get_numbers(table, "R0_rect", 9).reshape(3, 3) if "R0_rect" in table else np.eye(3)
    lidar = get_numbers(table, "Tr_velo_to_cam" if "Tr_velo_to_cam" in table else "Tr", 12)
    reference_T_lidar = np.vstack([lidar.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    camera_T_lidar = camera_T_rectified @ build_transform(rotation, np.zeros(3)) @ reference_T_lidar
    vehicle_T_lidar = check_rigid(np.eye(4) if vehicle_T_lidar is None else vehicle_T_lidar, "vehicle_T_lidar")
    pose = vehicle_T_lidar @ invert(check_rigid(camera_T_lidar, f"P{camera} from the lidar"))
    return _check_calibration(Calibration(width, height, *intrinsics, vehicle_T_camera=pose, name=f"P{camera}"))


def read_nuscenes(
    folder: str | Path, channel: str, *, token: str | None = None, width: int = 1600, height: int = 900
) -> Calibration:
    """Read one camera from the tables `sensor.json` and `calibrated_sensor.json` of nuScenes: an undistorted pinhole.

    Args:
        folder: Folder of the tables.
        channel: Name of the camera, such as "CAM_FRONT".
        token: Token of the calibrated sensor, if the tables contain several calibrations of the channel.
        width: Columns of the images.
        height: Rows of the images.

    Returns:
        The calibration; its vehicle frame is the ego frame of nuScenes, with the origin below the rear axle.

    Raises:
        FileNotFoundError: One of the tables is missing.
        BadFileError: The tables are others, the camera is missing or invalid, or several calibrations differ.
    """
    folder = Path(folder)
    table, sensors = (read_json_table(folder / f"{name}.json").rows for name in ("calibrated_sensor", "sensor"))
    with report_bad_file(folder, "nuScenes' tables"):
        channels = {row["token"]: row["channel"] for row in sensors}
        rows = [row for row in table if channels.get(row["sensor_token"]) == channel and token in (None, row["token"])]
        if not rows or not rows[0].get("camera_intrinsic"):
            raise ValueError(f"no calibrated camera {channel!r}, token {token}; channels: {sorted(channels.values())}")
        keys = ("camera_intrinsic", "rotation", "translation")
        if any(row.get(key) != rows[0].get(key) for row in rows for key in keys):
            tokens = ", ".join(row["token"] for row in rows)
            raise ValueError(f"{len(rows)} calibrations of {channel!r}; pass the token of one of them: {tokens}")
        matrix, rotation, translation = (rows[0].get(key) for key in keys)
        if not (isinstance(matrix, list) and len(matrix) == 3 and all(is_number_list(row, 3) for row in matrix)):
            raise ValueError(
                f"the camera_intrinsic of {channel!r} has three rows of three numbers; got {describe_value(matrix)}"
            )
        if not (is_number_list(rotation, 4) and is_number_list(translation, 3)):
            raise ValueError(
                f"{channel!r} needs a rotation of four numbers and a translation of three; "
                f"got {describe_value(rotation)}, {describe_value(translation)}"
            )
        pose = check_rigid(build_transform(convert_quaternion_to_rotation(rotation), translation), f"{channel!r}")
        intrinsics = split_matrix(matrix, channel)
        return _check_calibration(Calibration(width, height, *intrinsics, vehicle_T_camera=pose, name=channel))


def _apply_region_and_binning(
    content: Mapping[str, Any], size: tuple[int, int], K: Matrix
) -> tuple[tuple[int, int], Matrix]:
    """Compute size and matrix of the published image: a region of the whole sensor, then binned.

    Some drivers report the size of the region as that of the whole sensor.
    """
    max_pixels = 1_000_000  # no image has a longer side
    roi = content.get("roi") or {}
    if not isinstance(roi, dict):
        raise ValueError(f"roi: x_offset, y_offset, width and height are needed; got {describe_value(roi)}")
    sides, K = list[int](), K.copy()
    for axis, (name, length) in enumerate(zip(("width", "height"), size, strict=True)):
        offset, cut = (get_integer({key: 0, **roi}, key) for key in (f"{'xy'[axis]}_offset", name))
        key = f"binning_{'xy'[axis]}"
        binning = max(get_integer({key: 0, **content}, key), 1)
        is_part = 0 <= offset < offset + cut <= length or (0 <= offset < max_pixels and cut == length)
        if (offset or cut) and not is_part:
            raise ValueError(
                f"roi: a part of the image's {name} of {length} pixels is needed; got {cut} from {offset} on; give the "
                "region that was read, or 0 for all"
            )
        whole_center, published_center = offset + (cut or length) / 2, (cut or length) / binning / 2
        if binning > 1 and abs(K[axis, 2] - published_center) < abs(K[axis, 2] - whole_center):
            raise ValueError(
                f"{key} {binning}: K seems to describe the binned image already: c{'xy'[axis]} = {K[axis, 2]:g} "
                f"is its middle; set {key} to 1 and {name} to {(cut or length) // binning}, or give K of the sensor"
            )
        K[axis, 2] -= offset
        K[axis] /= binning
        sides.append((cut or length) // binning)
    return (sides[0], sides[1]), K


def _check_mapping(content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"a mapping of names to values is needed; got {type(content).__name__}")
    return content


def _build_calibration(
    name: str, size: tuple[int, int], matrix: Matrix, model: str, coefficients: Matrix
) -> Calibration:
    """Build the calibration of a distorted camera; without coefficients it is a pinhole."""
    values = tuple(float(value) for value in coefficients)
    model = model if values else "pinhole"
    return _check_calibration(Calibration(*size, *split_matrix(matrix, name), model, values, name=name))


def _check_calibration(calibration: Calibration) -> Calibration:
    """Check a calibration while the file is known, so that messages name it."""
    intrinsics = to_vector([calibration.fx, calibration.fy, calibration.cx, calibration.cy])
    check_image(calibration.name, calibration.width, calibration.height, intrinsics)
    check_model(calibration.model, calibration.coefficients)
    return calibration
