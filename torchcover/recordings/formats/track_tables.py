"""Tables that people write: a trajectory, and boxes of objects over time."""

import csv
import io
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, check_memory, decode, read_npz, reads
from torchcover.geometry import check_rigid
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import Objects, Track, checked_size, class_of, moving, only_one_scene

TRAJECTORY_COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
BOX_COLUMNS = ("t", "id", "category", "x", "y", "z", "length", "width", "height", "yaw")
# Text as Python keeps it: a dict of strings for each row.
_BYTES_PER_CHARACTER = 64
# A step this many times longer than the usual one means that poses are missing.
MAX_STEP = 5.0


@reads("a trajectory")
def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory.

    Args:
        path: `.csv` with the columns t, x, y, z, roll, pitch, yaw (seconds, metres, degrees); or `.npz` with `times_s`
            (K,) and `world_T_body` (K, 4, 4).

    Returns:
        The trajectory in the world frame.

    Raises:
        FileNotFoundError: No such file.
        IsADirectoryError: A folder.
        BadFileError: Another suffix, missing columns, what is no number, NaN, times that do not ascend, a gap in time,
            a pose that is not a rigid transform, or damage; the message names the file.
    """
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix not in readers:
        raise ValueError(f"a trajectory is a .csv or .npz file; got {path.suffix or 'no suffix'}")
    trajectory = readers[path.suffix](path)
    check_gaps(trajectory.times_s)
    return trajectory


def read_objects(path: Path, scene: str | None) -> Objects:
    """Read a table of boxes, which has no ego of its own; see `read_box_tracks`."""
    only_one_scene(scene, "a table of boxes")
    return Objects(read_box_tracks(path))


@reads("a file of boxes")
def read_box_tracks(path: Path) -> tuple[Track, ...]:
    """Read recorded boxes, one track for each id: of its first size, there between its first and last time.

    Args:
        path: `.csv` with the columns t, id, category, x, y, z, length, width, height, yaw (seconds, metres, degrees; x,
            y, z of the centre of the bottom).

    Returns:
        In the order of their first appearance; there may be gaps.

    Raises:
        FileNotFoundError: No such file.
        IsADirectoryError: A folder.
        BadFileError: Missing columns, what is no number, NaN, times that do not ascend, a box without volume; the
            message names the file and the id.
    """
    return tuple(_tracks(path))


def _tracks(path: Path) -> Iterator[Track]:
    rows: dict[str, list[dict[str, str]]] = {}
    for row in _rows(path, BOX_COLUMNS):
        rows.setdefault(row["id"], []).append(row)
    for name, track in rows.items():
        numbers = _numbers(track, [column for column in BOX_COLUMNS if column not in ("id", "category")])
        length, width, height = checked_size(name, numbers[0, 4:7])
        angles_deg = np.column_stack([numbers[:, 7], np.zeros((len(track), 2))])
        trajectory = moving(name, numbers[:, 0], numbers[:, 1:4], angles_deg)
        category = track[0]["category"]
        yield Track(name, category, class_of(category), (length, width, height), trajectory)


def _read_csv(path: Path) -> Trajectory:
    numbers = _numbers(_rows(path, TRAJECTORY_COLUMNS), TRAJECTORY_COLUMNS)
    time_s, position_m, (roll, pitch, yaw) = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:].T
    return Trajectory.from_arrays(time_s, position_m, np.stack([yaw, pitch, roll], axis=1))


def _read_npz(path: Path) -> Trajectory:
    wanted = ("times_s", "world_T_body")

    def check(header: NpyHeader) -> None:
        if header.dtype.kind not in "fiu":
            raise ValueError(f"times and poses are integers or floats; got {header.dtype}")

    def choose(names: Collection[str]) -> Collection[str]:
        if not set(wanted).issubset(names):
            raise ValueError(f"needs the arrays {' and '.join(wanted)}; got {', '.join(names) or 'none'}")
        return wanted

    times_s, poses = read_npz(path, check, choose).values()
    if times_s.ndim != 1 or poses.shape != (len(times_s), 4, 4):
        raise ValueError(f"times_s (K,) and world_T_body (K, 4, 4) are needed; got {times_s.shape} and {poses.shape}")
    return Trajectory.from_poses(times_s, np.stack([check_rigid(pose, f"pose {k}") for k, pose in enumerate(poses)]))


def _rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    check_memory(_BYTES_PER_CHARACTER * path.stat().st_size)
    reader = csv.DictReader(io.StringIO(decode(path.read_bytes()), newline=""), skipinitialspace=True)
    names = [name.strip() for name in reader.fieldnames or ()]
    missing = [column for column in columns if column not in names]
    if missing:
        raise ValueError(f"needs the columns {', '.join(columns)}; {', '.join(missing)} missing")
    reader.fieldnames = names
    rows: list[dict[str, str]] = []
    for row in reader:
        if None in row or None in row.values():
            raise ValueError(f"line {reader.line_num}: not {len(names)} values, as the header has")
        rows.append(row)
    if not rows:
        raise ValueError("holds no row")
    return rows


def _numbers(rows: Sequence[dict[str, str]], columns: Sequence[str]) -> NDArray[np.float64]:
    numbers = np.empty((len(rows), len(columns)))
    for line, row in enumerate(rows, 2):
        for k, column in enumerate(columns):
            try:
                numbers[line - 2, k] = float(row[column])
            except (TypeError, ValueError):
                raise ValueError(f"line {line}: {column} is {row[column]!r}, not a number") from None
    return numbers


def check_gaps(times_s: NDArray[np.float64]) -> None:
    """Refuse times of which some seem to be missing.

    Raises:
        ValueError: A step that is many times longer than the usual one.
    """
    steps = np.diff(times_s)
    if len(steps) and steps.max() > MAX_STEP * np.median(steps):
        at = int(steps.argmax())
        raise ValueError(
            f"a gap of {steps[at]:g} s after t = {times_s[at]:g} s, where the usual step is {np.median(steps):g} s; "
            "fill it, or split the file"
        )
