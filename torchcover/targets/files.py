"""The files of a map of a target."""

import json
from pathlib import Path

import numpy as np

from torchcover.files import csv_text, write_npz
from torchcover.targets.result import STATES, TargetMap

COLUMNS = ("x_m", "y_m", "distance_m", "side", "state", "steps", "points", "sensors", "seen", "least_points",
           "least_sensors", "share", "visible_m2")  # fmt: skip

ARRAYS = ("x_m", "y_m", "state", "steps", "points", "sensor_points", "sensors", "seen", "least_points",
          "least_sensors", "share", "visible_m2",
          "distance_m", "side", "vehicle_outline_m")  # fmt: skip


def write_csv(seen: TargetMap, path: Path) -> None:
    """One row a cell, row by row; empty where nothing is known. Last columns: the points of each sensor."""
    rows: list[list[object]] = [[*COLUMNS, *(f"points_{name}" for name in seen.sensor_names)]]
    points = seen.points
    for row, column in np.ndindex(seen.raster.shape):
        at = row, column
        place = seen.place(row, column)
        means = points[at], seen.sensors[at], seen.seen[at]
        known = *means, seen.least_points[at], seen.least_sensors[at], seen.share[at], seen.visible_m2[at]
        of_sensors = seen.sensor_points[(slice(None), row, column)]
        rows.append([
            f"{place.x_m:.9g}", f"{place.y_m:.9g}", f"{place.distance_m:.9g}", place.side, STATES[seen.state[at]],
            int(seen.steps[at]), *(_number(value) for value in (*known, *of_sensors)),
        ])  # fmt: skip
    path.write_text(csv_text(rows), encoding="utf-8")


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.9g}"


def write_arrays(seen: TargetMap, path: Path) -> None:
    """All arrays, and the settings as JSON text in `settings`; `np.load` reads it."""
    arrays = {name: getattr(seen, name) for name in ARRAYS}
    write_npz(path, {**arrays, "border_m": seen.border_m(), "settings": np.array(json.dumps(seen.settings()))})
