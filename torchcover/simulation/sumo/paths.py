"""Geometry of paths and of rectangular outlines in the ground plane."""

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64


def compute_lengths_m(vectors_m: Float64) -> Float64:
    """Compute the lengths (...) in the ground plane of vectors (..., 2 or more)."""
    return np.asarray(np.hypot(vectors_m[..., 0], vectors_m[..., 1]))


def compute_arc_lengths_m(path_m: Float64) -> Float64:
    """Compute the arc length of a path up to each position.

    Args:
        path_m: (K, 2) path.

    Returns:
        (K,) arc lengths in meters, from 0.
    """
    return np.concatenate([[0.0], compute_lengths_m(np.diff(path_m, axis=0)).cumsum()])


def interpolate_path(at: Float64, parameters: Float64, path_m: Float64) -> Float64:
    """Interpolate positions on a path.

    Args:
        at: (N,) queried parameters, such as times.
        parameters: (K,) ascending parameters of the path.
        path_m: (K, 2) path.

    Returns:
        (N, 2) positions; the first or last one of the path outside of its parameters.
    """
    return np.stack([np.interp(at, parameters, axis_m) for axis_m in path_m.T], axis=1)


def smooth_positions(positions_m: Float64, half_window: int) -> Float64:
    """Smooth positions (K, D) by weighted means.

    Args:
        positions_m: (K, D) positions; they are continued by reflection beyond both ends.
        half_window: Number of positions before and after each one.
    """
    window = np.hanning(2 * half_window + 3)
    weights = window[1:-1] / window.sum()
    padded_m = np.pad(positions_m, ((half_window, half_window), (0, 0)), "reflect", reflect_type="odd")
    return np.stack([np.convolve(axis_m, weights, "valid") for axis_m in padded_m.T], axis=1)


def shift_path_back(
    path_m: Float64, distance_m: float, initial_yaw_rad: float, corner_m: float = 3.0, spacing_m: float = 0.5
) -> Float64:
    """Compute the path of a point that follows another one at a distance, with rounded corners.

    Args:
        path_m: (K, 2) path of the point ahead.
        distance_m: Distance along the path.
        initial_yaw_rad: Heading before the start of the path.
        corner_m: Distance before and after a corner over which it is rounded.
        spacing_m: Distance of the positions that are smoothed.

    Returns:
        (K, 2) positions at the same times.
    """
    arc_lengths_m = compute_arc_lengths_m(path_m)
    start_m = path_m[:1] - distance_m * np.array([np.cos(initial_yaw_rad), np.sin(initial_yaw_rad)])
    extended_m, extended_lengths_m = np.concatenate([start_m, path_m]), np.concatenate([[-distance_m], arc_lengths_m])
    num_positions = 2 + int((arc_lengths_m[-1] + distance_m) / spacing_m)
    even_lengths_m = np.linspace(-distance_m, arc_lengths_m[-1], num_positions)
    # Smoothing needs even distances; standing vehicles would otherwise have many positions in one place.
    even_m = interpolate_path(even_lengths_m, extended_lengths_m, extended_m)
    rounded_m = smooth_positions(even_m, round(corner_m / spacing_m))
    return interpolate_path(arc_lengths_m - distance_m, even_lengths_m, rounded_m)


def spread_jumps(times_s: Float64, path_m: Float64, max_speed_mps: float, extra_speed_mps: float) -> Float64:
    """Spread jumps of a pedestrian over time, before and after each jump.

    Args:
        times_s: (K,) times.
        path_m: (K, 2) positions.
        max_speed_mps: Speed above which a step is a jump.
        extra_speed_mps: Additional speed with which the distance of a jump is walked.

    Returns:
        (K, 2) positions without jumps.
    """
    steps_m = np.diff(path_m, axis=0)
    lengths_m = compute_lengths_m(steps_m)
    walked_m = path_m.copy()
    for jump in np.flatnonzero(lengths_m > max_speed_mps * np.diff(times_s)).tolist():
        duration_s = min(lengths_m[jump] / extra_speed_mps, times_s[-1] - times_s[0])
        begin_s = (times_s[jump : jump + 2].mean() - duration_s / 2).clip(times_s[0], times_s[-1] - duration_s)
        is_after = np.arange(len(times_s)) > jump
        shares = ((times_s - begin_s) / duration_s).clip(0.0, 1.0) - is_after
        walked_m += shares[:, None] * steps_m[jump]
    return walked_m


