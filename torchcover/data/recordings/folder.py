"""A recording in a folder: the sensor clouds of one or several rigs beside a reference cloud for every instant."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from torchcover.data.clouds import READERS, read_cloud, split_name
from torchcover.data.recordings.folder_settings import read_poses
from torchcover.data.recordings.recording import Scan
from torchcover.geometry.rigid import Matrix

POSES_FILE = "frames.yaml"
# What the clouds of the only rig are called.
ONLY_RIG = "recording"
MAX_NAMES_SHOWN = 5


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
        self._files = {place: _clouds_by_name(self.path / place) for place in (*self.sensors, *self.reference_sensors)}
        _check_same_names(self.path, self._files)
        self.names = tuple(sorted(self._files["reference"], key=_natural))
        self._vehicle_T_sensor = read_poses(self.path / POSES_FILE)
        _check_places(self.path, self._vehicle_T_sensor, self._files)

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
    return {name: (f"rigs/{name}",) for name in sorted(names, key=_natural)}


def _clouds_by_name(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; a recording holds {FolderRecording.layout}")
    clouds: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):  # what file managers and version control leave behind
            continue
        name, suffix = split_name(path.name)
        if not suffix or path.is_dir():
            raise ValueError(f"{path}: not a cloud; allowed are files ending in {', '.join(READERS)}")
        if name in clouds:
            raise ValueError(f"{folder}: two files for the frame {name}: {clouds[name].name} and {path.name}")
        clouds[name] = path
    return clouds


def _check_same_names(folder: Path, files: Mapping[str, Mapping[str, Path]]) -> None:
    places = " and ".join(f"{place}/" for place in files)
    anywhere = set[str]().union(*files.values())
    if not anywhere:
        raise ValueError(f"{folder}: no frames; {places} are empty")
    complaints = [
        f"{len(gaps)} missing in {place}/ ({_some_of(gaps)})"
        for place, clouds in files.items()
        if (gaps := sorted(anywhere - clouds.keys(), key=_natural))
    ]
    if complaints:
        raise ValueError(f"{folder}: every frame needs a file in {places}; {' and '.join(complaints)}")


def _some_of(names: Sequence[str]) -> str:
    return ", ".join([*names[:MAX_NAMES_SHOWN], *["..."] * (len(names) > MAX_NAMES_SHOWN)])


def _check_places(folder: Path, poses: Mapping[str, Matrix], files: Mapping[str, object]) -> None:
    for place in poses:
        if place not in files:
            raise ValueError(f"{folder / POSES_FILE}: {place.replace('/', '.')}: there is no {place}/ beside it")


def _natural(name: str) -> tuple[list[str | int], str]:
    # Text and number alternate, starting with text, so that two keys always compare; the name itself breaks a tie.
    parts = re.split(r"(\d+)", name)
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], name
