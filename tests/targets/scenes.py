"""Small rigs and scenarios for targets."""

from pathlib import Path

import numpy as np

from torchcover.simulation import Rig, Scenario
from torchcover.targets import Raster, Target

EGO = {"shape": {"type": "box", "size_m": [4.0, 2.0, 1.0]}}
FLOOR = {"name": "floor", "shape": {"type": "plane", "size_m": [400, 400]}}
# Lower than the sensors.
WALL = {"name": "wall", "shape": {"type": "box", "size_m": [0.2, 1.5, 0.7]}, "poses": [{"x_m": 4.0, "y_m": 1.0}]}
RASTER = Raster((-7.0, 7.0), (-5.0, 5.0), 1.0)


def build_lidar(name="top", **keys):
    """Build the keys of a LiDAR whose rows and columns are no multiples of a block of rays."""
    keys = {"mount": {"z_m": 1.4}, "channels": 21, "vertical_fov_deg": [-50, 5], "columns": 251} | keys
    return {"name": name, "horizontal_fov_deg": 360, "max_range_m": 50} | keys


def build_rig(*sensors, name="small"):
    return Rig.model_validate({"name": name, "sensors": list(sensors) or [build_lidar()]})


def build_scenario(*bodies, ego=EGO, **keys):
    content = {"name": "s", "ego": ego, "bodies": [FLOOR, *bodies], **keys}
    return Scenario.model_validate(content)


def write_trajectory(folder: Path, *rows, name="drive.csv"):
    """Write a trajectory file of rows t, x, y, yaw."""
    lines = [f"{t},{x},{y},0,0,0,{yaw}" for t, x, y, yaw in rows]
    path = folder / name
    path.write_text("t,x,y,z,roll,pitch,yaw\n" + "\n".join(lines) + "\n")
    return path


def count_points_on_target(points_m, target: Target, x_m, y_m, yaw_rad):
    """Count the (N, 3) points on a target at a pose: in its box, and not on the ground."""
    away = points_m[:, :2].astype(np.float64) - [x_m, y_m]
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    there = np.column_stack([away[:, 0] * cos + away[:, 1] * sin, away[:, 1] * cos - away[:, 0] * sin, points_m[:, 2]])
    low, high = np.array(target.solid.bounding_box.lower_m) - 1e-3, np.array(target.solid.bounding_box.upper_m) + 1e-3
    return int(((there >= low) & (there <= high)).all(axis=1)[points_m[:, 2] > 1e-4].sum())
