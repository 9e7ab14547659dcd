"""Free variables of a sensor in a search space, and the sensor that their values define."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, Self

from pydantic import Field, PlainValidator, model_validator

from torchcover.geometry import convert_rotation_to_euler
from torchcover.placement.host_vehicle import HostVehicle
from torchcover.simulation import Document, Lidar, Pose, Sensor
from torchcover.simulation.documents import FARTHEST_M, NameOrFile

POSITION_KEYS = ("x_m", "y_m", "z_m")
ANGLE_KEYS = ("yaw_deg", "pitch_deg", "roll_deg")
DECIMALS = 6  # of values in files: micrometers and millionths of a degree
DEFAULT_HEIGHT_M = 0.1  # typical height of a LiDAR's optical center above its foot

VariableValue = float | str | bool


class FreeNumber(NamedTuple):
    """Free number with its bounds.

    Args:
        name: Sensor and key, as "roof.pitch_deg".
        low: Smallest value.
        high: Largest value.
    """

    name: str
    low: float
    high: float

    def get_value(self, fraction: float) -> float:
        """Return the value at a fraction of the range.

        Args:
            fraction: 0 for `low`, 1 for `high`.
        """
        return self.round_value(self.low + fraction * (self.high - self.low))

    def round_value(self, value: VariableValue) -> float:
        """Round a value to the decimals that files store, and clip it to the bounds.

        Args:
            value: The value.
        """
        return min(max(round(float(value), DECIMALS), self.low), self.high)

    def check(self, value: object) -> None:
        """Check that a value is allowed.

        Args:
            value: The value.

        Raises:
            ValueError: The value is not a number within the bounds.
        """
        if not self.is_allowed(value):
            raise ValueError(f"{self.name}: got {value!r}; give a number from {self.low:g} to {self.high:g}")

    def is_allowed(self, value: object) -> bool:
        """Return whether a value is a number within the bounds.

        Args:
            value: The value.
        """
        return isinstance(value, int | float) and not isinstance(value, bool) and self.low <= value <= self.high


class FreeChoice(NamedTuple):
    """Free choice among options.

    Args:
        name: Sensor and key, as "roof.model".
        options: All options.
    """

    name: str
    options: tuple[VariableValue, ...]

    def get_value(self, fraction: float) -> VariableValue:
        """Return the option at a fraction of all options.

        Args:
            fraction: 0 for the first option, 1 for the last.
        """
        return self.options[min(int(fraction * len(self.options)), len(self.options) - 1)]

    def round_value(self, value: VariableValue) -> VariableValue:
        """Return the option unchanged.

        Args:
            value: The option.
        """
        return value

    def check(self, value: object) -> None:
        """Check that a value is allowed.

        Args:
            value: The value.

        Raises:
            ValueError: The value is not one of the options.
        """
        if not self.is_allowed(value):
            raise ValueError(f"{self.name}: got {value!r}; give one of {', '.join(map(str, self.options))}")

    def is_allowed(self, value: object) -> bool:
        """Return whether a value is one of the options.

        Args:
            value: The value.
        """
        return any(value == option and type(value) is type(option) for option in self.options)


Variable = FreeNumber | FreeChoice


def _create_range_validator(low: float, high: float) -> PlainValidator:
    """Create the validator of a number, or of the smallest and largest value of a free number, within limits."""

    def validate(value: Any) -> float | tuple[float, float]:  # noqa: ANN401  (any content of a YAML file)
        bounds = value if isinstance(value, tuple) else (value, value)
        is_number = [isinstance(bound, int | float) and not isinstance(bound, bool) for bound in bounds]
        if len(bounds) != 2 or not all(is_number):
            raise ValueError(f"got {value!r}; give a number, or [smallest, largest] of a free number")
        if not all(math.isfinite(bound) and low <= bound <= high for bound in bounds):
            raise ValueError(f"got {value!r}; give values from {low:g} to {high:g}")
        if not isinstance(value, tuple):
            return float(value)
        if not bounds[0] < bounds[1]:
            raise ValueError(f"got {value!r}; the first value must be below the second")
        return float(bounds[0]), float(bounds[1])

    return PlainValidator(validate)


NumberOrRange = float | tuple[float, float]
Meters = Annotated[NumberOrRange, _create_range_validator(-FARTHEST_M, FARTHEST_M)]
Degrees = Annotated[NumberOrRange, _create_range_validator(-360.0, 360.0)]
Share = Annotated[NumberOrRange, _create_range_validator(0.0, 1.0)]
Height = Annotated[NumberOrRange, _create_range_validator(0.001, 10.0)]


class FreeSensor(Document):
    """Free variables of a sensor: a number is fixed, `[smallest, largest]` is a free number, a list is a free choice.

    Everything that is not named stays as in the start of the search. On a mount region, a sensor lies on the skin of
    the vehicle, level, with the heading of the region, unless its angles are given.

    Args:
        x_m: Position forward.
        y_m: Position to the left.
        z_m: Height above the ground.
        z_above_body_m: Height above the vehicle's body at x and y; instead of `z_m`.
        yaw_deg: Yaw, positive to the left; on a region relative to its heading.
        pitch_deg: Pitch, positive nose down; 0 is level.
        roll_deg: Roll, positive right side down; 0 is level.
        region: Mount region of the vehicle, or several to choose from.
        u: Position in the region along the first of its axes in the order x, y, z, from 0 to 1; free by default.
        v: Position along the second axis, from 0 to 1; free by default.
        height_m: Height above the skin along its normal; 0.1 by default.
        model: LiDAR models to choose from; each has its own scan pattern.
        present: `[true, false]` makes it free whether the sensor exists.
        mirror_of: Name of the free sensor that this one mirrors: y, yaw and roll change sign; model and presence are
            the same.

    Example:
        >>> [variable.name for variable in FreeSensor(x_m=(0.0, 1.0), pitch_deg=(-10.0, 10.0)).list_variables("roof")]
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
        """Check that the keys of a free sensor agree with each other."""
        keys = list(self._get_given_values())
        if self.mirror_of is not None and keys != ["mirror_of"]:
            raise ValueError(f"mirror_of: a mirror image has no other keys; remove {', '.join(keys[:-1])}")
        if not keys:
            raise ValueError("nothing is free: give a range or a choice, or remove the sensor")
        region_keys, position_keys = ("u", "v", "height_m"), (*POSITION_KEYS, "z_above_body_m")
        unused = [key for key in keys if key in (position_keys if self.region is not None else region_keys)]
        if unused:
            reason = "a region defines the position" if self.region is not None else "there is no region"
            raise ValueError(f"{', '.join(unused)}: {reason}; give a region, or x_m, y_m and z_m or z_above_body_m")
        if self.z_m is not None and self.z_above_body_m is not None:
            raise ValueError("z_m, z_above_body_m: got both; give one of them")
        if self.present is not None and sorted(self.present) != [False, True]:
            raise ValueError(f"present: got {list(self.present)}; give [true, false]")
        for key in ("model", "region"):
            options = getattr(self, key)
            if isinstance(options, tuple) and len(set(options)) != max(len(options), 2):
                raise ValueError(f"{key}: got {', '.join(options)}; give at least two different options")
        return self

    def list_variables(self, sensor_name: str) -> tuple[Variable, ...]:
        """List the free variables.

        Args:
            sensor_name: Name of the sensor, the prefix of the variables.
        """
        variables: list[Variable] = []
        for key, value in self._get_values().items():
            if key in ("present", "model") or (key == "region" and isinstance(value, tuple)):
                variables.append(FreeChoice(f"{sensor_name}.{key}", value))
            elif isinstance(value, tuple):
                variables.append(FreeNumber(f"{sensor_name}.{key}", *value))
        return tuple(variables)

    def _get_given_values(self) -> dict[str, Any]:
        """Return the keys of the file with their values."""
        return {key: getattr(self, key) for key in type(self).model_fields if getattr(self, key) is not None}

    def _get_values(self) -> dict[str, Any]:
        """Return the keys with their values, and on a region the defaults of the others."""
        values = self._get_given_values()
        if self.region is None:
            return values
        defaults: dict[str, Any] = {"u": (0.0, 1.0), "v": (0.0, 1.0), "height_m": DEFAULT_HEIGHT_M}
        return defaults | dict.fromkeys(ANGLE_KEYS, 0.0) | values

    def build_sensor(
        self, start_sensor: Sensor, values: Mapping[str, VariableValue], host: HostVehicle
    ) -> Sensor | None:
        """Build the sensor that values of the variables define.

        Args:
            start_sensor: The sensor in the start of the search.
            values: Values by the names of `list_variables`.
            host: The host vehicle.

        Returns:
            The sensor; None if the values exclude it.

        Raises:
            ValueError: The vehicle's body is not at the position.
        """
        sensor_values = {
            key: values.get(f"{start_sensor.name}.{key}", value) for key, value in self._get_values().items()
        }
        if sensor_values.get("present") is False:
            return None
        try:
            mount = self._build_mount(start_sensor.mount, sensor_values, host)
        except ValueError as error:
            raise ValueError(f"{start_sensor.name}: {error}") from error
        start_model = getattr(start_sensor, "model", None)
        if sensor_values.get("model", start_model) != start_model:
            return Lidar.model_validate({"name": start_sensor.name, "mount": mount, "model": sensor_values["model"]})
        assert isinstance(start_sensor, Document)  # all sensors of a rig are documents
        return start_sensor.model_copy(update={"mount": mount})

    def _build_mount(self, start: Pose, values: Mapping[str, Any], host: HostVehicle) -> Pose:
        """Build the mount from values, on a mount region or in the vehicle frame."""
        if self.region is None:
            mount = update_pose(start, {key: values[key] for key in (*POSITION_KEYS, *ANGLE_KEYS) if key in values})
            if "z_above_body_m" in values:
                mount = update_pose(mount, {"z_m": find_vehicle_top_m(host, mount) + values["z_above_body_m"]})
            return mount
        region = host.get_mount_region(values["region"])
        point = region.find_mount_point(host.skin, values["u"], values["v"])
        x_m, y_m, z_m = (point.position_m + values["height_m"] * point.normal).tolist()
        yaw_deg = region.heading_deg + values["yaw_deg"]
        return build_pose(x_m, y_m, z_m, yaw_deg, values["pitch_deg"], values["roll_deg"])

    def get_start_values(self, start_sensor: Sensor, host: HostVehicle) -> dict[str, VariableValue]:
        """Return the values of the variables in the start of the search, also those that are not allowed.

        Args:
            start_sensor: The sensor in the start.
            host: The host vehicle.

        Returns:
            Values by variable; those on a mount region are missing, since the start need not lie on one.
        """
        start_values: dict[str, VariableValue] = {"present": True}
        if isinstance(start_sensor, Lidar) and start_sensor.model is not None:
            start_values["model"] = start_sensor.model
        if self.region is None:
            start_values |= get_pose_values(start_sensor.mount)
            if self.z_above_body_m is not None:
                height_m = start_sensor.mount.z_m - find_vehicle_top_m(host, start_sensor.mount)
                start_values["z_above_body_m"] = round(height_m, DECIMALS)
        named_values = {f"{start_sensor.name}.{key}": value for key, value in start_values.items()}
        free_names = {variable.name for variable in self.list_variables(start_sensor.name)}
        return {name: named_values[name] for name in named_values if name in free_names}


