"""A rig: the sensors of a vehicle, where they are mounted, and what carries them."""

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


def parse_sensor(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (whatever stood in the file, or a sensor)
    """A sensor of the kind that its `type` names."""
    kind = content.get("type", "lidar") if isinstance(content, dict) else getattr(content, "type", type(content))
    if not isinstance(kind, str) or kind not in SENSORS:
        raise ValueError(f"type: a sensor is a {' or a '.join(map(repr, SENSORS))}; got {kind!r}")
    return TypeAdapter(SENSORS[kind]).validate_python(content, context=info.context)


def _read_mounted(content: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401
    is_known = isinstance(content, dict) and str(content.get("type", "lidar")) in SENSORS
    if is_known and not get_close_matches("mount", map(str, content)):
        raise ValueError("mount: missing; metres from the ground under the vehicle's middle, as {x_m: 1.5, z_m: 1.7}")
    return parse_sensor(content, info)


class Rig(BuiltInDocument):
    """The sensors of a vehicle.

    Args:
        name: What tables and maps call it.
        description: What it is, and where its numbers come from.
        vehicle: What carries it, a built-in vehicle or the YAML file of one, where neither the user nor the scenario
            decides that.
        weather: What it is measured in, in place of the scenario's.
        bodies: What the rig carries in addition to its sensors, such as a roof box, in the vehicle frame. Its sensors
            look around that; other rigs and the reference do not, so that rigs with and without it can be compared.
        sensors: The sensors, each of a kind in `SENSORS`; their clouds are fused.

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
    sensors: tuple[Annotated[Sensor, PlainValidator(_read_mounted)], ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        names = [sensor.name for sensor in self.sensors]
        if len(set(names)) != len(names):
            raise ValueError(f"sensors need different names; got {', '.join(names)}")
        return self

    def save(self, path: str | Path) -> None:
        """Write it to a YAML file from which `load` makes the same rig, wherever that is put.

        A LiDAR model from a file is written out, and so is the place of any other file.

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
        keys["sensors"] = [_written(sensor) for sensor in self.sensors]
        write_atomically(Path(path), lambda aside: aside.write_text(to_yaml(keys), encoding="utf-8"))

    def build_occluder_mesh(self, ego_mesh: Mesh) -> Mesh:
        """All that hides something from its sensors on a vehicle: the body of that, and what the rig carries."""
        return merge_meshes([ego_mesh, *(mesh for body in self.bodies for mesh in body.build_meshes())])

    @property
    def sensor_model(self) -> Literal["ideal", "real"]:
        """`real` if what returns too little light to one of its LiDARs is no point; else every hit is one."""
        return "real" if any(isinstance(one, Lidar) and one.range_at_10_percent_m for one in self.sensors) else "ideal"

    def apply_sensor_model(self, sensor_model: Literal["ideal", "real"] | None) -> Self:
        """The rig with ideal sensors, or as it is.

        Args:
            sensor_model: `ideal` takes the range at 10 % from every LiDAR.

        Raises:
            ValueError: `real` of a rig of which no range at 10 % is known.

        Example:
            >>> Rig.load("kitti").sensor_model, Rig.load("kitti").sensing("ideal").sensor_model
            ('real', 'ideal')
        """
        if sensor_model == "real" and self.sensor_model == "ideal":
            raise ValueError(
                f"sensor_model real: no LiDAR of the rig {self.name!r} has a range_at_10_percent_m; take it from a "
                "data sheet, or fit it to a recording by `torchcover calibrate`"
            )
        if sensor_model != "ideal":
            return self
        sensors = [
            one.model_copy(update={"range_at_10_percent_m": None}) if isinstance(one, Lidar) else one
            for one in self.sensors
        ]
        return self.model_copy(update={"sensors": tuple(sensors)})

    def collect_content(self) -> dict[str, Any]:
        """Its sensors; the vehicle is in the scenario that it is simulated in, if it is the one."""
        return {key: value for key, value in super().collect_content().items() if key != "vehicle"}


def _written(sensor: Sensor) -> dict[str, Any]:
    """The keys of a sensor, without those that its model stands for."""
    assert isinstance(sensor, Document)  # as all sensors of a rig
    keys = sensor.model_dump(mode="json", exclude_unset=True)
    keys = {key: keys[key] for key in ("type", "name") if key in keys} | {"mount": {}} | keys
    if isinstance(sensor, Lidar) and sensor.model is not None:
        if is_file_name(sensor.model):
            return {key: value for key, value in keys.items() if key != "model"}
        same = LidarModel.load(sensor.model).model_dump(mode="json", exclude={"name", "description"})
        return {key: value for key, value in keys.items() if key not in same or same[key] != value}
    return keys


@dataclass(frozen=True)
class RoadsideParams:
    """When a rig counts as one on a mast beside the road.

    Args:
        min_height_m: Its highest sensor is at least so high, above the sensors of most cars and robots.
        slenderness: That height is more than so many times the length and the width of its body, as of a mast;
        above_body_m: or the sensor is so much higher than its body, as where the mast was left out.
    """

    min_height_m: float = 2.5
    slenderness: float = 2.0
    above_body_m: float = 2.0


def is_roadside(rigs: Iterable[Rig], ego_box: BoundingBox, params: RoadsideParams = RoadsideParams()) -> bool:
    """Whether a rig is on a mast rather than on a vehicle, by the heights of its sensors and the size of its body.

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
    """The scenario with the body of what carries the rigs: the first of these that is given.

    `vehicle`; the shape of the scenario's own ego; the vehicle that the rigs name; an SUV.

    Args:
        scenario: The scenario.
        rigs: What is carried; those that name no vehicle go on any.
        vehicle: A built-in vehicle, the YAML file of one, or a mesh file in metres.

    Raises:
        ValueError: The rigs name different vehicles, and nothing else decides; or a vehicle that cannot be used.
        FileNotFoundError: No such vehicle.

    Example:
        >>> set_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}).ego_name
        'renault_zoe'
        >>> set_ego(Scenario.load("courtyard"), {"roof": Rig.load("nuscenes")}, "van").ego_name
        'van'
    """
    ego = scenario.ego or ActorDescription()
    shape = ego.shape if vehicle is None else _found_body("vehicle", create_body_shape(vehicle))
    return scenario.model_copy(update={"ego": ego.model_copy(update={"shape": shape or _of_rigs(rigs)})})


def _of_rigs(rigs: Mapping[str, Rig]) -> Shape:
    named = {name: rig.vehicle for name, rig in rigs.items() if rig.vehicle is not None}
    if len(set(named.values())) > 1:
        told = ", ".join(f"{name} {vehicle}" for name, vehicle in named.items())
        raise ValueError(
            f"the rigs name different vehicles ({told}), but all are compared in the same frames, which have one ego: "
            "say which by --vehicle (in Python, vehicle=), and give a rig what its vehicle has in addition as `bodies`"
        )
    if not named:
        return DEFAULT_EGO
    name, vehicle = next(iter(named.items()))
    return _found_body(f"rig {name!r}: vehicle", VehicleShape(type="vehicle", vehicle=vehicle))


def _found_body(owner: str, shape: VehicleShape | MeshFile) -> VehicleShape | MeshFile:
    """The shape, once its file was found."""
    try:
        shape.collect_content()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{owner}: {error}") from error
    return shape
