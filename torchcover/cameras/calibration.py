"""Reading calibrations: each reader turns one kind of source into a `Calibration`, from which a `Camera` is made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from torchcover.cameras.lens import as_vector
from torchcover.cameras.models import check_image, check_model
from torchcover.files import naming, parse_yaml, parse_yaml_stream, read_json_table, read_short_text, reads
from torchcover.geometry import check_rigid, invert, rigid, rotation_from_euler, rotation_from_quaternion
from torchcover.geometry.rigid import Matrix

# Beyond, squares of float64 overflow.
MAX_NUMBER = 1e150
# A side of an image is shorter.
MAX_PIXELS = 1_000_000
# Camera axes (x right, y down, z forward) of a camera that looks along the vehicle's x (forward; y left, z up).
LOOKING_FORWARD = rigid([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], [0.0, 0.0, 0.0])

# ROS and OpenCV names of the models.
_MODEL_NAMES = {
    "plumb_bob": "brown_conrady",
    "rational_polynomial": "brown_conrady",
    "equidistant": "kannala_brandt",
    "fisheye": "kannala_brandt",
}


def told(value: object) -> str:
    """What arrived, for a message. YAML may hold lists of lists whose text has no end."""
    return repr(value)[:80] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def first(content: Mapping[str, Any], *names: str) -> tuple[str, Any]:
    """The first entry of these names that there is."""
    for name in names:
        if name in content:
            return name, content[name]
    raise ValueError(f"{' or '.join(names)} is missing")


def whole(content: Mapping[str, Any], *names: str) -> int:
    """The first of these entries, a whole number."""
    name, value = first(content, *names)
    if type(value) is not int:
        raise ValueError(f"{name}: a whole number is needed; got {told(value)}")
    return value


def numbers(content: Mapping[str, Any], *names: str) -> Matrix:
    """A matrix that is written as {rows, cols, data}, or a list of numbers."""
    name, value = first(content, *names)
    data = value.get("data") if isinstance(value, dict) else value
    if not has_numbers(data):
        raise ValueError(f"{name}: a list of finite numbers is needed; got {told(data)}")
    values = np.array([float(number) for number in data])
    if not isinstance(value, dict):
        return values
    rows, columns = whole(value, "rows"), whole(value, "cols")
    if min(rows, columns) < 0 or rows * columns != values.size:
        raise ValueError(f"{name}: {rows} rows and {columns} columns are not {values.size} numbers")
    return values.reshape(rows, columns)


def numbers_of(table: Mapping[str, Sequence[str]], key: str, length: int) -> Matrix:
    """The numbers behind a key of a KITTI file."""
    words = table.get(key, [])
    if not has_numbers(words, length):
        arrived = " ".join(words)[:120] or "nothing"
        raise ValueError(f"{key} with {length} numbers is needed; got {arrived}; the file holds {', '.join(table)}")
    return np.array(words, dtype=np.float64)


def has_numbers(values: object, length: int | None = None) -> TypeGuard[list[Any]]:
    """Whether it is a list of finite numbers, without a look into whatever else may be in it.

    YAML takes 1e-1, without a point, for text.
    """
    return (
        isinstance(values, list)
        and length in (None, len(values))
        and all(isinstance(value, int | float | str) and _is_finite(value) for value in values)
    )


def _is_finite(value: float | str) -> bool:
    try:
        return not isinstance(value, bool) and abs(float(value)) < MAX_NUMBER
    except (ValueError, OverflowError):
        return False


@dataclass(frozen=True)
class Calibration:
    """What is known about a camera: the arguments of `Camera`."""

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
    """fx, fy, cx, cy of a 3x3 camera matrix, once it is known to be nothing else."""
    K = np.asarray(matrix, dtype=np.float64)
    if K.shape != (3, 3):
        raise ValueError(f"{name}: a camera matrix has shape (3, 3); got {K.shape}")
    if not K.any():
        raise ValueError(f"{name}: the camera matrix is zero, so the camera was never calibrated; calibrate it first")
    if not np.array_equal(K[2], [0.0, 0.0, 1.0]) or K[0, 1] != 0.0 or K[1, 0] != 0.0:
        raise ValueError(f"{name}: a camera matrix is [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], no skew; got {K.tolist()}")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def split_projection(numbers: Matrix, name: str) -> tuple[tuple[float, float, float, float], Matrix]:
    """fx, fy, cx, cy and `camera_T_rectified` of the 12 numbers of KITTI's P = K [I | t]: all cameras are parallel."""
    P = numbers.reshape(3, 4)
    intrinsics = split_matrix(P[:, :3], name)
    if 0.0 in intrinsics[:2]:
        raise ValueError(f"{name} has no focal length; got {P.tolist()}")
    return intrinsics, rigid(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))


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