def mirror_sensor(target_sensor: Sensor, source_sensor: Sensor | None) -> Sensor | None:
    """Mirror a sensor at the plane y = 0.

    Args:
        target_sensor: Sensor that gives the name.
        source_sensor: Sensor that gives everything else.

    Returns:
        The mirror image; None if there is no source.
    """
    if source_sensor is None:
        return None
    values = get_pose_values(source_sensor.mount)
    for key in ("y_m", "yaw_deg", "roll_deg"):
        values[key] = -values[key]
    assert isinstance(source_sensor, Document)  # all sensors of a rig are documents
    return source_sensor.model_copy(update={"name": target_sensor.name, "mount": build_pose(*values.values())})


def update_pose(pose: Pose, values: Mapping[str, float]) -> Pose:
    """Replace values of a pose; a quaternion is preserved as long as no angle is replaced.

    Args:
        pose: The pose.
        values: New values by key, such as `x_m` or `yaw_deg`.
    """
    if not values:
        return pose
    if pose.quaternion_wxyz is None or any(key in values for key in ANGLE_KEYS):
        return build_pose(*(get_pose_values(pose) | dict(values)).values())
    return Pose.model_validate(pose.model_dump() | dict(values))


def get_pose_values(pose: Pose) -> dict[str, float]:
    """Return position and angles of a pose by key, in the order of `Pose`.

    Args:
        pose: The pose, in meters and degrees.
    """
    if pose.quaternion_wxyz is None:
        angles_deg = (pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
    else:
        angles_deg = tuple(convert_rotation_to_euler(pose.to_matrix()[:3, :3]).round(DECIMALS).tolist())
    return dict(zip((*POSITION_KEYS, *ANGLE_KEYS), (pose.x_m, pose.y_m, pose.z_m, *angles_deg), strict=True))


def build_pose(x_m: float, y_m: float, z_m: float, yaw_deg: float, pitch_deg: float, roll_deg: float) -> Pose:
    """Build a pose whose values are rounded to the decimals that files store.

    Args:
        x_m: Position forward.
        y_m: Position to the left.
        z_m: Height above the ground.
        yaw_deg: Yaw, positive to the left.
        pitch_deg: Pitch, positive nose down.
        roll_deg: Roll, positive right side down.
    """
    values = (x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg)
    rounded = [round(value, DECIMALS) + 0.0 for value in values]  # + 0.0 turns -0.0 into 0.0
    return Pose.model_validate(dict(zip((*POSITION_KEYS, *ANGLE_KEYS), rounded, strict=True)))


def find_vehicle_top_m(host: HostVehicle, mount: Pose) -> float:
    """Return the height of the vehicle's body at the x and y of a mount.

    Args:
        host: The host vehicle.
        mount: Pose of a sensor.

    Raises:
        ValueError: The body is not at this x and y.
    """
    below = host.skin.find_surface_point("above", (mount.x_m, mount.y_m))
    if below is None:
        raise ValueError(f"z_above_body_m: {host.name} has no body at x = {mount.x_m:.3f} m, y = {mount.y_m:.3f} m")
    return float(below.position_m[2])
