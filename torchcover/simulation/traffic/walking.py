"""Pedestrians that walk to and fro on straight paths, such as crossings of a street."""

from dataclasses import dataclass

import numpy as np

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.traffic.scenery import CURB_HEIGHT_M


@dataclass(frozen=True, eq=False)
class Footpath:
    """Straight path between two waiting positions.

    Args:
        start_m: (2,) first waiting position.
        end_m: (2,) second waiting position.
        curb_distance_m: Distance from each waiting position to the curb ahead; None without curbs.
    """

    start_m: Float64
    end_m: Float64
    curb_distance_m: float | None = None

    @property
    def length_m(self) -> float:
        """Distance between the waiting positions."""
        return float(np.linalg.norm(self.end_m - self.start_m))

    def compute_poses(self, fractions: Float64, is_returning: Bools, body_radius_m: float) -> tuple[Float64, Float64]:
        """Compute poses of a pedestrian on the path.

        Args:
            fractions: (T,) positions as fractions of the path, from the start.
            is_returning: (T,) True on the way from the end to the start.
            body_radius_m: Radius of the body, which steps down when all of it is past the curb.

        Returns:
            (T, 3) positions in meters and (T,) headings in degrees.
        """
        path_m = self.end_m - self.start_m
        yaw_deg = np.rad2deg(np.arctan2(path_m[1], path_m[0])) + 180.0 * is_returning
        positions_m = self.start_m + fractions[:, None] * path_m
        heights_m = np.zeros(len(fractions))
        if self.curb_distance_m is not None:
            beyond_curb_m = np.minimum(fractions, 1 - fractions) * self.length_m - self.curb_distance_m
            heights_m = compute_step_height_m(beyond_curb_m, body_radius_m)
        return np.column_stack([positions_m, heights_m]), yaw_deg


@dataclass(frozen=True)
class WalkingParams:
    """Behavior of a pedestrian that walks to and fro.

    Args:
        max_wait_s: Longest wait before the pedestrian looks for a chance to start.
        start_probability: Probability to take a chance instead of waiting for a later one.
    """

    max_wait_s: float = 12.0
    start_probability: float = 0.8


def simulate_walking(
    path: Footpath,
    can_start: Bools,
    traversal_s: float,
    times_s: Float64,
    body_radius_m: float,
    generator: np.random.Generator,
    params: WalkingParams = WalkingParams(),
) -> tuple[Float64, Float64]:
    """Simulate a pedestrian that walks to and fro on a path.

    Args:
        path: The path.
        can_start: (T,) frames at which a pedestrian that starts finds the path free until its end.
        traversal_s: Duration of one way.
        times_s: (T,) evenly spaced times.
        body_radius_m: Radius of the body.
        generator: Random generator of waits.
        params: Behavior.

    Returns:
        (T, 3) positions in meters and (T,) headings in degrees.
    """
    num_frames, frame_interval_s = len(can_start), float(times_s[1] - times_s[0])
    start_frames = np.flatnonzero(can_start)
    traversal_frames = int(np.ceil(traversal_s / frame_interval_s))
    is_at_end = bool(generator.random() < 0.5)
    fractions, is_returning = np.full(num_frames, float(is_at_end)), np.full(num_frames, is_at_end)
    frame = 0
    while True:
        frame += round(generator.uniform(0.0, params.max_wait_s) / frame_interval_s)
        next_start = int(np.searchsorted(start_frames, frame))
        if next_start == len(start_frames):
            return path.compute_poses(fractions, is_returning, body_radius_m)
        start = int(start_frames[next_start])
        frame = start + 1
        if generator.random() < params.start_probability:
            progress = np.clip((np.arange(num_frames) - start) / traversal_frames, 0.0, 1.0)[start:]
            fractions[start:] = 1.0 - progress if is_at_end else progress
            frame = start + traversal_frames
            is_at_end = not is_at_end
            is_returning[frame:] = is_at_end


def compute_step_height_m(beyond_curb_m: Float64, body_radius_m: float | Float64) -> Float64:
    """Compute the height of the feet of a pedestrian near a curb.

    Args:
        beyond_curb_m: (...) distance of the center from the curb, positive on the carriageway.
        body_radius_m: Radius of the body, or (...) radii.

    Returns:
        (...) heights above the carriageway in meters.
    """
    step_fractions = (beyond_curb_m - body_radius_m) / CURB_HEIGHT_M
    return CURB_HEIGHT_M * (1.0 - np.clip(step_fractions, 0.0, 1.0))


def is_free_for(blocked: Bools, duration_s: float, step_s: float) -> Bools:
    """Test whether nothing is blocked from each frame on for a duration.

    Args:
        blocked: (T,) blocked frames; frames after the last one count as free.
        duration_s: The duration.
        step_s: Time between two frames.

    Returns:
        (T,) True where all frames of the duration are free.
    """
    num_frames = int(np.ceil(duration_s / step_s))
    blocked_before = np.concatenate([[0], np.cumsum(blocked)])
    frames = np.arange(len(blocked))
    ends = np.minimum(frames + num_frames + 1, len(blocked))
    return np.asarray(blocked_before[ends] == blocked_before[frames])
