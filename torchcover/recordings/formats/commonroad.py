"""Scenarios of CommonRoad (Althoff et al., IV 2017), versions 2018b and 2020a: obstacles and planning problems."""

import math
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from torchcover.files import parse_xml, reads
from torchcover.geometry import rigid, rotation_from_euler
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import Ego, RecordedObjects, Track, checked_size, class_of, moving

OBSTACLES = ("obstacle", "dynamicObstacle", "staticObstacle")


@reads("a scenario of CommonRoad")
def read_objects(path: Path) -> RecordedObjects:
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
    pose = rigid(rotation_from_euler(math.degrees(yaw), 0.0, 0.0), place_m)
    return Ego(name, np.array([time_s]), pose[None], np.eye(4))


def _track(obstacle: Element, step_s: float) -> Track:
    name = obstacle.get("id", "")
    category = (obstacle.findtext("type") or "unknown").strip().lower()
    size_m, middle_m = _shape(obstacle, name)
    states = [state for tag in ("initialState", "trajectory/state") for state in obstacle.findall(tag)]
    if not states:
        raise ValueError(f"id {name}: no initialState")
    rows = [_state(state, step_s, f"id {name}") for state in states]
    times_s, yaw = np.array([row[0] for row in rows]), np.array([row[2] for row in rows])
    forward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0], forward[:, 2]], axis=1)
    places_m = np.array([row[1] for row in rows]) + middle_m[0] * forward + middle_m[1] * left
    angles_deg = np.column_stack([np.rad2deg(yaw), np.zeros((len(yaw), 2))])
    trajectory = moving(name, times_s, places_m, angles_deg)
    if obstacle.tag == "staticObstacle" or (obstacle.findtext("role") or "").strip() == "static":
        trajectory = Trajectory(times_s[:1], places_m[:1], angles_deg[:1])
    return Track(name, category, class_of(category), size_m, trajectory)


def _shape(obstacle: Element, name: str) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Length and width, no height; and the middle, as seen from the obstacle's place."""
    owner = f"id {name}"
    rectangle, circle, polygon = (obstacle.find(f"shape/{tag}") for tag in ("rectangle", "circle", "polygon"))
    if rectangle is not None:
        low = -np.array([_number(rectangle, "length", owner), _number(rectangle, "width", owner)]) / 2
        high = -low
    elif circle is not None:
        high = np.full(2, _number(circle, "radius", owner))
        low = -high
    elif polygon is not None:
        corners = [(_number(point, "x", owner), _number(point, "y", owner)) for point in polygon.iter("point")]
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    else:
        raise ValueError(f"{owner}: no rectangle, circle or polygon as its shape, so no size")
    middle_m: Matrix = (low + high) / 2
    length, width = checked_size(name, high - low)
    return (length, width, math.nan), (float(middle_m[0]), float(middle_m[1]))


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
