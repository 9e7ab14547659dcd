"""Excerpts of recordings: the ego vehicle, the other tracks and the time span that a scene shows."""

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.objects import Ego, RecordedObjects, Track

TIME_SLACK_S = 1e-6  # tolerance of comparisons of times
MAX_LISTED_NAMES = 8  # names and time spans in an error message


@dataclass(frozen=True)
class GapParams:
    """Limits beyond which consecutive positions of a track do not belong together.

    Args:
        max_speed_mps: Largest speed of a road user; a faster change of position is a jump of the recording.
        position_slack_m: Part of a change of position that noise explains at any time difference.
        min_interval_s: Poses that follow sooner are dropped, since noise dominates the speed between them.
    """

    max_speed_mps: float = 90.0
    position_slack_m: float = 1.0
    min_interval_s: float = 1e-3


class Excerpt(NamedTuple):
    """Part of a recording that a scene shows.

    Args:
        name: Name of the ego vehicle.
        ego_trajectory: Trajectory of the vehicle frame, in the time of the recording.
        other_tracks: All other tracks, in the same time.
        begin_s: Time of the recording at which the excerpt begins.
        duration_s: Length of the excerpt.
    """

    name: str
    ego_trajectory: Trajectory
    other_tracks: tuple[Track, ...]
    begin_s: float = 0.0
    duration_s: float = 0.0


def choose_ego(recording: RecordedObjects, ego_id: str | None, ego_T_vehicle: Matrix | None) -> Excerpt:
    """Choose the ego vehicle of a recording; the time span is chosen later.

    Args:
        recording: Egos and tracks of the recording.
        ego_id: Name of an ego or a track; the first ego of the recording if None.
        ego_T_vehicle: (4, 4) pose of the vehicle frame in the frame of the ego's poses; the published one if None.

    Returns:
        Excerpt without a time span.

    Raises:
        ValueError: The recording has no such ego or track, or `ego_T_vehicle` is given for a track.
    """
    egos = {ego.name: ego for ego in recording.egos}
    if ego_id is None and not egos:
        names = _list_names(recording, "")
        raise ValueError(f"ego_id: the recording has no ego vehicle; name one of its tracks: {names}")
    ego = next(iter(egos.values())) if ego_id is None else egos.get(ego_id)
    if ego is not None:
        return Excerpt(ego.name, _compute_ego_trajectory(ego, ego_T_vehicle), recording.tracks)
    tracks = [track for track in recording.tracks if track.name == ego_id]
    if not tracks:
        names = _list_names(recording, str(ego_id))
        raise ValueError(f"ego_id: there is no {ego_id!r} in the recording; it has {names}")
    if ego_T_vehicle is not None:
        raise ValueError(
            f"ego_T_vehicle: only an ego vehicle without a box needs it; the box of track {ego_id!r} defines its "
            "vehicle frame; remove ego_T_vehicle"
        )
    other_tracks = [track for track in recording.tracks if track is not tracks[0]]
    for recorded_ego in recording.egos:
        track = _convert_ego_to_track(recorded_ego)
        if track is not None:
            other_tracks.append(track)
    return Excerpt(tracks[0].name, tracks[0].trajectory, tuple(other_tracks))


def choose_time_span(excerpt: Excerpt, begin_s: float, duration_s: float | None, max_gap_s: float) -> Excerpt:
    """Choose the time span of an excerpt within the time in which the ego vehicle and the other tracks are recorded.

    An ego vehicle with a single pose is static; the excerpt is that single time unless a duration is given.

    Args:
        excerpt: Ego vehicle and other tracks.
        begin_s: Start, after the first time at which the ego vehicle and the other tracks are recorded.
        duration_s: Length; up to the end of the recorded time if None.
        max_gap_s: Longest gap between two poses of the ego vehicle.

    Returns:
        Excerpt with a time span; the ego trajectory has no gaps and no jumps.

    Raises:
        ValueError: The span is not within the recorded time, or the ego trajectory has a gap in it.
    """
    ego_times_s = excerpt.ego_trajectory.times_s
    is_static = len(ego_times_s) == 1
    track_times_s = [track.trajectory.times_s for track in excerpt.other_tracks if track.trajectory.is_transient]
    earliest_s = min((float(times_s[0]) for times_s in track_times_s), default=-np.inf)
    latest_s = max((float(times_s[-1]) for times_s in track_times_s), default=np.inf)
    first_s = float(ego_times_s[0]) if is_static else max(float(ego_times_s[0]), earliest_s)
    last_s = max(latest_s, first_s) if is_static else min(float(ego_times_s[-1]), latest_s)
    if last_s < first_s - TIME_SLACK_S:
        raise ValueError(
            f"the ego {excerpt.name!r} is there from {ego_times_s[0]:g} to {ego_times_s[-1]:g} s, the others from "
            f"{earliest_s:g} to {latest_s:g} s of the recording: never at the same time"
        )
    available_s = last_s - first_s
    if duration_s is None:
        duration_s = 0.0 if is_static else available_s - begin_s
    if begin_s + max(duration_s, 0.0) > available_s + TIME_SLACK_S:
        raise ValueError(
            f"the ego {excerpt.name!r} and the others are known for {available_s:g} s; begin_s {begin_s:g} and "
            f"duration_s {max(duration_s, 0.0):g} reach beyond: make them shorter"
        )
    begin_s += first_s
    trajectory = excerpt.ego_trajectory
    if not is_static:
        trajectory = _select_piece_without_gaps(excerpt, begin_s, begin_s + duration_s, max_gap_s, first_s)
    return excerpt._replace(ego_trajectory=trajectory, begin_s=begin_s, duration_s=duration_s)


