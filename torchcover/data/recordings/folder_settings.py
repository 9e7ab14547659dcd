"""Where the sensors of a recording are: its `frames.yaml`."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchcover.files import parse_yaml, read_short_text, reads
from torchcover.geometry.rigid import Matrix, check_rigid

ALLOWED = "allowed are sensor, or rigs by name, and reference, each with a 4x4 vehicle_T_sensor"


class _Pose(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    vehicle_T_sensor: list[list[float]]


class _Poses(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    sensor: _Pose | None = None
    rigs: dict[str, _Pose] = Field(default_factory=dict)
    reference: _Pose | None = None


def read_poses(path: Path) -> dict[str, Matrix]:
    """Read the poses of a recording.

    Args:
        path: The YAML file, which may be missing.

    Returns:
        `sensor`, `rigs/NAME` or `reference` -> (4, 4) vehicle_T_sensor, of those that are given.

    Raises:
        BadFileError: Not such a file, or not a rigid transform; the message names file and field.
    """
    return _read(path) if path.exists() else {}


@reads("a file of poses")
def _read(path: Path) -> dict[str, Matrix]:
    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"got {type(content).__name__}, not a mapping; {ALLOWED}")
    try:
        poses = _Poses.model_validate(content)
    except ValidationError as error:
        complaints = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        raise ValueError(f"{'; '.join(complaints)}; {ALLOWED}") from error
    given = {"sensor": poses.sensor, "reference": poses.reference}
    given |= {f"rigs/{name}": pose for name, pose in poses.rigs.items()}
    return {
        name: check_rigid(pose.vehicle_T_sensor, f"{name.replace('/', '.')}.vehicle_T_sensor")
        for name, pose in given.items()
        if pose is not None
    }
