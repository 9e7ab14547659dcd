"""What was recorded of somebody: when and where, how large, and what it was."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import euler_from_rotation
from torchcover.geometry.rigid import Matrix
from torchcover.simulation.trajectory import Trajectory

# Whoever moves faster than this, by more than this, was moved by the recording.
FASTEST_MPS = 90.0
JUMP_M = 1.0
# Poses that follow each other more closely say nothing but noise about a speed.
CLOSEST_S = 1e-3


class Track(NamedTuple):
    """A box over time.

    Args:
        name: Its id.
        category: What the recording calls it.
        vehicle_class: The class whose bodies stand for it (`vehicle_class.BODIES`); None if it is a box.
        size_m: Length, width, height; NaN for a height that was not recorded.
        trajectory: Of the middle of its bottom; transient, unless it is there all the time.
    """

    name: str
    category: str
    vehicle_class: str | None
    size_m: tuple[float, float, float]
    trajectory: Trajectory


class Ego(NamedTuple):
    """A recording's own ego.

    Args:
        name: Its id.
        times_s: (K,) when.
        world_T_ego: (K, 4, 4) where.
        ego_T_vehicle: (4, 4) the vehicle frame in that of these poses: on the ground under the middle of its body.
        size_m: Of its body, as published; None if it is unknown.
    """

    name: str
    times_s: NDArray[np.float64]
    world_T_ego: Matrix
    ego_T_vehicle: Matrix
    size_m: tuple[float, float, float] | None = None


class Recording(NamedTuple):
    """What was recorded, at times of one clock.

    Args:
        tracks: Everybody but its egos.
        egos: Its own; the first is meant if none is named.
    """

    tracks: tuple[Track, ...]
    egos: tuple[Ego, ...] = ()


def track_of(
    name: str, category: str, vehicle_class: str | None, sizes_m: Matrix, times_s: Matrix, world_T_box: Matrix
) -> Track:
    """A track from boxes about their middles.

    Args:
        name: Its id.
        category: What the recording calls it.
        vehicle_class: See `Track`.
        sizes_m: (K, 3) length, width and height of each box; the median counts.
        times_s: (K,) ascending.
        world_T_box: (K, 4, 4).

    Raises:
        ValueError: No size, times that do not ascend, numbers that are none; the message names the id.
    """
    checked_size(name, sizes_m.min(axis=0))
    length, width, height = checked_size(name, np.median(sizes_m, axis=0))
    places_m = world_T_box[:, :3, 3] - sizes_m[:, 2:] / 2 * world_T_box[:, :3, 2]
    angles_deg = euler_from_rotation(world_T_box[:, :3, :3])
    trajectory = moving(name, times_s, places_m, angles_deg)
    return Track(name, category, vehicle_class, (length, width, height), trajectory)


def checked_size(name: str, size_m: Matrix) -> tuple[float, ...]:
    """A size that a body can have, as far as it was recorded.

    Raises:
        ValueError: It is not; the message names the id.
    """
    if not (np.isfinite(size_m).all() and (size_m > 0).all()):
        raise ValueError(f"id {name}: a box needs a positive length, width and height; got {size_m.tolist()}")
    return tuple(size_m.tolist())


def moving(name: str, times_s: Matrix, places_m: Matrix, angles_deg: Matrix) -> Trajectory:
    """A trajectory that is there within its times.

    Raises:
        ValueError: As `Trajectory`; the message names the id.
    """
    try:
        return Trajectory(times_s, places_m, angles_deg, transient=True)
    except ValueError as error:
        raise ValueError(f"id {name}: {error}") from error


def pieces(trajectory: Trajectory, max_gap_s: float) -> list[Trajectory]:
    """What is left of a trajectory where nobody knows where it was in between, or where it jumps."""
    kept = _apart(trajectory.times_s)
    times_s, places_m, angles_deg = trajectory.times_s[kept], trajectory.positions_m[kept], trajectory.angles_deg[kept]
    taken_s, way_m = np.diff(times_s), np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    breaks = np.flatnonzero((taken_s > max_gap_s) | (way_m > FASTEST_MPS * taken_s + JUMP_M)) + 1
    return [
        Trajectory(times_s[first:end], places_m[first:end], angles_deg[first:end], trajectory.transient)
        for first, end in pairwise([0, *breaks.tolist(), len(times_s)])
    ]


def _apart(times_s: Matrix) -> Sequence[int] | slice:
    """Numbers of times that do not follow each other too closely."""
    if len(times_s) < 2 or np.diff(times_s).min() >= CLOSEST_S:
        return slice(None)
    kept = [0]
    for number, time_s in enumerate(times_s.tolist()):
        if time_s - times_s[kept[-1]] >= CLOSEST_S:
            kept.append(number)
    return kept


def rows_by_name(names: Sequence[str], times_s: Matrix) -> list[tuple[str, NDArray[np.int64]]]:
    """The rows of each name, in the order of time."""
    found: dict[str, list[int]] = {}
    for row in np.argsort(times_s, kind="stable").tolist():
        found.setdefault(str(names[row]), []).append(row)
    return [(name, np.array(rows, dtype=np.int64)) for name, rows in found.items()]


def only_one_scene(scene: str | None, what: str) -> None:
    """Refuse the name of a scene where there is but one.

    Raises:
        ValueError: One was given.
    """
    if scene is not None:
        raise ValueError(f"scene: is for tables of nuScenes; {what} has but one; leave it out")
