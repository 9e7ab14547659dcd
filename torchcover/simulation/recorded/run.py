"""Which track is the ego, and from when to when a recording is shown."""

from collections.abc import Sequence
from difflib import get_close_matches
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import Ego, RecordedObjects, Track

TIME_SLACK_S = 1e-6
# Whoever moves faster than this, by more than this, was moved by the recording.
FASTEST_MPS = 90.0
JUMP_M = 1.0
# Poses that follow each other more closely say nothing but noise about a speed.
CLOSEST_S = 1e-3
TOLD = 8


class Excerpt(NamedTuple):
    """What is shown of a recording: `ego_trajectory` of the ego and all `other_tracks`, in its time, from `begin_s` on."""

    name: str
    ego_trajectory: Trajectory
    other_tracks: tuple[Track, ...]
    begin_s: float = 0.0
    duration_s: float = 0.0


def choose_ego(recording: RecordedObjects, ego_id: str | None, ego_T_vehicle: Matrix | None) -> Excerpt:
    """Choose the ego, and no times yet: the track or the recording's own ego of an id, the first of these without one.

    `ego_T_vehicle` is the vehicle frame in that of the poses of its own ego, if not as published.
    """
    egos = {ego.name: ego for ego in recording.egos}
    if ego_id is None and not egos:
        raise ValueError(f"ego_id: the recording has no ego of its own; name one of its tracks, {_told(recording, '')}")
    own = next(iter(egos.values())) if ego_id is None else egos.get(ego_id)
    if own is not None:
        return Excerpt(own.name, _drive(own, ego_T_vehicle), recording.tracks)
    found = [track for track in recording.tracks if track.name == ego_id]
    if not found:
        raise ValueError(f"ego_id: there is no {ego_id!r} in the recording, but {_told(recording, str(ego_id))}")
    if ego_T_vehicle is not None:
        raise ValueError(f"ego_T_vehicle: is for an ego without a box; that of {ego_id!r} says where its middle is")
    others = [track for track in recording.tracks if track is not found[0]]
    bodies = [_as_track(ego) for ego in recording.egos]
    return Excerpt(found[0].name, found[0].trajectory, (*others, *(body for body in bodies if body is not None)))


def choose_time_span(excerpt: Excerpt, begin_s: float, duration_s: float | None, max_gap_s: float) -> Excerpt:
    """Choose the times: those at which the ego and the others are known, or of them what is asked for.

    An ego of which one pose is known stands there; that instant alone is shown, unless a duration is given.
    """
    drive_s = excerpt.ego_trajectory.times_s
    stands = len(drive_s) == 1
    known_s = [track.trajectory.times_s for track in excerpt.other_tracks if track.trajectory.is_transient]
    earliest_s = min((float(times_s[0]) for times_s in known_s), default=-np.inf)
    latest_s = max((float(times_s[-1]) for times_s in known_s), default=np.inf)
    first_s = float(drive_s[0]) if stands else max(float(drive_s[0]), earliest_s)
    last_s = max(latest_s, first_s) if stands else min(float(drive_s[-1]), latest_s)
    if last_s < first_s - TIME_SLACK_S:
        raise ValueError(
            f"the ego {excerpt.name!r} is there from {drive_s[0]:g} to {drive_s[-1]:g} s, the others from {earliest_s:g} "
            f"to {latest_s:g} s of the recording: never at the same time"
        )
    length_s = last_s - first_s
    if duration_s is None:
        duration_s = 0.0 if stands else length_s - begin_s
    if begin_s + max(duration_s, 0.0) > length_s + TIME_SLACK_S:
        raise ValueError(
            f"the ego {excerpt.name!r} and the others are known for {length_s:g} s; begin_s {begin_s:g} and duration_s "
            f"{max(duration_s, 0.0):g} reach beyond: make them shorter"
        )
    begin_s += first_s
    whole = (
        excerpt.ego_trajectory if stands else _without_gaps(excerpt, begin_s, begin_s + duration_s, max_gap_s, first_s)
    )
    return excerpt._replace(ego_trajectory=whole, begin_s=begin_s, duration_s=duration_s)


def _without_gaps(cast: Excerpt, begin_s: float, end_s: float, max_gap_s: float, first_s: float) -> Trajectory:
    """The piece of the ego's drive that holds all of a time."""
    found = split_at_gaps(cast.ego_trajectory, max_gap_s)
    for piece in found:
        if piece.times_s[0] <= begin_s + TIME_SLACK_S and piece.times_s[-1] >= end_s - TIME_SLACK_S:
            return piece
    told = [
        f"{max(piece.times_s[0], first_s) - first_s:.4g} to {piece.times_s[-1] - first_s:.4g} s"
        for piece in found
        if piece.times_s[-1] > first_s
    ]
    raise ValueError(
        f"the ego {cast.name!r} is not there all the time: it has a gap of over {max_gap_s:g} s (max_gap_s), or jumps. "
        f"It is there from {', '.join(told[:TOLD])}; choose begin_s and duration_s within one of these"
    )


def split_at_gaps(trajectory: Trajectory, max_gap_s: float) -> list[Trajectory]:
    """What is left of a trajectory where it was unseen for too long, or jumps."""
    kept = _apart(trajectory.times_s)
    times_s, places_m, angles_deg = trajectory.times_s[kept], trajectory.positions_m[kept], trajectory.angles_deg[kept]
    taken_s, way_m = np.diff(times_s), np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    breaks = np.flatnonzero((taken_s > max_gap_s) | (way_m > FASTEST_MPS * taken_s + JUMP_M)) + 1
    return [
        Trajectory(times_s[first:end], places_m[first:end], angles_deg[first:end], trajectory.is_transient)
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


def _drive(ego: Ego, ego_T_vehicle: Matrix | None) -> Trajectory:
    world_T_vehicle = ego.world_T_ego @ (ego.ego_T_vehicle if ego_T_vehicle is None else ego_T_vehicle)
    return Trajectory.from_poses(ego.times_s, world_T_vehicle)


def _as_track(ego: Ego) -> Track | None:
    """A recording's own ego as one of the others; None if its size is unknown."""
    if ego.size_m is None:
        return None
    drive = _drive(ego, None)
    there = Trajectory(drive.times_s, drive.positions_m, drive.angles_deg, is_transient=True)
    return Track(ego.name, "car", "passenger", ego.size_m, there)


def _told(recording: RecordedObjects, like: str) -> str:
    """Some of the ids that there are, those that look like one first."""
    names = [*(ego.name for ego in recording.egos), *(track.name for track in recording.tracks)]
    alike = get_close_matches(like, names, n=TOLD, cutoff=0.3)
    told = [*alike, *(name for name in names if name not in alike)]
    more = len(told) - TOLD
    return ", ".join(map(repr, told[:TOLD])) + (f" and {more} more" if more > 0 else "")


def build_pose_matrices(trajectory: Trajectory) -> Matrix:
    """(K, 4, 4) the poses that a trajectory was given."""
    return build_transform(convert_euler_to_rotation(*trajectory.angles_deg.T), trajectory.positions_m)
