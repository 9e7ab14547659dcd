"""How much of what is not seen was thought to be visible: where a rig would see something in an empty world."""

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.contrib.frame_metric import WorldRatios, said
from torchcover.contrib.sights import rig_of
from torchcover.contrib.voxel_walk import VoxelGrid, crossed_voxels
from torchcover.coverage import BevGrid
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float64
from torchcover.simulation import Sensor
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

# Of rays that meet neither the ground nor the vehicle: beyond any grid.
FARTHEST_M = 1000.0


class FalseVisible(WorldRatios):
    """Of the cells that the rig does not see, the share that its field of view says it does: FVR = FV / (FV + TI).

    A cell is predicted visible if a ray crosses it in an empty world; see `field_of_view`. In a frame it is truly
    visible if the rig has a point within the threshold of a reference point there (detection > 0), and invisible if
    of none; a cell without reference points is unknown and does not count. FV is predicted visible and invisible, TI
    invisible either way predicted and found (after Börger et al. 2022).

    Args:
        sensors: The rig's sensors.
        ego: The vehicle's body; None if it is unknown: then it hides nothing from the prediction.
        grid: Extent and height bands; its cells are made `cell_m` long.
        threshold_m: Distance within which a point counts as seen.
        cell_m: Side of the cells.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.

    Raises:
        ValueError: No sensors: of a recording, name the rig or give its file; a threshold that is negative.

    Example:
        >>> from torchcover.simulation import Rig
        >>> metric = FalseVisible(Rig.load("front_roof_32").sensors, None, BevGrid(x=(0.0, 40.0), y=(-5.0, 5.0)))
        >>> hidden = torch.tensor([[30.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, hidden, 0, "a"))
        >>> [(one.quantity.key, one.value) for one in metric.compute()]
        [('false_visible_ground_0.4m_1m', 0.5), ('false_visible_obstacle_0.4m_1m', nan)]
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        ego: Mesh | None,
        grid: BevGrid,
        threshold_m: float = 0.4,
        cell_m: float = 1.0,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        if not sensors:
            raise ValueError(
                "false_visible: the rig's sensors are needed, with mounts and rays; for a recording give the rig's "
                "YAML file (or the name of a built-in one)"
            )
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        coarse = coarse_grid(grid, cell_m)
        predicted = field_of_view(sensors, coarse, ego)
        given = {"threshold_m": float(threshold_m), "cell_m": float(cell_m)}
        ratios = [
            said(
                f"false_visible_{band}_{threshold_m:g}m_{cell_m:g}m",
                "share",
                "invisible cells",
                lower_is_better=True,
                **given,
            )
            for band in coarse.heights
        ]
        fingerprint = hashlib.sha256(predicted.numpy().tobytes()).hexdigest()
        super().__init__(ratios, {**given, "grid": coarse, "predicted": fingerprint}, **kwargs)
        self.grid = coarse
        self.predicted = predicted.flatten()
        self.threshold_m = float(threshold_m)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        seen = self.sights.distance(frame, rig_of(frame, self.rig), self.threshold_m) <= self.threshold_m
        inside, of, cell = self.sights.bins(frame, self.grid)
        known = torch.zeros(self.grid.cells, dtype=torch.bool, device=cell.device)
        visible = known.clone()
        known[cell] = True
        visible[cell[seen[inside[of]]]] = True
        invisible = (known & ~visible).view(len(self.ratios), -1)
        false_visible = invisible & self.predicted.to(cell.device).view(invisible.shape)
        base = invisible.sum(dim=1)
        return base.double(), false_visible.sum(dim=1).double(), base


def coarse_grid(grid: BevGrid, cell_m: float) -> BevGrid:
    """A grid of other cells, as large as the given one, or by a part of a cell larger.

    Example:
        >>> coarse_grid(BevGrid(x=(-0.5, 2.0), y=(0.0, 1.0), cell=0.25), 1.0).x
        (-1.0, 2.0)
    """
    x, y = ((math.floor(low / cell_m) * cell_m, math.ceil(high / cell_m) * cell_m) for low, high in (grid.x, grid.y))
    return BevGrid(x, y, cell_m, grid.heights, grid.band_frame)


def field_of_view(sensors: Sequence[Sensor], grid: BevGrid, ego: Mesh | None = None) -> Tensor:
    """Which cells the rays of a rig cross, down to the plane z = 0, up to their range or the vehicle's own body.

    Exactly: a cell is crossed in a height band if a piece of a ray lies in both; see `crossed_voxels`.

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
    # Each band is one layer of cubes: rays are cut off at its ends and seen from above. Level ground is at z = 0.
    flat = VoxelGrid(BoundingBox((grid.x[0], grid.y[0], 0.0), (grid.x[1], grid.y[1], grid.cell)), grid.cell)
    seen = np.zeros((len(grid.heights), *flat.shape), dtype=bool)
    caster = None if ego is None else RayCaster([ego])
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.matrix()
        directions = sensor.directions().reshape(3, -1)
        directions = vehicle_T_sensor[:3, :3] @ directions[:, ~np.isnan(directions[0])]
        origin_m = vehicle_T_sensor[:3, 3]
        ends_m = _ends_m(origin_m, directions, min(sensor.max_range_m, FARTHEST_M), caster)
        for band, crossed in zip(grid.heights.values(), seen, strict=True):
            begin_m, end_m = _within(band, origin_m[2], directions[2], sensor.min_range_m, ends_m)
            there = (begin_m < end_m) & directions[:2].any(axis=0)
            level = directions[:, there].T * [1.0, 1.0, 0.0]
            starts_m = origin_m * [1.0, 1.0, 0.0] + level * begin_m[there, None] + [0.0, 0.0, grid.cell / 2]
            crossed_voxels(flat, starts_m, level, (end_m - begin_m)[there], crossed=crossed)
    return torch.from_numpy(np.ascontiguousarray(seen[..., 0].transpose(0, 2, 1)))


def _within(
    band: tuple[float, float], height_m: float, up: Float64, begin_m: float, ends_m: Float64
) -> tuple[Float64, Float64]:
    """(n,) where rays enter a height band, and (n,) leave it; the end first where they do not."""
    rises = np.where(up == 0, 1.0, up)
    low, high = ((edge - height_m) / rises for edge in band)
    inside = (up != 0) | (band[0] <= height_m < band[1])
    first = np.where(up == 0, np.where(inside, -np.inf, np.inf), np.minimum(low, high))
    last = np.where(up == 0, np.inf, np.maximum(low, high))
    return np.maximum(first, begin_m), np.minimum(last, ends_m)


def _ends_m(origin_m: Float64, directions: Float64, range_m: float, ego: RayCaster | None) -> Float64:
    """(n,) where the rays end."""
    down = directions[2] < 0
    to_ground = np.full(directions.shape[1], np.inf)
    to_ground[down] = origin_m[2] / -directions[2, down]
    ends_m: Float64 = np.minimum(to_ground, range_m)
    if ego is None:
        return ends_m
    hits = ego.cast(origin_m, directions.astype(np.float32), ends_m.astype(np.float32))
    ends_m[hits.body >= 0] = 0.0  # what points at the vehicle sees the vehicle
    return ends_m
