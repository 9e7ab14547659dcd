"""LiDARs of CARLA (Dosovitskiy et al., CoRL 2017), as `save_to_disk` writes them."""

import os
import warnings
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from torchcover.data.clouds import read_cloud
from torchcover.data.recordings.csv_tables import read_csv
from torchcover.data.recordings.file_names import check_frames, check_same_names, frame_files
from torchcover.data.recordings.recording import Scan, check_times
from torchcover.files import naming, parse_yaml, read_short_text, reads
from torchcover.geometry import rigid, rotation_from_euler
from torchcover.geometry.rigid import Matrix

SENSORS_FILES = ("sensors.json", "sensors.yaml")
POSES_FILE, REFERENCE = "poses.csv", "reference"
LIDARS = ("sensor.lidar.ray_cast", "sensor.lidar.ray_cast_semantic")
WHOLE_TURN = 0.99
POSE = ("x", "y", "z", "roll", "pitch", "yaw")


class CarlaSensor(BaseModel):
    """A sensor as an agent of CARLA's leaderboard lists it in `sensors()`: metres and degrees in CARLA's axes."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    id: Annotated[str, Field(pattern=r"^[^./\\][^/\\]*$")]
    type: str
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    rotation_frequency: float | None = None


class Carla:
    """A folder with `sensors.json` and `ID/FRAME.ply` (or `.npy`) of each LiDAR in it, in CARLA's left-handed axes.

    `sensors.json` (or `.yaml`) is the list that an agent of CARLA's leaderboard returns: `id`, `type`, `x`, `y`, `z`,
    `roll`, `pitch`, `yaw` of each sensor on its vehicle, and any attributes of its blueprint; what is no LiDAR is left
    out. A LiDAR whose `id` is `reference` is the reference. Optional, with the columns `frame, x, y, z, roll, pitch,
    yaw`: `ID/poses.csv` where a sensor was on the vehicle in each frame, and `poses.csv`, also with `time_s`, where the
    vehicle was. Parts of a turn are not joined.

    Args:
        path: The folder.

    Raises:
        FileNotFoundError: No `sensors.json`, or no clouds of a LiDAR in it.
        ValueError: Not such a list, no LiDAR in it, places with other frames, or a bad table.

    Warns:
        UserWarning: Frames come faster than a LiDAR turns.
    """

    layout: ClassVar[str] = "sensors.json, ID/FRAME.ply of each LiDAR in it"
    body = None
    weight_kind = None
    instants = None

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        listed = read_carla_sensors(next(filter(Path.exists, _lists(self.path)), self.path / SENSORS_FILES[0]))
        self._mounts = {one.id: _right_handed([getattr(one, name) for name in POSE]) for one in listed}
        self.sensors = tuple(name for name in self._mounts if name != REFERENCE)
        self.rigs = {"carla": self.sensors}
        self.reference_sensors = (REFERENCE,) if REFERENCE in self._mounts else ()
        self._files = {name: frame_files(self.path / name, beside=(POSES_FILE,)) for name in self._mounts}
        check_same_names(self.path, self._files)
        self.names = tuple(next(iter(self._files.values())))
        moving = {name: self.path / name / POSES_FILE for name in self._mounts}
        self._moving = {name: self._read(path, ())[1] for name, path in moving.items() if path.exists()}
        self.times_s, self._poses = None, None
        if (self.path / POSES_FILE).exists():
            times_s, self._poses = self._read(self.path / POSES_FILE, ("time_s",))
            self.times_s = check_times(times_s, len(self.names), str(self.path / POSES_FILE))
            self._warn_of_parts(listed, times_s)

    @property
    def frames(self) -> range:
        """All of them."""
        return range(len(self.names))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether there is a list of sensors."""
        return any(file.is_file() for file in _lists(path))

    def scan(self, sensor: str, index: int) -> Scan:
        """Read a cloud, its y turned to the left."""
        path = self._files[sensor][self.names[index]]
        points_m = read_cloud(path)
        points_m[:, 1] *= -1
        vehicle_T_sensor = self._moving[sensor][index] if sensor in self._moving else self._mounts[sensor]
        return Scan(points_m, vehicle_T_sensor, str(path))

    def world_T_vehicle(self, index: int) -> Matrix | None:
        """Where the vehicle was, if there is a `poses.csv`."""
        return None if self._poses is None else self._poses[index]

    def boxes(self, index: int) -> None:
        """Nobody has labelled anything."""

    def _warn_of_parts(self, listed: list[CarlaSensor], times_s: Matrix) -> None:
        every_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else np.inf
        for one in listed:
            if one.rotation_frequency is not None and one.rotation_frequency * every_s < WHOLE_TURN:
                warnings.warn(
                    f"{self.path}: {one.id}: a file holds {one.rotation_frequency * every_s:.0%} of a turn at most "
                    f"({one.rotation_frequency:g} turns a second, a frame every {every_s:g} s): record with a "
                    "rotation_frequency of 1 / fixed_delta_seconds",
                    stacklevel=4,
                )

    def _read(self, path: Path, timed: tuple[str, ...]) -> tuple[Matrix, Matrix]:
        """(F,) times, or nothing, and (F, 4, 4) poses of the frames of a table."""
        table = read_csv(path, (*timed, *POSE), ("frame",))
        with naming(path, "a table of poses"):
            order = check_frames(table.words["frame"], self.names)
        poses = _right_handed([table.numbers[name][order] for name in POSE])
        return (table.numbers["time_s"][order] if timed else np.empty(0)), poses


@reads("a list of CARLA's sensors")
def read_carla_sensors(path: Path) -> list[CarlaSensor]:
    """Read the LiDARs of a list of sensors; JSON is YAML, too.

    Raises:
        BadFileError: Not such a list, no LiDAR in it, or two of one name; the message names the field.
    """
    try:
        listed = TypeAdapter(list[CarlaSensor]).validate_python(parse_yaml(read_short_text(path)))
    except ValidationError as error:
        complaints = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        raise ValueError(f"a list of sensors with id and type is needed; {'; '.join(complaints)}") from error
    lidars = [one for one in listed if one.type in LIDARS]
    names = [one.id for one in lidars]
    if not set(names) - {REFERENCE} or len(set(names)) < len(names):
        raise ValueError(f"LiDARs ({' or '.join(LIDARS)}) of different id are needed; got {', '.join(names) or 'none'}")
    return lidars


def _lists(folder: Path) -> list[Path]:
    return [folder / name for name in SENSORS_FILES]


def _right_handed(pose: list[float] | list[Matrix]) -> Matrix:
    """(..., 4, 4) of x, y, z, roll, pitch, yaw in CARLA's axes: y and yaw to the right, pitch up."""
    x, y, z, roll, pitch, yaw = map(np.asarray, pose)
    return rigid(rotation_from_euler(-yaw, -pitch, roll), np.stack([x, -y, z], axis=-1))
