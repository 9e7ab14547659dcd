"""Loops over points of scans, compiled; importing this fails where numba is missing."""

import math

import numpy as np

from torchcover.neighbors.compiled import Array, compile_function, inline_function
from torchcover.recordings.free_space import A1, A3, A5, A7, A9, BEHIND, BEHIND_M, COLUMNS, OVER_M, ROWS, TINY


@compile_function("void(f8[:, ::1], f4[:, ::1], i8, f8[:, ::1], f8, i2[::1], i8)")
def count_votes_by_loop(
    points_m: Array,
    free_range_m: Array,
    first_row: int,
    sensor_T_local: Array,
    max_free_range_m: float,
    votes: Array,
    increment: int,
) -> None:
    """Count the places that lie in free space: `count_votes_by_arrays`."""
    T, rows, halved = sensor_T_local, free_range_m.shape[0], 0
    while COLUMNS >> halved > free_range_m.shape[1]:
        halved += 1
    for i in range(points_m.shape[0]):
        px, py, pz = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        range_m = math.sqrt(x * x + y * y + z * z)
        if range_m >= max_free_range_m:
            continue
        row = (min(int((1 + z / max(range_m, 1e-9)) * (ROWS / 2)), ROWS - 1) >> halved) - first_row
        if row < 0 or row >= rows:
            continue
        low, high = min(abs(x), abs(y)), max(abs(x), abs(y), 1e-9)
        turn = low / high * (0.64 - 0.14 * (low / high))
        if abs(y) > abs(x):
            turn = 1 - turn
        if x < 0:
            turn = 2 - turn
        if y < 0:
            turn = 4 - turn
        column = int(turn * (COLUMNS / 4))
        if range_m < free_range_m[row, (0 if column == COLUMNS else column) >> halved]:
            votes[i] += increment


@inline_function
def _angle_rad(y: Array, x: Array) -> Array:
    low, high = min(abs(x), abs(y)), max(abs(x), abs(y), TINY)
    share = low / high
    square = share * share
    angle = share * (A1 + square * (A3 + square * (A5 + square * (A7 + square * A9))))
    if abs(y) > abs(x):
        angle = math.pi / 2 - angle
    if x < 0:
        angle = math.pi - angle
    return -angle if y < 0 else angle


@compile_function("void(f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8[::1], b1[::1])")
def mark_hidden_by_loop(
    points_m: Array,
    viewpoint_m: Array,
    box_corners_m: Array,
    bin_sizes_rad: Array,
    max_occluder_ranges_m: Array,
    hidden: Array,
) -> None:
    """Mark the points that a body or others hide from a place: `mark_hidden_by_arrays`."""
    count = points_m.shape[0]
    up, over, across, range_m = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        x, y, z = points_m[i, 0] - viewpoint_m[0], points_m[i, 1] - viewpoint_m[1], points_m[i, 2] - viewpoint_m[2]
        flat_m = math.sqrt(x * x + y * y)
        range_m[i] = math.sqrt(flat_m * flat_m + z * z)
        up[i], across[i] = _angle_rad(z, flat_m) + math.pi / 2, _angle_rad(y, x) + math.pi
        over[i] = _angle_rad(z + OVER_M, flat_m) + math.pi / 2
        enters, leaves = -math.inf, math.inf
        for axis in range(3):
            way_m = points_m[i, axis] - viewpoint_m[axis]
            one, other = (
                (box_corners_m[0, axis] - viewpoint_m[axis]) / way_m,
                (box_corners_m[1, axis] - viewpoint_m[axis]) / way_m,
            )
            enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
        hidden[i] |= enters < leaves and leaves > 0 and enters < 1
    for level in range(bin_sizes_rad.shape[0]):
        bin_rad, columns = bin_sizes_rad[level], int(2 * math.pi / bin_sizes_rad[level]) + 1
        nearest_m = np.full((int(math.pi / bin_rad) + 1) * columns, np.inf)
        for i in range(count):
            if range_m[i] < max_occluder_ranges_m[level]:
                number = int(up[i] / bin_rad) * columns + int(across[i] / bin_rad)
                nearest_m[number] = min(nearest_m[number], range_m[i])
        for i in range(count):
            number = int(over[i] / bin_rad) * columns + int(across[i] / bin_rad)
            hidden[i] |= nearest_m[number] * (1 + BEHIND) + BEHIND_M < range_m[i]


@compile_function("void(f8[:, ::1], f8[::1], u1[:, :, ::1], f8, f8[:, ::1], f8[::1])")
def compute_overlap_by_loop(
    positions_m: Array, time_offsets_s: Array, occupancy: Array, cell_m: float, velocities_mps: Array, overlap: Array
) -> None:
    """How much of what each velocity makes of places is filled at other times: `compute_overlap_by_arrays`."""
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
