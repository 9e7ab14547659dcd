"""Sensor rigs: the sensors of one vehicle with their extrinsics, and the vehicle that carries them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, PlainValidator, TypeAdapter, ValidationInfo, model_validator

from torchcover.files import to_yaml, write_atomically
from torchcover.geometry import BoundingBox
from torchcover.simulation.bodies import Body, Shape, VehicleShape, create_body_shape, merge_meshes
from torchcover.simulation.documents import BuiltInDocument, Document, NameOrFile, is_file_name
from torchcover.simulation.kinds import SENSORS
from torchcover.simulation.lidar import Lidar, LidarModel
from torchcover.simulation.returns import Weather
from torchcover.simulation.scenario import DEFAULT_EGO, ActorDescription, Scenario
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.shapes import Mesh, MeshFile


def parse_sensor(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (raw content of a file, or a sensor)
    """Parse a sensor of the type that its key `type` names.

    Args:
        content: Keys of the sensor, or a sensor.
        info: Context of the validation.

    Raises:
        ValueError: The type is unknown, or a key or value is wrong.
    """
    kind = content.get("type", "lidar") if isinstance(content, dict) else getattr(content, "type", type(content))
    if not isinstance(kind, str) or kind not in SENSORS:
        raise ValueError(f"type: a sensor is a {' or a '.join(map(repr, SENSORS))}; got {kind!r}")
    return TypeAdapter(SENSORS[kind]).validate_python(content, context=info.context)


def _parse_mounted_sensor(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401
    has_known_type = isinstance(content, dict) and str(content.get("type", "lidar")) in SENSORS
    if has_known_type and not get_close_matches("mount", map(str, content)):
        raise ValueError("mount: missing; meters from the ground under the vehicle's center, as {x_m: 1.5, z_m: 1.7}")
    return parse_sensor(content, info)


class Rig(BuiltInDocument):
    """Sensor rig of a vehicle.

    Args:
        name: Name in tables and maps.
        description: Rig and source of its numbers.
        vehicle: Built-in vehicle or YAML file of the vehicle that carries the rig, unless the user or the scenario
            chooses one.
        weather: Weather of the measurement, in place of that in the scenario.
        bodies: Bodies that the rig adds to the vehicle, such as a roof box, in the vehicle frame. They occlude
            sensors of this rig only, so that rigs with and without them can be compared in the same frames.
        sensors: Sensors, each of a type in `SENSORS`; their points are merged.

    Example:
        >>> [sensor.name for sensor in Rig.load("front_roof_128").sensors]
        ['roof']
    """

    kind: ClassVar[str] = "a rig"
    folder: ClassVar[str] = "rigs"

    name: str
    description: str = ""
    vehicle: NameOrFile | None = None
    weather: Weather | None = None
    bodies: tuple[Body, ...] = ()
    sensors: tuple[Annotated[Sensor, PlainValidator(_parse_mounted_sensor)], ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) != len(names):
            raise ValueError(f"sensors need different names; got {', '.join(names)}")
        return self

    def save(self, path: str | Path) -> None:
        """Write the rig to a YAML file from which `load` reads an equal rig, wherever the file is moved.

        A LiDAR model from a file is expanded to its keys; paths of other files become absolute.

        Args:
            path: YAML file to write.

        Raises:
            OSError: The file cannot be written.

        Example:
            >>> import tempfile
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     Rig.load("kitti").save(Path(folder, "mine.yaml"))
            ...     Rig.load(Path(folder, "mine.yaml")) == Rig.load("kitti")
            True
        """
        keys = self.model_dump(mode="json", exclude_unset=True, exclude={"sensors"})
        keys["sensors"] = [_dump_sensor(sensor) for sensor in self.sensors]
        text = to_yaml(keys)
        write_atomically(Path(path), lambda temporary_path: temporary_path.write_text(text, encoding="utf-8"))

    def build_occluder_mesh(self, ego_mesh: Mesh) -> Mesh:
        """Build the mesh that occludes the sensors of the rig: the ego vehicle and the bodies of the rig.

        Args:
            ego_mesh: Mesh of the ego vehicle in the vehicle frame.
        """
        meshes = [ego_mesh]
        for body in self.bodies:
            meshes += body.build_meshes()
        return merge_meshes(meshes)

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors, in their order."""
        return tuple(sensor.name for sensor in self.sensors)

    @property
    def sensor_model(self) -> Literal["ideal", "real"]:
        """`real` if range-limited returns of at least one LiDAR are simulated; `ideal` if every hit returns."""
        is_real = any(isinstance(sensor, Lidar) and sensor.range_at_10_percent_m for sensor in self.sensors)
        return "real" if is_real else "ideal"

    def apply_sensor_model(self, sensor_model: Literal["ideal", "real"] | None) -> Self:
        """Apply a sensor model.

        Args:
            sensor_model: `ideal` removes `range_at_10_percent_m` from each LiDAR; `real` and None keep it.

        Returns:
            Rig with that sensor model.

        Raises:
            ValueError: `real` for a rig without a LiDAR that has `range_at_10_percent_m`.

        Example:
            >>> Rig.load("kitti").sensor_model, Rig.load("kitti").apply_sensor_model("ideal").sensor_model
            ('real', 'ideal')
        """
        if sensor_model == "real" and self.sensor_model == "ideal":
            raise ValueError(
                f"sensor_model real: no LiDAR of the rig {self.name!r} has a range_at_10_percent_m; take it from a "
                "data sheet, or fit it to a recording by `torchcover calibrate`"
            )
        if sensor_model != "ideal":
            return self
        sensors: list[Sensor] = []
        for sensor in self.sensors:
            if isinstance(sensor, Lidar):
                sensors.append(sensor.model_copy(update={"range_at_10_percent_m": None}))
            else:
                sensors.append(sensor)
        return self.model_copy(update={"sensors": tuple(sensors)})

    def collect_content(self) -> dict[str, Any]:
        """Collect all that influences a simulation; the vehicle belongs to the content of the scenario."""
        return {key: value for key, value in super().collect_content().items() if key != "vehicle"}


