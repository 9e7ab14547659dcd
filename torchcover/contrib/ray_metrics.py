"""Metrics of the rays of a rig: M-SOG (Place3D, Li et al. 2024), and blind cells that the field of view promised."""

import hashlib
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, SceneRatios, describe_number, get_rig_name
from torchcover.contrib.voxels import (
    REGION,
    VoxelGrid,
    check_sensors,
    count_rays,
    create_voxel_grid,
    find_crossed_voxels,
    mark_crossed_by_rays,
)
from torchcover.coverage import BevGrid
from torchcover.estimation import Estimate, Number
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float64
from torchcover.metrics import BlockedSums
from torchcover.neighbors import check_cloud
from torchcover.simulation import Sensor
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh

# Numbers that are kept of each voxel and block: frames in which it is labelled as the category, and as anything else.
LABELS = 2
# Numbers that are worked out together: voxels, of each draw.
AT_ONCE = 1 << 20
RANKS_ONLY = (
    "only for ranks of rigs at voxels of one size: printed values are a million times smaller than a mean entropy, and "
    "the size is not printed"
)


class MSog(BlockedSums, FrameMetric):
    """Mean entropy in nats of what the voxels on the way of a rig's rays hold, as a loss: M-SOG (Place3D, 2024).

        H(v)  = - sum over c of p_c(v) ln p_c(v)         c: the category, anything else, empty
        M-SOG = - mean over the distinct voxels v on the way of any ray of H(v)

    where p_c is the share of frames in which the voxel has the label c. Higher is better. This is the paper's variant
    for detection. A frame's label of a voxel comes from the reference points in it: the category if at least half of
    them are in its boxes (`find_points_in_boxes`), else anything else; empty if there is none, whether the reference saw
    that it is empty or did not see it.

    Nothing hides anything from the rays, which go to the wall of the region or the end of the sensor's range; and a
    voxel that is crossed once counts as much as one that is crossed often. At 1 m nearly every voxel is crossed by any
    rig: the size of a voxel is part of the name. The error is the jackknife's over 16 blocks of worlds.

    Args:
        sensors: Those of the rig, with mounts and rays.
        voxel_m: Side of a voxel; the paper does not print its own.
        region: What the voxels fill, 60 x 40 x 4 m as of S-MIG if not given.
        category: Of the boxes that have a label of their own.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: No sensor, voxels that do not divide the region or do not fit into the memory. From `update`: a
            frame without boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> from torchcover.simulation import Rig
        >>> car = Boxes.from_rows(torch.tensor([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]]), categories=("car",))
        >>> metric = MSog(Rig.load("hu2022_center").sensors)
        >>> seen = torch.tensor([[8.1, 0.1, 0.6]])  # its rear, in one of two frames
        >>> for index, points in enumerate((seen, seen[:0])):
        ...     metric.update(Frame({"rig": torch.zeros(0, 3)}, points, index, str(index), boxes=car))
        >>> number = metric.compute()[0]
        >>> number.quantity.key, round(number.value * number.count / math.log(2), 9)
        ('m_sog_car_0.5m', -1.0)
    """

    label_counts: Tensor

    def __init__(
        self,
        sensors: Sequence[Sensor],
        voxel_m: float = 0.5,
        region: BoundingBox = REGION,
        category: str = "car",
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        check_sensors(sensors)
        grid = create_voxel_grid(region, voxel_m, BLOCKS * LABELS * 8)
        meaning = {"sensors": tuple(sensors), "voxel_m": float(voxel_m), "region": region, "category": category}
        super().__init__(BLOCKS, meaning, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.category = category
        self.define_block_sum("label_counts", (LABELS, grid.num_voxels), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        labels = self.query_cache.get_or_compute(
            frame, ("labels", self.category, self.grid), lambda: self._labels(frame)
        )
        block = self._assign_block(frame.block_index)
        for label, voxels in enumerate(labels):
            self.label_counts[block, label, voxels.to(self.label_counts.device)] += 1

    def _labels(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """The voxels that have the label of the category in a frame, and those that hold anything else."""
        boxes = self.query_cache.get_boxes(frame)
        of_category = torch.tensor([each == self.category for each in boxes.categories], dtype=torch.bool, device="cpu")
        inside = self.query_cache.find_reference_in_boxes(frame)
        votes = np.zeros(len(frame.reference), dtype=bool)
        votes[inside.point_indices.cpu()[of_category[inside.box_indices.cpu()]].numpy()] = True
        voxel = self.grid.find_voxels(frame.reference.cpu().numpy())
        occupied, which, points = np.unique(voxel[voxel >= 0], return_inverse=True, return_counts=True)
        chosen = 2 * np.bincount(which, weights=votes[voxel >= 0], minlength=len(occupied)) >= points
        return torch.from_numpy(occupied[chosen]), torch.from_numpy(occupied[~chosen])

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        crossed = torch.from_numpy(mark_crossed_by_rays(self.sensors, self.grid).reshape(-1).nonzero()[0])
        about = describe_number(
            f"m_sog_{self.category}_{self.grid.voxel_m:g}m",
            "nats",
            "voxels",
            voxel_m=self.grid.voxel_m,
            region_m=(self.grid.region.lower_m, self.grid.region.upper_m),
            category=self.category,
            rays=count_rays(self.sensors),
            crossed_share=len(crossed) / self.grid.num_voxels,
        )
        used = self.block_frame_counts.cpu() > 0
        # Unknown if the category was never seen.
        on_the_way = crossed.to(self.label_counts.device) if self.label_counts[:, 0].any() else crossed[:0]
        labelled, steps = self.label_counts[:, :, on_the_way].cpu()[used], self.block_frame_counts.cpu()[used]
        estimate = Estimate.from_blocks([about.quantity], partial(_again, labelled, steps), steps)
        return estimate, [about._replace(count=0 if estimate.value[0].isnan() else len(crossed), warning=RANKS_ONLY)]


def _again(labelled: Tensor, steps: Tensor, weights: Tensor) -> Tensor:
    """(R, 1) the number of voxels labelled (g, 2, K) times in blocks of steps (g,), if these weigh (R, g)."""
    of_all, voxels = weights @ steps.double(), labelled.shape[2]
    total, part = torch.zeros(len(weights), dtype=torch.float64, device="cpu"), max(AT_ONCE // len(weights), 1)
    for start in range(0, voxels, part):
        some = labelled[:, :, start : start + part].double()
        share = torch.tensordot(weights, some, dims=1) / of_all[:, None, None]
        empty = (1.0 - share.sum(dim=1)).clamp(min=0.0)
        total += torch.special.entr(share).sum(dim=(1, 2)) + torch.special.entr(empty).sum(dim=1)
    known = (of_all > 0) & (voxels > 0)
    return torch.where(known, -total / max(voxels, 1), math.nan)[:, None]


# Of rays that meet neither the ground nor the vehicle: beyond any grid.
FARTHEST_M = 1000.0


class FalseVisible(SceneRatios):
    """Of the cells that the rig does not see, the share that its field of view says it does: FVR = FV / (FV + TI).

    A cell is predicted visible if a ray crosses it in an empty world; see `compute_field_of_view`. In a frame it is truly
    visible if the rig has a point within the threshold of a reference point there (detection > 0), and invisible if
    of none; a cell without reference points is unknown and does not count. FV is predicted visible and invisible, TI
    invisible either way predicted and found (after Börger et al. 2022).

    Args:
        sensors: The rig's sensors.
        ego: The vehicle's body; None if it is unknown: then it hides nothing from the prediction.
        grid: Extent and height bands; its cells are made `cell_m` long.
        threshold_m: Distance within which a point counts as seen.
        cell_m: Side of the cells.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: No sensors: of a recording, name the rig or give its file; a threshold that is negative.

    Example:
        >>> from torchcover.simulation import Rig
        >>> metric = FalseVisible(Rig.load("front_roof_32").sensors, None, BevGrid(x_m=(0.0, 40.0), y_m=(-5.0, 5.0)))
        >>> hidden = torch.tensor([[30.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, hidden, 0, "a"))
        >>> [(number.quantity.key, number.value) for number in metric.compute()]
        [('false_visible_ground_0.4m_1m', 0.5), ('false_visible_obstacle_0.4m_1m', nan)]
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        ego_mesh: Mesh | None,
        grid: BevGrid,
        threshold_m: float = 0.4,
        cell_m: float = 1.0,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        if not sensors:
            raise ValueError(
                "false_visible: the rig's sensors are needed, with mounts and rays; for a recording give the rig's "
                "YAML file (or the name of a built-in one)"
            )
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        coarse = build_coarse_grid(grid, cell_m)
        predicted = compute_field_of_view(sensors, coarse, ego_mesh)
        given = {"threshold_m": float(threshold_m), "cell_m": float(cell_m)}
        ratios = [
            describe_number(
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
        self.predicted_mask = predicted.flatten()
        self.threshold_m = float(threshold_m)

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        seen = (
            self.query_cache.find_distances_m(frame, get_rig_name(frame, self.rig_name), self.threshold_m)
            <= self.threshold_m
        )
        inside, of, cell = self.query_cache.assign_cells(frame, self.grid)
        known = torch.zeros(self.grid.num_cells, dtype=torch.bool, device=cell.device)
        visible = known.clone()
        known[cell] = True
        visible[cell[seen[inside[of]]]] = True
        invisible = (known & ~visible).view(len(self.ratios), -1)
        false_visible = invisible & self.predicted_mask.to(cell.device).view(invisible.shape)
        base = invisible.sum(dim=1)
        return base.double(), false_visible.sum(dim=1).double(), base


def build_coarse_grid(grid: BevGrid, cell_m: float) -> BevGrid:
    """A grid of other cells, as large as the given one, or by a part of a cell larger.

    Example:
        >>> build_coarse_grid(BevGrid(x_m=(-0.5, 2.0), y_m=(0.0, 1.0), cell_m=0.25), 1.0).x_m
        (-1.0, 2.0)
    """
    x, y = (
        (math.floor(low / cell_m) * cell_m, math.ceil(high / cell_m) * cell_m) for low, high in (grid.x_m, grid.y_m)
    )
    return BevGrid(x, y, cell_m, grid.heights, grid.band_frame)


def compute_field_of_view(sensors: Sequence[Sensor], grid: BevGrid, ego_mesh: Mesh | None = None) -> Tensor:
    """Which cells the rays of a rig cross, down to the plane z = 0, up to their range or the vehicle's own body.

    Exactly: a cell is crossed in a height band if a piece of a ray lies in both; see `find_crossed_voxels`.

    Args:
        sensors: With mounts, rays and ranges.
        grid: Cells and height bands.
        ego_mesh: The vehicle's body in the vehicle frame; None if it hides nothing.

    Returns:
        (H, Y, X) bool.

    Example:
        >>> from torchcover.simulation import Rig
        >>> grid = BevGrid(x_m=(-5.0, 40.0), y_m=(-5.0, 5.0), cell_m=1.0)
        >>> in_view = compute_field_of_view(Rig.load("front_roof_32").sensors, grid)
        >>> [bool(in_view[0, 5, x]) for x in (0, 6, 30)]        # behind, too close, ahead
        [False, False, True]
    """
    # Each band is one layer of cubes: rays are cut off at its ends and seen from above. Level ground is at z = 0.
    flat = VoxelGrid(BoundingBox((grid.x_m[0], grid.y_m[0], 0.0), (grid.x_m[1], grid.y_m[1], grid.cell_m)), grid.cell_m)
    seen = np.zeros((len(grid.heights), *flat.shape), dtype=bool)
    caster = None if ego_mesh is None else RayCaster([ego_mesh])
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions().reshape(3, -1)
        directions = vehicle_T_sensor[:3, :3] @ directions[:, ~np.isnan(directions[0])]
        origin_m = vehicle_T_sensor[:3, 3]
        ends_m = _ends_m(origin_m, directions, min(sensor.max_range_m, FARTHEST_M), caster)
        for band, crossed in zip(grid.heights.values(), seen, strict=True):
            begin_m, end_m = _within(band, origin_m[2], directions[2], sensor.min_range_m, ends_m)
            there = (begin_m < end_m) & directions[:2].any(axis=0)
            level = directions[:, there].T * [1.0, 1.0, 0.0]
            starts_m = origin_m * [1.0, 1.0, 0.0] + level * begin_m[there, None] + [0.0, 0.0, grid.cell_m / 2]
            find_crossed_voxels(flat, starts_m, level, (end_m - begin_m)[there], output=crossed)
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
    ends_m[hits.body_indices >= 0] = 0.0  # what points at the vehicle sees the vehicle
    return ends_m
