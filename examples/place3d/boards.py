"""LOB: how many cells of an upright board the rays of a rig hit (LiDAR occupancy board, Kim and Park 2020)."""

import math

import numpy as np

from torchcover.simulation import RayHits, SensorNoise

DISTANCES_M = (10.0, 20.0, 30.0, 40.0, 50.0)
HEIGHT_M = (0.0, 2.0)
CELL_M = 0.2


def cells_hit(sensors, distance_m, *, height_m=HEIGHT_M, cell_m=CELL_M, width_m=None):
    """(rows, columns) whether any ray hits a cell of the board: from below, and counter-clockwise from behind.

    The board is bent into a cylinder about the origin of the vehicle, so that it is as far away on every side. Its
    cells are as wide as makes their number around it whole. The original is a flat board across the way ahead, whose
    size and cells could not be found; of one, give the width. The original takes cells from the board that other cars
    hide; here nothing hides anything.
    """
    check_board(sensors, distance_m, height_m, cell_m, width_m)
    around_m = 2 * math.pi * distance_m if width_m is None else width_m
    columns = max(round(around_m / cell_m), 1)
    rows = round((height_m[1] - height_m[0]) / cell_m)
    hit = np.zeros((rows, columns), dtype=bool)
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.matrix()
        directions = sensor.directions().reshape(3, -1)
        pixel_of_ray = np.flatnonzero(~np.isnan(directions[0]))
        way = vehicle_T_sensor[:3, :3] @ directions[:, pixel_of_ray]
        origin_m = vehicle_T_sensor[:3, 3]
        range_m = ranges_m(origin_m, way, distance_m, flat=width_m is not None)
        measured = np.flatnonzero(range_m <= sensor.max_range_m)
        gives, _ = sensor.measure(RayHits(measured, range_m[measured], pixel_of_ray), SensorNoise(None))
        measured = measured if gives is None else measured[gives]
        place_m = origin_m[:, None] + range_m[measured] * way[:, measured]
        along = place_m[1] / around_m + 0.5
        if width_m is None:
            along = np.arctan2(place_m[1], place_m[0]) / (2 * math.pi) + 0.5
        # Half-open, with both ends of the cylinder's seam in one cell.
        column = np.floor(along * columns).astype(np.int64)
        column = column % columns if width_m is None else column
        row = np.floor((place_m[2] - height_m[0]) / cell_m).astype(np.int64)
        on = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        hit[row[on], column[on]] = True
    return hit


def ranges_m(origin_m, way, distance_m, *, flat):
    """(N,) how far it is along each ray to the board from its inner side; infinite if it never hits."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if flat:
            range_m = np.where(way[0] > 0, (distance_m - origin_m[0]) / way[0], np.inf)
        else:
            # |o + t d|^2 = distance^2 over ground: of two places the one ahead.
            a, b = (way[:2] ** 2).sum(axis=0), origin_m[:2] @ way[:2]
            c = origin_m[:2] @ origin_m[:2] - distance_m**2
            range_m = np.where(a > 0, (np.sqrt(b**2 - a * c) - b) / a, np.inf)
    return np.where(np.isfinite(range_m), range_m, np.inf)


def check_board(sensors, distance_m, height_m, cell_m, width_m):
    """Refuse a board that cannot be, or that a sensor is behind."""
    if not 0 < distance_m < math.inf:
        raise ValueError(f"distance_m: a positive length in metres is needed; got {distance_m}")
    if not 0 < cell_m < math.inf:
        raise ValueError(f"cell_m: a positive length in metres is needed; got {cell_m}")
    low, high = height_m
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise ValueError(f"height_m: a lower and a higher bound in metres are needed; got {height_m}")
    for name, extent in (("height_m", high - low), ("width_m", width_m)):
        cells = 1.0 if extent is None else extent / cell_m
        if not 0.5 <= cells < math.inf or abs(cells - round(cells)) > 1e-6 * cells:
            raise ValueError(f"{name}: {extent:g} m is not a multiple of the cell of {cell_m:g} m; change one of them")
    for sensor in sensors:
        x_m, y_m, _ = sensor.mount.matrix()[:3, 3]
        away_m = math.hypot(x_m, y_m) if width_m is None else x_m
        if away_m >= distance_m:
            raise ValueError(
                f"distance_m: sensor {sensor.name!r} is {away_m:g} m away, behind the board at {distance_m:g} m"
            )
