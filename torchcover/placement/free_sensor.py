"""Free variables of a sensor in a search space, and the sensor that their values give."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, PlainValidator, model_validator

from torchcover.geometry import convert_rotation_to_euler
from torchcover.placement.host_vehicle import HostVehicle
from torchcover.simulation import Document, Lidar, Pose, Sensor
from torchcover.simulation.documents import FARTHEST_M, NameOrFile

ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
PLACES = ("x_m", "y_m", "z_m", "z_above_body_m")
ON_REGIONS = ("u", "v", "height_m")
MIRRORED = ("y_m", "yaw_deg", "roll_deg")
# The middle of what a sensor measures from is about this far above its foot.
HEIGHT_M = 0.1

VariableValue = float | str | bool
DECIMALS = 6  # of numbers: micrometers and millionths of a degree, so that a table of them can be read back


class FreeNumber(NamedTuple):
    """A free number with its bounds, under the name of its sensor and key, as "roof.pitch_deg"."""

    name: str
    low: float
    high: float

    def get_value(self, fraction: float) -> float:
        """Return the value at a share, 0 to 1, of the way from the lowest to the highest."""
        return self.round_value(self.low + fraction * (self.high - self.low))

    def round_value(self, value: VariableValue) -> float:
        """Return a value with the digits that files keep, within the bounds."""
        return min(max(round(float(value), DECIMALS), self.low), self.high)

    def check(self, value: object) -> None:
        """ValueError: the value is not a number within the bounds."""
        if not self.is_allowed(value):
            raise ValueError(f"{self.name}: a number from {self.low:g} to {self.high:g} is needed; got {value!r}")

    def is_allowed(self, value: object) -> bool:
        """Return whether a value is a number within the bounds."""
        return isinstance(value, int | float) and not isinstance(value, bool) and self.low <= value <= self.high


class FreeChoice(NamedTuple):
    """A free choice of several options."""

    name: str
    options: tuple[VariableValue, ...]

    def get_value(self, fraction: float) -> VariableValue:
        """Return the option at a share, 0 to 1, of all options."""
        return self.options[min(int(fraction * len(self.options)), len(self.options) - 1)]

    def round_value(self, value: VariableValue) -> VariableValue:
        """Return the option itself."""
        return value

    def check(self, value: object) -> None:
        """ValueError: the value is not one of the options."""
        if not self.is_allowed(value):
            raise ValueError(f"{self.name}: one of {', '.join(map(str, self.options))} is needed; got {value!r}")

    def is_allowed(self, value: object) -> bool:
        """Return whether a value is one of the options."""
        return any(value == option and type(value) is type(option) for option in self.options)


Variable = FreeNumber | FreeChoice


def _span(low: float, high: float) -> PlainValidator:
    """What reads a number, or the lowest and the highest of a free one."""

    def read(given: Any) -> float | tuple[float, float]:  # noqa: ANN401  (whatever stood in the file)
        ends = given if isinstance(given, tuple) else (given, given)
        if len(ends) != 2 or any(isinstance(end, bool) or not isinstance(end, int | float) for end in ends):
            raise ValueError(f"a number, or the lowest and the highest of a free one, is needed; got {given!r}")
        if not all(math.isfinite(end) and low <= end <= high for end in ends):
            raise ValueError(f"from {low:g} to {high:g} is allowed; got {given!r}")
        if not isinstance(given, tuple):
            return float(given)
        if not ends[0] < ends[1]:
            raise ValueError(f"the lowest must be below the highest; got {given!r}")
        return float(ends[0]), float(ends[1])

    return PlainValidator(read)


NumberOrRange = float | tuple[float, float]
Meters = Annotated[NumberOrRange, _span(-FARTHEST_M, FARTHEST_M)]
Degrees = Annotated[NumberOrRange, _span(-360.0, 360.0)]
Share = Annotated[NumberOrRange, _span(0.0, 1.0)]
Height = Annotated[NumberOrRange, _span(0.001, 10.0)]


class FreeSensor(Document):
    """What of a sensor is free: a number is set, two numbers are the lowest and the highest, options are a list.

    What is not named stays as in the rig that the search starts from. On a mount region, the place is one of the skin,
    and a sensor is level and looks to where the region faces, unless its angles say otherwise.

    Args:
        x_m: Forward.
        y_m: To the left.
        z_m: Up from the ground.
        z_above_body_m: Up from the vehicle's body at x and y, instead.
        yaw_deg: Positive turns left; on a region from where that faces.
        pitch_deg: Positive turns the nose down; 0 is level.
        roll_deg: Positive lowers the right side; 0 is level.
        region: Mount region of the vehicle, or several to choose from.
        u: Place in the region along the first of its axes in the order x, y, z, from 0 to 1; free if not given.
        v: Along the second; free if not given.
        height_m: Above the skin, along its normal; 0.1 if not given.
        model: LiDAR models to choose from; each brings its whole scan pattern.
        present: `[true, false]`: whether the sensor is there is free, too.
        mirror_of: Name of a free sensor of which this one is the mirror image: y, yaw and roll change their sign, and
            its model, and whether it is there, are the same.

    Example:
        >>> [variable.name for variable in FreeSensor(x_m=(0.0, 1.0), pitch_deg=(-10.0, 10.0)).variables("roof")]
        ['roof.x_m', 'roof.pitch_deg']
    """

    x_m: Meters | None = None
    y_m: Meters | None = None
    z_m: Meters | None = None
    z_above_body_m: Meters | None = None
    yaw_deg: Degrees | None = None
    pitch_deg: Degrees | None = None
    roll_deg: Degrees | None = None
    region: str | tuple[str, ...] | None = None
    u: Share | None = None
    v: Share | None = None
    height_m: Height | None = None
    model: tuple[NameOrFile, ...] | None = Field(default=None, min_length=2)
    present: tuple[bool, ...] | None = None
    mirror_of: str | None = None

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        given = [key for key in type(self).model_fields if getattr(self, key) is not None]
        if self.mirror_of is not None and given != ["mirror_of"]:
            raise ValueError(f"mirror_of: the mirror image has nothing of its own; leave out {', '.join(given[:-1])}")
        if not given:
            raise ValueError("nothing of it is free: name a number or a choice, or leave the sensor out")
        unused = [key for key in given if key in (PLACES if self.region is not None else ON_REGIONS)]
        if unused:
            other = "the place is that in the region" if self.region is not None else "they are places in a region"
            raise ValueError(f"{', '.join(unused)}: {other}; give a region, or x_m, y_m and z_m or z_above_body_m")
        if self.z_m is not None and self.z_above_body_m is not None:
            raise ValueError("give z_m or z_above_body_m, not both")
        if self.present is not None and sorted(self.present) != [False, True]:
            raise ValueError(f"present: [true, false] is the choice; got {list(self.present)}")
        for key in ("model", "region"):
            options = getattr(self, key)
            if isinstance(options, tuple) and len(set(options)) != max(len(options), 2):
                raise ValueError(f"{key}: at least two different options are needed; got {', '.join(options)}")
        return self

    def list_variables(self, sensor_name: str) -> tuple[Variable, ...]:
        """What is free of it, under the name of the sensor."""
        free: list[Variable] = []
        for key, given in self._given().items():
            if key in ("present", "model") or (key == "region" and isinstance(given, tuple)):
                free.append(FreeChoice(f"{sensor_name}.{key}", given))
            elif isinstance(given, tuple):
                free.append(FreeNumber(f"{sensor_name}.{key}", *given))
        return tuple(free)

    def _given(self) -> dict[str, Any]:
        """Its keys, and on a region what stands for those that are not given."""
        given = {key: getattr(self, key) for key in type(self).model_fields if getattr(self, key) is not None}
        if self.region is None:
            return given
        usual = {"u": (0.0, 1.0), "v": (0.0, 1.0), "height_m": HEIGHT_M, **dict.fromkeys(ANGLES, 0.0)}
        return usual | given

    def build_sensor(
        self, start_sensor: Sensor, values: Mapping[str, VariableValue], host: HostVehicle
    ) -> Sensor | None:
        """The sensor that values make of that of the start, by the names of `variables`; None where they leave it out.

        ValueError: nothing of the body is at its place.
        """
        own = {key: values.get(f"{start_sensor.name}.{key}", given) for key, given in self._given().items()}
        if own.get("present") is False:
            return None
        try:
            mount = self._mount(start_sensor.mount, own, host)
        except ValueError as error:
            raise ValueError(f"{start_sensor.name}: {error}") from error
        if own.get("model", getattr(start_sensor, "model", None)) != getattr(start_sensor, "model", None):
            return Lidar.model_validate({"name": start_sensor.name, "mount": mount, "model": own["model"]})
        assert isinstance(start_sensor, Document)  # as all sensors of a rig
        return start_sensor.model_copy(update={"mount": mount})

    def _mount(self, start: Pose, own: Mapping[str, Any], host: HostVehicle) -> Pose:
        if self.region is None:
            numbers = {key: own[key] for key in (*PLACES[:3], *ANGLES) if key in own}
            mount = update_pose(start, numbers)
            if "z_above_body_m" in own:
                mount = update_pose(mount, {"z_m": find_vehicle_top_m(host, mount) + own["z_above_body_m"]})
            return mount
        region = host.get_mount_region(own["region"])
        point = region.find_mount_point(host.skin, own["u"], own["v"])
        x, y, z = (point.position_m + own["height_m"] * point.normal).tolist()
        return build_pose(x, y, z, region.heading_deg + own["yaw_deg"], own["pitch_deg"], own["roll_deg"])

    def get_start_values(self, start_sensor: Sensor, host: HostVehicle) -> dict[str, VariableValue]:
        """What the variables are in the rig that the search starts from, whether they may be that or not.

        On an unknown region: the sensor may be anywhere.
        """
        known: dict[str, VariableValue] = {"present": True}
        if isinstance(start_sensor, Lidar) and start_sensor.model is not None:
            known["model"] = start_sensor.model
        if self.region is None:
            known |= get_pose_values(start_sensor.mount)
            if self.z_above_body_m is not None:
                known["z_above_body_m"] = round(
                    start_sensor.mount.z_m - find_vehicle_top_m(host, start_sensor.mount), DECIMALS
                )
        names = {variable.name for variable in self.list_variables(start_sensor.name)}
        return {
            f"{start_sensor.name}.{key}": value for key, value in known.items() if f"{start_sensor.name}.{key}" in names
        }


def mirror_sensor(target_sensor: Sensor, source_sensor: Sensor | None) -> Sensor | None:
    """A sensor as the mirror image of another, of the same model, beyond the vehicle's middle; None without one."""
    if source_sensor is None:
        return None
    numbers = {key: -value if key in MIRRORED else value for key, value in get_pose_values(source_sensor.mount).items()}
    assert isinstance(source_sensor, Document)  # as all sensors of a rig
    return source_sensor.model_copy(update={"name": target_sensor.name, "mount": build_pose(*numbers.values())})


