"""A recording in a folder: clouds of one or several sensors or rigs, and files beside them, as `frames.yaml`."""

import os
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchcover.detection.boxes import Boxes
from torchcover.files import guard_reader, parse_yaml, read_short_text
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix, check_rigid
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.clouds.arrays import read_cloud_with_weights, read_heights
from torchcover.recordings.formats.frame_files import (
    PoseTable,
    check_same_names,
    find_frame_files,
    make_natural_sort_key,
    read_boxes,
)
from torchcover.recordings.recording import RecordingBase, Scan, check_times

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


class CloudSettings(NamedTuple):
    """How the clouds of a place are to be read."""

    vehicle_T_sensor: Matrix | None = None
    flip_y: bool = False
    min_range_m: float = 0.0


class FolderSettings(NamedTuple):
    """What the file says, by `sensor`, `sensors/NAME`, `rigs/NAME` or `reference`, where it does.

    With `has_area_weights` the reference's files have weights; `ego_box` is the vehicle itself, None if unknown.
    """

    cloud_settings: dict[str, CloudSettings]
    has_area_weights: bool = False
    ego_box: BoundingBox | None = None


def read_folder_settings(path: Path) -> FolderSettings:
    """Read the settings of a plain folder."""
    return _read(path) if path.exists() else FolderSettings({})


@guard_reader("a file of poses")
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


def _place(name: str, place: _Place) -> CloudSettings:
    pose = place.vehicle_T_sensor
    matrix = None if pose is None else check_rigid(pose, f"{name}.vehicle_T_sensor")
    return CloudSettings(matrix, place.flip_y, place.min_range_m)


def _body(vehicle: _Vehicle) -> BoundingBox:
    (x0, y0, z0), (x1, y1, z1) = vehicle.lower_m, vehicle.upper_m
    try:
        return BoundingBox((x0, y0, z0), (x1, y1, z1))
    except ValueError as error:
        raise ValueError(f"vehicle: {error}") from error


SETTINGS_FILE = "frames.yaml"
POSES_FILE = "poses.csv"
REFERENCE, BOXES = "reference", "boxes"
# What the clouds of the only rig are called.
ONLY_RIG = "recording"


