"""A recording in a folder: the sensor clouds of one or several rigs beside a reference cloud for every instant."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

from torchcover.data.clouds import read_cloud
from torchcover.data.recordings.file_names import check_same_names, frame_files, natural
from torchcover.data.recordings.folder_settings import read_poses
from torchcover.data.recordings.recording import Scan
from torchcover.geometry.rigid import Matrix

POSES_FILE = "frames.yaml"
# What the clouds of the only rig are called.
ONLY_RIG = "recording"


class FolderRecording:
    """A folder with `sensor/FRAME.*` beside `reference/FRAME.*`, in natural order (frame2 before frame10).

    Several rigs have `rigs/NAME/FRAME.*` each, instead of `sensor/`, against one reference. Any format of `read_cloud`
    will do, and the sides may differ. Clouds are in the vehicle frame, unless `frames.yaml` in the folder says where
    their sensor is:

        sensor:                      # all are optional
          vehicle_T_sensor:          # 4x4, metres
            - [1, 0, 0, 1.2]
            - [0, 1, 0, 0.0]
            - [0, 0, 1, 1.73]
            - [0, 0, 0, 1]

    for the rig and likewise for `reference`; for several rigs `rigs: {NAME: {vehicle_T_sensor: ...}}`.

    Args:
        path: The folder.

    Raises:
        FileNotFoundError: The folder, or `sensor` or `reference` in it, is missing.
        ValueError: No frames, a file that is no cloud, two files of one name, names on one side only, both `sensor` and
            `rigs`, or a bad `frames.yaml`.
    """

    layout: ClassVar[str] = "sensor/FRAME.*, or rigs/NAME/FRAME.* for several, beside reference/FRAME.*"
    reference_sensors = ("reference",)
    times_s = None
    body = None

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if not self.path.is_dir():
            raise FileNotFoundError(f"{self.path}: no such folder; a recording holds {self.layout}")
        self.rigs = _rigs(self.path)
        self.sensors = tuple(place for places in self.rigs.values() for place in places)
        self._files = {place: frame_files(self.path / place) for place in (*self.sensors, *self.reference_sensors)}
        check_same_names(self.path, self._files)
        self.names = tuple(self._files["reference"])
        self._vehicle_T_sensor = read_poses(self.path / POSES_FILE)
        _check_places(self.path, self._vehicle_T_sensor, self._files)

    @property
    def frames(self) -> range:
        """All of them."""
        return range(len(self.names))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether it is a folder with clouds of a sensor, of rigs or of a reference in it."""
        return any((path / place).is_dir() for place in ("sensor", "rigs", "reference"))

    def scan(self, sensor: str, index: int) -> Scan:
        """Read a file; a sensor is called as its folder is."""
        path = self._files[sensor][self.names[index]]
        return Scan(read_cloud(path), self._vehicle_T_sensor.get(sensor), str(path))

    def world_T_vehicle(self, index: int) -> None:
        """Nobody knows."""

    def boxes(self, index: int) -> None:
        """Nobody has labelled anything."""


def _rigs(folder: Path) -> dict[str, tuple[str, ...]]:
    """Name of each rig -> the folders of its sensors within the recording; a pose is under the same path."""
    if not (folder / "rigs").is_dir():
        return {ONLY_RIG: ("sensor",)}
    if (folder / "sensor").exists():
        raise ValueError(f"{folder}: both sensor/ and rigs/; sensor/ is for one rig, rigs/NAME/ for several")
    names = [path.name for path in (folder / "rigs").iterdir() if not path.name.startswith(".")]
    if not names:
        raise ValueError(f"{folder / 'rigs'}: no rig; each has a folder rigs/NAME/ of its own")
    return {name: (f"rigs/{name}",) for name in sorted(names, key=natural)}


def _check_places(folder: Path, poses: Mapping[str, Matrix], files: Mapping[str, object]) -> None:
    for place in poses:
        if place not in files:
            raise ValueError(f"{folder / POSES_FILE}: {place.replace('/', '.')}: there is no {place}/ beside it")
