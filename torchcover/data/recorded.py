"""A recording in a folder: a sensor cloud beside a reference cloud for every instant."""

import operator
import os
import re
from collections.abc import Set
from pathlib import Path

import numpy as np
import torch
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from torch.utils.data import Dataset

from torchcover.data.clouds import READERS, read_cloud, split_name
from torchcover.data.formats.arrays import Points
from torchcover.data.frame import Frame
from torchcover.geometry.rigid import Matrix, check_rigid, transform

SOURCES = ("sensor", "reference")
POSES_FILE = "frames.yaml"
# float32 resolves 8 mm here; clouds in world coordinates lie far beyond and would lose decimetres without a word.
MAX_COORDINATE_M = 1e5
NAMES_SHOWN = 5


class BadFrameError(ValueError):
    """One frame of a recording cannot be used; the others can.

    `name` and `index` say which frame. A caller that skips bad frames catches this around `next`, with and without
    worker processes.

    Args:
        message: `NAME (frame INDEX): reason`, or a worker's traceback that ends in it: DataLoader knows no other way to
            build an exception again than from its text.

    Example:
        >>> error = BadFrameError("night_7 (frame 6): the reference cloud has no points")
        >>> error.name, error.index
        ('night_7', 6)
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.rpartition("BadFrameError: ")[2].strip())
        parts = re.match(r"(?P<name>.*?) \(frame (?P<index>\d+)\): ", str(self))
        self.name = parts["name"] if parts else ""
        self.index = int(parts["index"]) if parts else -1


class _Source(BaseModel):
    model_config = ConfigDict(extra="forbid")

    vehicle_T_sensor: list[list[float]]


class _Poses(BaseModel):
    model_config = ConfigDict(extra="forbid")

    sensor: _Source | None = None
    reference: _Source | None = None


class RecordedFrames(Dataset[Frame]):
    """Frames of a folder with `sensor/NAME.*` beside `reference/NAME.*`, in natural order (frame2 before frame10).

    Any format of `read_cloud` will do, and the two sides may differ. Clouds are in the vehicle frame, unless
    `frames.yaml` in the folder says where their sensor is:

        sensor:                      # both sources are optional
          vehicle_T_sensor:          # 4x4, metres
            - [1, 0, 0, 1.2]
            - [0, 1, 0, 0.0]
            - [0, 0, 1, 1.73]
            - [0, 0, 0, 1]

    Non-finite points are dropped and counted in `Frame.counts` (`sensor_nonfinite`, `reference_nonfinite`). An empty
    sensor cloud is a blind step; an empty reference cloud is an error, for nothing was measured.

    Args:
        folder: The recording.

    Raises:
        FileNotFoundError: The folder, or `sensor` or `reference` in it, is missing.
        ValueError: No frames, a file that is no cloud, two files of one name, names on one side only, or a bad
            `frames.yaml`. From indexing: `BadFrameError`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for source in ("sensor", "reference"):
        ...         Path(folder, source).mkdir()
        ...         _ = Path(folder, source, "frame7.xyz").write_text("1 2 3")
        ...     [(frame.name, frame.sensor.tolist()) for frame in RecordedFrames(folder)]
        [('frame7', [[1.0, 2.0, 3.0]])]
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{self.folder}: no such folder; a recording holds sensor/ and reference/")
        sensor, reference = (_clouds_by_name(self.folder / source) for source in SOURCES)
        _check_pairs(self.folder, sensor.keys(), reference.keys())
        self.names = tuple(sorted(sensor, key=_natural))
        self._paths = [{"sensor": sensor[name], "reference": reference[name]} for name in self.names]
        self._vehicle_T_source = _read_poses(self.folder / POSES_FILE)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            IndexError: There are fewer frames; also what ends a `for` loop.
            BadFrameError: One of its two files cannot be used.
        """
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"frame {position} of {len(self)} in {self.folder}")
        position %= len(self)
        try:
            (sensor, reference), counts = self._read(position)
        except (OSError, ValueError) as error:
            raise BadFrameError(f"{self.names[position]} (frame {position}): {error}") from error
        return Frame({"recording": sensor}, reference, index=position, name=self.names[position], counts=counts)

    def _read(self, position: int) -> tuple[list[torch.Tensor], dict[str, int]]:
        clouds, counts = [], {}
        for source in SOURCES:
            path = self._paths[position][source]
            points = read_cloud(path)
            if source == "reference" and len(points) == 0:
                raise ValueError(f"{path}: the reference cloud has no points, so there is nothing to measure against")
            finite = np.isfinite(points).all(axis=1)
            clouds.append(_to_vehicle(points[finite], self._vehicle_T_source.get(source), path))
            counts[f"{source}_nonfinite"] = int((~finite).sum())
        return clouds, counts


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
        raise FileNotFoundError(f"{folder}: no such folder; a recording holds sensor/ and reference/")
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


def _check_pairs(folder: Path, sensor: Set[str], reference: Set[str]) -> None:
    if not sensor and not reference:
        raise ValueError(f"{folder}: no frames; both sensor/ and reference/ are empty")
    complaints = [
        f"{len(alone)} only in {source}/ ({', '.join(alone[:NAMES_SHOWN])}{', ...' * (len(alone) > NAMES_SHOWN)})"
        for source, alone in (
            ("sensor", sorted(sensor - reference, key=_natural)),
            ("reference", sorted(reference - sensor, key=_natural)),
        )
        if alone
    ]
    if complaints:
        raise ValueError(f"{folder}: every frame needs a file on both sides; {' and '.join(complaints)}")


def _natural(name: str) -> tuple[list[str | int], str]:
    # Text and number alternate, starting with text, so that two keys always compare; the name itself breaks a tie.
    parts = re.split(r"(\d+)", name)
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], name


def _read_poses(path: Path) -> dict[str, Matrix]:
    if not path.exists():
        return {}
    allowed = "allowed are sensor and reference, each with a 4x4 vehicle_T_sensor"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not a YAML file ({' '.join(str(error).split())})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: got {type(content).__name__}, not a mapping; {allowed}")
    try:
        poses = _Poses.model_validate(content)
    except ValidationError as error:
        complaints = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
        raise ValueError(f"{path}: {'; '.join(complaints)}; {allowed}") from error
    sources = {"sensor": poses.sensor, "reference": poses.reference}
    return {
        name: check_rigid(source.vehicle_T_sensor, f"{path}: {name}.vehicle_T_sensor")
        for name, source in sources.items()
        if source is not None
    }
