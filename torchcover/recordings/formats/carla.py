"""LiDARs and depth cameras of CARLA (Dosovitskiy et al., CoRL 2017), as `save_to_disk` writes them, left-handed."""

import math
import os
import warnings
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from torchcover.cameras import Camera, read_depth
from torchcover.cameras.calibration import LOOKING_FORWARD
from torchcover.detection.boxes import Boxes, build_upright_rows
from torchcover.files import guard_reader, parse_yaml, read_csv, read_short_text, report_bad_file
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.formats.frame_files import check_same_names, find_frame_files, find_frame_rows
from torchcover.recordings.recording import RecordingBase, Scan, check_times

# Attributes of cameras that bend the image, and the values at which CARLA does not.
LENS = {"lens_k": -1.0, "lens_kcube": 0.0, "lens_x_size": 0.08, "lens_y_size": 0.08}
LIDARS = ("sensor.lidar.ray_cast", "sensor.lidar.ray_cast_semantic")
DEPTH = "sensor.camera.depth"
REFERENCE = "reference"
POSE = ("x", "y", "z", "roll", "pitch", "yaw")
EXTENT, VELOCITY = ("extent_x", "extent_y", "extent_z"), ("velocity_x", "velocity_y")
# What is so near to the ground is the ground that the vehicle stands on.
CLEARANCE_M = 0.05


class CarlaSensor(BaseModel):
    """A sensor as an agent of CARLA's leaderboard lists it in `sensors()`: metres and degrees in CARLA's axes.

    The size of an image may have the name of the blueprint's attribute, `image_size_x` and `image_size_y`.
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
        if self.type == DEPTH and None in (self.width, self.height, self.fov):
            raise ValueError("a camera needs width (or image_size_x), height (or image_size_y) and fov, in degrees")
        bent = [name for name, value in LENS.items() if float((self.model_extra or {}).get(name, value)) != value]
        if self.type == DEPTH and bent:
            raise ValueError(f"{', '.join(bent)}: distorted depth images are not read; record with CARLA's values")
        return self

    @property
    def parent_T_sensor(self) -> Matrix:
        """(4, 4) its mount, in right-handed axes."""
        return to_right_handed([getattr(self, name) for name in POSE])

    @property
    def camera(self) -> Camera | None:
        """Its lens, in the origin; None for a LiDAR."""
        if self.type != DEPTH:
            return None
        assert self.width is not None  # checked in _check_camera, like the next two
        assert self.height is not None
        assert self.fov is not None
        return Camera.from_fov(self.width, self.height, self.fov, name=self.id)


class _Point(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)

    x: float
    y: float
    z: float


class CarlaVehicle(BaseModel):
    """The `bounding_box` of a vehicle of CARLA: its centre in the actor's frame, and half its size."""

    location: _Point
    extent: _Point
    rotation: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_rotation(self) -> Self:
        if any(self.rotation.values()):
            raise ValueError(f"rotation: a box along the vehicle's axes is needed; got {self.rotation}")
        return self

    @property
    def vehicle_T_actor(self) -> Matrix:
        """(4, 4) the actor's frame in the vehicle frame, whose origin is under the centre of the box."""
        return build_transform(np.eye(3), [-self.location.x, self.location.y, 0.0])

    @property
    def ego_box(self) -> BoundingBox:
        """The box in the vehicle frame, off the ground."""
        half, z = self.extent, self.location.z
        low_m = max(z - half.z, 0.0) + CLEARANCE_M
        return BoundingBox((-half.x, -half.y, low_m), (half.x, half.y, z + half.z))