def update_pose(pose: Pose, values: Mapping[str, float]) -> Pose:
    """A pose with other numbers; a rotation stays as it is written, as long as none of its angles is another."""
    if not values:
        return pose
    if pose.quaternion_wxyz is None or any(key in values for key in ANGLES):
        return build_pose(*(get_pose_values(pose) | dict(values)).values())
    return Pose.model_validate(pose.model_dump() | dict(values))


def get_pose_values(pose: Pose) -> dict[str, float]:
    """Place and angles of a pose, in the order of `Pose`."""
    if pose.quaternion_wxyz is None:
        angles = (pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
    else:
        angles = tuple(convert_rotation_to_euler(pose.to_matrix()[:3, :3]).round(DECIMALS).tolist())
    return dict(zip((*PLACES[:3], *ANGLES), (pose.x_m, pose.y_m, pose.z_m, *angles), strict=True))


def build_pose(x_m: float, y_m: float, z_m: float, yaw_deg: float, pitch_deg: float, roll_deg: float) -> Pose:
    """A pose of which a file keeps every digit."""
    given = x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg
    x, y, z, yaw, pitch, roll = (round(number, DECIMALS) + 0.0 for number in given)
    return Pose(x_m=x, y_m=y, z_m=z, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll)


def find_vehicle_top_m(host: HostVehicle, mount: Pose) -> float:
    """How high the vehicle's body is where a sensor is mounted. ValueError: the body is not below it."""
    below = host.skin.find_surface_point("above", (mount.x_m, mount.y_m))
    if below is None:
        raise ValueError(
            f"z_above_body_m: nothing of {host.name} is below x = {mount.x_m:.3f} m, y = {mount.y_m:.3f} m"
        )
    return float(below.position_m[2])
