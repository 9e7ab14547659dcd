"""Objects over time without scans: tables of trajectories and boxes, and CommonRoad scenarios."""

import math
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from torchcover.files import NpyHeader, guard_reader, parse_xml, read_csv, read_npz
from torchcover.geometry import build_transform, check_rigid, convert_euler_to_rotation
from torchcover.geometry.arrays import Float64
from torchcover.geometry.rigid import Matrix, warn_about_radians
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.formats.frame_files import stack_columns
from torchcover.recordings.objects import (
    Ego,
    RecordedObjects,
    Track,
    build_trajectory,
    check_box_size,
    find_vehicle_class,
)
from torchcover.recordings.recording import check_seconds

# Columns of tables in seconds, meters and degrees.
TRAJECTORY_COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
BOX_COLUMNS = ("t", "x", "y", "z", "length", "width", "height", "yaw")
# Older versions have one tag for all obstacles, newer ones have two.
OBSTACLE_TAGS = ("obstacle", "dynamicObstacle", "staticObstacle")


@guard_reader("a trajectory")
def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory.

    Args:
        path: `.csv` with columns t, x, y, z, roll, pitch, yaw (seconds, meters, degrees), or `.npz` with arrays
            `times_s` (K,) and `world_T_body` (K, 4, 4).

    Returns:
        The trajectory.

    Raises:
        BadFileError: The suffix is unknown, columns or poses are invalid, times do not ascend, or have a gap.
    """
    readers = {".csv": _read_csv_trajectory, ".npz": _read_npz_trajectory}
    if path.suffix not in readers:
        raise ValueError(f"a trajectory is a .csv or .npz file; got {path.suffix or 'no suffix'}")
    trajectory = readers[path.suffix](path)
    check_seconds(trajectory.times_s, positions_m=trajectory.positions_m)
    check_gaps(trajectory.times_s)
    return trajectory


@guard_reader("a file of boxes")
def read_box_tracks(path: Path) -> tuple[Track, ...]:
    """Read recorded boxes: one track per id with its first size, present between its first and last time.

    Args:
        path: `.csv` with columns t, id, category, x, y, z, length, width, height, yaw (seconds, meters, degrees; x, y,
            z of the center of the bottom).

    Returns:
        Tracks in the order of their first rows.

    Raises:
        BadFileError: Columns are missing, values are invalid, times do not ascend, or a box has no volume; the message
            names the file and the id.
    """
    table = read_csv(path, BOX_COLUMNS, ("id", "category"), None)
    rows = _stack_columns(table.numbers, BOX_COLUMNS)
    check_seconds(np.unique(rows[:, 0]))
    rows_by_name: dict[str, list[int]] = {}
    for row, name in enumerate(table.texts["id"]):
        rows_by_name.setdefault(name, []).append(row)
    _check_degrees([(rows[indices, 1:3], rows[indices, 7]) for indices in rows_by_name.values()])
    tracks = []
    for name, indices in rows_by_name.items():
        numbers, category = rows[indices], table.texts["category"][indices[0]]
        length_m, width_m, height_m = check_box_size(name, numbers[0, 4:7])
        angles_deg = np.column_stack([numbers[:, 7], np.zeros((len(indices), 2))])
        trajectory = build_trajectory(name, numbers[:, 0], numbers[:, 1:4], angles_deg)
        tracks.append(Track(name, category, find_vehicle_class(category), (length_m, width_m, height_m), trajectory))
    return tuple(tracks)


def _read_csv_trajectory(path: Path) -> Trajectory:
    """Read a trajectory from a table."""
    numbers = _stack_columns(read_csv(path, TRAJECTORY_COLUMNS, optional_columns=None).numbers, TRAJECTORY_COLUMNS)
    times_s, positions_m, (roll, pitch, yaw) = numbers[:, 0], numbers[:, 1:4], numbers[:, 4:].T
    _check_degrees([(positions_m[:, :2], yaw)])
    return Trajectory.from_arrays(times_s, positions_m, np.stack([yaw, pitch, roll], axis=1))


def _check_degrees(drives: Sequence[tuple[Float64, Float64]]) -> None:
    """Warn about yaw angles in degrees that look like radians.

    Args:
        drives: (K, 2) positions in meters and (K,) yaw angles of each object.

    Warns:
        UserWarning: Yaw angles match the direction of motion as radians only, or constant ones are round in radians.
    """
    min_step_m = 0.05  # shorter steps have no direction
    min_deviation = 0.05  # mean sine of the angle between yaw and motion from which yaw is wrong
    directions, yaws, constant_yaws = [], [], set()
    for positions_m, yaw in drives:
        steps_m = np.diff(positions_m, axis=0)
        is_moving = np.linalg.norm(steps_m, axis=1) > min_step_m
        directions.append(np.arctan2(steps_m[is_moving, 1], steps_m[is_moving, 0]))
        yaws.append(yaw[:-1][is_moving])
        if np.ptp(yaw) == 0:
            constant_yaws.add(float(yaw[0]))
    if max(np.abs(yaw).max() for _, yaw in drives) > 2 * np.pi + 0.01:
        return
    warn_about_radians({"yaw": sorted(constant_yaws)})
    direction_rad, moving_yaw = np.concatenate(directions), np.concatenate(yaws)
    if len(direction_rad):
        deviation_as_radians = np.abs(np.sin(direction_rad - moving_yaw)).mean()
        deviation_as_degrees = np.abs(np.sin(direction_rad - np.deg2rad(moving_yaw))).mean()
        if deviation_as_degrees > min_deviation and deviation_as_radians < deviation_as_degrees / 5:
            warnings.warn(
                f"yaw: up to {np.abs(moving_yaw).max():.4g}, and along the way as radians only; angles have to be in "
                "degrees",
                stacklevel=2,
            )


def _stack_columns(numbers: Mapping[str, Float64], names: Sequence[str]) -> Float64:
    """Stack columns of a table as (rows, names)."""
    rows = stack_columns(numbers, names)
    if not len(rows):
        raise ValueError("holds no row")
    return rows


def _check_header(header: NpyHeader) -> None:
    """Check that an array holds real numbers."""
    if header.dtype.kind not in "fiu":
        raise ValueError(f"times and poses are integers or floats; got {header.dtype}")


def _choose_arrays(names: Collection[str]) -> Collection[str]:
    """Choose times and poses, which both have to exist."""
    required = ("times_s", "world_T_body")
    if not set(required).issubset(names):
        raise ValueError(f"needs the arrays {' and '.join(required)}; got {', '.join(names) or 'none'}")
    return required


def _read_npz_trajectory(path: Path) -> Trajectory:
    """Read a trajectory from arrays of times and rigid poses."""
    times_s, poses = read_npz(path, _check_header, _choose_arrays).values()
    if times_s.ndim != 1 or poses.shape != (len(times_s), 4, 4):
        raise ValueError(f"times_s (K,) and world_T_body (K, 4, 4) are needed; got {times_s.shape} and {poses.shape}")
    check_seconds(times_s)
    return Trajectory.from_poses(
        times_s, np.stack([check_rigid(pose, f"pose {index}") for index, pose in enumerate(poses)])
    )


def check_gaps(times_s: Float64, max_interval_ratio: float = 5.0) -> None:
    """Check that no times are missing.

    Args:
        times_s: (K,) ascending times.
        max_interval_ratio: An interval this many times longer than the median means that times are missing.

    Raises:
        ValueError: There is such a gap.
    """
    intervals_s = np.diff(times_s)
    if len(intervals_s) and intervals_s.max() > max_interval_ratio * np.median(intervals_s):
        longest = int(intervals_s.argmax())
        raise ValueError(
            f"a gap of {intervals_s[longest]:g} s after t = {times_s[longest]:g} s, where the median interval is "
            f"{np.median(intervals_s):g} s; fill it, or split the file"
        )


@guard_reader("a scenario of CommonRoad")
def read_commonroad(path: Path) -> RecordedObjects:
    """Read the obstacles and planning problems of a CommonRoad scenario.

    Args:
        path: XML file.

    Returns:
        Obstacles as tracks and planning problems as ego vehicles.

    Raises:
        BadFileError: The content is no such scenario.
        FileNotFoundError: The file does not exist.
    """
    root = parse_xml(path)
    if root.tag != "commonRoad":
        raise ValueError(f"<commonRoad> is needed as its root; got <{root.tag[:40]}>")
    frame_interval_s = float(root.get("timeStepSize", "nan"))
    if not 0 < frame_interval_s < math.inf:
        raise ValueError(f"timeStepSize: a positive number is needed; got {root.get('timeStepSize')}")
    _warn_of_skipped_elements(root)
    tracks = [_parse_track(obstacle, frame_interval_s) for obstacle in _list_obstacles(root)]
    egos = tuple(_parse_ego(problem, frame_interval_s) for problem in root.iter("planningProblem"))
    if not tracks:
        raise ValueError("no obstacle in it")
    return RecordedObjects(tuple(tracks), egos)


def _list_obstacles(root: Element) -> list[Element]:
    """List the obstacles of all format versions."""
    obstacles: list[Element] = []
    for tag in OBSTACLE_TAGS:
        obstacles.extend(root.iter(tag))
    return obstacles


def _parse_ego(problem: Element, frame_interval_s: float) -> Ego:
    """Parse a planning problem, which has the initial state of an ego vehicle only."""
    name = problem.get("id", "")
    start = problem.find("initialState")
    if start is None:
        raise ValueError(f"planningProblem {name}: no initialState")
    time_s, position_m, yaw_rad = _parse_state(start, frame_interval_s, f"planningProblem {name}")
    pose = build_transform(convert_euler_to_rotation(math.degrees(yaw_rad), 0.0, 0.0), position_m)
    return Ego(name, np.array([time_s]), pose[None], np.eye(4))


def _parse_track(obstacle: Element, frame_interval_s: float) -> Track:
    """Parse an obstacle; static ones get a single pose."""
    name = obstacle.get("id", "")
    category = (obstacle.findtext("type") or "unknown").strip().lower()
    size_m, center_m, turn_rad = _parse_shape(obstacle, name)
    states = [*obstacle.findall("initialState"), *obstacle.findall("trajectory/state")]
    if not states:
        raise ValueError(f"id {name}: no initialState")
    rows = [_parse_state(state, frame_interval_s, f"id {name}") for state in states]
    if len(rows) > 1 and rows[0] == rows[1]:
        del rows[0]  # the trajectory of some scenarios repeats the initial state
    times_s, positions_m, yaw = (np.array(column) for column in zip(*rows, strict=True))
    forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0], forward[:, 2]], axis=1)
    positions_m = positions_m + center_m[0] * forward + center_m[1] * left
    angles_deg = np.column_stack([np.rad2deg(yaw + turn_rad), np.zeros((len(yaw), 2))])
    trajectory = build_trajectory(name, times_s, positions_m, angles_deg)
    if obstacle.tag == "staticObstacle" or (obstacle.findtext("role") or "").strip() == "static":
        trajectory = Trajectory(times_s[:1], positions_m[:1], angles_deg[:1])
    return Track(name, category, find_vehicle_class(category), size_m, trajectory)


def _parse_shape(obstacle: Element, name: str) -> tuple[tuple[float, float, float], tuple[float, float], float]:
    """Parse size (height NaN), center and rotation of the box around all shapes, in the frame of the obstacle."""
    shapes: list[Element] = []
    for tag in ("rectangle", "circle", "polygon"):
        shapes.extend(obstacle.findall(f"shape/{tag}"))
    if not shapes:
        raise ValueError(f"id {name}: no rectangle, circle or polygon as its shape, so no size")
    turn_rad = 0.0
    if len(shapes) == 1 and shapes[0].find("orientation") is not None:
        turn_rad = _parse_number(shapes[0], "orientation", f"id {name}")
    # A single rotated shape keeps its rotation, so that its box is tight.
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    corners = np.concatenate([_parse_corners(shape, name) for shape in shapes]) @ np.array([[c, -s], [s, c]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    center_m: Matrix = np.array([[c, -s], [s, c]]) @ (low + high) / 2
    length, width = check_box_size(name, high - low)
    return (length, width, math.nan), (float(center_m[0]), float(center_m[1])), turn_rad


def _parse_corners(shape: Element, name: str) -> Matrix:
    """Parse the (K, 2) corners of a shape in the frame of its obstacle; a circle becomes the square around it."""
    owner = f"id {name}"
    if shape.tag == "polygon":
        points = shape.iter("point")
        return np.array([(_parse_number(point, "x", owner), _parse_number(point, "y", owner)) for point in points])
    if shape.tag == "circle":
        half_size_m = np.full(2, _parse_number(shape, "radius", owner))
    else:
        half_size_m = np.array([_parse_number(shape, "length", owner), _parse_number(shape, "width", owner)]) / 2
    check_box_size(name, 2 * half_size_m)
    turn_rad = 0.0 if shape.find("orientation") is None else _parse_number(shape, "orientation", owner)
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    center = shape.find("center")
    center_m = np.zeros(2) if center is None else np.array([_parse_number(center, axis, owner) for axis in "xy"])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return np.asarray((signs * half_size_m) @ np.array([[c, s], [-s, c]]) + center_m)


def _warn_of_skipped_elements(root: Element) -> None:
    """Warn about obstacles that are excluded, reduced to their initial state, or replaced by one box."""
    skipped: Counter[str] = Counter()
    for tag in ("environmentObstacle", "phantomObstacle"):
        for element in root.iter(tag):
            skipped[f"{tag} ({(element.findtext('type') or 'unknown').strip()})"] += 1
    reports = [f"{count} {name} excluded, which occlude nothing" for name, count in skipped.items()]
    obstacles = _list_obstacles(root)
    uncertain = [obstacle.get("id", "") for obstacle in obstacles if obstacle.find("occupancySet") is not None]
    if uncertain:
        reports.append(f"occupancySet of id {', '.join(uncertain[:5])} excluded; only the other states are used")
    joined = [obstacle.get("id", "") for obstacle in obstacles if len(obstacle.findall("shape/*")) > 1]
    if joined:
        reports.append(f"shapes of id {', '.join(joined[:5])} replaced by the box around them")
    if reports:
        warnings.warn(f"CommonRoad scenario: {'; '.join(reports)}", stacklevel=3)


def _parse_state(state: Element, frame_interval_s: float, owner: str) -> tuple[float, list[float], float]:
    """Parse time, position (z is 0 in two dimensions) and yaw in radians."""
    point = state.find("position/point")
    if point is None:
        raise ValueError(f"{owner}: a state needs a point as its position; areas are not read")
    z_m = _parse_number(point, "z", owner) if point.find("z") is not None else 0.0
    position_m = [_parse_number(point, "x", owner), _parse_number(point, "y", owner), z_m]
    time_s = _parse_number(state, "time/exact", owner) * frame_interval_s
    return time_s, position_m, _parse_number(state, "orientation/exact", owner)


def _parse_number(element: Element, tag: str, owner: str) -> float:
    """Parse the number in a child element; errors name the owner."""
    text = element.findtext(tag)
    try:
        return float(text)  # type: ignore[arg-type]  # the message below reports None, too
    except (TypeError, ValueError):
        raise ValueError(f"{owner}: <{element.tag}> needs a number as its <{tag}>; got {text!r}") from None
