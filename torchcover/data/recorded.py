"""A recording in a folder: the sensor clouds of one or several rigs beside a reference cloud for every instant."""

import operator
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from torchcover.data.bad_frame import BadFrameError
from torchcover.data.clouds import READERS, read_cloud, split_name
from torchcover.data.formats.arrays import Points
from torchcover.data.frame import Frame
from torchcover.data.poses import read_poses
from torchcover.geometry.rigid import Matrix, transform
from torchcover.simulation import Sensor, WeightKind

POSES_FILE = "frames.yaml"
# What the clouds of the only rig are called.
ONLY_RIG = "recording"
# float32 resolves 8 mm here; clouds in world coordinates lie far beyond and would lose decimetres without a word.
MAX_COORDINATE_M = 1e5
MAX_NAMES_SHOWN = 5


class RecordedFrames(Dataset[Frame]):
    """Frames of a folder with `sensor/FRAME.*` beside `reference/FRAME.*`, in natural order (frame2 before frame10).

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

    Non-finite points are dropped and counted in `Frame.counts` (`sensor_nonfinite`, `reference_nonfinite`). An empty
    sensor cloud is a blind step; an empty reference cloud is an error, for nothing was measured.

    Args:
        folder: The recording.

    Raises:
        FileNotFoundError: The folder, or `sensor` or `reference` in it, is missing.
        ValueError: No frames, a file that is no cloud, two files of one name, names on one side only, both `sensor` and
            `rigs`, or a bad `frames.yaml`. From indexing: `BadFrameError`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for source in ("sensor", "reference"):
        ...         Path(folder, source).mkdir()
        ...         _ = Path(folder, source, "frame7.xyz").write_text("1 2 3")
        ...     [(frame.name, frame.sensor.tolist()) for frame in RecordedFrames(folder)]
        [('frame7', [[1.0, 2.0, 3.0]])]
    """

    layout: ClassVar[str] = "sensor/FRAME.*, or rigs/NAME/FRAME.* for several, beside reference/FRAME.*"

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{self.folder}: no such folder; a recording holds {self.layout}")
        # Name of the rig -> its folder; a pose is under the same path in frames.yaml.
        self._places = _rig_places(self.folder)
        files = {place: _clouds_by_name(self.folder / place) for place in (*self._places.values(), "reference")}
        _check_same_names(self.folder, files)
        self.names = tuple(sorted(files["reference"], key=_natural))
        self._paths = [{place: clouds[name] for place, clouds in files.items()} for name in self.names]
        self._vehicle_T_source = read_poses(self.folder / POSES_FILE)
        _check_places(self.folder, self._vehicle_T_source, files)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Whether it is a folder with clouds of a sensor, of rigs or of a reference in it."""
        return any((path / place).is_dir() for place in ("sensor", "rigs", "reference"))

    @property
    def rigs(self) -> tuple[str, ...]:
        """Names of the rigs, in natural order; `recording` if there is one only, without a name."""
        return tuple(self._places)

    @property
    def sensors(self) -> Mapping[str, Sequence[Sensor]]:
        """Nothing: a recording does not say what its sensors are."""
        return {}

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """Nothing: nor does it say how large the vehicle is."""
        return None

    @property
    def description(self) -> Mapping[str, object]:
        """The folder."""
        return {"scenario": None, "frames": str(self.folder), "seed": None}

    @property
    def weight_kind(self) -> WeightKind | None:
        """None: all points of the reference count the same."""
        return None

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """None: the reference was recorded."""
        return None

    @property
    def content(self) -> Mapping[str, object]:
        """Names, sizes and times of change of all clouds, which are not read for it, and the poses of their sensors."""
        poses = {place: pose.tolist() for place, pose in self._vehicle_T_source.items()}
        return {"recording": [[_stamp(path) for path in clouds.values()] for clouds in self._paths], "poses": poses}

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            IndexError: There are fewer frames; also what ends a `for` loop.
            BadFrameError: One of its files cannot be used.
        """
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"frame {position} of {len(self)} in {self.folder}")
        position %= len(self)
        name = self.names[position]
        try:
            sensors = {rig: self._read(position, place) for rig, place in self._places.items()}
            reference, reference_dropped = self._read(position, "reference")
        except (OSError, ValueError) as error:
            raise BadFrameError(f"{name} (frame {position}): {error}") from error
        counts = {
            "sensor_nonfinite": sum(dropped for _, dropped in sensors.values()),
            "reference_nonfinite": reference_dropped,
        }
        clouds = {rig: cloud for rig, (cloud, _) in sensors.items()}
        return Frame(clouds, reference, index=position, name=name, counts=counts)

    def _read(self, position: int, place: str) -> tuple[torch.Tensor, int]:
        """One cloud in the vehicle frame, and how many of its points were not finite."""
        path = self._paths[position][place]
        points = read_cloud(path)
        if place == "reference" and len(points) == 0:
            raise ValueError(f"{path}: the reference cloud has no points, so there is nothing to measure against")
        finite = np.isfinite(points).all(axis=1)
        return _to_vehicle(points[finite], self._vehicle_T_source.get(place), path), int((~finite).sum())


def _stamp(path: Path) -> tuple[str, int, int]:
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def _rig_places(folder: Path) -> dict[str, str]:
    """Name of each rig -> its folder within the recording."""
    if not (folder / "rigs").is_dir():
        return {ONLY_RIG: "sensor"}
    if (folder / "sensor").exists():
        raise ValueError(f"{folder}: both sensor/ and rigs/; sensor/ is for one rig, rigs/NAME/ for several")
    names = [path.name for path in (folder / "rigs").iterdir() if not path.name.startswith(".")]
    if not names:
        raise ValueError(f"{folder / 'rigs'}: no rig; each has a folder rigs/NAME/ of its own")
    return {name: f"rigs/{name}" for name in sorted(names, key=_natural)}


def _to_vehicle(points_m: Points, vehicle_T_source: Matrix | None, path: Path) -> torch.Tensor:
    points = points_m if vehicle_T_source is None else transform(vehicle_T_source, points_m)
    farthest_m = float(np.abs(points).max(initial=0.0))
    if farthest_m > MAX_COORDINATE_M:
        raise ValueError(
            f"{path}: a coordinate of {farthest_m:.6g} m in the vehicle frame, at most {MAX_COORDINATE_M:g} m is "
            f"allowed; for world coordinates give vehicle_T_sensor in {POSES_FILE}"
        )
    return torch.from_numpy(points.astype(np.float32))


def _clouds_by_name(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder; a recording holds {RecordedFrames.layout}")
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
