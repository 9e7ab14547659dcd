"""Loops over points of scans, compiled by numba; importing this module fails where numba is missing.

Each function is the twin of a function `..._by_arrays`, which documents the arguments, and gives the same result.
"""

import math

import numpy as np

from torchcover.neighbors.compiled import Array, compile_function, inline_function


@compile_function("void(f8[:, ::1], f4[:, ::1], i8, f8[:, ::1], f8, i8, i8, i2[::1], i8)")
def count_votes_by_loop(
    points_m: Array,
    free_range_m: Array,
    first_row: int,
    sensor_T_local: Array,
    max_free_range_m: float,
    columns: int,
    rows: int,
    votes: Array,
    increment: int,
) -> None:
    """Add votes to the points in the free space of a range image: twin of `free_space.count_votes_by_arrays`."""
    T, halvings = sensor_T_local, 0  # a shift by the halvings of the bins is faster than a division
    while columns >> halvings > free_range_m.shape[1]:
        halvings += 1
    for i in range(points_m.shape[0]):
        px, py, pz = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        range_m = math.sqrt(x * x + y * y + z * z)
        if range_m >= max_free_range_m:
            continue
        row = (min(int((1 + z / max(range_m, 1e-9)) * (rows / 2)), rows - 1) >> halvings) - first_row
        if row < 0 or row >= free_range_m.shape[0]:
            continue
        smaller, larger = min(abs(x), abs(y)), max(abs(x), abs(y), 1e-9)
        quarter_turns = smaller / larger * (0.64 - 0.14 * (smaller / larger))
        if abs(y) > abs(x):
            quarter_turns = 1 - quarter_turns
        if x < 0:
            quarter_turns = 2 - quarter_turns
        if y < 0:
            quarter_turns = 4 - quarter_turns
        column = int(quarter_turns * (columns / 4))
        if range_m < free_range_m[row, (0 if column == columns else column) >> halvings]:
            votes[i] += increment


@inline_function
def _approximate_angle(y: Array, x: Array) -> Array:
    """Approximate `math.atan2(y, x)`: twin of the function of this name in `visibility`."""
    ratio = min(abs(x), abs(y)) / max(abs(x), abs(y), 1e-30)
    square = ratio * ratio
    polynomial = -0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351))
    angle = ratio * (0.9998660 + square * polynomial)
    if abs(y) > abs(x):
        angle = math.pi / 2 - angle
    if x < 0:
        angle = math.pi - angle
    return -angle if y < 0 else angle


@compile_function("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], f8, f8, f8, b1[::1])")
def mark_hidden_by_loop(
    points_m: Array,
    viewpoint_m: Array,
    box_corners_m: Array,
    bin_sizes_rad: Array,
    max_occluder_ranges_m: Array,
    margin_m: float,
    relative_margin: float,
    roughness_m: float,
    hidden: Array,
) -> None:
    """Mark the points that a box or other points occlude: twin of `visibility.mark_hidden_by_arrays`."""
    count = points_m.shape[0]
    elevation_rad, raised_elevation_rad, azimuth_rad = np.empty(count), np.empty(count), np.empty(count)
    range_m = np.empty(count)
    for i in range(count):
        x, y, z = points_m[i, 0] - viewpoint_m[0], points_m[i, 1] - viewpoint_m[1], points_m[i, 2] - viewpoint_m[2]
        horizontal_m = math.sqrt(x * x + y * y)
        range_m[i] = math.sqrt(horizontal_m * horizontal_m + z * z)
        elevation_rad[i] = _approximate_angle(z, horizontal_m) + math.pi / 2
        raised_elevation_rad[i] = _approximate_angle(z + roughness_m, horizontal_m) + math.pi / 2
        azimuth_rad[i] = _approximate_angle(y, x) + math.pi
        enters, leaves = -math.inf, math.inf
        for axis in range(3):
            ray_m = points_m[i, axis] - viewpoint_m[axis]
            lower_share = (box_corners_m[0, axis] - viewpoint_m[axis]) / ray_m
            upper_share = (box_corners_m[1, axis] - viewpoint_m[axis]) / ray_m
            enters = max(enters, min(lower_share, upper_share))
            leaves = min(leaves, max(lower_share, upper_share))
        hidden[i] |= enters < leaves and leaves > 0 and enters < 1
    for level in range(bin_sizes_rad.shape[0]):
        bin_rad, columns = bin_sizes_rad[level], int(2 * math.pi / bin_sizes_rad[level]) + 1
        nearest_m = np.full((int(math.pi / bin_rad) + 1) * columns, np.inf)
        for i in range(count):
            if range_m[i] < max_occluder_ranges_m[level]:
                index = int(elevation_rad[i] / bin_rad) * columns + int(azimuth_rad[i] / bin_rad)
                nearest_m[index] = min(nearest_m[index], range_m[i])
        for i in range(count):
            index = int(raised_elevation_rad[i] / bin_rad) * columns + int(azimuth_rad[i] / bin_rad)
            hidden[i] |= nearest_m[index] * (1 + relative_margin) + margin_m < range_m[i]


@compile_function("void(f8[:, ::1], f8[::1], u1[:, :, ::1], f8, f8[:, ::1], f8[::1])")
def compute_overlap_by_loop(
    positions_m: Array, time_offsets_s: Array, occupancy: Array, cell_m: float, velocities_mps: Array, overlap: Array
) -> None:
    """Compute the overlap with occupied cells: twin of `moving_clusters.compute_overlap_by_arrays`."""
    scans, columns, rows = occupancy.shape
    for v in range(velocities_mps.shape[0]):
        total = 0
        for scan in range(scans):
            dx_m, dy_m = velocities_mps[v, 0] * time_offsets_s[scan], velocities_mps[v, 1] * time_offsets_s[scan]
            for i in range(positions_m.shape[0]):
                x_m, y_m = positions_m[i, 0] + dx_m, positions_m[i, 1] + dy_m
                if x_m >= 0 and y_m >= 0:
                    x, y = int(x_m / cell_m), int(y_m / cell_m)
                    if x < columns and y < rows:
                        total += occupancy[scan, x, y]
        overlap[v] = total / (2.0 * scans * positions_m.shape[0])
