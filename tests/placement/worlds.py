"""Small scenarios and rigs, and estimates of given scores."""

import numpy as np
import torch

from torchcover.estimation import Estimate, Quantity
from torchcover.placement import CommonFrames, Objective
from torchcover.simulation import Rig, Scenario

EGO = {"shape": {"type": "box", "size_m": [4, 2, 1.5]}}
FLOOR = {"name": "floor", "shape": {"type": "plane", "size_m": [400, 400]}}
WALL = {"name": "wall", "shape": {"type": "box", "size_m": [0.5, 6, 1.8]}, "poses": [{"x_m": 9.0, "y_m": 1.0}]}

# Three frames per run, 0.4 s apart.
LOT = Scenario.model_validate(
    {
        "name": "lot",
        "ego": EGO,
        "traffic": {
            "type": "parking",
            "duration_s": 1.0,
            "time_step_s": 0.2,
            "crossings_per_aisle": 0,
            "parked_share": 0.3,
        },
    }
)
BAY = {"bay": {"polygon_m": [[2.5, -4.0], [9.0, -4.0], [9.0, 5.0]]}}
OBJECTIVES = {
    "near": Objective(threshold_m=0.3, region="20m"),
    "far": Objective(threshold_m=0.2, region=["80m", "20m"], band="ground"),
    "bay": Objective(threshold_m=0.3, region=BAY, band=["obstacle", "ground"]),
}


def yard(*bodies, name="yard"):
    return Scenario.model_validate({"name": name, "ego": EGO, "bodies": [FLOOR, *bodies]})


def lidar(name="top", **keys):
    keys = {"mount": {"z_m": 1.9}, "channels": 16, "vertical_fov_deg": [-40, 2], "columns": 181} | keys
    return {"name": name, "horizontal_fov_deg": 360, "max_range_m": 90} | keys


def rig(*sensors, name="small", **keys):
    return Rig.model_validate({"name": name, "sensors": list(sensors) or [lidar()], **keys})


def create_frames(scenarios=(LOT,), objectives=OBJECTIVES, **keys):
    return CommonFrames(
        scenarios,
        objectives,
        **{"num_scenes": 3, "frames_per_scene": 2, "frame_interval_s": 0.4, "num_rays": 1024} | keys,
    )


def estimate_values(values, scene_ids, lower_is_better=()):
    """Estimate the means of (n, O) values in frames of some scenes, also without each scene."""
    values = torch.as_tensor(np.asarray(values, dtype=np.float64).reshape(len(scene_ids), -1))
    unique_ids, scene_indices = torch.unique(torch.as_tensor(scene_ids), return_inverse=True)
    sums = torch.zeros(len(unique_ids), values.shape[1], dtype=torch.float64).index_add_(0, scene_indices, values)
    frame_counts = torch.bincount(scene_indices)
    names = [f"o{k}" for k in range(values.shape[1])]
    quantities = [Quantity(name, name, "share", name in lower_is_better) for name in names]
    return Estimate.from_ratios(quantities, frame_counts.double(), sums, frame_counts)
