"""Metrics of the rays of a rig: M-SOG (Place3D, Li et al. 2024), and blind cells inside the field of view."""

import hashlib
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcover.contrib.frame_metric import BLOCKS, FrameMetric, SceneRatios, describe_number
from torchcover.contrib.frame_queries import get_rig_name
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

# Labels with a count for each voxel and block: the category, and any other content.
NUM_LABELS = 2


class MSog(BlockedSums, FrameMetric):
    """Negative mean entropy in nats of the labels of the voxels that the rays of a rig cross: M-SOG (Place3D, 2024).

        H(v)  = - sum over c of p_c(v) ln p_c(v)         c: the category, other content, empty
        M-SOG = - mean over the distinct voxels v that any ray crosses of H(v)

    where p_c is the share of frames in which the voxel has the label c. Higher is better. This is the paper's variant
    for detection. The label of a voxel in a frame comes from its reference points: the category if at least half of
    them are in boxes of the category (`find_points_in_boxes`), else other content; empty without points, whether the
    reference sensor observed that it is empty or did not observe it.

    Rays are not occluded and end at the border of the region or at the maximum range of the sensor; each voxel counts
    once, however many rays cross it. At 1 m nearly every voxel is crossed by any rig: the voxel size is part of the
    name. The standard error is that of the jackknife over 16 blocks of scenes.

    Args:
        sensors: Sensors of the rig, with mounts and rays.
        voxel_m: Side length of a voxel in meters; the paper does not report it.
        region: Region of the voxels; by default 60 x 40 x 4 m as for S-MIG.
        category: Category of boxes with a label of its own.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: There is no sensor, or voxels do not divide the region or do not fit into memory. From `update`: a
            frame has no boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> from torchcover.simulation import Rig
        >>> car = Boxes.from_rows(torch.tensor([[10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]]), categories=("car",))
        >>> metric = MSog(Rig.load("hu2022_center").sensors)
        >>> rear = torch.tensor([[8.1, 0.1, 0.6]])  # observed in one of two frames
        >>> for index, points in enumerate((rear, rear[:0])):
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
        grid = create_voxel_grid(region, voxel_m, BLOCKS * NUM_LABELS * 8)
        definition = {"sensors": tuple(sensors), "voxel_m": float(voxel_m), "region": region, "category": category}
        super().__init__(BLOCKS, definition, **kwargs)
        self.sensors = tuple(sensors)
        self.grid = grid
        self.category = category
        self.define_block_sum("label_counts", (NUM_LABELS, grid.num_voxels), torch.int64)

    def _add_frame(self, frame: Frame) -> None:
        check_cloud(frame.reference, "reference")
        key = ("labels", self.category, self.grid)
        label_voxels = self.query_cache.get_or_compute(frame, key, self._label_voxels, frame)
        block = self._assign_block(frame.block_index)
        for label, voxels in enumerate(label_voxels):
            self.label_counts[block, label, voxels.to(self.label_counts.device)] += 1

    def _label_voxels(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Find the voxels with the label of the category in a frame, and those with other content."""
        boxes = self.query_cache.get_boxes(frame)
        is_category = [category == self.category for category in boxes.categories]
        box_mask = torch.tensor(is_category, dtype=torch.bool, device="cpu")
        points_in_boxes = self.query_cache.find_reference_in_boxes(frame)
        is_in_category = np.zeros(len(frame.reference), dtype=bool)
        is_pair_of_category = box_mask[points_in_boxes.box_indices.cpu()]
        is_in_category[points_in_boxes.point_indices.cpu()[is_pair_of_category].numpy()] = True
        point_voxels = self.grid.find_voxels(frame.reference.cpu().numpy())
        is_inside = point_voxels >= 0
        voxels, positions, point_counts = np.unique(point_voxels[is_inside], return_inverse=True, return_counts=True)
        category_counts = np.bincount(positions, weights=is_in_category[is_inside], minlength=len(voxels))
        has_category = 2 * category_counts >= point_counts
        return torch.from_numpy(voxels[has_category]), torch.from_numpy(voxels[~has_category])

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        crossed = torch.from_numpy(mark_crossed_by_rays(self.sensors, self.grid).reshape(-1).nonzero()[0])
        number = describe_number(
            f"m_sog_{self.category}_{self.grid.voxel_m:g}m",
            "nats",
            "voxels",
            voxel_m=self.grid.voxel_m,
            region_m=(self.grid.region.lower_m, self.grid.region.upper_m),
            category=self.category,
            rays=count_rays(self.sensors),
            crossed_share=len(crossed) / self.grid.num_voxels,
        )
        used_blocks = self.block_frame_counts.cpu() > 0
        # The number is unknown if the category was never observed.
        voxels = crossed.to(self.label_counts.device) if self.label_counts[:, 0].any() else crossed[:0]
        label_counts = self.label_counts[:, :, voxels].cpu()[used_blocks]
        frame_counts = self.block_frame_counts.cpu()[used_blocks]
        recompute = partial(_recompute_m_sog, label_counts, frame_counts)
        estimate = Estimate.from_blocks([number.quantity], recompute, frame_counts)
        warning = (
            "only for ranks of rigs at voxels of one size: printed values are a million times smaller than a mean "
            "entropy, and the size is not printed"
        )
        return estimate, [number._replace(count=0 if estimate.value[0].isnan() else len(crossed), warning=warning)]