@reads("a camera_info file")
def read_ros(path: Path) -> Calibration:
    """Read a ROS `camera_info` file, as camera_calibration writes it or as `topic echo` prints the message.

    Args:
        path: A YAML file with size, matrix K, distortion model and coefficients. The unrectified image is described;
            the matrices R and P of the rectified one are not read. The region of interest and the binning are applied,
            as image_geometry does. Of several messages all but their headers has to be equal.

    Returns:
        The calibration of the image as it is published; a file without coefficients is a pinhole.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing or makes no camera, messages differ, or the distortion model is none of
            `plumb_bob`, `rational_polynomial`, `equidistant` and `fisheye`.
    """
    content, *others = map(_check_mapping, parse_yaml_stream(read_short_text(path)) or [None])
    if any({**other, "header": None} != {**content, "header": None} for other in others):
        raise ValueError(f"{1 + len(others)} messages of different content; keep one of them")
    size = whole(content, "image_width", "width"), whole(content, "image_height", "height")
    matrix = numbers(content, "camera_matrix", "k", "K")
    if matrix.size != 9:
        raise ValueError(f"the camera matrix has 9 numbers; got {matrix.size}")
    distortion = numbers(content, "distortion_coefficients", "d", "D")
    _, model = first(content, "distortion_model")
    if not isinstance(model, str) or model not in _MODEL_NAMES:
        raise ValueError(f"distortion_model {told(model)} is unknown; allowed: {', '.join(_MODEL_NAMES)}")
    name = content.get("camera_name")
    name = name if isinstance(name, str) else path.stem
    size, K = _cut_and_binned(content, size, matrix.reshape(3, 3))
    return _distorted(name, size, K, _MODEL_NAMES[model], distortion.ravel())


