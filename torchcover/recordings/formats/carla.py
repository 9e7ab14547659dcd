"""CARLA recordings (Dosovitskiy et al., CoRL 2017): left-handed LiDAR clouds and depth images of `save_to_disk`."""

import math
import os
import warnings
from itertools import compress
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from torchcover.cameras import Camera, read_depth
from torchcover.cameras.calibration import LOOKING_FORWARD
from torchcover.detection.boxes import Boxes, build_upright_rows
from torchcover.files import (
    explain_validation_error,
    guard_reader,
    parse_yaml,
    read_csv,
    read_short_text,
    report_bad_file,
)
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.formats.folder import POSES_FILE, REFERENCE
from torchcover.recordings.formats.frame_files import (
    BOX_FOLDER,
    check_frames_with_boxes,
    find_frame_files,
    find_frame_rows,
    stack_columns,
)
from torchcover.recordings.recording import GROUND_CLEARANCE_M, Recording, Scan, check_times

# Blueprints of sensors that are read.
LIDAR_TYPES = ("sensor.lidar.ray_cast", "sensor.lidar.ray_cast_semantic")
DEPTH_TYPE = "sensor.camera.depth"
# Columns of tables of poses and boxes.
POSE_COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw")
EXTENT_COLUMNS = ("extent_x", "extent_y", "extent_z")
VELOCITY_COLUMNS = ("velocity_x", "velocity_y")
# Possible names of the list of sensors, the preferred one first.
SENSORS_FILES = ("sensors.json", "sensors.yaml")


class CarlaSensor(BaseModel):
    """Sensor in the list of `sensors()` of a CARLA leaderboard agent, in meters and degrees in CARLA's axes.

    Args:
        id: Name of the sensor.
        type: Blueprint, such as `sensor.lidar.ray_cast`.
        x: Position forward of the actor.
        y: Position to the right.
        z: Position upward.
        roll: Rotation about x.
        pitch: Rotation about y; positive raises the nose.
        yaw: Rotation about z; positive turns right.
        rotation_frequency: Revolutions of a LiDAR per second.
        horizontal_fov: Horizontal field of view of a LiDAR.
        width: Width of images in pixels, or `image_size_x`.
        height: Height of images in pixels, or `image_size_y`.
        fov: Horizontal field of view of a camera.
    """

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    id: Annotated[str, Field(pattern=r"^[^./\\][^/\\]*$")]
    type: str
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    rotation_frequency: Annotated[float, Field(gt=0)] | None = None
    horizontal_fov: float = 360.0
    width: Annotated[int | None, Field(ge=1, validation_alias=AliasChoices("width", "image_size_x"))] = None
    height: Annotated[int | None, Field(ge=1, validation_alias=AliasChoices("height", "image_size_y"))] = None
    fov: Annotated[float, Field(gt=0, lt=180)] | None = None

    @model_validator(mode="after")
    def _check_camera(self) -> Self:
        """Check that a depth camera has a size, a field of view and no distortion."""
        if self.type == DEPTH_TYPE and None in (self.width, self.height, self.fov):
            raise ValueError("a camera needs width (or image_size_x), height (or image_size_y) and fov, in degrees")
        # Values of the lens attributes at which CARLA does not distort images.
        defaults = {"lens_k": -1.0, "lens_kcube": 0.0, "lens_x_size": 0.08, "lens_y_size": 0.08}
        attributes = self.model_extra or {}
        distorted = [name for name, default in defaults.items() if float(attributes.get(name, default)) != default]
        if self.type == DEPTH_TYPE and distorted:
            raise ValueError(f"{', '.join(distorted)}: distorted depth images are not read; record with CARLA's values")
        return self

    @property
    def parent_T_sensor(self) -> Matrix:
        """(4, 4) pose of the sensor in the actor frame, right-handed."""
        return to_right_handed([getattr(self, name) for name in POSE_COLUMNS])

    @property
    def camera(self) -> Camera | None:
        """Camera model in the origin; None for a LiDAR."""
        if self.type != DEPTH_TYPE:
            return None
        assert self.width is not None  # checked in _check_camera, like the next two
        assert self.height is not None
        assert self.fov is not None
        return Camera.from_fov(self.width, self.height, self.fov, name=self.id)


