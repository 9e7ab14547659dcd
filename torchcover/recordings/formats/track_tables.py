"""Tables that people write: a trajectory, and boxes of objects over time."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, read_csv, read_npz, reads
from torchcover.geometry import check_rigid
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import Track, checked_size, class_of, moving
from torchcover.recordings.recording import check_seconds

TRAJECTORY_COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
BOX_COLUMNS = ("t", "x", "y", "z", "length", "width", "height", "yaw")
# A step this many times longer than the usual one means that poses are missing.
MAX_STEP = 5.0


@reads("a trajectory")
def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory.

    A `.csv` has the columns t, x, y, z, roll, pitch, yaw (seconds, metres, degrees), a `.npz` `times_s` (K,) and
    `world_T_body` (K, 4, 4). BadFileError: another suffix, missing columns, what is no number, NaN, times that do not
    ascend, a gap in time, a pose that is not a rigid transform, or damage.
    """
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix not in readers:
        raise ValueError(f"a trajectory is a .csv or .npz file; got {path.suffix or 'no suffix'}")
    trajectory = readers[path.suffix](path)
    check_seconds(trajectory.times_s, positions_m=trajectory.positions_m)
    check_gaps(trajectory.times_s)
    return trajectory


@reads("a file of boxes")
def read_box_tracks(path: Path) -> tuple[Track, ...]:
    """Read recorded boxes, one track for each id: of its first size, there between its first and last time.

    The `.csv` has the columns t, id, category, x, y, z, length, width, height, yaw (seconds, metres, degrees; x, y, z
    of the centre of the bottom). BadFileError: missing columns, what is no number, NaN, times that do not ascend, a box
    without volume; the message names the file and the id.
    """
    return tuple(_tracks(path))


def _tracks(path: Path) -> Iterator[Track]:
    table = read_csv(path, BOX_COLUMNS, ("id", "category"), None)
    rows = _columns(table.numbers, BOX_COLUMNS)
    check_seconds(np.unique(rows[:, 0]))
    own: dict[str, list[int]] = {}
    for row, name in enumerate(table.words["id"]):
        own.setdefault(name, []).append(row)
    for name, of in own.items():
        numbers, category = rows[of], table.words["category"][of[0]]
        length, width, height = checked_size(name, numbers[0, 4:7])
        angles_deg = np.column_stack([numbers[:, 7], np.zeros((len(of), 2))])
        trajectory = moving(name, numbers[:, 0], numbers[:, 1:4], angles_deg)
        yield Track(name, category, class_of(category), (length, width, height), trajectory)


def _read_csv(path: Path) -> Trajectory:
    numbers = _columns(read_csv(path, TRAJECTORY_COLUMNS, optional=None).numbers, TRAJECTORY_COLUMNS)
    time_s, position_m, (roll, pitch, yaw) = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:].T
    return Trajectory.from_arrays(time_s, position_m, np.stack([yaw, pitch, roll], axis=1))


def _columns(numbers: Mapping[str, NDArray[np.float64]], names: Sequence[str]) -> NDArray[np.float64]:
    """(rows, names) some columns of a table."""
    rows = np.column_stack([numbers[name] for name in names])
    if not len(rows):
        raise ValueError("holds no row")
    return rows


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
    check_seconds(times_s)
    return Trajectory.from_poses(times_s, np.stack([check_rigid(pose, f"pose {k}") for k, pose in enumerate(poses)]))


def check_gaps(times_s: NDArray[np.float64]) -> None:
    """Refuse times of which some seem to be missing."""
    steps = np.diff(times_s)
    if len(steps) and steps.max() > MAX_STEP * np.median(steps):
        at = int(steps.argmax())
        raise ValueError(
            f"a gap of {steps[at]:g} s after t = {times_s[at]:g} s, where the usual step is {np.median(steps):g} s; "
            "fill it, or split the file"
        )
