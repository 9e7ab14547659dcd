"""LiDAR occupancy boards (LOB, Kim and Park 2020): the cells of an upright board that the rays of a rig hit."""

import math

import numpy as np

from torchcover.simulation import RayHits, SensorNoise

DISTANCES_M = (10.0, 20.0, 30.0, 40.0, 50.0)


def find_hit_cells(sensors, distance_m, *, height_m=(0.0, 2.0), cell_m=0.2, width_m=None):
    """Find the cells of a board that any ray hits.

    By default the board is a cylinder around the origin of the vehicle, so that its distance is the same on all sides,
    and the width of its cells is rounded to a whole number of cells. The original is a flat board ahead whose size and
    cells are not published; give its width to use one. The original also removes cells that other cars occlude; here
    nothing occludes the board.

    Args:
        sensors: Sensors of the rig.
        distance_m: Distance of the board in meters.
        height_m: Lower and upper edge in meters.
        cell_m: Size of a cell in meters.
        width_m: Width of a flat board in meters; None for a cylinder.

    Returns:
        (rows, columns) True where a ray hits; rows upwards, columns to the left, from behind the vehicle.

    Raises:
        ValueError: A size is not positive, or no multiple of the cell, or a sensor is behind the board.
    """
    check_board(sensors, distance_m, height_m, cell_m, width_m)
    is_flat = width_m is not None
    board_m = width_m if is_flat else 2 * math.pi * distance_m
    columns = max(round(board_m / cell_m), 1)
    rows = round((height_m[1] - height_m[0]) / cell_m)
    is_hit = np.zeros((rows, columns), dtype=bool)
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions().reshape(3, -1)
        pixel_indices = np.flatnonzero(~np.isnan(directions[0]))
        directions = vehicle_T_sensor[:3, :3] @ directions[:, pixel_indices]
        origin_m = vehicle_T_sensor[:3, 3]
        range_m = compute_ranges_m(origin_m, directions, distance_m, is_flat=is_flat)
        hits = np.flatnonzero(range_m <= sensor.max_range_m)
        measured, _ = sensor.measure(RayHits(hits, range_m[hits], pixel_indices), SensorNoise(None))
        hits = hits if measured is None else hits[measured]
        points_m = origin_m[:, None] + range_m[hits] * directions[:, hits]
        if is_flat:
            column = np.floor((points_m[1] / board_m + 0.5) * columns).astype(np.int64)
        else:  # the first and the last column are adjacent
            turns = np.arctan2(points_m[1], points_m[0]) / (2 * math.pi) + 0.5
            column = np.floor(turns * columns).astype(np.int64) % columns
        row = np.floor((points_m[2] - height_m[0]) / cell_m).astype(np.int64)
        is_inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        is_hit[row[is_inside], column[is_inside]] = True
    return is_hit


def compute_ranges_m(origin_m, directions, distance_m, *, is_flat):
    """Compute the range from a sensor to the board along each ray.

    Args:
        origin_m: (3,) position of the sensor, in front of the board.
        directions: (3, N) unit directions of the rays.
        distance_m: Distance of the board in meters.
        is_flat: True for a plane ahead, False for a cylinder.

    Returns:
        (N,) ranges; infinite where a ray misses the board.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if is_flat:
            range_m = np.where(directions[0] > 0, (distance_m - origin_m[0]) / directions[0], np.inf)
        else:
            # The larger root of |origin + t direction|^2 = distance^2 in the ground plane is ahead.
            a, b = (directions[:2] ** 2).sum(axis=0), origin_m[:2] @ directions[:2]
            c = origin_m[:2] @ origin_m[:2] - distance_m**2
            range_m = np.where(a > 0, (np.sqrt(b**2 - a * c) - b) / a, np.inf)
    return np.where(np.isfinite(range_m), range_m, np.inf)


def check_board(sensors, distance_m, height_m, cell_m, width_m):
    """Check the sizes of a board and that all sensors are in front of it; see `find_hit_cells`."""
    if not 0 < distance_m < math.inf:
        raise ValueError(f"distance_m: got {distance_m}; give a positive length in meters")
    if not 0 < cell_m < math.inf:
        raise ValueError(f"cell_m: got {cell_m}; give a positive length in meters")
    low, high = height_m
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"height_m: got {height_m}; give a lower and a higher bound in meters")
    for name, extent_m in (("height_m", high - low), ("width_m", width_m)):
        cells = 1.0 if extent_m is None else extent_m / cell_m
        if not 0.5 <= cells < math.inf or abs(cells - round(cells)) > 1e-6 * cells:
            raise ValueError(f"{name}: {extent_m:g} m is no multiple of the cell of {cell_m:g} m; change one of them")
    for sensor in sensors:
        x_m, y_m, _ = sensor.mount.to_matrix()[:3, 3]
        sensor_m = math.hypot(x_m, y_m) if width_m is None else x_m
        if sensor_m >= distance_m:
            raise ValueError(
                f"distance_m: sensor {sensor.name!r} is {sensor_m:g} m away, behind the board at {distance_m:g} m"
            )