class _Point(BaseModel):
    """Coordinates in meters."""

    model_config = ConfigDict(allow_inf_nan=False)

    x: float
    y: float
    z: float


class CarlaVehicle(BaseModel):
    """Bounding box of a CARLA vehicle.

    Args:
        location: Center in the actor frame.
        extent: Half of its size.
        rotation: Angles of the box, which have to be 0.
    """

    location: _Point
    extent: _Point
    rotation: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        """Check that the box is aligned with the axes of the actor."""
        if any(self.rotation.values()):
            raise ValueError(f"rotation: a box aligned with the vehicle's axes is needed; got {self.rotation}")
        return self

    @property
    def vehicle_T_actor(self) -> Matrix:
        """(4, 4) pose of the actor frame in the vehicle frame, whose origin is below the center of the box."""
        return build_transform(np.eye(3), [-self.location.x, self.location.y, 0.0])

    @property
    def ego_box(self) -> BoundingBox:
        """Bounding box in the vehicle frame, slightly above the ground."""
        half, z = self.extent, self.location.z
        bottom_m = max(z - half.z, 0.0) + GROUND_CLEARANCE_M
        return BoundingBox((-half.x, -half.y, bottom_m), (half.x, half.y, z + half.z))


@guard_reader("a list of CARLA's sensors")
def read_carla_sensors(path: Path) -> list[CarlaSensor]:
    """Read the LiDARs and depth cameras of a list of sensors.

    Args:
        path: YAML or JSON file.

    Returns:
        The sensors; other types of sensors are skipped.

    Raises:
        BadFileError: The file is no such list, has no LiDAR or depth camera, or an id is repeated.
    """
    try:
        sensors = TypeAdapter(list[CarlaSensor]).validate_python(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        raise ValueError(
            f"a list of sensors with id and type is needed; {'; '.join(explain_validation_error(error))}"
        ) from error
    sensors = [sensor for sensor in sensors if sensor.type in (*LIDAR_TYPES, DEPTH_TYPE)]
    names = [sensor.id for sensor in sensors]
    if not set(names) - {REFERENCE} or len(set(names)) < len(names):
        raise ValueError(
            f"LiDARs ({' or '.join(LIDAR_TYPES)}) or depth cameras ({DEPTH_TYPE}) of different id are needed; got "
            f"{', '.join(names) or 'none'}"
        )
    return sensors


@guard_reader("the bounding box of a vehicle of CARLA")
def read_carla_vehicle(path: Path) -> CarlaVehicle:
    """Read `{"location": {"x": ..., "y": ..., "z": ...}, "extent": {...}}`.

    Args:
        path: YAML or JSON file.

    Returns:
        The bounding box.

    Raises:
        BadFileError: Keys are missing, or the box has no size or is rotated.
    """
    try:
        vehicle = CarlaVehicle.model_validate(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        raise ValueError(
            f"location and extent, each with x, y, z, are needed; {'; '.join(explain_validation_error(error))}"
        ) from error
    _ = vehicle.ego_box  # raises for a box without a size
    return vehicle


def read_carla_boxes(path: Path, vehicle_T_world: Matrix) -> Boxes:
    """Read the objects of a frame.

    The columns are `id, category, x, y, z, roll, pitch, yaw, extent_x, extent_y, extent_z`, with the center and half
    of the size of each bounding box in the world frame; `velocity_x, velocity_y` are optional.

    Args:
        path: CSV file.
        vehicle_T_world: (4, 4) transform from the world to the vehicle frame.

    Returns:
        Boxes in the vehicle frame.

    Raises:
        BadFileError: Columns are missing, or values are invalid.

    Warns:
        UserWarning: Boxes without a size are excluded; CARLA 0.9.8 to 0.9.14 writes some for bicycles and walkers.
    """
    table = read_csv(path, (*POSE_COLUMNS, *EXTENT_COLUMNS), ("id", "category"), VELOCITY_COLUMNS)
    has_size = np.asarray((stack_columns(table.numbers, EXTENT_COLUMNS) > 0).all(axis=1))
    numbers, count = {name: column[has_size] for name, column in table.numbers.items()}, int(has_size.sum())
    if count < len(has_size):
        empty = int(np.argmin(has_size))
        extent = ", ".join(f"{name} {table.numbers[name][empty]:g}" for name in EXTENT_COLUMNS)
        warnings.warn(
            f"{path.parent}: boxes of objects without a size are excluded: {len(has_size) - count} of {len(has_size)} "
            f"in one frame, such as {table.texts['id'][empty]} ({table.texts['category'][empty]}): {extent}",
            stacklevel=2,
        )
    poses = to_right_handed(stack_columns(numbers, POSE_COLUMNS).T)
    size_m = 2 * stack_columns(numbers, EXTENT_COLUMNS)
    unknown = np.full(count, np.nan)
    velocity_mps = np.column_stack([numbers.get(name, unknown) for name in VELOCITY_COLUMNS]) * [1.0, -1.0]
    velocity_mps = velocity_mps @ vehicle_T_world[:2, :2].T
    with report_bad_file(path, "a table of boxes"):
        return Boxes.from_rows(
            build_upright_rows(poses[:, :3, 3], size_m, poses[:, :3, 0], vehicle_T_world),
            velocity_mps=torch.from_numpy(velocity_mps).float(),
            ids=tuple(compress(table.texts["id"], has_size)),
            categories=tuple(compress(table.texts["category"], has_size)),
        )


def to_right_handed(pose: ArrayLike) -> Matrix:
    """Convert poses from CARLA's axes (y to the right, positive yaw right, positive pitch up) to right-handed ones.

    Args:
        pose: (6,) or (6, N) x, y, z in meters and roll, pitch, yaw in degrees.

    Returns:
        (..., 4, 4) transforms.
    """
    x, y, z, roll, pitch, yaw = np.asarray(pose)
    return build_transform(convert_euler_to_rotation(-yaw, -pitch, roll), np.stack([x, -y, z], axis=-1))


class Carla(Recording):
    """Folder with `sensors.json` and `ID/FRAME.ply` (or `.npy`; `.png` of a depth camera) of each of its sensors.

    All data are in CARLA's left-handed axes. `sensors.json` (or `.yaml`) is the list that an agent of CARLA's
    leaderboard returns: `id`, `type`, `x`, `y`, `z`, `roll`, `pitch`, `yaw` of each sensor on its vehicle, `width`,
    `height` and `fov` of cameras, and any attributes of its blueprint; sensors other than LiDARs and depth cameras are
    skipped. A sensor with the `id` `reference` is the reference. Optional are:

    * `vehicle.json`, the `bounding_box` of the vehicle: points inside belong to the ego vehicle, and the vehicle frame
      is below its center. Without it the vehicle frame is the actor frame, and points of the ego vehicle remain;
    * `ID/poses.csv` with the columns `frame, x, y, z, roll, pitch, yaw`: extrinsics of a sensor in each frame;
    * `poses.csv`, also with `time_s`: poses of the vehicle;
    * `boxes/FRAME.csv`, the objects, see `read_carla_boxes`; they need `poses.csv`.

    If `poses.csv` and `rotation_frequency` show that files cover less than one revolution, a frame joins as many files
    as all LiDARs need for one revolution. It has the name, time and pose of the last file; earlier parts are moved by
    the poses of the vehicle, without compensation of other moving objects. An incomplete revolution at the end is
    excluded.

    Args:
        path: Folder.

    Raises:
        FileNotFoundError: `sensors.json` or the clouds of a sensor are missing.
        ValueError: The list is invalid, frames differ between folders, there are too few for a revolution, or a table
            is invalid.

    Warns:
        UserWarning: The period of a revolution is unknown, and the first file of a LiDAR looks like a part of one.
    """

    layout: ClassVar[str] = "sensors.json, ID/FRAME.ply of each LiDAR and ID/FRAME.png of each depth camera in it"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        json_file, yaml_file = _list_sensor_files(self.path)
        sensors = read_carla_sensors(yaml_file if yaml_file.exists() and not json_file.exists() else json_file)
        vehicle_file = self.path / "vehicle.json"
        vehicle = read_carla_vehicle(vehicle_file) if vehicle_file.exists() else None
        self.ego_box = None if vehicle is None else vehicle.ego_box
        self._vehicle_T_actor = np.eye(4) if vehicle is None else vehicle.vehicle_T_actor
        self._mounts, self._cameras, self._files = (
            dict[str, Matrix](),
            dict[str, Camera](),
            dict[str, dict[str, Path]](),
        )
        for sensor in sensors:
            self._mounts[sensor.id] = self._vehicle_T_actor @ sensor.parent_T_sensor
            if sensor.camera is not None:
                self._cameras[sensor.id] = sensor.camera
            folder, is_depth = self.path / sensor.id, sensor.camera is not None
            self._files[sensor.id] = find_frame_files(folder, ignored_files=(POSES_FILE,), is_depth=is_depth)
        self.reference_sensors = (REFERENCE,) if REFERENCE in self._mounts else ()
        self.sensors = tuple(name for name in self._mounts if name != REFERENCE)
        self.rigs = {"carla": self.sensors}
        self._has_boxes = check_frames_with_boxes(self.path, self._files)
        self._file_names = tuple(next(iter(self._files.values())))
        self._extrinsics = {}
        for name in self._mounts:
            table = self.path / name / POSES_FILE
            if table.exists():
                self._extrinsics[name] = self._read_poses(table, ())[1]
        self.times_s, self._poses = None, None
        self._num_parts = dict.fromkeys(self._mounts, 1)
        if (self.path / POSES_FILE).exists():
            self.times_s, self._poses = self._read_poses(self.path / POSES_FILE, ("time_s",))
            check_times(self.times_s, len(self._file_names), str(self.path / POSES_FILE))
            self._num_parts = {sensor.id: _count_parts(sensor, self.times_s) for sensor in sensors}
        elif self._has_boxes:
            raise ValueError(f"{self.path}: {BOX_FOLDER}/ are in the world; {POSES_FILE} is needed, which is missing")
        if self.times_s is None or len(self.times_s) == 1:
            self._warn_about_sectors(sensors)
        num_parts = max(self._num_parts.values())
        if len(self._file_names) < num_parts:
            raise ValueError(
                f"{self.path}: a revolution of its LiDARs takes {num_parts} files; there are {len(self._file_names)}"
            )
        self._last_files = range(num_parts - 1, len(self._file_names), num_parts)  # last file of each frame
        self.frame_names = tuple(self._file_names[last] for last in self._last_files)
        if self.times_s is not None:
            self.times_s = self.times_s[self._last_files.start :: num_parts]

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a folder with a list of sensors.

        Args:
            path: Existing path.
        """
        return any(file.is_file() for file in _list_sensor_files(path))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud or depth image in right-handed axes, and join all parts of a revolution.

        Args:
            sensor: Name of the sensor.
            index: Index of the frame.

        Returns:
            The scan; in the vehicle frame if it was joined.
        """
        last = self._last_files[index]
        cloud_m, vehicle_T_sensor, source = self._read_file(sensor, last)
        if self._num_parts[sensor] == 1:
            return Scan(cloud_m, vehicle_T_sensor, source)
        parts = [transform_points(vehicle_T_sensor, cloud_m)]
        for number in range(last - self._num_parts[sensor] + 1, last):
            cloud_m, vehicle_T_sensor, _ = self._read_file(sensor, number)
            parts.append(self._move_points(transform_points(vehicle_T_sensor, cloud_m), number, last))
        return Scan(np.concatenate(parts), None, source)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Return the (4, 4) pose of the vehicle in a frame; None without `poses.csv`."""
        return self._get_pose(self._last_files[index])

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the objects of a frame; None without the folder `boxes`."""
        pose = self.get_world_T_vehicle(index)
        if pose is None or not self._has_boxes:
            return None
        return read_carla_boxes(self.path / BOX_FOLDER / f"{self.frame_names[index]}.csv", invert(pose))

    def _read_file(self, sensor: str, number: int) -> tuple[NDArray[np.floating], Matrix, str]:
        """Read the points of a file in right-handed axes, the extrinsics of the sensor, and the name of the file."""
        path = self._files[sensor][self._file_names[number]]
        mount = self._mounts[sensor]
        if sensor in self._extrinsics:
            mount = self._vehicle_T_actor @ self._extrinsics[sensor][number]
        # Depth images give points in the camera frame, which LOOKING_FORWARD rotates to x forward.
        if sensor in self._cameras:
            with report_bad_file(path, "a depth image"):
                points = self._cameras[sensor].unproject(read_depth(path))
            return points.numpy(), mount @ LOOKING_FORWARD, str(path)  # type: ignore[union-attr]  # one image
        points_m = read_cloud(path)
        points_m[:, 1] *= -1
        return points_m, mount, str(path)

    def _move_points(self, points_m: Matrix, number: int, last: int) -> Matrix:
        """Move points of the static world to the vehicle frame of a later file; points of the ego vehicle stay."""
        before, after = self._get_pose(number), self._get_pose(last)
        assert before is not None  # without times there are no parts
        assert after is not None
        moved_m = transform_points(invert(after) @ before, points_m)
        if self.ego_box is None:
            return moved_m
        is_inside = (points_m > self.ego_box.lower_m) & (points_m < self.ego_box.upper_m)
        return np.where(is_inside.all(axis=1, keepdims=True), points_m, moved_m)

    def _get_pose(self, number: int) -> Matrix | None:
        """Get the vehicle pose of a file; None without `poses.csv`."""
        return None if self._poses is None else self._poses[number] @ invert(self._vehicle_T_actor)

    def _warn_about_sectors(self, sensors: list[CarlaSensor]) -> None:
        """Warn about rotating LiDARs whose first file covers only a sector."""
        min_gap_deg = 60.0  # a wider angle without points is probably not covered
        for sensor in sensors:
            if sensor.rotation_frequency is None or sensor.horizontal_fov < 360 - min_gap_deg:
                continue
            points_m, _, source = self._read_file(sensor.id, 0)
            azimuth_deg = np.sort(np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0])))
            gap_deg = float(np.diff(azimuth_deg, append=azimuth_deg[:1] + 360).max(initial=0.0))
            if gap_deg > min_gap_deg:
                warnings.warn(
                    f"{source}: {sensor.id}: no points in {gap_deg:.0f} degrees; if a file holds a part of a "
                    f"revolution, add {POSES_FILE}, by which parts are joined, or record with a rotation_frequency of "
                    "1 / fixed_delta_seconds",
                    stacklevel=4,
                )

    def _read_poses(self, path: Path, time_columns: tuple[str, ...]) -> tuple[NDArray[np.float64], Matrix]:
        """Read (F,) times, if requested, and (F, 4, 4) poses of all files from a table."""
        table = read_csv(path, (*time_columns, *POSE_COLUMNS), ("frame",))
        with report_bad_file(path, "a table of poses"):
            order = find_frame_rows(table.texts["frame"], self._file_names)
        poses = to_right_handed(stack_columns(table.numbers, POSE_COLUMNS)[order].T)
        return (table.numbers["time_s"][order] if time_columns else np.empty(0)), poses


def _list_sensor_files(folder: Path) -> list[Path]:
    """List the possible files of the sensor list, the preferred one first."""
    return [folder / name for name in SENSORS_FILES]


def _count_parts(sensor: CarlaSensor, times_s: NDArray[np.float64]) -> int:
    """Count the files of one revolution; 1 for cameras and if the period is unknown."""
    if sensor.rotation_frequency is None or sensor.camera is not None or len(times_s) < 2:
        return 1
    revolutions_per_file = sensor.rotation_frequency * float(np.median(np.diff(times_s)))
    rounding = 0.02  # times are not exact; such a part of a file is no additional file
    return max(1, math.ceil(1 / revolutions_per_file - rounding))