def _select_piece_without_gaps(
    excerpt: Excerpt, begin_s: float, end_s: float, max_gap_s: float, first_s: float
) -> Trajectory:
    """Select the piece of the ego trajectory that covers a time span; times in messages count from `first_s`."""
    pieces = split_at_gaps(excerpt.ego_trajectory, max_gap_s)
    for piece in pieces:
        if piece.times_s[0] <= begin_s + TIME_SLACK_S and piece.times_s[-1] >= end_s - TIME_SLACK_S:
            return piece
    spans = []
    for piece in pieces:
        if piece.times_s[-1] > first_s:
            spans.append(f"{max(piece.times_s[0], first_s) - first_s:.4g} to {piece.times_s[-1] - first_s:.4g} s")
    raise ValueError(
        f"the ego {excerpt.name!r} is not there all the time: it has a gap of over {max_gap_s:g} s (max_gap_s), or "
        f"jumps. It is there from {', '.join(spans[:MAX_LISTED_NAMES])}; choose begin_s and duration_s within one of "
        "these"
    )


def split_at_gaps(trajectory: Trajectory, max_gap_s: float, params: GapParams = GapParams()) -> list[Trajectory]:
    """Split a trajectory where the object was unobserved for too long, or where it jumps.

    Args:
        trajectory: Recorded trajectory.
        max_gap_s: Longest time between two poses of one piece.
        params: Speed above which a change of position is a jump.

    Returns:
        Pieces in the order of time.
    """
    selection = _select_spaced_times(trajectory.times_s, params.min_interval_s)
    times_s, positions_m = trajectory.times_s[selection], trajectory.positions_m[selection]
    angles_deg = trajectory.angles_deg[selection]
    intervals_s, distances_m = np.diff(times_s), np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    is_jump = distances_m > params.max_speed_mps * intervals_s + params.position_slack_m
    breaks = np.flatnonzero((intervals_s > max_gap_s) | is_jump) + 1
    pieces = []
    for first, end in pairwise([0, *breaks.tolist(), len(times_s)]):
        piece = slice(first, end)
        pieces.append(Trajectory(times_s[piece], positions_m[piece], angles_deg[piece], trajectory.is_transient))
    return pieces


def _select_spaced_times(times_s: Matrix, min_interval_s: float) -> Sequence[int] | slice:
    """Select indices of times that are at least `min_interval_s` apart, beginning with the first."""
    if len(times_s) < 2 or np.diff(times_s).min() >= min_interval_s:
        return slice(None)
    indices = [0]
    for index, time_s in enumerate(times_s.tolist()):
        if time_s - times_s[indices[-1]] >= min_interval_s:
            indices.append(index)
    return indices


def _compute_ego_trajectory(ego: Ego, ego_T_vehicle: Matrix | None) -> Trajectory:
    """Compute the trajectory of the vehicle frame of a recorded ego vehicle."""
    world_T_vehicle = ego.world_T_ego @ (ego.ego_T_vehicle if ego_T_vehicle is None else ego_T_vehicle)
    return Trajectory.from_poses(ego.times_s, world_T_vehicle)


def _convert_ego_to_track(ego: Ego) -> Track | None:
    """Convert the ego vehicle of a recording to a track; None if its size is unknown."""
    if ego.size_m is None:
        return None
    trajectory = _compute_ego_trajectory(ego, None)
    transient = Trajectory(trajectory.times_s, trajectory.positions_m, trajectory.angles_deg, is_transient=True)
    return Track(ego.name, "car", "passenger", ego.size_m, transient)


def _list_names(recording: RecordedObjects, query: str) -> str:
    """List some names of the recording for a message, names similar to `query` first."""
    names = [*(ego.name for ego in recording.egos), *(track.name for track in recording.tracks)]
    similar = get_close_matches(query, names, n=MAX_LISTED_NAMES, cutoff=0.3)
    ordered = [*similar, *(name for name in names if name not in similar)]
    num_omitted = len(ordered) - MAX_LISTED_NAMES
    listed = ", ".join(map(repr, ordered[:MAX_LISTED_NAMES]))
    return listed + (f" and {num_omitted} more" if num_omitted > 0 else "")


def build_pose_matrices(trajectory: Trajectory) -> Matrix:
    """Build the (K, 4, 4) pose matrices at the times of a trajectory."""
    return build_transform(convert_euler_to_rotation(*trajectory.angles_deg.T), trajectory.positions_m)