def _dump_sensor(sensor: Sensor) -> dict[str, Any]:
    """Return the keys of a sensor without those that its built-in model supplies."""
    assert isinstance(sensor, Document)  # all sensors of a rig are documents
    keys = sensor.model_dump(mode="json", exclude_unset=True)
    leading_keys = {key: keys[key] for key in ("type", "name") if key in keys}
    keys = leading_keys | {"mount": {}} | keys
    if not isinstance(sensor, Lidar) or sensor.model is None:
        return keys
    if is_file_name(sensor.model):
        return {key: value for key, value in keys.items() if key != "model"}
    model_keys = LidarModel.load(sensor.model).model_dump(mode="json", exclude={"name", "description"})
    return {key: value for key, value in keys.items() if key not in model_keys or model_keys[key] != value}


@dataclass(frozen=True)
class RoadsideParams:
    """Limits from which a rig counts as mounted on a mast at the roadside.

    Args:
        min_height_m: Smallest height of the highest sensor, above the sensors of most cars and robots.
        slenderness: Smallest ratio of that height to the length and the width of the body, as for a mast.
        above_body_m: Alternatively, smallest height of the sensor above the body, as for a mast without a mesh.
    """

    min_height_m: float = 2.5
    slenderness: float = 2.0
    above_body_m: float = 2.0


def is_roadside(rigs: Iterable[Rig], ego_box: BoundingBox, params: RoadsideParams = RoadsideParams()) -> bool:
    """Return True if a rig is on a mast rather than on a vehicle, by sensor heights and the size of the body.

    Args:
        rigs: Rigs of one run.
        ego_box: Bounding box of the body that carries them, in the vehicle frame.
        params: Limits.

    Example:
        >>> car = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> is_roadside([Rig.load("kitti")], car)
        False
    """
    top_m = max((sensor.mount.z_m for rig in rigs for sensor in rig.sensors), default=0.0)
    length_m, width_m, _ = ego_box.size_m
    is_slender = top_m > params.slenderness * max(length_m, width_m)
    return top_m >= params.min_height_m and (is_slender or top_m > ego_box.upper_m[2] + params.above_body_m)


def set_ego(scenario: Scenario, rigs: Mapping[str, Rig], vehicle: str | Path | None = None) -> Scenario:
    """Choose the ego vehicle of a scenario.

    The first of these that exists is taken: `vehicle`, the shape of the ego in the scenario, the vehicle that the rigs
    name, an SUV.

    Args:
        scenario: Scenario.
        rigs: Rigs by name; rigs without a vehicle fit any vehicle.
        vehicle: Built-in vehicle, YAML file of a vehicle, or mesh file in meters.

    Returns:
        Scenario with the shape of the ego vehicle.

    Raises:
        ValueError: The rigs name different vehicles and nothing else decides, or a vehicle cannot be used.
        FileNotFoundError: No such vehicle.

    Example:
        >>> set_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}).ego_name
        'renault_zoe'
        >>> set_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}, "van").ego_name
        'van'
    """
    ego = scenario.ego or ActorDescription()
    shape = ego.shape if vehicle is None else _check_files("vehicle", create_body_shape(vehicle))
    ego_with_shape = ego.model_copy(update={"shape": shape or _find_vehicle_of_rigs(rigs)})
    return scenario.model_copy(update={"ego": ego_with_shape})


def _find_vehicle_of_rigs(rigs: Mapping[str, Rig]) -> Shape:
    vehicles = {name: rig.vehicle for name, rig in rigs.items() if rig.vehicle is not None}
    if len(set(vehicles.values())) > 1:
        listing = ", ".join(f"{name} {vehicle}" for name, vehicle in vehicles.items())
        raise ValueError(
            f"the rigs name different vehicles ({listing}), but all are compared in the same frames, which have one "
            "ego: choose it by --vehicle (in Python, vehicle=), and add parts of another vehicle as `bodies` of a rig"
        )
    if not vehicles:
        return DEFAULT_EGO
    name, vehicle = next(iter(vehicles.items()))
    return _check_files(f"rig {name!r}: vehicle", VehicleShape(type="vehicle", vehicle=vehicle))


def _check_files(key: str, shape: VehicleShape | MeshFile) -> VehicleShape | MeshFile:
    """Return the shape, or raise FileNotFoundError with the key if a file of it is missing."""
    try:
        shape.collect_content()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{key}: {error}") from error
    return shape
