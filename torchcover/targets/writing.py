"""Files of maps of the visibility of a test target."""

import json
from pathlib import Path

import numpy as np

from torchcover.files import format_csv, write_npz
from torchcover.targets.result import CELL_ARRAYS, STATES, TargetMap


def write_csv(target_map: TargetMap, path: Path) -> None:
    """Write a table with one row for each cell; undefined values are empty. The last columns are points of each sensor.

    Args:
        target_map: The map.
        path: File to write.
    """
    header: list[object] = ["x_m", "y_m", "distance_m", "side", *CELL_ARRAYS]
    header += [f"points_{name}" for name in target_map.sensor_names]
    value_arrays = [getattr(target_map, name) for name in CELL_ARRAYS if name not in ("state", "free_frames")]
    rows = [header]
    for row, column in np.ndindex(target_map.raster.shape):
        cell = row, column
        position = target_map.get_position(row, column)
        location = [f"{value:.9g}" for value in (position.x_m, position.y_m, position.distance_m)]
        state = STATES[target_map.state[cell]], int(target_map.free_frames[cell])
        values = [*(array[cell] for array in value_arrays), *target_map.sensor_points[:, row, column]]
        texts = ["" if np.isnan(value) else f"{value:.9g}" for value in values]
        rows.append([*location, position.side, *state, *texts])
    path.write_text(format_csv(rows), encoding="utf-8")


def write_arrays(target_map: TargetMap, path: Path) -> None:
    """Write all arrays to a file for `np.load`; `settings` has the settings as JSON text.

    Args:
        target_map: The map.
        path: File to write.
    """
    names = (
        "x_m", "y_m", "state", "free_frames", "points", "sensor_points", "detecting_sensors", "detected_share",
        "min_points", "min_sensors", "surface_share", "visible_m2", "distance_m", "side", "vehicle_outline_m",
    )  # fmt: skip
    arrays = {name: getattr(target_map, name) for name in names}
    arrays["detection_border_m"] = target_map.compute_detection_border_m()
    arrays["settings"] = np.array(json.dumps(target_map.get_settings()))
    write_npz(path, arrays)
