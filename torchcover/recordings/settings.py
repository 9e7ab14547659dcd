"""Settings for recordings with missing or wrong metadata: `recording.yaml` and `--set recording.KEY=VALUE`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

if TYPE_CHECKING:
    from torchcover.geometry.rigid import Matrix

SETTINGS_FILE = "recording.yaml"


class Mount(BaseModel):
    """Extrinsics of a sensor in the vehicle frame (x forward, y left, z up).

    Args:
        x_m: Position along x.
        y_m: Position along y.
        z_m: Height above the ground.
        yaw_deg: Rotation about z; positive turns left.
        pitch_deg: Rotation about y; positive lowers the nose.
        roll_deg: Rotation about x.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def to_matrix(self) -> "Matrix":
        """Build the (4, 4) transform `vehicle_T_sensor`; angles that look like radians cause a warning."""
        from torchcover.geometry import build_transform, convert_euler_to_rotation  # `--help` needs no NumPy
        from torchcover.geometry.rigid import warn_about_radians

        warn_about_radians({name: getattr(self, name) for name in ("yaw_deg", "pitch_deg", "roll_deg")})
        rotation = convert_euler_to_rotation(self.yaw_deg, self.pitch_deg, self.roll_deg)
        return build_transform(rotation, (self.x_m, self.y_m, self.z_m))


class RecordingSettings(BaseModel):
    """Settings of a recording; a fault of the recording is corrected only on request.

    Raises:
        ValidationError: A value has a wrong type, or the time offset exceeds one second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    format: str | None = Field(None, description="Format of the recording, if it is not recognized.")
    vehicle_frame: str | None = Field(
        None, description="Frame of the vehicle in a bag. Default: base_footprint, else base_link."
    )
    mounts: dict[str, Mount] = Field(
        {}, description="Extrinsics of the sensors of a bag by name: {x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg}."
    )
    point_time_unit: Literal["s", "ms", "us", "ns", "scan_share", "none"] | None = Field(
        None,
        description="Unit of the point times of a bag; scan_share: shares of the scan period; none: ignore them. "
        "Default: the unit that fits the time between scans.",
    )
    units: Literal["m", "cm", "mm", "ft"] = Field("m", description="Unit of the coordinates of the clouds.")
    axis_order: Literal["xyz", "yxz"] = Field("xyz", description="Order of the columns of the clouds.")
    quaternion_order: Literal["wxyz", "xyzw"] = Field("wxyz", description="Order of the numbers of quaternions.")
    pose_convention: Literal["world_T_vehicle", "vehicle_T_world", "swapped_xy"] = Field(
        "world_T_vehicle", description="Direction of the poses; swapped_xy: world_T_vehicle with x and y exchanged."
    )
    interpolate_poses: bool = Field(
        False, description="Interpolate between poses that repeat the previous one, as from a slow localization."
    )
    time_offset_s: float = Field(0.0, description="Delay of the poses in seconds.")
    window_s: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Accumulation window in seconds of `reference: accumulated`. Default: 2."
    )

    @field_validator("time_offset_s")
    @classmethod
    def _check_time_offset(cls, time_offset_s: float) -> float:
        """Check that the time offset is at most one second."""
        # The two nearest poses are extrapolated before the first and after the last, which a second allows.
        if abs(time_offset_s) > 1.0:
            raise ValueError(
                f"at most 1 s of time offset is corrected; got {time_offset_s:g}; correct the times instead"
            )
        return time_offset_s

    @property
    def corrections(self) -> dict[str, Any]:
        """Name and value of the settings that change points, poses or times."""
        names = ("units", "axis_order", "quaternion_order", "pose_convention", "interpolate_poses", "time_offset_s")
        fields = type(self).model_fields
        return {name: getattr(self, name) for name in names if getattr(self, name) != fields[name].default}

    @property
    def command_line_options(self) -> str:
        """The corrections as options of the command line; empty if there are none.

        Example:
            >>> RecordingSettings(units="mm", interpolate_poses=True).command_line_options
            '--set recording.units=mm --set recording.interpolate_poses=true'
        """
        options = []
        for name, value in self.corrections.items():
            text = "true" if value is True else value
            options.append(f"--set recording.{name}={text}")
        return " ".join(options)


def merge_recording_settings(recording: Path, settings: RecordingSettings | None = None) -> RecordingSettings:
    """Merge `recording.yaml` in the folder of a recording with settings of the caller, which take precedence.

    Args:
        recording: Folder or file of the recording.
        settings: Settings of the caller; only values that were set explicitly count.

    Returns:
        The merged settings.

    Raises:
        BadFileError: The file is not YAML, or has an unknown key or a wrong value; the message names both.
    """
    from torchcover.files import guard_reader  # loads NumPy, which `--help` does without

    path = recording / SETTINGS_FILE
    file_values = guard_reader("settings of a recording")(_read_settings)(path) if path.is_file() else {}
    caller_values = {} if settings is None else settings.model_dump(exclude_unset=True)
    return RecordingSettings.model_validate({**file_values, **caller_values})


def _read_settings(path: Path) -> dict[str, Any]:
    """Read and validate `recording.yaml`."""
    from torchcover.files import explain_validation_error, parse_yaml, read_short_text

    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"a YAML mapping of keys is needed; got {type(content).__name__}")
    try:
        RecordingSettings.model_validate(content)
    except ValidationError as error:
        raise ValueError("; ".join(explain_validation_error(error))) from error
    return content
