"""What `frames.yaml` says of a plain folder: where its sensors are, and how large the vehicle is."""

from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchcover.files import parse_yaml, read_short_text, reads
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix, check_rigid

ALLOWED = (
    "allowed are sensor, or sensors or rigs by name, and reference, each with a 4x4 vehicle_T_sensor, flip_y and "
    "min_range_m, for the reference also square_metres (true or false); and vehicle with lower_m and upper_m"
)


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _Place(_Strict):
    vehicle_T_sensor: list[list[float]] | None = None
    flip_y: bool = False
    min_range_m: Annotated[float, Field(ge=0)] = 0.0


class _Reference(_Place):
    square_metres: bool = False


Corner = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Vehicle(_Strict):
    lower_m: Corner
    upper_m: Corner


class _Settings(_Strict):
    sensor: _Place | None = None
    sensors: dict[str, _Place] = Field(default_factory=dict)
    rigs: dict[str, _Place] = Field(default_factory=dict)
    reference: _Reference | None = None
    vehicle: _Vehicle | None = None


class PlaceSettings(NamedTuple):
    """How the clouds of a place are to be read."""

    vehicle_T_sensor: Matrix | None = None
    flip_y: bool = False
    min_range_m: float = 0.0


class FolderSettings(NamedTuple):
    """What the file says, by `sensor`, `sensors/NAME`, `rigs/NAME` or `reference`, where it does.

    With `square_metres` the reference's files have weights; `body` is the vehicle itself, None if unknown.
    """

    places: dict[str, PlaceSettings]
    square_metres: bool = False
    body: BoundingBox | None = None


def read_folder_settings(path: Path) -> FolderSettings:
    """Read the settings of a plain folder."""
    return _read(path) if path.exists() else FolderSettings({})


@reads("a file of poses")
def _read(path: Path) -> FolderSettings:
    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"got {type(content).__name__}, not a mapping; {ALLOWED}")
    try:
        settings = _Settings.model_validate(content)
    except ValidationError as error:
        complaints = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        raise ValueError(f"{'; '.join(complaints)}; {ALLOWED}") from error
    given: dict[str, _Place | None] = {"sensor": settings.sensor, "reference": settings.reference}
    given |= {f"sensors/{name}": place for name, place in settings.sensors.items()}
    given |= {f"rigs/{name}": place for name, place in settings.rigs.items()}
    return FolderSettings(
        {name: _place(name.replace("/", "."), place) for name, place in given.items() if place is not None},
        settings.reference is not None and settings.reference.square_metres,
        None if settings.vehicle is None else _body(settings.vehicle),
    )


def _place(name: str, place: _Place) -> PlaceSettings:
    pose = place.vehicle_T_sensor
    matrix = None if pose is None else check_rigid(pose, f"{name}.vehicle_T_sensor")
    return PlaceSettings(matrix, place.flip_y, place.min_range_m)


def _body(vehicle: _Vehicle) -> BoundingBox:
    (x0, y0, z0), (x1, y1, z1) = vehicle.lower_m, vehicle.upper_m
    try:
        return BoundingBox((x0, y0, z0), (x1, y1, z1))
    except ValueError as error:
        raise ValueError(f"vehicle: {error}") from error