class FolderRecording(RecordingBase):
    """A folder with `sensor/FRAME.*`, in natural order (frame2 before frame10), and whatever else is known.

    Several sensors of one rig have `sensors/NAME/FRAME.*` each, several rigs `rigs/NAME/FRAME.*`. Any format of
    `read_cloud` will do, and places may differ. All that follows is optional:

    * `reference/FRAME.*`, what the reference sensor saw; a `.npz` may have the array `heights_m` beside its points,
      their heights above the local ground, NaN where there is none at or below;
    * `poses.csv`, time and place of the vehicle in each frame, see `PoseTable`: `get_world_T_vehicle`;
    * `PLACE/poses.csv`, where that sensor was on the vehicle in each frame: `vehicle_T_sensor`;
    * `boxes/FRAME.csv`, the objects of each frame, see `read_boxes`;
    * `frames.yaml`. Clouds are in the vehicle frame, unless it says where their sensor is:

          sensor:                      # or sensors: {NAME: ...}, or rigs: {NAME: ...}; reference likewise
            vehicle_T_sensor:          # 4x4, metres
              - [1, 0, 0, 1.2]
              - [0, 1, 0, 0.0]
              - [0, 0, 1, 1.73]
              - [0, 0, 0, 1]
            flip_y: true               # the cloud has y to the right, as CARLA's: turned before anything else
            min_range_m: 0.5           # nearer to the sensor is no return
          reference:
            has_area_weights: true        # its files are .npz with points and weights
          vehicle:                     # what lies in it is the vehicle itself
            lower_m: [-2.4, -0.9, 0.05]
            upper_m: [2.4, 0.9, 1.6]

    Raises:
        FileNotFoundError: The folder, or clouds of a sensor in it, are missing.
        ValueError: No frames, a file that is no cloud, two files of one name, names in one place only, two of
            `sensor`, `sensors` and `rigs`, or a bad `frames.yaml` or `poses.csv`.
    """

    layout: ClassVar[str] = (
        "sensor/FRAME.*, or sensors/NAME/FRAME.* or rigs/NAME/FRAME.* for several; reference/FRAME.*"
    )

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{self.path}: no such folder; a recording holds {self.layout}")
        self._places = _places(self.path)
        self.sensors = tuple(self._places)
        several_rigs = (self.path / "rigs").is_dir()
        self.rigs = {name: (name,) for name in self.sensors} if several_rigs else {ONLY_RIG: self.sensors}
        self.reference_sensors = (REFERENCE,) if (self.path / REFERENCE).is_dir() else ()
        self._places |= {name: name for name in self.reference_sensors}
        files = {
            place: find_frame_files(self.path / place, ignored_files=(POSES_FILE,)) for place in self._places.values()
        }
        self._labelled = (self.path / BOXES).is_dir()
        boxes = {BOXES: {path.stem: path for path in (self.path / BOXES).glob("*.csv")}} if self._labelled else {}
        check_same_names(self.path, {**files, **boxes})
        self._files = files
        self.frame_names = tuple(next(iter(files.values())))
        self._settings = read_folder_settings(self.path / SETTINGS_FILE)
        self.ego_box, self.has_area_weights = self._settings.ego_box, self._settings.has_area_weights
        self._poses = self._table(self.path, timed=True)
        self.block_indices = None if self._poses is None else self._poses.block_indices
        times_s = None if self._poses is None else self._poses.times_s
        self.times_s = (
            None if times_s is None else check_times(times_s, len(self.frame_names), str(self.path / POSES_FILE))
        )
        self._moving = {place: self._table(self.path / place, timed=False) for place in files}
        self._check(self._settings)

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Whether it is a folder with clouds of a sensor, of sensors, of rigs or of a reference in it."""
        if any((path / place).is_dir() for place in ("sensors", "rigs", REFERENCE)):
            return True
        # Argoverse 2 has its logs in folders of `sensor`.
        clouds = path / "sensor"
        return clouds.is_dir() and (any(one.is_file() for one in clouds.iterdir()) or not any(clouds.iterdir()))

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read a file."""
        place = self._places[sensor]
        path = self._files[place][self.frame_names[index]]
        weights = None
        if sensor == REFERENCE and self.has_area_weights:
            points_m, weights = read_cloud_with_weights(path)
        else:
            points_m = read_cloud(path)
        heights_m = read_heights(path, len(points_m)) if sensor == REFERENCE else None
        settings, moving = self._settings.cloud_settings.get(place, CloudSettings()), self._moving[place]
        if settings.flip_y:
            points_m[:, 1] *= -1
        vehicle_T_sensor = settings.vehicle_T_sensor if moving is None else moving[index]
        return Scan(points_m, vehicle_T_sensor, str(path), settings.min_range_m, weights, heights_m)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was, if there is a `poses.csv`."""
        return None if self._poses is None else self._poses[index]

    def read_boxes(self, index: int) -> Boxes | None:
        """The objects of a frame; None without the folder."""
        return read_boxes(self.path / BOXES / f"{self.frame_names[index]}.csv") if self._labelled else None

    def _table(self, folder: Path, *, timed: bool) -> PoseTable | None:
        path = folder / POSES_FILE
        return PoseTable(path, self.frame_names, has_times=timed) if path.exists() else None

    def _check(self, settings: FolderSettings) -> None:
        file = self.path / SETTINGS_FILE
        for place, said in settings.cloud_settings.items():
            name = place.replace("/", ".")
            if place not in self._files:
                raise ValueError(f"{file}: {name}: there is no {place}/ beside it")
            moving = self._moving[place] is not None
            if moving and said.vehicle_T_sensor is not None:
                raise ValueError(f"{file}: {name}.vehicle_T_sensor: {place}/{POSES_FILE} says it too; keep one of them")
            if said.min_range_m and not moving and said.vehicle_T_sensor is None:
                raise ValueError(f"{file}: {name}.min_range_m: it needs vehicle_T_sensor, to say where the sensor is")


def _places(folder: Path) -> dict[str, str]:
    """Name of each sensor of the vehicle -> its folder within the recording; its settings are under the same path."""
    found = [kind for kind in ("sensor", "sensors", "rigs") if (folder / kind).exists()]
    if len(found) > 1:
        raise ValueError(
            f"{folder}: both {found[0]}/ and {found[1]}/; sensor/ is for one sensor, sensors/NAME/ for several of one "
            "rig, rigs/NAME/ for several rigs"
        )
    if not found or found == ["sensor"]:
        return {"sensor": "sensor"}
    (kind,) = found
    names = [path.name for path in (folder / kind).iterdir() if not path.name.startswith(".")]
    if not names or REFERENCE in names:
        wrong = f"a {kind[:-1]} called reference" if names else f"no {kind[:-1]}"
        raise ValueError(f"{folder / kind}: {wrong}; each has a folder {kind}/NAME/ of its own")
    return {name: f"{kind}/{name}" for name in sorted(names, key=make_natural_sort_key)}
