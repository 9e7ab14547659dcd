"""Objects over time without scans: tables that people write, and scenarios of CommonRoad."""

import math
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from torchcover.files import NpyHeader, guard_reader, parse_xml, read_csv, read_npz
from torchcover.geometry import build_transform, check_rigid, convert_euler_to_rotation
from torchcover.geometry.rigid import Matrix, warn_about_radians
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import (
    Ego,
    RecordedObjects,
    Track,
    build_trajectory,
    check_box_size,
    find_vehicle_class,
)
from torchcover.recordings.recording import check_seconds

TRAJECTORY_COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
BOX_COLUMNS = ("t", "x", "y", "z", "length", "width", "height", "yaw")
# A step this many times longer than the usual one means that poses are missing.
MAX_STEP = 5.0
# Shorter steps in meters have no direction.
MIN_STEP_M = 0.05
# Mean sine of the angle between headings and ways, from which headings are wrong.
MIN_OFF = 0.05


@guard_reader("a trajectory")
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


@guard_reader("a file of boxes")
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
    for row, name in enumerate(table.texts["id"]):
        own.setdefault(name, []).append(row)
    _check_degrees("yaw", [(rows[of, 1:3], rows[of, 7]) for of in own.values()])
    for name, of in own.items():
        numbers, category = rows[of], table.texts["category"][of[0]]
        length, width, height = check_box_size(name, numbers[0, 4:7])
        angles_deg = np.column_stack([numbers[:, 7], np.zeros((len(of), 2))])
        trajectory = build_trajectory(name, numbers[:, 0], numbers[:, 1:4], angles_deg)
        yield Track(name, category, find_vehicle_class(category), (length, width, height), trajectory)


def _read_csv(path: Path) -> Trajectory:
    numbers = _columns(read_csv(path, TRAJECTORY_COLUMNS, optional_columns=None).numbers, TRAJECTORY_COLUMNS)
    time_s, position_m, (roll, pitch, yaw) = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:].T
    _check_degrees("yaw", [(position_m[:, :2], yaw)])
    return Trajectory.from_arrays(time_s, position_m, np.stack([yaw, pitch, roll], axis=1))


def _check_degrees(column: str, drives: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> None:
    """Warn of headings in degrees that look like radians.

    Args:
        column: Name of the column of headings.
        drives: (K, 2) positions in meters and (K,) headings of each object.

    Warns:
        UserWarning: Headings lie along the ways as radians only, or headings that never change are round in radians.
    """
    ways_rad, headings, constant = [], [], set()
    for position_m, heading in drives:
        step_m = np.diff(position_m, axis=0)
        moves = np.linalg.norm(step_m, axis=1) > MIN_STEP_M
        ways_rad.append(np.arctan2(step_m[moves, 1], step_m[moves, 0]))
        headings.append(heading[:-1][moves])
        if np.ptp(heading) == 0:
            constant.add(float(heading[0]))
    if max(np.abs(heading).max() for _, heading in drives) > 2 * np.pi + 0.01:
        return
    warn_about_radians({column: sorted(constant)})
    way_rad, heading = np.concatenate(ways_rad), np.concatenate(headings)
    if len(way_rad):
        off, off_deg = (np.abs(np.sin(way_rad - angle)).mean() for angle in (heading, np.deg2rad(heading)))
        if off_deg > MIN_OFF and off < off_deg / 5:
            largest = f"{np.abs(heading).max():.4g}"
            words = f"{column}: up to {largest}, and along the way as radians only; angles are in degrees here"
            warnings.warn(words, stacklevel=2)


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


OBSTACLES = ("obstacle", "dynamicObstacle", "staticObstacle")


@guard_reader("a scenario of CommonRoad")
def read_commonroad(path: Path) -> RecordedObjects:
    """Read the obstacles and planning problems of a file.

    Raises:
        BadFileError: Another content.
        FileNotFoundError: No such file.
    """
    root = parse_xml(path)
    if root.tag != "commonRoad":
        raise ValueError(f"<commonRoad> is needed as its root; got <{root.tag[:40]}>")
    step_s = float(root.get("timeStepSize", "nan"))
    if not 0 < step_s < math.inf:
        raise ValueError(f"timeStepSize: a positive number is needed; got {root.get('timeStepSize')}")
    _warn_of_skipped_elements(root)
    found = [_track(element, step_s) for tag in OBSTACLES for element in root.iter(tag)]
    egos = tuple(_ego(problem, step_s) for problem in root.iter("planningProblem"))
    if not found:
        raise ValueError("no obstacle in it")
    return RecordedObjects(tuple(found), egos)


def _ego(problem: Element, step_s: float) -> Ego:
    name = problem.get("id", "")
    start = problem.find("initialState")
    if start is None:
        raise ValueError(f"planningProblem {name}: no initialState")
    time_s, place_m, yaw = _state(start, step_s, f"planningProblem {name}")
    pose = build_transform(convert_euler_to_rotation(math.degrees(yaw), 0.0, 0.0), place_m)
    return Ego(name, np.array([time_s]), pose[None], np.eye(4))


def _track(obstacle: Element, step_s: float) -> Track:
    name = obstacle.get("id", "")
    category = (obstacle.findtext("type") or "unknown").strip().lower()
    size_m, middle_m, turn_rad = _shape(obstacle, name)
    states = [state for tag in ("initialState", "trajectory/state") for state in obstacle.findall(tag)]
    if not states:
        raise ValueError(f"id {name}: no initialState")
    rows = [_state(state, step_s, f"id {name}") for state in states]
    if len(rows) > 1 and rows[0] == rows[1]:
        del rows[0]  # a known flaw of some scenarios: the trajectory begins with the initial state
    times_s, yaw = np.array([row[0] for row in rows]), np.array([row[2] for row in rows])
    forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0], forward[:, 2]], axis=1)
    places_m = np.array([row[1] for row in rows]) + middle_m[0] * forward + middle_m[1] * left
    angles_deg = np.column_stack([np.rad2deg(yaw + turn_rad), np.zeros((len(yaw), 2))])
    trajectory = build_trajectory(name, times_s, places_m, angles_deg)
    if obstacle.tag == "staticObstacle" or (obstacle.findtext("role") or "").strip() == "static":
        trajectory = Trajectory(times_s[:1], places_m[:1], angles_deg[:1])
    return Track(name, category, find_vehicle_class(category), size_m, trajectory)


