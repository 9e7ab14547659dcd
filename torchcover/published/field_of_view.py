"""Where a rig would see something in an empty world: a plane to stand on, and the vehicle itself."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.simulation import Sensor
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

# Of rays that meet neither the ground nor the vehicle: beyond any grid.
FARTHEST_M = 1000.0


def field_of_view(sensors: Sequence[Sensor], grid: BevGrid, ego: Mesh | None = None) -> Tensor:
    """Which cells the rays of a rig cross, down to the plane z = 0, up to their range or the vehicle's own body.

    Rays are looked at every half cell over ground.

    Args:
        sensors: With mounts, rays and ranges.
        grid: Cells and height bands.
        ego: The vehicle's body in the vehicle frame; None if it hides nothing.

    Returns:
        (H, Y, X) bool.

    Example:
        >>> from torchcover.simulation import Rig
        >>> grid = BevGrid(x=(-5.0, 40.0), y=(-5.0, 5.0), cell=1.0)
        >>> seen = field_of_view(Rig.load("front_roof_32").sensors, grid)
        >>> [bool(seen[0, 5, x]) for x in (0, 6, 30)]           # behind it, too close, and ahead
        [False, False, True]
    """
    seen = np.zeros(grid.cells, dtype=bool)
    caster = None if ego is None else RayCaster([ego])
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.matrix()
        directions = sensor.directions().reshape(3, -1)
        directions = vehicle_T_sensor[:3, :3] @ directions[:, ~np.isnan(directions[0])]
        origin_m = vehicle_T_sensor[:3, 3]
        ends_m = _ends_m(origin_m, directions, min(sensor.max_range_m, FARTHEST_M), caster)
        _mark(seen, grid, origin_m, directions, sensor.min_range_m, ends_m)
    return torch.from_numpy(seen).view(grid.shape)


def _ends_m(
    origin_m: NDArray[np.float64], directions: NDArray[np.float64], range_m: float, ego: RayCaster | None
) -> NDArray[np.float64]:
    """(n,) where the rays end."""
    down = directions[2] < 0
    to_ground = np.full(directions.shape[1], np.inf)
    to_ground[down] = origin_m[2] / -directions[2, down]
    ends_m: NDArray[np.float64] = np.minimum(to_ground, range_m)
    if ego is None:
        return ends_m
    hits = ego.cast(origin_m, directions.astype(np.float32), ends_m.astype(np.float32))
    ends_m[hits.body >= 0] = 0.0  # what points at the vehicle sees the vehicle
    return ends_m


def _mark(
    seen: NDArray[np.bool_],
    grid: BevGrid,
    origin_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    min_range_m: float,
    ends_m: NDArray[np.float64],
) -> None:
    level = np.hypot(directions[0], directions[1])
    # Ring by ring over ground: few rays are left in the far ones. The last point of each ray is looked at, too.
    far_m = ends_m * level
    order = np.argsort(-far_m)
    directions, ends_m, level, far_m = directions[:, order], ends_m[order], level[order], far_m[order]
    corner_m = np.abs(np.array([grid.x, grid.y])).max(axis=1) + np.abs(origin_m[:2])
    step_m = grid.cell / 2
    rings = np.arange(step_m, min(float(far_m[0]) if len(far_m) else 0.0, float(np.hypot(*corner_m))), step_m)
    left = np.searchsorted(-far_m, -rings, side="right")
    for ring_m, rays in zip(rings.tolist(), left.tolist(), strict=True):
        along_m = ring_m / level[:rays]
        _mark_points(seen, grid, origin_m, directions[:, :rays], np.where(along_m >= min_range_m, along_m, np.nan))
    _mark_points(seen, grid, origin_m, directions, np.where(ends_m >= max(min_range_m, 1e-9), ends_m, np.nan))


def _mark_points(
    seen: NDArray[np.bool_],
    grid: BevGrid,
    origin_m: NDArray[np.float64],
    directions: NDArray[np.float64],
    along_m: NDArray[np.float64],
) -> None:
    points = torch.from_numpy((origin_m[:, None] + directions * along_m).T)
    seen[grid.bins(points).cell.numpy()] = True
