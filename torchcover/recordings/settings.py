"""How to read a recording that says too little of itself, or says it wrongly: `recording.yaml` and `--set`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

if TYPE_CHECKING:
    from torchcover.geometry.rigid import Matrix

SETTINGS_FILE = "recording.yaml"


class Mount(BaseModel):
    """Pose of a sensor in the vehicle frame, as `vehicle_T_sensor`; positive pitch turns the nose down."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def to_matrix(self) -> "Matrix":
        """The (4, 4) transform."""
        from torchcover.geometry import build_transform, convert_euler_to_rotation  # `--help` needs no NumPy
        from torchcover.geometry.rigid import warn_about_radians

        warn_about_radians({name: getattr(self, name) for name in ("yaw_deg", "pitch_deg", "roll_deg")})
        rotation = convert_euler_to_rotation(self.yaw_deg, self.pitch_deg, self.roll_deg)
        return build_transform(rotation, (self.x_m, self.y_m, self.z_m))


class RecordingSettings(BaseModel):
    """Settings of a recording; what is wrong about a recording is corrected only if a user asks for it.

    Raises:
        ValidationError: A value of a wrong type, or a time offset of more than a second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    format: str | None = Field(None, description="Format of the recording, if it is not recognized.")
    vehicle_frame: str | None = Field(
        None, description="Of a bag: the frame of the vehicle. Not given: base_footprint, else base_link."
    )
    mounts: dict[str, Mount] = Field(
        {}, description="Of a bag: name of a sensor -> its pose on the vehicle, {x_m, y_m, z_m, yaw_deg, ...}."
    )
    point_times: Literal["s", "ms", "us", "ns", "turn", "none"] | None = Field(
        None,
        description="Of a bag: unit of the times of points, or turn for shares of the scan period, or none to ignore "
        "them. Not given: the unit that fits the time between scans.",
    )
    units: Literal["m", "cm", "mm", "ft"] = Field("m", description="Unit of the coordinates of its clouds.")
    axes: Literal["xyz", "yxz"] = Field("xyz", description="Order of the columns of its clouds.")
    quaternions: Literal["wxyz", "xyzw"] = Field("wxyz", description="Order of the numbers of its rotations.")
    poses: Literal["given", "inverse", "yx", "held"] = Field(
        "given",
        description="Its poses are world_T_vehicle (given), vehicle_T_world (inverse), have x and y exchanged (yx), or "
        "are each repeated until the next one (held: they are interpolated).",
    )
    time_offset_s: float = Field(0.0, description="Seconds by which its poses are late.")
    window_s: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Seconds over which `reference: accumulated` adds up the scans of all sensors (2)."
    )

    @field_validator("time_offset_s")
    @classmethod
    def _check_lag(cls, lag_s: float) -> float:
        # The two nearest poses are extrapolated before the first and after the last, which a second allows.
        if abs(lag_s) > 1.0:
            raise ValueError(f"at most 1 s of time offset is corrected; got {lag_s:g}; correct the times instead")
        return lag_s

    @property
    def corrections(self) -> dict[str, Any]:
        """Name -> value of the settings that change points, poses or times."""
        names = ("units", "axes", "quaternions", "poses", "time_offset_s")
        return {
            name: getattr(self, name) for name in names if getattr(self, name) != type(self).model_fields[name].default
        }

    @property
    def command_line_options(self) -> str:
        """The corrections as options of the command line; empty if there are none.

        Example:
            >>> RecordingSettings(units="mm", time_offset_s=0.1).command_line_options
            '--set recording.units=mm --set recording.time_offset_s=0.1'
        """
        return " ".join(f"--set recording.{name}={value}" for name, value in self.corrections.items())


def merge_recording_settings(recording: Path, settings: RecordingSettings | None = None) -> RecordingSettings:
    """Merge `recording.yaml` in the folder of a recording with settings that a user gives, which win.

    Raises:
        BadFileError: Not YAML, or a key or value that is no setting; the message names the file and the key.
    """
    from torchcover.files import guard_reader  # loads NumPy, which `--help` does without

    path = recording / SETTINGS_FILE
    content = guard_reader("settings of a recording")(_read)(path) if path.is_file() else {}
    given = {} if settings is None else settings.model_dump(exclude_unset=True)
    return RecordingSettings.model_validate({**content, **given})


def _read(path: Path) -> dict[str, Any]:
    from torchcover.files import parse_yaml, read_short_text

    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of keys is needed; got {type(content).__name__}")
    try:
        RecordingSettings.model_validate(content)
    except ValidationError as error:
        raise ValueError("; ".join(explain_validation_error(error))) from error
    return content


def explain_validation_error(error: ValidationError) -> Iterator[str]:
    """Yield a sentence for each mistake that pydantic found: the key, what is wrong, what arrived."""
    for detail in error.errors(include_url=False):
        key = ".".join(str(part) for part in detail["loc"])
        if detail["type"] == "extra_forbidden":
            yield f"{key}: unknown key"
        elif detail["type"] == "value_error":
            yield f"{key}: {detail['msg'].removeprefix('Value error, ')}"
        else:
            expected = detail["msg"].removeprefix("Input should be ").replace("tuple", "list")
            yield f"{key}: {expected} is needed; got {detail['input']!r:.60}"
