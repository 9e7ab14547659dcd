"""The files beside CARLA's clouds, in its left-handed axes: sensors, the vehicle's box, objects."""

import warnings
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from torchcover.cameras import Camera
from torchcover.detection.boxes import Boxes, upright_rows
from torchcover.files import naming, parse_yaml, read_csv, read_short_text, reads
from torchcover.geometry import BoundingBox, rigid, rotation_from_euler
from torchcover.geometry.rigid import Matrix

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
        return right_handed([getattr(self, name) for name in POSE])

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
        return rigid(np.eye(3), [-self.location.x, self.location.y, 0.0])

    @property
    def body(self) -> BoundingBox:
        """The box in the vehicle frame, off the ground."""
        half, z = self.extent, self.location.z
        low_m = max(z - half.z, 0.0) + CLEARANCE_M
        return BoundingBox((-half.x, -half.y, low_m), (half.x, half.y, z + half.z))


@reads("a list of CARLA's sensors")
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


@reads("the bounding box of a vehicle of CARLA")
def read_carla_vehicle(path: Path) -> CarlaVehicle:
    """Read `{"location": {"x": ..., "y": ..., "z": ...}, "extent": {...}}`."""
    try:
        vehicle = CarlaVehicle.model_validate(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        raise ValueError(f"location and extent, each with x, y, z, are needed; {_complaints(error)}") from error
    _ = vehicle.body  # refuses a box without a size
    return vehicle


def read_carla_boxes(path: Path, vehicle_T_world: Matrix) -> Boxes:
    """Read the objects of a frame.

    The table has the columns `id, category, x, y, z, roll, pitch, yaw, extent_x, extent_y, extent_z`: the centre and
    half the size of each bounding box in the world; `velocity_x, velocity_y` may be there too. Boxes without a size, as
    CARLA 0.9.8 to 0.9.14 gives some bicycles and pedestrians, are left out, with a warning.
    """
    table = read_csv(path, (*POSE, *EXTENT), ("id", "category"), VELOCITY)
    has_size = np.all([table.numbers[name] > 0 for name in EXTENT], axis=0)
    words = {name: [word for word, has in zip(of, has_size, strict=True) if has] for name, of in table.words.items()}
    numbers, count = {name: of[has_size] for name, of in table.numbers.items()}, int(has_size.sum())
    if count < len(has_size):
        empty = int(np.argmin(has_size))
        extent = ", ".join(f"{name} {table.numbers[name][empty]:g}" for name in EXTENT)
        warnings.warn(
            f"{path.parent}: boxes of objects without a size are left out: {len(has_size) - count} of {len(has_size)} "
            f"in one frame, such as {table.words['id'][empty]} ({table.words['category'][empty]}): {extent}",
            stacklevel=2,
        )
    poses = right_handed([numbers[name] for name in POSE])
    size_m = 2 * np.column_stack([numbers[name] for name in EXTENT])
    over_ground = np.column_stack([numbers.get(name, np.full(count, np.nan)) for name in VELOCITY]) * [1.0, -1.0]
    velocity_mps = over_ground @ vehicle_T_world[:2, :2].T
    with naming(path, "a table of boxes"):
        return Boxes.from_rows(
            upright_rows(poses[:, :3, 3], size_m, poses[:, :3, 0], vehicle_T_world),
            velocity_mps=torch.from_numpy(velocity_mps).float(),
            ids=tuple(words["id"]),
            categories=tuple(words["category"]),
        )


def right_handed(pose: list[float] | list[NDArray[np.float64]]) -> Matrix:
    """(..., 4, 4) of x, y, z, roll, pitch, yaw in CARLA's axes: y and yaw to the right, pitch up."""
    x, y, z, roll, pitch, yaw = map(np.asarray, pose)
    return rigid(rotation_from_euler(-yaw, -pitch, roll), np.stack([x, -y, z], axis=-1))


def _complaints(error: ValidationError) -> str:
    return "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
