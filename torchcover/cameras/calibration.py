"""Reading calibrations: each reader turns one kind of source into a `Calibration`, from which a `Camera` is made."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from torchcover.files import parse_yaml
from torchcover.geometry import check_rigid, invert, rigid, rotation_from_euler, rotation_from_quaternion
from torchcover.geometry.rigid import Matrix

# Camera axes (x right, y down, z forward) of a camera that looks along the vehicle's x (forward; y left, z up).
LOOKING_FORWARD = rigid([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], [0.0, 0.0, 0.0])

# ROS and OpenCV names of the models.
_MODEL_NAMES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}


@dataclass(frozen=True)
class Calibration:
    """What is known about a camera before it is checked: the arguments of `Camera`."""

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
    """fx, fy, cx, cy of a 3x3 camera matrix, once it is known to be nothing else.

    Raises:
        ValueError: Another shape, a skew, or a last row that is not 0 0 1.
    """
    K = np.asarray(matrix, dtype=np.float64)
    if K.shape != (3, 3):
        raise ValueError(f"{name}: a camera matrix has shape (3, 3); got {K.shape}")
    if not np.array_equal(K[2], [0.0, 0.0, 1.0]) or K[0, 1] != 0.0 or K[1, 0] != 0.0:
        raise ValueError(f"{name}: a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], no skew; got {K.tolist()}")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def focal_from_fov(width: int, fov_deg: float) -> float:
    """Focal length in pixels of a pinhole with this horizontal field of view: W / (2 tan(fov / 2))."""
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"a pinhole's field of view lies between 0 and 180 degrees; got {fov_deg}")
    return float(width / (2.0 * np.tan(np.deg2rad(fov_deg) / 2.0)))


def carla_pose(
    location_m: Sequence[float], *, pitch_deg: float = 0.0, yaw_deg: float = 0.0, roll_deg: float = 0.0
) -> Matrix:
    """`vehicle_T_camera` of a camera attached to a vehicle in CARLA, from the carla.Transform that attached it.

    CARLA is left-handed (x forward, y right, z up): y and the signs of yaw (there to the right) and pitch (there
    upwards) are turned over.

    Args:
        location_m: x, y, z in CARLA's axes.
        pitch_deg: Upwards positive.
        yaw_deg: To the right positive.
        roll_deg: Right side down positive.

    Returns:
        (4, 4) float64 matrix.

    Example:
        >>> carla_pose([0.0, 1.0, 2.8])[:3, 3]  # a metre to the right
        array([ 0. , -1. ,  2.8])
    """
    x, y, z = location_m
    return rigid(rotation_from_euler(-yaw_deg, -pitch_deg, roll_deg), [x, -y, z]) @ LOOKING_FORWARD


def read_ros(path: str | Path) -> Calibration:
    """Read a ROS `camera_info` file, as camera_calibration writes it or as `topic echo` prints the message.

    Args:
        path: A YAML file with size, matrix K, distortion model and coefficients. The unrectified image is described;
            the matrices R and P of the rectified one are not read.

    Returns:
        The calibration; a file without coefficients is a pinhole.

    Raises:
        ValueError: An entry is missing, or the distortion model is none of `plumb_bob`, `rational_polynomial`,
            `equidistant` and `fisheye`.
    """
    content = _read_yaml(path)
    try:
        size = int(_first(content, "image_width", "width")), int(_first(content, "image_height", "height"))
        matrix = _numbers(_first(content, "camera_matrix", "k", "K"))
        distortion = _numbers(_first(content, "distortion_coefficients", "d", "D"))
        model = str(_first(content, "distortion_model"))
    except KeyError as error:
        raise ValueError(f"{path}: not a camera_info file: {error.args[0]} is missing") from error
    if model not in _MODEL_NAMES:
        raise ValueError(f"{path}: distortion_model {model!r} is unknown; allowed: {', '.join(_MODEL_NAMES)}")
    name = str(content.get("camera_name", Path(path).stem))
    return _distorted(name, size, matrix.reshape(3, 3), _MODEL_NAMES[model], distortion)


def read_opencv(
    path: str | Path,
    *,
    matrix_key: str = "camera_matrix",
    distortion_key: str = "distortion_coefficients",
    size: tuple[int, int] | None = None,
    model: str | None = None,
) -> Calibration:
    """Read an OpenCV FileStorage YAML file (`%YAML:1.0`, matrices tagged `!!opencv-matrix`).

    Args:
        path: The file.
        matrix_key: Name of the camera matrix in it; stereo calibrations use M1 and M2.
        distortion_key: Name of the coefficients in it; there D1 and D2.
        size: (width, height); None takes image_width and image_height from the file.
        model: None is Brown-Conrady, or Kannala-Brandt where the file says `fisheye_model: 1`.

    Returns:
        The calibration.

    Raises:
        ValueError: An entry is missing; the message lists those that the file has.
    """
    content = _read_yaml(path)
    wanted = [matrix_key, distortion_key] + ([] if size else ["image_width", "image_height"])
    missing = [key for key in wanted if key not in content]
    if missing:
        raise ValueError(f"{path}: {', '.join(missing)} not in the file; it holds {', '.join(content)}")
    size = size or (int(content["image_width"]), int(content["image_height"]))
    model = model or ("kannala_brandt" if content.get("fisheye_model") else "brown_conrady")
    matrix, distortion = _matrix(content[matrix_key]), _matrix(content[distortion_key])
    return _distorted(Path(path).stem, size, matrix, model, distortion.ravel())


def read_kitti(
    path: str | Path, camera: int, *, width: int, height: int, vehicle_T_lidar: ArrayLike | None = None
) -> Calibration:
    """Read one camera of a KITTI object or odometry calibration file. Its images are rectified: a pinhole.

    Args:
        path: The file, with P0 to P3 and Tr_velo_to_cam (or Tr).
        camera: 0 to 3; 2 is the left colour camera.
        width: Columns of the images, which the file does not tell.
        height: Rows of the images.
        vehicle_T_lidar: Where the lidar sits, through which the camera is placed; None is the identity, so that the
            lidar frame takes the place of the vehicle frame.

    Returns:
        The calibration.

    Raises:
        ValueError: An entry is missing or has another length.
    """
    lines = (line.split(":", 1) for line in Path(path).read_text().splitlines() if ":" in line)
    table = {key.strip(): value.split() for key, value in lines}
    lidar_key = "Tr_velo_to_cam" if "Tr_velo_to_cam" in table else "Tr"
    for key in (f"P{camera}", lidar_key):
        if len(table.get(key, [])) != 12:
            raise ValueError(f"{path}: {key} with 12 numbers is needed; the file holds {', '.join(table)}")
    P = np.array(table[f"P{camera}"], dtype=np.float64).reshape(3, 4)
    # P = K [I | t]: the rectified cameras differ from each other by a translation only.
    camera_T_rectified = rigid(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
    rotation = np.array(table.get("R0_rect", np.eye(3).ravel()), dtype=np.float64).reshape(3, 3)
    reference_T_lidar = np.vstack([np.array(table[lidar_key], dtype=np.float64).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    camera_T_lidar = camera_T_rectified @ rigid(rotation, np.zeros(3)) @ reference_T_lidar
    vehicle_T_lidar = check_rigid(np.eye(4) if vehicle_T_lidar is None else vehicle_T_lidar, "vehicle_T_lidar")
    pose = vehicle_T_lidar @ invert(check_rigid(camera_T_lidar, f"{path}: P{camera} from the lidar"))
    return Calibration(width, height, *split_matrix(P[:, :3], str(path)), vehicle_T_camera=pose, name=f"P{camera}")


def read_nuscenes(
    folder: str | Path, channel: str, *, token: str | None = None, width: int = 1600, height: int = 900
) -> Calibration:
    """Read one camera from nuScenes' tables `sensor.json` and `calibrated_sensor.json`. Undistorted: a pinhole.

    Args:
        folder: Where the tables lie.
        channel: "CAM_FRONT" and so on.
        token: Of the calibrated sensor; needed where the tables hold several calibrations of the channel.
        width: Columns of the images.
        height: Rows of the images.

    Returns:
        The calibration, placed in nuScenes' ego frame, whose origin lies under the rear axle.

    Raises:
        ValueError: No such camera, or several that differ.
    """
    folder = Path(folder)
    channels = {row["token"]: row["channel"] for row in json.loads((folder / "sensor.json").read_text())}
    table = json.loads((folder / "calibrated_sensor.json").read_text())
    rows = [row for row in table if channels.get(row["sensor_token"]) == channel and token in (None, row["token"])]
    if not rows or not rows[0]["camera_intrinsic"]:
        raise ValueError(
            f"{folder}: no calibrated camera {channel!r}, token {token}; channels: {sorted(channels.values())}"
        )
    keys = ("camera_intrinsic", "rotation", "translation")
    if any(row[key] != rows[0][key] for row in rows for key in keys):
        tokens = ", ".join(row["token"] for row in rows)
        raise ValueError(f"{folder}: {len(rows)} calibrations of {channel!r}; pass the token of one of them: {tokens}")
    matrix, rotation, translation = (rows[0][key] for key in keys)
    pose = rigid(rotation_from_quaternion(rotation), translation)
    return Calibration(width, height, *split_matrix(matrix, channel), vehicle_T_camera=pose, name=channel)


def _read_yaml(path: str | Path) -> dict[str, Any]:
    try:
        content = parse_yaml(Path(path).read_text())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: a mapping of names to values is needed; got {type(content).__name__}")
    return content


def _first(content: Mapping[str, Any], *names: str) -> Any:  # noqa: ANN401
    for name in names:
        if name in content:
            return content[name]
    raise KeyError(" or ".join(names))


def _numbers(value: Any) -> Any:  # noqa: ANN401
    """The list of a matrix that is written as {rows, cols, data}, or as the list itself."""
    return np.asarray(value["data"] if isinstance(value, dict) else value, dtype=np.float64)


def _matrix(value: Any) -> Any:  # noqa: ANN401
    numbers = _numbers(value)
    return numbers.reshape(value["rows"], value["cols"]) if isinstance(value, dict) else numbers


def _distorted(
    name: str, size: tuple[int, int], matrix: ArrayLike, model: str, coefficients: Sequence[float]
) -> Calibration:
    """A distorted camera; a file without any coefficient means a pinhole."""
    values = tuple(float(value) for value in coefficients)
    return Calibration(*size, *split_matrix(matrix, name), model if values else "pinhole", values, name=name)