def _shape(obstacle: Element, name: str) -> tuple[tuple[float, float, float], tuple[float, float], float]:
    """Return the size of the box around all shapes (no height), its middle and its turn, seen from the obstacle."""
    shapes = [shape for tag in ("rectangle", "circle", "polygon") for shape in obstacle.findall(f"shape/{tag}")]
    if not shapes:
        raise ValueError(f"id {name}: no rectangle, circle or polygon as its shape, so no size")
    turn_rad = 0.0
    if len(shapes) == 1 and shapes[0].find("orientation") is not None:
        turn_rad = _number(shapes[0], "orientation", f"id {name}")
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    corners = np.concatenate([_corners(shape, name) for shape in shapes]) @ np.array([[c, -s], [s, c]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle_m: Matrix = np.array([[c, -s], [s, c]]) @ (low + high) / 2
    length, width = check_box_size(name, high - low)
    return (length, width, math.nan), (float(middle_m[0]), float(middle_m[1])), turn_rad


def _corners(shape: Element, name: str) -> Matrix:
    """Return (K, 2) corners of a shape in the frame of its obstacle; of a circle those of the square around it."""
    owner = f"id {name}"
    if shape.tag == "polygon":
        return np.array([(_number(point, "x", owner), _number(point, "y", owner)) for point in shape.iter("point")])
    if shape.tag == "circle":
        half = np.full(2, _number(shape, "radius", owner))
    else:
        half = np.array([_number(shape, "length", owner), _number(shape, "width", owner)]) / 2
    check_box_size(name, 2 * half)
    turn_rad = 0.0 if shape.find("orientation") is None else _number(shape, "orientation", owner)
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    center = shape.find("center")
    middle_m = np.zeros(2) if center is None else np.array([_number(center, axis, owner) for axis in "xy"])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.asarray((signs * half) @ np.array([[c, s], [-s, c]]) + middle_m)


def _warn_of_skipped_elements(root: Element) -> None:
    """Warn of obstacles that are left out, moved no further than their initial state, or put into one box."""
    skipped = Counter(
        f"{tag} ({(element.findtext('type') or 'unknown').strip()})"
        for tag in ("environmentObstacle", "phantomObstacle")
        for element in root.iter(tag)
    )
    reports = [f"{count} {name} left out, which hide nothing" for name, count in skipped.items()]
    obstacles = [element for tag in OBSTACLES for element in root.iter(tag)]
    uncertain = [obstacle.get("id", "") for obstacle in obstacles if obstacle.find("occupancySet") is not None]
    if uncertain:
        reports.append(f"occupancySet of id {', '.join(uncertain[:5])} left out, of which only other states are used")
    joined = [obstacle.get("id", "") for obstacle in obstacles if len(obstacle.findall("shape/*")) > 1]
    if joined:
        reports.append(f"shapes of id {', '.join(joined[:5])} taken as the box around them")
    if reports:
        warnings.warn(f"CommonRoad scenario: {'; '.join(reports)}", stacklevel=3)


def _state(state: Element, step_s: float, owner: str) -> tuple[float, list[float], float]:
    """Time, place and heading in radians; a height only in three dimensions."""
    point = state.find("position/point")
    if point is None:
        raise ValueError(f"{owner}: a state without the point at which it is; areas are no places")
    place_m = [_number(point, axis, owner) for axis in "xy"]
    up_m = _number(point, "z", owner) if point.find("z") is not None else 0.0
    time_s = _number(state, "time/exact", owner) * step_s
    return time_s, [*place_m, up_m], _number(state, "orientation/exact", owner)


def _number(element: Element, tag: str, owner: str) -> float:
    text = element.findtext(tag)
    try:
        return float(text)  # type: ignore[arg-type]  # None is told, too
    except (TypeError, ValueError):
        raise ValueError(f"{owner}: <{element.tag}> needs a number as its <{tag}>; got {text!r}") from None