def follow_edges(
    path_m: Float64,
    time_step_s: float,
    walkable_area: shapely.Geometry,
    edge_distance_m: float = 0.25,
    max_distance_m: float = 2.0,
    max_speed_mps: float = 3.5,
) -> Float64:
    """Move a pedestrian who leaves the walkable area back along its edge.

    SUMO lets people walk straight through the areas where sidewalks meet, even if these bend around a carriageway.

    Args:
        path_m: (K, 2) positions at even times.
        time_step_s: Time between two positions.
        walkable_area: Sidewalks and crossings.
        edge_distance_m: Distance from the edge, inside the area.
        max_distance_m: Largest distance of the positions before and after from the edge.
        max_speed_mps: Largest speed along the edge; a longer way is not taken.

    Returns:
        (K, 2) positions.
    """
    is_outside = ~shapely.contains_xy(walkable_area, *path_m.T)
    if not is_outside.any():
        return path_m
    moved_m = path_m.copy()
    rings = shapely.get_rings(shapely.get_parts(walkable_area.buffer(-edge_distance_m)))
    changes = np.flatnonzero(np.diff(np.pad(is_outside, 1).astype(np.int8)))
    for first, end in changes.reshape(-1, 2).tolist():
        num_steps = end - first + 1
        ends = shapely.points(path_m[[max(first - 1, 0), min(end, len(path_m) - 1)]])
        nearest = rings[int(shapely.distance(rings[:, None], ends).sum(axis=1).argmin())]
        begin_m, end_m = shapely.line_locate_point(nearest, ends)
        ring_m = shapely.length(nearest)
        distance_m = (end_m - begin_m + ring_m / 2) % ring_m - ring_m / 2  # the shorter way around
        is_close = shapely.distance(nearest, ends).max() < max_distance_m
        if is_close and abs(distance_m) < max_speed_mps * time_step_s * num_steps:
            shares = np.arange(1, num_steps) / num_steps
            points = shapely.line_interpolate_point(nearest, (begin_m + shares * distance_m) % ring_m)
            moved_m[first:end] = shapely.get_coordinates(points)
    return moved_m


def compute_rectangle_corners_m(poses: Float64, sizes_m: Float64) -> Float64:
    """Compute the corners (K, 4, 2) of rectangles.

    Args:
        poses: (K, 3) x, y and heading in radians.
        sizes_m: (K, 2) lengths and widths.
    """
    forward = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=1)[:, None]
    left = np.stack([-forward[..., 1], forward[..., 0]], axis=2)
    half = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]) / 2
    forward_m, left_m = (half[:, axis] * sizes_m[:, axis, None] for axis in (0, 1))
    return np.asarray(poses[:, None, :2] + forward_m[..., None] * forward + left_m[..., None] * left)


def find_overlapping_rectangles(
    poses: Float64, sizes_m: Float64, other_poses: Float64, other_sizes_m: Float64
) -> Bools:
    """Find which of K pairs of rectangles overlap at T times: no axis of either separates them.

    Args:
        poses: (T, K, 3 or more) x, y and heading in radians of the first rectangles; NaN where they are absent.
        sizes_m: (K, 2) lengths and widths of the first rectangles.
        other_poses: (T, K, 3 or more) poses of the second rectangles.
        other_sizes_m: (K, 2) lengths and widths of the second rectangles.

    Returns:
        (T, K) True where both are present and overlap.
    """
    offset_m, turn_rad = other_poses[..., :2] - poses[..., :2], other_poses[..., 2] - poses[..., 2]
    cos, sin = np.abs(np.cos(turn_rad)), np.abs(np.sin(turn_rad))
    overlaps = np.isfinite(turn_rad)
    for yaw_rad, size_m, second_m in (
        (poses[..., 2], sizes_m, other_sizes_m),
        (other_poses[..., 2], other_sizes_m, sizes_m),
    ):
        forward_m = offset_m[..., 0] * np.cos(yaw_rad) + offset_m[..., 1] * np.sin(yaw_rad)
        left_m = offset_m[..., 1] * np.cos(yaw_rad) - offset_m[..., 0] * np.sin(yaw_rad)
        overlaps &= 2 * np.abs(forward_m) < size_m[:, 0] + second_m[:, 0] * cos + second_m[:, 1] * sin
        overlaps &= 2 * np.abs(left_m) < size_m[:, 1] + second_m[:, 0] * sin + second_m[:, 1] * cos
    return overlaps


def measure_evasions_m(obstacles: NDArray[np.object_], poses: Float64, sizes_m: Float64) -> Float64:
    """Measure how far rectangles must move sideways to leave obstacles.

    Args:
        obstacles: Polygons.
        poses: (K, 3) x, y and heading in radians.
        sizes_m: (K, 2) lengths and widths.

    Returns:
        (2, K) distances to the right, negative, because of obstacles on the left, and to the left, positive.
    """
    outlines = shapely.polygons(compute_rectangle_corners_m(poses, sizes_m))
    obstacle, rectangle = shapely.STRtree(outlines).query(obstacles, predicate="intersects")
    overlaps = shapely.intersection(outlines[rectangle], obstacles[obstacle])
    vertices_m, pair = shapely.get_coordinates(overlaps, return_index=True)
    offset_m, yaw_rad = vertices_m - poses[rectangle[pair], :2], poses[rectangle[pair], 2]
    left_m = offset_m[:, 1] * np.cos(yaw_rad) - offset_m[:, 0] * np.sin(yaw_rad)
    lower_m, upper_m = np.full((2, len(rectangle)), [[np.inf], [-np.inf]])
    np.minimum.at(lower_m, pair, left_m)
    np.maximum.at(upper_m, pair, left_m)
    # An overlap lies on the side of its middle.
    half_width_m = sizes_m[rectangle, 1] / 2
    evasion_m = np.where(lower_m + upper_m > 0, lower_m - half_width_m, upper_m + half_width_m)
    evasions_m = np.zeros((2, len(poses)))
    np.minimum.at(evasions_m[0], rectangle, evasion_m)
    np.maximum.at(evasions_m[1], rectangle, evasion_m)
    return evasions_m
