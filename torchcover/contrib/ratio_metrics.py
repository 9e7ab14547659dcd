"""Ratio metrics: object coverage, perception entropy, coverage by k sensors and point density."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

import torchcover.geometry.tensors  # noqa: F401
from torchcover.contrib.frame_metric import SceneRatios, describe_number
from torchcover.contrib.frame_queries import (
    CATEGORIES,
    RANGE_BORDERS_M,
    ObjectStrata,
    count_points_in_boxes,
    get_rig_name,
)
from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.coverage.regions import RegionBands
from torchcover.detection.visibility import compute_box_means
from torchcover.frames import Frame
from torchcover.neighbors import check_cloud, nearest
from torchcover.simulation import CameraSensor, Sensor


class ObjectCoverage(SceneRatios):
    """Mean detected share of objects, and share of objects with at least n sensor points.

    The share of an object is that of `torchcover.detection.measure_box_visibility`, weighted by area if frames
    have area weights; objects without reference points are unknown and excluded from the mean. The shares of objects
    with n points refer to all objects, including hidden ones.

    Args:
        threshold_m: Detection threshold.
        min_point_counts: Numbers of points n.
        categories: Categories with separate numbers.
        range_borders_m: Borders between range bins; farther objects are excluded.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: A negative threshold, n below 1, invalid categories or borders. From `update`: a frame without
            boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), categories=("car",))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5]])
        >>> metric = ObjectCoverage()
        >>> metric.update(Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, 0, "a", boxes=boxes))
        >>> numbers = [number for number in metric.compute() if number.has_value]
        >>> [(number.quantity.key, number.value) for number in numbers if ":" not in number.quantity.key]
        [('object_coverage_0.4m', 0.5), ('objects_hit_1', 1.0), ('objects_hit_5', 0.0), ('objects_hit_10', 0.0)]
    """

    def __init__(
        self,
        threshold_m: float = 0.4,
        min_point_counts: Sequence[int] = (1, 5, 10),
        categories: Sequence[str] = CATEGORIES,
        range_borders_m: Sequence[float] = RANGE_BORDERS_M,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in meters is needed; got {threshold_m}")
        if not min_point_counts or min(min_point_counts) < 1 or len(set(min_point_counts)) < len(min_point_counts):
            raise ValueError(
                f"min_point_counts: different numbers of points from 1 on are needed; got {tuple(min_point_counts)}"
            )
        strata = ObjectStrata(categories, range_borders_m)
        parameters: dict[str, dict[str, Any]] = {f"object_coverage_{threshold_m:g}m": {"threshold_m": threshold_m}}
        for count in min_point_counts:
            parameters[f"objects_hit_{count}"] = {"hits": count}
        ratios = []
        for name, row in parameters.items():
            row["range_m"] = strata.range_borders_m[-1]
            for stratum in strata.name_suffixes:
                ratios.append(describe_number(name + stratum, "share", "objects", **row))
        super().__init__(
            ratios,
            {"threshold_m": float(threshold_m), "min_point_counts": tuple(min_point_counts), **strata.definition},
            **kwargs,
        )
        self.strata = strata
        self.threshold_m = float(threshold_m)
        self.min_point_counts = tuple(min_point_counts)

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        rig, boxes = get_rig_name(frame, self.rig_name), self.query_cache.get_boxes(frame)
        is_detected = self.query_cache.find_distances_m(frame, rig, self.threshold_m) <= self.threshold_m
        box, point = self.query_cache.find_reference_in_boxes(frame)
        weights = None if frame.reference_weights is None else frame.reference_weights[point]
        share = compute_box_means(is_detected[point].double(), box, len(boxes), weights)
        is_observed = ~share.isnan()
        point_counts = self.query_cache.count_points_in_boxes(frame, rig).to(share.device)
        # (1 + number of n, K) weight and value of each object for each ratio.
        counts = torch.stack([is_observed.double(), *[torch.ones_like(share)] * len(self.min_point_counts)])
        values = torch.stack(
            [share.where(is_observed, 0.0), *((point_counts >= n).double() for n in self.min_point_counts)]
        )
        membership = self.query_cache.compute_membership(frame, self.strata).to(share.device)
        denominators = (counts @ membership.T).flatten()
        return denominators, (values @ membership.T).flatten(), denominators.long()


# Constants a and b of the average precision a ln m + b for m points or pixels on an object, from GO4ROBO.
CONSTANTS: Mapping[str, tuple[float, float]] = MappingProxyType({"lidar": (0.152, 0.659), "camera": (0.055, 0.155)})


def compute_standard_deviation(measurements: Tensor, sensor_kind: str) -> Tensor:
    """Compute the standard deviation 1 / AP - 1 with AP = a ln m + b, clamped to [0.001, 0.999] as in GO4ROBO.

    With the LiDAR constants, AP is 0.999 from 10 points on; zero measurements give the smallest AP.

    Args:
        measurements: (K,) number of measurements m on each object.
        sensor_kind: "lidar" or "camera".

    Returns:
        (K,) float64 standard deviations.
    """
    a, b = CONSTANTS[sensor_kind]
    precision = (a * measurements.double().log() + b).clamp(0.001, 0.999)
    return 1 / precision - 1


def fuse_standard_deviations(sigmas: Sequence[Tensor]) -> Tensor:
    """Fuse the standard deviations of several kinds of sensors: (sum of sigma_i^-2)^-1/2.

    Args:
        sigmas: (K,) standard deviations for each kind.

    Returns:
        (K,) fused standard deviations.
    """
    return torch.stack(list(sigmas)).pow(-2).sum(dim=0).pow(-0.5)


def compute_entropy_nats(sigma: Tensor, *, is_bounded: bool = False) -> Tensor:
    """Compute the entropy of a 2D Gaussian.

    Args:
        sigma: (K,) standard deviations.
        is_bounded: False: 2 ln sigma + 1 + ln 2 pi; True: 2 ln(sigma + 1) + ln 2 pi.

    Returns:
        (K,) entropies in nats.
    """
    if is_bounded:
        return 2 * (sigma + 1).log() + math.log(2 * math.pi)
    return 2 * sigma.log() + 1 + math.log(2 * math.pi)


class PerceptionEntropy(SceneRatios):
    """Mean perception entropy of objects (Ma et al. 2021, in the form of GO4ROBO); lower is better.

    Points of all LiDARs on an object are added, pixels of all cameras too, and the two kinds are fused late. The plain
    form is unbounded in the quality of a detector and dominated by the criterion of 10 points on an object; the bounded
    form, from the differentiable path of GO4ROBO, is at least ln 2 pi.

    Args:
        sensors: Sensors of the rig; without cameras, all points count as LiDAR points.
        categories: Categories with separate numbers.
        range_borders_m: Borders between range bins; farther objects are excluded.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: From `update`: a frame without boxes; for a rig with cameras, unknown sensors of the points.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), points_in_box={"rig": torch.tensor([5])})
        >>> metric = PerceptionEntropy()
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, torch.zeros(0, 3), 0, "a", boxes=boxes))
        >>> round(metric.compute()[0].value, 6)
        -1.638678
    """

    def __init__(
        self,
        sensors: Sequence[Sensor] = (),
        categories: Sequence[str] = CATEGORIES,
        range_borders_m: Sequence[float] = RANGE_BORDERS_M,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        cameras = {sensor.name: sensor.pixels_per_sample for sensor in sensors if isinstance(sensor, CameraSensor)}
        strata = ObjectStrata(categories, range_borders_m)
        parameters = {"range_m": strata.range_borders_m[-1], "constants": dict(CONSTANTS), "cameras": sorted(cameras)}
        ratios = []
        for form in ("perception_entropy", "perception_entropy_bounded"):
            for name in strata.name_suffixes:
                ratios.append(describe_number(form + name, "nats", "objects", lower_is_better=True, **parameters))
        super().__init__(ratios, {**strata.definition, "cameras": tuple(sorted(cameras.items()))}, **kwargs)
        self.strata = strata
        self.pixels_per_sample = cameras

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        sigma = self._compute_sigma(frame, get_rig_name(frame, self.rig_name))
        membership = self.query_cache.compute_membership(frame, self.strata).to(sigma.device)
        values = torch.stack([compute_entropy_nats(sigma), compute_entropy_nats(sigma, is_bounded=True)])
        count = membership.sum(dim=1).repeat(2)
        return count, (values @ membership.T).flatten(), count.long()

    def _compute_sigma(self, frame: Frame, rig: str) -> Tensor:
        """Compute the standard deviation of the measurements of each object."""
        if not self.pixels_per_sample:
            return compute_standard_deviation(self.query_cache.count_points_in_boxes(frame, rig), "lidar")
        boxes, measurements = self.query_cache.get_boxes(frame), dict[str, Tensor]()
        for name, cloud in frame.get_clouds_by_sensor(rig, max_error_m=MEASURED_WITHIN_M).items():
            kind = "camera" if name in self.pixels_per_sample else "lidar"
            sensor_counts = self.pixels_per_sample.get(name, 1) * count_points_in_boxes(cloud, boxes)
            measurements[kind] = measurements.get(kind, torch.zeros_like(sensor_counts)) + sensor_counts
        sigmas = [compute_standard_deviation(count, kind) for kind, count in measurements.items()]
        return fuse_standard_deviations(sigmas)


class KCover(SceneRatios):
    """Share of the visible surface that at least k sensors of the rig detect.

    Corresponds to binary coverage with redundancy in art gallery problems (Vijay et al. 2021), over the surface
    that the reference observes instead of a list of cells; k = 1 is the detection rate by area.

    Args:
        grid: Cells and height bands.
        regions: Regions with separate numbers.
        threshold_m: Detection threshold.
        min_sensor_counts: Numbers of sensors k; a k above the number of sensors gives 0.
        has_area_weights: True: share of the area, which needs area weights; False: share of the reference points.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: k below 1, a negative threshold, regions outside the grid. From `update`: unknown sensors of the
            points, or missing area weights.

    Example:
        >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0)
        >>> frame = Frame({"rig": torch.zeros(2, 3)}, torch.tensor([[0.3, 0.0, 0.0]]), 0, "a",
        ...               sensor_point_counts={"rig": {"left": 1, "right": 1, "rear": 0}})
        >>> metric = KCover(grid, (), has_area_weights=False)
        >>> metric.update(frame)
        >>> [number.value for number in metric.compute()]
        [1.0, 1.0, 0.0]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        threshold_m: float = 0.4,
        min_sensor_counts: Sequence[int] = (1, 2, 3),
        *,
        has_area_weights: bool = True,
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in meters is needed; got {threshold_m}")
        if not min_sensor_counts or min(min_sensor_counts) < 1 or len(set(min_sensor_counts)) < len(min_sensor_counts):
            raise ValueError(
                f"min_sensor_counts: different numbers of sensors from 1 on are needed; got {tuple(min_sensor_counts)}"
            )
        check_regions(regions, grid)
        region_bands = RegionBands(regions, grid)
        names = ["", *(f":{region.name}_{band}" for region in region_bands.regions for band in grid.heights)]
        counted = "reference points, by square metres" if has_area_weights else "reference points"
        ratios = []
        for k in min_sensor_counts:
            for name in names:
                key = f"k_cover_{k}_{threshold_m:g}m{name}"
                ratios.append(describe_number(key, "share", counted, k=k, threshold_m=threshold_m))
        definition = {
            "threshold_m": float(threshold_m),
            "min_sensor_counts": tuple(min_sensor_counts),
            "has_area_weights": has_area_weights,
            "grid": grid,
            "regions": region_bands.regions,
        }
        super().__init__(ratios, definition, **kwargs)
        self.region_bands = region_bands
        self.threshold_m = float(threshold_m)
        self.min_sensor_counts = tuple(min_sensor_counts)
        self.has_area_weights = has_area_weights
        self.query_cache.searches_by_sensor = True

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        weights = frame.reference_weights if self.has_area_weights else frame.reference.new_ones(len(frame.reference))
        if weights is None:
            raise ValueError(
                f"frame {frame.name!r}: the areas of its reference points (reference_weights) are needed; got "
                "none; for a share of the points use has_area_weights=False"
            )
        is_detected = (
            self.query_cache.find_sensor_distances_m(frame, get_rig_name(frame, self.rig_name), self.threshold_m)
            <= self.threshold_m
        )
        inside, row, cell = self.query_cache.assign_cells(frame, self.region_bands.grid)
        point = inside[row]
        sensor_count = is_detected.sum(dim=0)[point]
        weight = weights.to(point.device)[point].double()
        covered = [weight * (sensor_count >= k) for k in self.min_sensor_counts]
        values = torch.stack([torch.ones_like(weight), weight, *covered])
        region_band, point_of_pair = self.region_bands.assign_points(frame.reference.to(point.device)[point], cell)
        region_sums = values.new_zeros(len(values), self.region_bands.num_region_bands).index_add_(
            1, region_band, values[:, point_of_pair]
        )
        sums = torch.cat([values.sum(dim=1, keepdim=True), region_sums], dim=1)
        count, denominators = (row.repeat(len(covered)) for row in sums[:2])
        return denominators, sums[2:].flatten(), count.long()


