"""Plain folder format: clouds of one or several sensors or rigs, with optional poses, boxes and `frames.yaml`."""

import os
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from torchcover.detection.boxes import Boxes
from torchcover.files import explain_validation_error, guard_reader, parse_yaml, read_short_text
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix, check_rigid
from torchcover.recordings.clouds import read_cloud
from torchcover.recordings.clouds.arrays import read_cloud_with_weights, read_heights
from torchcover.recordings.formats.frame_files import (
    BOX_FOLDER,
    PoseTable,
    check_frames_with_boxes,
    find_frame_files,
    make_natural_sort_key,
    read_boxes,
)
from torchcover.recordings.recording import Recording, Scan, check_times

# Files and folders of a recording next to its clouds.
SETTINGS_FILE = "frames.yaml"
POSES_FILE = "poses.csv"
REFERENCE = "reference"


class _StrictModel(BaseModel):
    """Section of `frames.yaml` without unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class _SensorEntry(_StrictModel):
    """Entry of a sensor or rig.

    Args:
        vehicle_T_sensor: (4, 4) extrinsics; None if the clouds are in the vehicle frame.
        flip_y: True if y points to the right, as in CARLA.
        min_range_m: Points closer to the sensor are missing returns.
    """

    vehicle_T_sensor: list[list[float]] | None = None
    flip_y: bool = False
    min_range_m: Annotated[float, Field(ge=0)] = 0.0


class _ReferenceEntry(_SensorEntry):
    """Entry of the reference."""

    area_weights: bool = False


Corner = Annotated[list[float], Field(min_length=3, max_length=3)]


class _VehicleEntry(_StrictModel):
    """Entry of the bounding box of the ego vehicle."""

    lower_m: Corner
    upper_m: Corner


class _SettingsFile(_StrictModel):
    """Top level of `frames.yaml`."""

    sensor: _SensorEntry | None = None
    sensors: dict[str, _SensorEntry] = Field(default_factory=dict)
    rigs: dict[str, _SensorEntry] = Field(default_factory=dict)
    reference: _ReferenceEntry | None = None
    vehicle: _VehicleEntry | None = None


class FolderSettings(NamedTuple):
    """Content of `frames.yaml`.

    Args:
        entries: Entries by folder: `sensor`, `sensors/NAME`, `rigs/NAME` or `reference`.
        extrinsics: (4, 4) `vehicle_T_sensor` by folder, if it is given.
        has_area_weights: True if the files of the reference have weights.
        ego_box: Bounding box of the ego vehicle; None if unknown.
    """

    entries: dict[str, _SensorEntry]
    extrinsics: dict[str, Matrix]
    has_area_weights: bool = False
    ego_box: BoundingBox | None = None


def read_folder_settings(path: Path) -> FolderSettings:
    """Read the settings of a plain folder.

    Args:
        path: `frames.yaml` of the recording; it may be missing.

    Returns:
        The settings, or defaults without the file.

    Raises:
        BadFileError: Keys are unknown, or values are invalid.
    """
    return _read_settings_file(path) if path.exists() else FolderSettings({}, {})


@guard_reader("a file of poses")
def _read_settings_file(path: Path) -> FolderSettings:
    """Read an existing `frames.yaml`."""
    allowed = (
        "allowed are sensor, or sensors or rigs by name, and reference, each with a 4x4 vehicle_T_sensor, flip_y and "
        "min_range_m, for the reference also area_weights (true or false); and vehicle with lower_m and upper_m"
    )
    content = parse_yaml(read_short_text(path))
    if not isinstance(content, dict):
        raise ValueError(f"got {type(content).__name__}, not a mapping; {allowed}")
    try:
        settings = _SettingsFile.model_validate(content)
    except ValidationError as error:
        raise ValueError(f"{'; '.join(explain_validation_error(error))}; {allowed}") from error
    entries: dict[str, _SensorEntry] = {}
    if settings.sensor is not None:
        entries["sensor"] = settings.sensor
    if settings.reference is not None:
        entries[REFERENCE] = settings.reference
    entries |= {f"sensors/{name}": entry for name, entry in settings.sensors.items()}
    entries |= {f"rigs/{name}": entry for name, entry in settings.rigs.items()}
    extrinsics = {}
    for folder, entry in entries.items():
        if entry.vehicle_T_sensor is not None:
            key = f"{folder.replace('/', '.')}.vehicle_T_sensor"
            extrinsics[folder] = check_rigid(entry.vehicle_T_sensor, key)
    ego_box = None
    if settings.vehicle is not None:
        (x0, y0, z0), (x1, y1, z1) = settings.vehicle.lower_m, settings.vehicle.upper_m
        try:
            ego_box = BoundingBox((x0, y0, z0), (x1, y1, z1))
        except ValueError as error:
            raise ValueError(f"vehicle: {error}") from error
    has_area_weights = settings.reference is not None and settings.reference.area_weights
    return FolderSettings(entries, extrinsics, has_area_weights, ego_box)


class FolderRecording(Recording):
    """Folder with `sensor/FRAME.*` in natural order (frame2 before frame10) and optional files.

    Several sensors of one rig are in `sensors/NAME/FRAME.*`, several rigs in `rigs/NAME/FRAME.*`. Clouds have any
    format of `read_cloud`, which may differ between folders. Optional are:

    * `reference/FRAME.*`, the points of the reference sensor; a `.npz` may have the array `heights_m` with heights
      above the local ground, NaN where there is no ground;
    * `poses.csv`, time and pose of the vehicle in each frame, see `PoseTable`;
    * `FOLDER/poses.csv` next to the clouds of a sensor, its extrinsics in each frame;
    * `boxes/FRAME.csv`, the objects of each frame, see `read_boxes`;
    * `frames.yaml`. Clouds are in the vehicle frame unless it gives extrinsics:

          sensor:                      # or sensors: {NAME: ...}, or rigs: {NAME: ...}; reference likewise
            vehicle_T_sensor:          # 4x4, meters
              - [1, 0, 0, 1.2]
              - [0, 1, 0, 0.0]
              - [0, 0, 1, 1.73]
              - [0, 0, 0, 1]
            flip_y: true               # y of the cloud points right, as in CARLA; flipped before anything else
            min_range_m: 0.5           # closer points are missing returns
          reference:
            area_weights: true         # its files are .npz with points and weights
          vehicle:                     # points inside belong to the ego vehicle
            lower_m: [-2.4, -0.9, 0.05]
            upper_m: [2.4, 0.9, 1.6]

    Args:
        path: Folder.

    Raises:
        FileNotFoundError: The folder, or the clouds of a sensor, are missing.
        ValueError: There are no frames, a file is no cloud, frames differ between folders, two of `sensor`, `sensors`
            and `rigs` exist, or `frames.yaml` or `poses.csv` is invalid.
    """

    layout: ClassVar[str] = (
        "sensor/FRAME.*, or sensors/NAME/FRAME.* or rigs/NAME/FRAME.* for several; reference/FRAME.*"
    )

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{self.path}: no such folder; a recording holds {self.layout}")
        self._folders = _find_sensor_folders(self.path)
        self.sensors = tuple(self._folders)
        has_rigs = (self.path / "rigs").is_dir()
        self.rigs = {name: (name,) for name in self.sensors} if has_rigs else {"recording": self.sensors}
        self.reference_sensors = (REFERENCE,) if (self.path / REFERENCE).is_dir() else ()
        self._folders |= {name: name for name in self.reference_sensors}
        self._files = {}
        for folder in self._folders.values():
            self._files[folder] = find_frame_files(self.path / folder, ignored_files=(POSES_FILE,))
        self._has_boxes = check_frames_with_boxes(self.path, self._files)
        self.frame_names = tuple(next(iter(self._files.values())))
        self._settings = read_folder_settings(self.path / SETTINGS_FILE)
        self.ego_box = self._settings.ego_box
        self.has_area_weights = self._settings.has_area_weights
        self._poses = self._read_poses(self.path, has_times=True)
        self.block_indices = None if self._poses is None else self._poses.block_indices
        self.times_s = None
        if self._poses is not None and self._poses.times_s is not None:
            self.times_s = check_times(self._poses.times_s, len(self.frame_names), str(self.path / POSES_FILE))
        self._extrinsics = {folder: self._read_poses(self.path / folder, has_times=False) for folder in self._files}
        self._check_settings()

    @classmethod
    def can_read(cls, path: Path) -> bool:
        """Test whether a path is a folder with clouds of sensors, rigs or a reference.

        Args:
            path: Existing path.
        """
        if any((path / folder).is_dir() for folder in ("sensors", "rigs", REFERENCE)):
            return True
        # The folder `sensor` of Argoverse 2 holds folders of logs instead of files.
        clouds = path / "sensor"
        if not clouds.is_dir():
            return False
        entries = list(clouds.iterdir())
        return not entries or any(entry.is_file() for entry in entries)

    def read_scan(self, sensor: str, index: int) -> Scan:
        """Read the cloud of a sensor in a frame.

        Args:
            sensor: Name of the sensor.
            index: Index of the frame.

        Returns:
            The scan; scans of the reference have weights and heights if the files do.
        """
        folder = self._folders[sensor]
        path = self._files[folder][self.frame_names[index]]
        weights = None
        if sensor == REFERENCE and self.has_area_weights:
            points_m, weights = read_cloud_with_weights(path)
        else:
            points_m = read_cloud(path)
        heights_m = read_heights(path, len(points_m)) if sensor == REFERENCE else None
        entry = self._settings.entries.get(folder, _SensorEntry())
        if entry.flip_y:
            points_m[:, 1] *= -1
        extrinsics = self._extrinsics[folder]
        vehicle_T_sensor = self._settings.extrinsics.get(folder) if extrinsics is None else extrinsics[index]
        return Scan(points_m, vehicle_T_sensor, str(path), entry.min_range_m, weights, heights_m)

    def get_world_T_vehicle(self, index: int) -> Matrix | None:
        """Return the (4, 4) pose of the vehicle in a frame; None without `poses.csv`."""
        return None if self._poses is None else self._poses[index]

    def read_boxes(self, index: int) -> Boxes | None:
        """Read the objects of a frame; None without the folder `boxes`."""
        return read_boxes(self.path / BOX_FOLDER / f"{self.frame_names[index]}.csv") if self._has_boxes else None

    def _read_poses(self, folder: Path, *, has_times: bool) -> PoseTable | None:
        """Read the table of poses in a folder; None if there is none."""
        path = folder / POSES_FILE
        return PoseTable(path, self.frame_names, has_times=has_times) if path.exists() else None

    def _check_settings(self) -> None:
        """Check that entries have folders, and that extrinsics are given once."""
        file = self.path / SETTINGS_FILE
        for folder, entry in self._settings.entries.items():
            key = folder.replace("/", ".")
            if folder not in self._files:
                raise ValueError(f"{file}: {key}: the folder {folder}/ does not exist in the recording")
            has_table = self._extrinsics[folder] is not None
            has_matrix = entry.vehicle_T_sensor is not None
            if has_table and has_matrix:
                raise ValueError(f"{file}: {key}.vehicle_T_sensor: {folder}/{POSES_FILE} has it too; keep one of them")
            if entry.min_range_m and not has_table and not has_matrix:
                raise ValueError(f"{file}: {key}.min_range_m: it needs vehicle_T_sensor, the pose of the sensor")


def _find_sensor_folders(folder: Path) -> dict[str, str]:
    """Find the folder of each sensor on the vehicle, relative to the recording."""
    kinds = [kind for kind in ("sensor", "sensors", "rigs") if (folder / kind).exists()]
    if len(kinds) > 1:
        raise ValueError(
            f"{folder}: both {kinds[0]}/ and {kinds[1]}/; sensor/ is for one sensor, sensors/NAME/ for several of one "
            "rig, rigs/NAME/ for several rigs"
        )
    if not kinds or kinds == ["sensor"]:
        return {"sensor": "sensor"}
    (kind,) = kinds
    names = [path.name for path in (folder / kind).iterdir() if not path.name.startswith(".")]
    if not names or REFERENCE in names:
        fault = f"a {kind[:-1]} called reference" if names else f"no {kind[:-1]}"
        raise ValueError(f"{folder / kind}: {fault}; each has a folder {kind}/NAME/ of its own")
    return {name: f"{kind}/{name}" for name in sorted(names, key=make_natural_sort_key)}