@guard_reader("a list of CARLA's sensors")
def read_carla_sensors(path: Path) -> list[CarlaSensor]:
    """Read the LiDARs and depth cameras of a list of sensors; JSON is YAML, too."""
    try:
        listed = TypeAdapter(list[CarlaSensor]).validate_python(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        raise ValueError(f"a list of sensors with id and type is needed; {_complaints(error)}") from error
    found = [one for one in listed if one.type in (*LIDARS, DEPTH)]
    names = [one.id for one in found]
    if not set(names) - {REFERENCE} or len(set(names)) < len(names):
        raise ValueError(
            f"LiDARs ({' or '.join(LIDARS)}) or depth cameras ({DEPTH}) of different id are needed; got "
            f"{', '.join(names) or 'none'}"
        )
    return found


@guard_reader("the bounding box of a vehicle of CARLA")
def read_carla_vehicle(path: Path) -> CarlaVehicle:
    """Read `{"location": {"x": ..., "y": ..., "z": ...}, "extent": {...}}`."""
    try:
        vehicle = CarlaVehicle.model_validate(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        raise ValueError(f"location and extent, each with x, y, z, are needed; {_complaints(error)}") from error
    _ = vehicle.ego_box  # refuses a box without a size
    return vehicle


def read_carla_boxes(path: Path, vehicle_T_world: Matrix) -> Boxes:
    """Read the objects of a frame.

    The table has the columns `id, category, x, y, z, roll, pitch, yaw, extent_x, extent_y, extent_z`: the centre and
    half the size of each bounding box in the world; `velocity_x, velocity_y` may be there too. Boxes without a size, as
    CARLA 0.9.8 to 0.9.14 gives some bicycles and pedestrians, are left out, with a warning.
    """
    table = read_csv(path, (*POSE, *EXTENT), ("id", "category"), VELOCITY)
    has_size = np.all([table.numbers[name] > 0 for name in EXTENT], axis=0)
    words = {name: [word for word, has in zip(of, has_size, strict=True) if has] for name, of in table.texts.items()}
    numbers, count = {name: of[has_size] for name, of in table.numbers.items()}, int(has_size.sum())
    if count < len(has_size):
        empty = int(np.argmin(has_size))
        extent = ", ".join(f"{name} {table.numbers[name][empty]:g}" for name in EXTENT)
        warnings.warn(
            f"{path.parent}: boxes of objects without a size are left out: {len(has_size) - count} of {len(has_size)} "
            f"in one frame, such as {table.texts['id'][empty]} ({table.texts['category'][empty]}): {extent}",
            stacklevel=2,
        )
    poses = to_right_handed([numbers[name] for name in POSE])
    size_m = 2 * np.column_stack([numbers[name] for name in EXTENT])
    over_ground = np.column_stack([numbers.get(name, np.full(count, np.nan)) for name in VELOCITY]) * [1.0, -1.0]
    velocity_mps = over_ground @ vehicle_T_world[:2, :2].T
    with report_bad_file(path, "a table of boxes"):
        return Boxes.from_rows(
            build_upright_rows(poses[:, :3, 3], size_m, poses[:, :3, 0], vehicle_T_world),
            velocity_mps=torch.from_numpy(velocity_mps).float(),
            ids=tuple(words["id"]),
            categories=tuple(words["category"]),
        )


def to_right_handed(pose: list[float] | list[NDArray[np.float64]]) -> Matrix:
    """(..., 4, 4) of x, y, z, roll, pitch, yaw in CARLA's axes: y and yaw to the right, pitch up."""
    x, y, z, roll, pitch, yaw = map(np.asarray, pose)
    return build_transform(convert_euler_to_rotation(-yaw, -pitch, roll), np.stack([x, -y, z], axis=-1))


def _complaints(error: ValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())


SENSORS_FILES = ("sensors.json", "sensors.yaml")
VEHICLE_FILE, POSES_FILE, BOXES = "vehicle.json", "poses.csv", "boxes"
# Times are a little off; so much of a file is no part of a turn of its own.
OF_A_FILE = 0.02
# Where a LiDAR that turns saw nothing over so wide an angle, it has probably not been there.
SECTOR_DEG = 60.0


class Carla(RecordingBase):
    """A folder with `sensors.json` and `ID/FRAME.ply` (or `.npy`; `.png` of a depth camera) of each sensor in it.

    All of it is in CARLA's left-handed axes. `sensors.json` (or `.yaml`) is the list that an agent of CARLA's
    leaderboard returns: `id`, `type`, `x`, `y`, `z`, `roll`, `pitch`, `yaw` of each sensor on its vehicle, `width`,
    `height` and `fov` of cameras, and any attributes of its blueprint; what is neither a LiDAR nor a depth camera is
    left out. A sensor whose `id` is `reference` is the reference. All that follows is optional:

    * `vehicle.json`, the `bounding_box` of the vehicle: points in it are its own, and the vehicle frame lies under its
      middle. Without it the actor's frame is taken for that, and own points are taken for the world;
    * `ID/poses.csv`, with the columns `frame, x, y, z, roll, pitch, yaw`: where a sensor was on the vehicle;
    * `poses.csv`, also with `time_s`: where the vehicle was;
    * `boxes/FRAME.csv`, the objects, see `read_carla_boxes`; they need `poses.csv`.

    Where frames come faster than a LiDAR turns, as `poses.csv` and `rotation_frequency` say, an instant is as many
    frames as make a turn of all LiDARs. It bears name, time and pose of the last; the parts before are moved by the
    poses of the vehicle, without whatever else moved meanwhile. Frames at the end that make no turn are left out.

    Raises:
        FileNotFoundError: No `sensors.json`, or no clouds of a LiDAR in it.
        ValueError: Not such a list, no LiDAR or depth camera in it, places with other frames, too few for a turn, or a
            bad table.

    Warns:
        UserWarning: How long a turn takes is unknown, and the first file of a LiDAR looks like a part of one.
    """

    layout: ClassVar[str] = "sensors.json, ID/FRAME.ply of each LiDAR and ID/FRAME.png of each depth camera in it"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        listed = read_carla_sensors(next(filter(Path.exists, _lists(self.path)), self.path / SENSORS_FILES[0]))
        vehicle = read_carla_vehicle(self.path / VEHICLE_FILE) if (self.path / VEHICLE_FILE).exists() else None
        self.ego_box = None if vehicle is None else vehicle.ego_box
        self._vehicle_T_actor = np.eye(4) if vehicle is None else vehicle.vehicle_T_actor
        self._mounts = {one.id: self._vehicle_T_actor @ one.parent_T_sensor for one in listed}
        self._cameras = {one.id: one.camera for one in listed if one.camera is not None}
        self.sensors = tuple(name for name in self._mounts if name != REFERENCE)
        self.rigs = {"carla": self.sensors}
        self.reference_sensors = (REFERENCE,) if REFERENCE in self._mounts else ()
        self._files = {name: self._files_of(name) for name in self._mounts}
        self._labelled = (self.path / BOXES).is_dir()
        boxes = {BOXES: {file.stem: file for file in (self.path / BOXES).glob("*.csv")}} if self._labelled else {}
        check_same_names(self.path, {**self._files, **boxes})
        self._ticks = tuple(next(iter(self._files.values())))
        moving = {name: self.path / name / POSES_FILE for name in self._mounts}
        self._moving = {name: self._table(path, ())[1] for name, path in moving.items() if path.exists()}
        self.times_s, self._poses = None, None
        self._parts = dict.fromkeys(self._mounts, 1)
        if (self.path / POSES_FILE).exists():
            self.times_s, self._poses = self._table(self.path / POSES_FILE, ("time_s",))
            check_times(self.times_s, len(self._ticks), str(self.path / POSES_FILE))
            self._parts = {one.id: _parts_of_a_turn(one, self.times_s) for one in listed}
        elif self._labelled:
            raise ValueError(f"{self.path}: {BOXES}/ are in the world; {POSES_FILE} is needed, which is not there")
        if self.times_s is None or len(self.times_s) == 1:
            self._warn_of_sectors(listed)
        turn = max(self._parts.values())
        if len(self._ticks) < turn:
            raise ValueError(f"{self.path}: a turn of its LiDARs takes {turn} frames; there are {len(self._ticks)}")
        self._lasts = range(turn - 1, len(self._ticks), turn)
        self.frame_names = tuple(self._ticks[last] for last in self._lasts)
        if self.times_s is not None:
            self.times_s = self.times_s[self._lasts.start :: turn]

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether there is a list of sensors."""
        return any(file.is_file() for file in _lists(path))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud, its y turned to the left, or a depth image; all parts of a turn."""
        last = self._lasts[index]
        cloud_m, vehicle_T_sensor, source = self._read(sensor, last)
        if self._parts[sensor] == 1:
            return Scan(cloud_m, vehicle_T_sensor, source)
        parts = [transform_points(vehicle_T_sensor, cloud_m)]
        for tick in range(last - self._parts[sensor] + 1, last):
            cloud_m, vehicle_T_sensor, _ = self._read(sensor, tick)
            parts.append(self._moved(transform_points(vehicle_T_sensor, cloud_m), tick, last))
        return Scan(np.concatenate(parts), None, source)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was, if there is a `poses.csv`."""
        return self._pose(self._lasts[index])

    def read_boxes(self, index: int) -> Boxes | None:
        """The objects of a frame; None without the folder."""
        pose = self.get_world_T_vehicle(index)
        if pose is None or not self._labelled:
            return None
        return read_carla_boxes(self.path / BOXES / f"{self.frame_names[index]}.csv", invert(pose))

    def _read(self, sensor: str, tick: int) -> tuple[NDArray[np.floating], Matrix, str]:
        """Points of a file in right-handed axes, where their sensor was, and the file."""
        path = self._files[sensor][self._ticks[tick]]
        mount = self._mounts[sensor]
        if sensor in self._moving:
            mount = self._vehicle_T_actor @ self._moving[sensor][tick]
        if sensor in self._cameras:
            with report_bad_file(path, "a depth image"):
                points = self._cameras[sensor].unproject(read_depth(path))
            return points.numpy(), mount @ LOOKING_FORWARD, str(path)  # type: ignore[union-attr]  # one image
        points_m = read_cloud(path)
        points_m[:, 1] *= -1
        return points_m, mount, str(path)

    def _moved(self, points_m: Matrix, tick: int, last: int) -> Matrix:
        """Points of the world as the vehicle finds them later; its own go with it."""
        before, after = self._pose(tick), self._pose(last)
        assert before is not None  # without times there are no parts
        assert after is not None
        moved_m = transform_points(invert(after) @ before, points_m)
        if self.ego_box is None:
            return moved_m
        own = ((points_m > self.ego_box.lower_m) & (points_m < self.ego_box.upper_m)).all(axis=1, keepdims=True)
        return np.where(own, points_m, moved_m)

    def _pose(self, tick: int) -> Matrix | None:
        return None if self._poses is None else self._poses[tick] @ invert(self._vehicle_T_actor)

    def _files_of(self, sensor: str) -> dict[str, Path]:
        return find_frame_files(self.path / sensor, ignored_files=(POSES_FILE,), is_depth=sensor in self._cameras)

    def _warn_of_sectors(self, listed: list[CarlaSensor]) -> None:
        for one in listed:
            if one.rotation_frequency is None or one.horizontal_fov < 360 - SECTOR_DEG:
                continue
            points_m, _, source = self._read(one.id, 0)
            azimuth_deg = np.sort(np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0])))
            gap_deg = float(np.diff(azimuth_deg, append=azimuth_deg[:1] + 360).max(initial=0.0))
            if gap_deg > SECTOR_DEG:
                warnings.warn(
                    f"{source}: {one.id}: nothing in {gap_deg:.0f} degrees; if a file holds a part of a turn, add "
                    f"{POSES_FILE}, by which parts are joined, or record with a rotation_frequency of "
                    "1 / fixed_delta_seconds",
                    stacklevel=4,
                )

    def _table(self, path: Path, timed: tuple[str, ...]) -> tuple[NDArray[np.float64], Matrix]:
        """(F,) times, or nothing, and (F, 4, 4) poses of the frames of a table."""
        table = read_csv(path, (*timed, *POSE), ("frame",))
        with report_bad_file(path, "a table of poses"):
            order = find_frame_rows(table.texts["frame"], self._ticks)
        poses = to_right_handed([table.numbers[name][order] for name in POSE])
        return (table.numbers["time_s"][order] if timed else np.empty(0)), poses


def _lists(folder: Path) -> list[Path]:
    return [folder / name for name in SENSORS_FILES]


def _parts_of_a_turn(sensor: CarlaSensor, times_s: NDArray[np.float64]) -> int:
    """How many files make a turn; 1 where that is unknown, as of a camera."""
    if sensor.rotation_frequency is None or sensor.camera is not None or len(times_s) < 2:
        return 1
    turns_in_a_file = sensor.rotation_frequency * float(np.median(np.diff(times_s)))
    return max(1, math.ceil(1 / turns_in_a_file - OF_A_FILE))