class PointDensity(SceneRatios):
    """Number of points of the rig per frame; their density and uniformity over the grid and in regions.

    The density refers to the area of the grid, whether visible or not. The uniformity is (sum n)^2 / (C sum n^2)
    over the points n in C square cells: 1 for equal counts, 1 / C if one cell has all points. Cai et al. (2023)
    use density and uniformity; their formula of uniformity was not accessible. The uniformity does not depend on the
    number of
    points: missing points may raise it, by 0.0004 within 3 m ahead of `kitti` in fog of 100 m.

    Args:
        grid: Extent, height bands and cells. The ground below a point is that below the nearest reference point in
            bird's-eye view.
        regions: Regions with separate numbers.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.

    Raises:
        ValueError: Regions outside the grid.

    Example:
        >>> metric = PointDensity(BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 1.0), cell_m=1.0), ())
        >>> cloud = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0], [9.0, 0.0, 0.0]])
        >>> metric.update(Frame({"rig": cloud}, torch.zeros(0, 3), 0, "a"))
        >>> [(number.quantity.key, number.value) for number in metric.compute()]
        [('points', 3.0), ('point_density', 0.5), ('point_uniformity_1m', 0.5)]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        **kwargs: Any,  # noqa: ANN401  (arguments of `FrameMetric`)
    ) -> None:
        check_regions(regions, grid)
        names = ["", *(f":{region.name}" for region in regions)]
        ratios = [
            describe_number("points", "points", "frames"),
            *(describe_number(f"point_density{name}", "points/m2", "frames") for name in names),
            *(describe_number(f"point_uniformity_{grid.cell_m:g}m{name}", "share", "frames") for name in names),
        ]
        super().__init__(ratios, {"grid": grid, "regions": tuple(regions)}, **kwargs)
        self.grid = grid
        whole_grid = torch.ones(grid.shape[1:], dtype=torch.bool, device="cpu")
        self._region_masks = (
            torch.stack([whole_grid, *(region.mask_cells(grid) for region in regions)]).flatten(1).double()
        )

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.get_cloud(get_rig_name(frame, self.rig_name))
        check_cloud(cloud, "sensor")
        height_m = None if self.grid.band_frame == "vehicle" else _estimate_heights_m(cloud, frame)
        cell_counts = self.grid.count_points_by_column(cloud, height_m).flatten().cpu()
        cells = self._region_masks.sum(dim=1)
        points, squares = (self._region_masks @ torch.stack([cell_counts, cell_counts.square()], dim=1)).T
        has_points = (points > 0).double()
        uniformity = points.square() / (cells * squares).where(points > 0, 1.0)
        frame_count, point_count = cells.new_ones(1), cells.new_tensor([len(cloud)])
        denominators = torch.cat([frame_count, cells * self.grid.cell_m**2, has_points])
        counts = torch.cat([frame_count, torch.ones_like(cells), has_points]).long()
        return denominators, torch.cat([point_count, points, uniformity]), counts


def _estimate_heights_m(cloud: Tensor, frame: Frame) -> Tensor:
    """Estimate (N,) heights of points above ground from the nearest reference point; NaN without known ground."""
    heights_m = frame.get_heights_m("ground")
    assert heights_m is not None  # The result is None only for the band frame "vehicle"
    has_ground = heights_m.isfinite()
    ground_m = torch.cat([(frame.reference[:, 2] - heights_m)[has_ground], heights_m.new_tensor([math.nan])])
    bev_scale = cloud.new_tensor([1.0, 1.0, 0.0])
    return cloud[:, 2] - ground_m[nearest(cloud * bev_scale, frame.reference[has_ground] * bev_scale).index]