@reads("an OpenCV calibration")
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
        matrix_key: Name of the camera matrix in it; stereo calibrations use M1 and M2.
        distortion_key: Name of the coefficients in it; there D1 and D2.
        size: (width, height); None takes image_width and image_height from the file.
        model: None is Brown-Conrady, or Kannala-Brandt where the file says `fisheye_model: 1`.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing, and the message lists those that the file has; or makes no camera.
    """
    content = _read_yaml(path)
    wanted = [matrix_key, distortion_key] + ([] if size else ["image_width", "image_height"])
    missing = [key for key in wanted if key not in content]
    if missing:
        raise ValueError(f"{', '.join(missing)} not in the file; it holds {', '.join(map(str, content))}")
    if "xi" in content:
        raise ValueError("xi: the omnidirectional model of OpenCV is not read; calibrate with its fisheye model")
    size = size or (whole(content, "image_width"), whole(content, "image_height"))
    model = model or ("kannala_brandt" if content.get("fisheye_model") else "brown_conrady")
    matrix, distortion = numbers(content, matrix_key), numbers(content, distortion_key)
    return _distorted(path.stem, size, matrix, model, distortion.ravel())


@reads("a KITTI calibration")
def read_kitti(
    path: Path, camera: int, *, width: int, height: int, vehicle_T_lidar: ArrayLike | None = None
) -> Calibration:
    """Read one camera of a KITTI object or odometry calibration file. Its images are rectified: a pinhole.

    Args:
        path: The file, with P0 to P3 and Tr_velo_to_cam (or Tr).
        camera: 0 to 3; 2 is the left colour camera.
        width: Columns of the images, which the file does not tell.
        height: Rows of the images.
        vehicle_T_lidar: Where the lidar sits, through which the camera is placed; None is the identity, so that the
            lidar frame takes the place of the vehicle frame.

    Raises:
        FileNotFoundError: There is no such file.
        BadFileError: An entry is missing, has another length, or makes no camera.
    """
    lines = (line.split(":", 1) for line in read_short_text(path).splitlines() if ":" in line)
    table = {key.strip(): value.split() for key, value in lines}
    intrinsics, camera_T_rectified = split_projection(numbers_of(table, f"P{camera}", 12), f"P{camera}")
    rotation = numbers_of(table, "R0_rect", 9).reshape(3, 3) if "R0_rect" in table else np.eye(3)
    lidar = numbers_of(table, "Tr_velo_to_cam" if "Tr_velo_to_cam" in table else "Tr", 12)
    reference_T_lidar = np.vstack([lidar.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    camera_T_lidar = camera_T_rectified @ rigid(rotation, np.zeros(3)) @ reference_T_lidar
    vehicle_T_lidar = check_rigid(np.eye(4) if vehicle_T_lidar is None else vehicle_T_lidar, "vehicle_T_lidar")
    pose = vehicle_T_lidar @ invert(check_rigid(camera_T_lidar, f"P{camera} from the lidar"))
    return _checked(Calibration(width, height, *intrinsics, vehicle_T_camera=pose, name=f"P{camera}"))


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
        FileNotFoundError: One of the tables is missing.
        BadFileError: Not such tables, no such camera, several that differ, or one that cannot be.
    """
    folder = Path(folder)
    table, sensors = (read_json_table(folder / f"{name}.json").rows for name in ("calibrated_sensor", "sensor"))
    with naming(folder, "nuScenes' tables"):
        channels = {row["token"]: row["channel"] for row in sensors}
        rows = [row for row in table if channels.get(row["sensor_token"]) == channel and token in (None, row["token"])]
        if not rows or not rows[0].get("camera_intrinsic"):
            raise ValueError(f"no calibrated camera {channel!r}, token {token}; channels: {sorted(channels.values())}")
        keys = ("camera_intrinsic", "rotation", "translation")
        if any(row.get(key) != rows[0].get(key) for row in rows for key in keys):
            tokens = ", ".join(row["token"] for row in rows)
            raise ValueError(f"{len(rows)} calibrations of {channel!r}; pass the token of one of them: {tokens}")
        matrix, rotation, translation = (rows[0].get(key) for key in keys)
        if not (isinstance(matrix, list) and len(matrix) == 3 and all(has_numbers(row, 3) for row in matrix)):
            raise ValueError(f"the camera_intrinsic of {channel!r} has three rows of three numbers; got {told(matrix)}")
        if not (has_numbers(rotation, 4) and has_numbers(translation, 3)):
            raise ValueError(
                f"{channel!r} needs a rotation of four numbers and a translation of three; "
                f"got {told(rotation)}, {told(translation)}"
            )
        pose = check_rigid(rigid(rotation_from_quaternion(rotation), translation), f"{channel!r}")
        intrinsics = split_matrix(matrix, channel)
        return _checked(Calibration(width, height, *intrinsics, vehicle_T_camera=pose, name=channel))


def _cut_and_binned(content: Mapping[str, Any], size: tuple[int, int], K: Matrix) -> tuple[tuple[int, int], Matrix]:
    """The size and the matrix of the published image: a region of the whole sensor, then binned.

    Some drivers give the size of the region where the size of the whole sensor belongs.
    """
    roi = content.get("roi") or {}
    if not isinstance(roi, dict):
        raise ValueError(f"roi: x_offset, y_offset, width and height are needed; got {told(roi)}")
    sides, K = list[int](), K.copy()
    for axis, (name, length) in enumerate(zip(("width", "height"), size, strict=True)):
        offset, cut = (whole({key: 0, **roi}, key) for key in (f"{'xy'[axis]}_offset", name))
        key = f"binning_{'xy'[axis]}"
        binning = max(whole({key: 0, **content}, key), 1)
        is_part = 0 <= offset < offset + cut <= length or (0 <= offset < MAX_PIXELS and cut == length)
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


def _read_yaml(path: Path) -> dict[str, Any]:
    return _check_mapping(parse_yaml(read_short_text(path)))


def _check_mapping(content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise ValueError(f"a mapping of names to values is needed; got {type(content).__name__}")
    return content


def _distorted(name: str, size: tuple[int, int], matrix: Matrix, model: str, coefficients: Matrix) -> Calibration:
    """A distorted camera; a file without any coefficient means a pinhole."""
    values = tuple(float(value) for value in coefficients)
    model = model if values else "pinhole"
    return _checked(Calibration(*size, *split_matrix(matrix, name), model, values, name=name))


def _checked(source: Calibration) -> Calibration:
    """Refuse what no camera can be made of, here, where the file is known."""
    check_image(source.name, source.width, source.height, as_vector([source.fx, source.fy, source.cx, source.cy]))
    check_model(source.model, source.coefficients)
    return source
