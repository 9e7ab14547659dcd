"""Rigs and frames for metrics of rays in voxels."""

import torch

from torchcover.data import Frame
from torchcover.detection import Boxes
from torchcover.simulation import Lidar, Pose

# Place3D 2024: placements of table 7 (x forward, y to the right), the LiDAR of table 5.
PLACE3D = {
    "center": ((0, 0, 2.2), (0, 0, 2.4), (0, 0, 2.6), (0, 0, 2.8)),
    "line": ((0, -0.6, 2.2), (0, -0.4, 2.2), (0, 0.4, 2.2), (0, 0.6, 2.2)),
}


def place3d(name):
    return tuple(
        Lidar(
            name=f"lidar_{number}",
            mount=Pose(x_m=x, y_m=-y, z_m=z),
            channels=16,
            vertical_fov_deg=(-24.8, 2.0),
            horizontal_fov_deg=360.0,
            columns=250,
            max_range_m=100.0,
        )
        for number, (x, y, z) in enumerate(PLACE3D[name])
    )


def beam(name="beam", *, columns=1, range_m=100.0, **mount):
    """Create a sensor with level rays: one forward, or several around."""
    return Lidar(
        name=name,
        mount=Pose(**mount),
        elevations_deg=(0.0,),
        horizontal_fov_deg=360.0 if columns > 1 else 1.0,
        columns=columns,
        max_range_m=range_m,
    )


def boxes(*rows, category="car"):
    table = torch.tensor(rows).reshape(-1, 7)
    return Boxes.from_rows(table, categories=(category,) * len(table))


def frame(index, objects, *, reference=None, clouds=None, place=None):
    """Create a frame with these objects; `clouds` are by sensor."""
    clouds = {"beam": torch.zeros(0, 3)} if clouds is None else clouds
    return Frame(
        {"rig": torch.cat(list(clouds.values()))},
        torch.zeros(0, 3) if reference is None else reference,
        index=index,
        name=f"frame {index}",
        boxes=objects,
        block_index=place,
        sensor_point_counts={"rig": {name: len(cloud) for name, cloud in clouds.items()}},
    )
