"""Removal of road users that overlap others."""

from collections.abc import Sequence

import numpy as np
import shapely

from torchcover.geometry.arrays import Bools
from torchcover.simulation.sumo.motion import Motion
from torchcover.simulation.sumo.paths import find_overlapping_rectangles


def drop_colliding_users(motions: Sequence[Motion]) -> list[Motion]:
    """Drop road users that are not plausible or overlap others; of two that overlap, the one with more overlaps.

    Args:
        motions: Motions; the first one, the ego vehicle, is always present and stays.

    Returns:
        The remaining motions in the same order.
    """
    motions = [motions[0], *(motion for motion in motions[1:] if motion.is_plausible)]
    overlaps = find_overlapping_users(motions)
    counts = overlaps.sum(axis=1)
    counts[0] = -1
    stays = np.ones(len(motions), dtype=bool)
    # Road users with few overlaps decide first, beginning with the ego vehicle.
    for index in np.argsort(counts, kind="stable").tolist():
        if stays[index]:
            stays[overlaps[index]] = False
    return [motions[index] for index in np.flatnonzero(stays).tolist()]


def find_overlapping_users(
    motions: Sequence[Motion], gap_m: float = 0.05, min_level_distance_m: float = 3.0, chunk_frames: int = 20
) -> Bools:
    """Find pairs of road users whose outlines ever overlap.

    Args:
        motions: N motions; the first one is always present.
        gap_m: Smallest gap between outlines.
        min_level_distance_m: Difference of the heights in the simulation from which two are on different road levels.
        chunk_frames: Number of poses that are compared together.

    Returns:
        (N, N) True for pairs that overlap.
    """
    overlaps = np.zeros((len(motions), len(motions)), dtype=bool)
    time_step_s = float(motions[0].times_s[1])
    part_users, part_first_frames, part_sizes_m, part_poses = [], [], [], []
    for index, motion in enumerate(motions):
        track = motion.road_user.track
        heights_m = np.interp(motion.times_s, track.times_s, track.front_positions_m[:, 2])
        for poses, size_m in motion.parts:
            part_users.append(index)
            part_first_frames.append(round(float(motion.times_s[0]) / time_step_s))
            part_sizes_m.append(size_m)
            part_poses.append(np.column_stack([poses, heights_m]))
    users, sizes_m = np.array(part_users), np.array(part_sizes_m) + gap_m
    radii_m = np.linalg.norm(sizes_m, axis=1)[:, None] / 2
    for begin in range(0, len(motions[0].times_s), chunk_frames):
        poses = np.full((chunk_frames, len(part_poses), 4), np.nan)
        for part, all_poses in enumerate(part_poses):
            start = begin - part_first_frames[part]
            chunk = all_poses[max(start, 0) : max(start + chunk_frames, 0)]
            poses[max(-start, 0) :, part][: len(chunk)] = chunk
        # Only bodies whose bounding boxes overlap within these frames are compared.
        present = np.flatnonzero(np.isfinite(poses[..., 0]).any(axis=0))
        positions_m = poses[:, present, :2]
        lower_m = np.fmin.reduce(positions_m) - radii_m[present]
        upper_m = np.fmax.reduce(positions_m) + radii_m[present]
        boxes = shapely.box(*lower_m.T, *upper_m.T)
        pairs = present[shapely.STRtree(boxes).query(boxes)]
        first, second = pairs[:, users[pairs[0]] < users[pairs[1]]]
        is_overlapping = find_overlapping_rectangles(poses[:, first], sizes_m[first], poses[:, second], sizes_m[second])
        is_same_level = np.abs(poses[:, first, 3] - poses[:, second, 3]) < min_level_distance_m
        is_colliding = (is_overlapping & is_same_level).any(axis=0)
        first_users, second_users = users[first[is_colliding]], users[second[is_colliding]]
        overlaps[first_users, second_users] = overlaps[second_users, first_users] = True
    return overlaps