def _recompute_m_sog(label_counts: Tensor, frame_counts: Tensor, weights: Tensor) -> Tensor:
    """Recompute the (R, 1) number for (R, g) block weights.

    Args:
        label_counts: (g, 2, K) frames in which each crossed voxel has each label.
        frame_counts: (g,) frames of each block.
        weights: (R, g) weights of the blocks.
    """
    total_frames, num_voxels = weights @ frame_counts.double(), label_counts.shape[2]
    total = torch.zeros(len(weights), dtype=torch.float64, device="cpu")
    chunk_size = max((1 << 20) // len(weights), 1)  # limits the memory of one chunk to megabytes
    for start in range(0, num_voxels, chunk_size):
        chunk = label_counts[:, :, start : start + chunk_size].double()
        label_shares = torch.tensordot(weights, chunk, dims=1) / total_frames[:, None, None]
        empty_shares = (1.0 - label_shares.sum(dim=1)).clamp(min=0.0)
        total += torch.special.entr(label_shares).sum(dim=(1, 2)) + torch.special.entr(empty_shares).sum(dim=1)
    is_known = (total_frames > 0) & (num_voxels > 0)
    return torch.where(is_known, -total / max(num_voxels, 1), math.nan)[:, None]


class FalseVisible(SceneRatios):
    """Share of the blind cells that lie inside the field of view: FVR = FV / (FV + TI), after Börger et al. 2022.

    A cell is predicted visible if a ray crosses it in an empty scene; see `compute_field_of_view`. In a frame it is
    visible if the rig has a point within the threshold of a reference point in the cell, and invisible (blind)
    otherwise; cells without reference points do not count. FV are the blind cells that are predicted visible, TI those
    that are predicted invisible.

    Args:
        sensors: Sensors of the rig, with mounts and rays.
        ego_mesh: Mesh of the ego vehicle in the vehicle frame, which occludes the field of view; None if unknown.
        grid: Extent and height bands; its cells are replaced by cells of `cell_m`.
        threshold_m: Largest distance in meters at which a point counts as detected.
        cell_m: Side length of the cells in meters.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: There are no sensors (for a recording, name the rig or give its file), or the threshold is negative.

    Example:
        >>> from torchcover.simulation import Rig
        >>> metric = FalseVisible(Rig.load("front_roof_32").sensors, None, BevGrid(x_m=(0.0, 40.0), y_m=(-5.0, 5.0)))
        >>> reference = torch.tensor([[30.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, reference, 0, "a"))
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
            raise ValueError(f"threshold_m: a finite distance >= 0 in meters is needed; got {threshold_m}")
        coarse_grid = build_coarse_grid(grid, cell_m)
        predicted = compute_field_of_view(sensors, coarse_grid, ego_mesh)
        parameters = {"threshold_m": float(threshold_m), "cell_m": float(cell_m)}
        ratios = []
        for band in coarse_grid.heights:
            key = f"false_visible_{band}_{threshold_m:g}m_{cell_m:g}m"
            ratios.append(describe_number(key, "share", "invisible cells", lower_is_better=True, **parameters))
        fingerprint = hashlib.sha256(predicted.numpy().tobytes()).hexdigest()
        super().__init__(ratios, {**parameters, "grid": coarse_grid, "predicted": fingerprint}, **kwargs)
        self.grid = coarse_grid
        self.predicted_mask = predicted.flatten()
        self.threshold_m = float(threshold_m)

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        rig = get_rig_name(frame, self.rig_name)
        is_detected = self.query_cache.find_distances_m(frame, rig, self.threshold_m) <= self.threshold_m
        point_indices, point_positions, cells = self.query_cache.assign_cells(frame, self.grid)
        is_observed = torch.zeros(self.grid.num_cells, dtype=torch.bool, device=cells.device)
        is_visible = is_observed.clone()
        is_observed[cells] = True
        is_visible[cells[is_detected[point_indices[point_positions]]]] = True
        is_invisible = (is_observed & ~is_visible).view(len(self.ratios), -1)
        is_false_visible = is_invisible & self.predicted_mask.to(cells.device).view(is_invisible.shape)
        invisible_counts = is_invisible.sum(dim=1)
        return invisible_counts.double(), is_false_visible.sum(dim=1).double(), invisible_counts


def build_coarse_grid(grid: BevGrid, cell_m: float) -> BevGrid:
    """Build a grid with other cells that contains a grid and exceeds it by less than a cell on each side.

    Args:
        grid: Extent and height bands.
        cell_m: Side length of the new cells in meters.

    Example:
        >>> build_coarse_grid(BevGrid(x_m=(-0.5, 2.0), y_m=(0.0, 1.0), cell_m=0.25), 1.0).x_m
        (-1.0, 2.0)
    """
    x_m, y_m = (
        (math.floor(low / cell_m) * cell_m, math.ceil(high / cell_m) * cell_m) for low, high in (grid.x_m, grid.y_m)
    )
    return BevGrid(x_m, y_m, cell_m, grid.heights, grid.band_frame)


def compute_field_of_view(sensors: Sequence[Sensor], grid: BevGrid, ego_mesh: Mesh | None = None) -> Tensor:
    """Compute the cells that the rays of a rig cross, up to the plane z = 0, their range or the ego vehicle.

    A cell is crossed in a height band if it contains a piece of a ray within the band; see `find_crossed_voxels`.

    Args:
        sensors: Sensors with mounts, rays and ranges.
        grid: Cells and height bands.
        ego_mesh: Mesh of the ego vehicle in the vehicle frame; None for no occlusion.

    Returns:
        (H, Y, X) bool.

    Example:
        >>> from torchcover.simulation import Rig
        >>> grid = BevGrid(x_m=(-5.0, 40.0), y_m=(-5.0, 5.0), cell_m=1.0)
        >>> in_view = compute_field_of_view(Rig.load("front_roof_32").sensors, grid)
        >>> [bool(in_view[0, 5, x]) for x in (0, 6, 30)]  # behind, too close, ahead
        [False, False, True]
    """
    # Each band is one layer of cubes: rays are cut at the bounds of the band and projected to bird's-eye view.
    region = BoundingBox((grid.x_m[0], grid.y_m[0], 0.0), (grid.x_m[1], grid.y_m[1], grid.cell_m))
    layer = VoxelGrid(region, grid.cell_m)
    crossed = np.zeros((len(grid.heights), *layer.shape), dtype=bool)
    caster = None if ego_mesh is None else RayCaster([ego_mesh])
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions().reshape(3, -1)
        directions = vehicle_T_sensor[:3, :3] @ directions[:, ~np.isnan(directions[0])]
        origin_m = vehicle_T_sensor[:3, 3]
        max_range_m = min(sensor.max_range_m, 1000.0)  # finite, and beyond any grid
        ends_m = _compute_ray_ends_m(origin_m, directions, max_range_m, caster)
        for band, band_crossed in zip(grid.heights.values(), crossed, strict=True):
            begin_m, end_m = _clip_to_band(band, origin_m[2], directions[2], sensor.min_range_m, ends_m)
            is_in_band = (begin_m < end_m) & directions[:2].any(axis=0)
            flat_directions = directions[:, is_in_band].T * [1.0, 1.0, 0.0]
            starts_m = origin_m * [1.0, 1.0, 0.0] + flat_directions * begin_m[is_in_band, None]
            starts_m += np.array([0.0, 0.0, grid.cell_m / 2])
            lengths_m = (end_m - begin_m)[is_in_band]
            find_crossed_voxels(layer, starts_m, flat_directions, lengths_m, output=band_crossed)
    return torch.from_numpy(np.ascontiguousarray(crossed[..., 0].transpose(0, 2, 1)))


def _clip_to_band(
    band: tuple[float, float], height_m: float, directions_z: Float64, begin_m: float, ends_m: Float64
) -> tuple[Float64, Float64]:
    """Compute (n,) begin and end of rays in a height band; the end is not above the begin for rays outside."""
    is_level = directions_z == 0
    slopes = np.where(is_level, 1.0, directions_z)
    low_m, high_m = (band[0] - height_m) / slopes, (band[1] - height_m) / slopes
    is_inside = ~is_level | (band[0] <= height_m < band[1])
    entry_m = np.where(is_level, np.where(is_inside, -np.inf, np.inf), np.minimum(low_m, high_m))
    exit_m = np.where(is_level, np.inf, np.maximum(low_m, high_m))
    return np.maximum(entry_m, begin_m), np.minimum(exit_m, ends_m)


def _compute_ray_ends_m(
    origin_m: Float64, directions: Float64, max_range_m: float, ego_caster: RayCaster | None
) -> Float64:
    """Compute (n,) ranges at which rays reach the ground plane or their maximum range; 0 for rays onto the vehicle."""
    is_downward = directions[2] < 0
    ground_m = np.full(directions.shape[1], np.inf)
    ground_m[is_downward] = origin_m[2] / -directions[2, is_downward]
    ends_m: Float64 = np.minimum(ground_m, max_range_m)
    if ego_caster is None:
        return ends_m
    hits = ego_caster.cast(origin_m, directions.astype(np.float32), ends_m.astype(np.float32))
    ends_m[hits.body_indices >= 0] = 0.0
    return ends_m
