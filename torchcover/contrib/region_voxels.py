"""The voxels around a vehicle, and which of them the rays of a rig cross."""

from collections.abc import Sequence

import numpy as np

from torchcover.contrib.voxel_walk import VoxelGrid, crossed_voxels
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools
from torchcover.simulation import Sensor
from torchcover.simulation.memory import check_fits

# 60 x 40 x 4 m about the vehicle, as Hu et al. 2022 and those after them.
REGION: BoundingBox = BoundingBox((-30.0, -20.0, -0.5), (30.0, 20.0, 3.5))


def checked_grid(region: BoundingBox, voxel_m: float, bytes_a_voxel: int) -> VoxelGrid:
    """The voxels of a region, if this machine has the memory for what is kept of each.

    ValueError: it has not; or as `VoxelGrid`.
    """
    grid = VoxelGrid(region, float(voxel_m))
    what = f"{grid.voxels:,} voxels of {voxel_m:g} m in {' x '.join(f'{size:g}' for size in region.size_m)} m"
    check_fits(what, bytes_a_voxel * grid.voxels, "take larger voxels, or a smaller region")
    return grid


def check_sensors(sensors: Sequence[Sensor]) -> None:
    """Refuse a rig without sensors: it would have no rays, which some metrics reward.

    ValueError: there is no sensor.
    """
    if not sensors:
        raise ValueError("sensors: the sensors of the rig, with their mounts and rays, are needed; got none")


def ray_count(sensors: Sequence[Sensor]) -> int:
    """How many rays they have, without the pixels that have none."""
    return sum(int((~np.isnan(sensor.directions()[0])).sum()) for sensor in sensors)


def crossed_by(sensors: Sequence[Sensor], grid: VoxelGrid) -> Bools:
    """(X, Y, Z) whether any of their rays crosses a voxel, up to the wall of the region or the end of its range.

    Nothing hides anything.
    """
    crossed = np.zeros(grid.shape, dtype=bool)
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.matrix()
        directions = sensor.directions().reshape(3, -1).T @ vehicle_T_sensor[:3, :3].T
        crossed_voxels(grid, vehicle_T_sensor[:3, 3], directions, sensor.max_range_m, crossed=crossed)
    return crossed


def crossed_on_the_way(sensors: Sequence[Sensor], frame: Frame, rig: str | None, grid: VoxelGrid) -> Bools:
    """(X, Y, Z) whether a voxel is crossed on the way from a sensor to a point that it measured.

    A ray that gave no point is not known to a frame, and crosses nothing: what it passed through the open sky, or with
    its drop-out, is left out.

    ValueError: which points are of which sensor is unknown, or a sensor is none of these.
    """
    mounts = {sensor.name: sensor.mount.matrix()[:3, 3] for sensor in sensors}
    crossed = np.zeros(grid.shape, dtype=bool)
    for name, points in frame.clouds_by_sensor(rig).items():
        if name not in mounts:
            raise ValueError(
                f"frame {frame.name!r} has points of a sensor {name!r}; the rig has {', '.join(mounts)}: give the "
                "sensors that made the frame"
            )
        ways = points.cpu().numpy().astype(np.float64) - mounts[name]
        crossed_voxels(grid, mounts[name], ways[ways.any(axis=1)], 1.0, crossed=crossed)
    return crossed
