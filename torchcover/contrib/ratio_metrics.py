"""Ratios over frames: coverage of objects, perception entropy, surface seen by k sensors, density of points."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

import torchcover.geometry.tensors  # noqa: F401
from torchcover.contrib.frame_metric import (
    CATEGORIES,
    RANGE_BORDERS_M,
    ObjectStrata,
    SceneRatios,
    count_points_in_boxes,
    describe_number,
    get_rig_name,
)
from torchcover.coverage import BevGrid, Region, check_regions
from torchcover.coverage.quantity import MEASURED_WITHIN_M
from torchcover.coverage.regions import RegionBands
from torchcover.detection.visibility import compute_box_means
from torchcover.frames import Frame
from torchcover.neighbors import check_cloud, nearest
from torchcover.simulation import CameraSensor, Sensor

HITS = (1, 5, 10)


class ObjectCoverage(SceneRatios):
    """Mean over objects of the share that the rig sees, and share of objects with n points of the rig or more.

    The share of one object is that of `torchcover.detection.measure_box_visibility`: of what the reference's places see of it,
    in square metres where the weights are; an object of which they see nothing is unknown and not in the mean. Hits are
    counted over all objects, those that are hidden from everywhere among them.

    Args:
        threshold_m: Distance within which a point counts as seen.
        min_point_counts: Numbers of points, n.
        categories: Those that have numbers of their own.
        range_borders_m: Borders between bins of range; farther objects do not count.
        kwargs: `rig` and `sights` of `FrameMetric`.

    Raises:
        ValueError: A threshold that is negative, n below 1, categories or borders that make no sense. From `update`:
            a frame without boxes.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), categories=("car",))
        >>> reference = torch.tensor([[8.0, 0.0, 0.5], [8.0, 0.0, 1.5]])
        >>> metric = ObjectCoverage()
        >>> metric.update(Frame({"rig": torch.tensor([[8.0, 0.0, 0.6]])}, reference, 0, "a", boxes=boxes))
        >>> [(one.quantity.key, one.value) for one in metric.compute() if one.known and ":" not in one.quantity.key]
        [('object_coverage_0.4m', 0.5), ('objects_hit_1', 1.0), ('objects_hit_5', 0.0), ('objects_hit_10', 0.0)]
    """

    def __init__(
        self,
        threshold_m: float = 0.4,
        min_point_counts: Sequence[int] = HITS,
        categories: Sequence[str] = CATEGORIES,
        range_borders_m: Sequence[float] = RANGE_BORDERS_M,
        **kwargs: Any,  # noqa: ANN401  (of `FrameMetric`)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        if (
            not min_point_counts
            or any(least < 1 for least in min_point_counts)
            or len(set(min_point_counts)) < len(min_point_counts)
        ):
            raise ValueError(f"hits: different numbers of points from 1 on are needed; got {tuple(min_point_counts)}")
        strata = ObjectStrata(categories, range_borders_m)
        names = [f"object_coverage_{threshold_m:g}m", *(f"objects_hit_{least}" for least in min_point_counts)]
        given: list[dict[str, Any]] = [{"threshold_m": threshold_m}, *({"hits": least} for least in min_point_counts)]
        within: dict[str, Any] = {"range_m": strata.range_borders_m[-1]}
        ratios = [
            describe_number(name + stratum, "share", "objects", **parameters, **within)
            for name, parameters in zip(names, given, strict=True)
            for stratum in strata.name_suffixes
        ]
        super().__init__(
            ratios,
            {"threshold_m": float(threshold_m), "min_point_counts": tuple(min_point_counts), **strata.definition},
            **kwargs,
        )
        self.strata = strata
        self.threshold_m = float(threshold_m)
        self.min_point_counts = tuple(min_point_counts)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        rig, boxes = get_rig_name(frame, self.rig_name), self.query_cache.get_boxes(frame)
        seen = self.query_cache.find_distances_m(frame, rig, self.threshold_m) <= self.threshold_m
        box, point = self.query_cache.find_reference_in_boxes(frame)
        weights = None if frame.reference_weights is None else frame.reference_weights[point]
        share = compute_box_means(seen[point].double(), box, len(boxes), weights)
        known = ~share.isnan()
        hits = self.query_cache.count_points_in_boxes(frame, rig).to(share.device)
        # (1 + hits, K) of each object, whether it counts, and with what.
        counts = torch.stack([known.double(), *[torch.ones_like(share)] * len(self.min_point_counts)])
        values = torch.stack([share.where(known, 0.0), *((hits >= least).double() for least in self.min_point_counts)])
        members = self.query_cache.compute_membership(frame, self.strata).to(share.device)
        base = (counts @ members.T).flatten()
        return base, (values @ members.T).flatten(), base.long()


# Of average precision a ln m + b over m points or pixels on the object, as GO4ROBO has them.
CONSTANTS: Mapping[str, tuple[float, float]] = MappingProxyType({"lidar": (0.152, 0.659), "camera": (0.055, 0.155)})
PRECISIONS = (0.001, 0.999)


def compute_standard_deviation(measurements: Tensor, sensor_kind: str) -> Tensor:
    """The sigma of objects with (K,) measurements of one kind of sensor: 1 / AP - 1, AP = a ln m + b.

    AP is kept within [0.001, 0.999], as GO4ROBO does; with the constants of LiDARs it is 0.999 from 10 points on. No
    measurement is as bad as can be.
    """
    a, b = CONSTANTS[sensor_kind]
    precision = (a * measurements.double().log() + b).clamp(*PRECISIONS)
    return 1 / precision - 1


def fuse_standard_deviations(sigmas: Sequence[Tensor]) -> Tensor:
    """The sigma of several kinds of sensors together: (sum of sigma_i^-2)^-1/2."""
    return torch.stack(list(sigmas)).pow(-2).sum(dim=0).pow(-0.5)


def compute_entropy_nats(sigma: Tensor, *, is_bounded: bool = False) -> Tensor:
    """Nats of a Gaussian in the plane: 2 ln sigma + 1 + ln 2 pi; bounded: 2 ln(sigma + 1) + ln 2 pi."""
    if is_bounded:
        return 2 * (sigma + 1).log() + math.log(2 * math.pi)
    return 2 * sigma.log() + 1 + math.log(2 * math.pi)


class PerceptionEntropy(SceneRatios):
    """Mean over objects of their perception entropy (Ma et al. 2021, as GO4ROBO has it); lower is better.

    Points of LiDARs on an object are added up, those of cameras too, and the two kinds are fused late. The plain form
    is unbounded in the quality of a detector and dominated by whether an object has 10 points; the bounded one, of
    GO4ROBO's differentiable path, is never below ln 2 pi.

    Args:
        sensors: The rig's sensors; if not given, or without a camera, all points are taken for those of LiDARs.
        categories: Those that have numbers of their own.
        range_borders_m: Borders between bins of range; farther objects do not count.
        kwargs: `rig` and `sights` of `FrameMetric`.

    Raises:
        ValueError: From `update`: a frame without boxes; of a rig with cameras, if it is unknown which points are of
            which sensor.

    Example:
        >>> from torchcover.detection import Boxes
        >>> boxes = Boxes.from_rows(torch.tensor([[10.0, 0, 1, 4, 2, 2, 0]]), hits={"rig": torch.tensor([5])})
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
        **kwargs: Any,  # noqa: ANN401  (of `FrameMetric`)
    ) -> None:
        cameras = {sensor.name: sensor.pixels_per_sample for sensor in sensors if isinstance(sensor, CameraSensor)}
        strata = ObjectStrata(categories, range_borders_m)
        given = {"range_m": strata.range_borders_m[-1], "constants": dict(CONSTANTS), "cameras": sorted(cameras)}
        ratios = [
            describe_number(form + name, "nats", "objects", lower_is_better=True, **given)
            for form in ("perception_entropy", "perception_entropy_bounded")
            for name in strata.name_suffixes
        ]
        super().__init__(ratios, {**strata.definition, "cameras": tuple(sorted(cameras.items()))}, **kwargs)
        self.strata = strata
        self.pixels_per_sample = cameras

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        sigma = self._sigma(frame, get_rig_name(frame, self.rig_name))
        members = self.query_cache.compute_membership(frame, self.strata).to(sigma.device)
        values = torch.stack([compute_entropy_nats(sigma), compute_entropy_nats(sigma, is_bounded=True)])
        count = members.sum(dim=1).repeat(2)
        return count, (values @ members.T).flatten(), count.long()

    def _sigma(self, frame: Frame, rig: str) -> Tensor:
        if not self.pixels_per_sample:
            return compute_standard_deviation(self.query_cache.count_points_in_boxes(frame, rig), "lidar")
        boxes, measurements = self.query_cache.get_boxes(frame), dict[str, Tensor]()
        for name, cloud in frame.get_clouds_by_sensor(rig, max_error_m=MEASURED_WITHIN_M).items():
            kind = "camera" if name in self.pixels_per_sample else "lidar"
            of_sensor = self.pixels_per_sample.get(name, 1) * count_points_in_boxes(cloud, boxes)
            measurements[kind] = measurements.get(kind, torch.zeros_like(of_sensor)) + of_sensor
        return fuse_standard_deviations(
            [compute_standard_deviation(count, kind) for kind, count in measurements.items()]
        )


AT_LEAST = (1, 2, 3)


class KCover(SceneRatios):
    """Share of the visible square metres within the threshold of k sensors of the rig or more.

    The binary cover with redundancy of the art gallery line (Vijay et al. 2021): of surface that the random reference
    sees instead of a list of cells, so that k = 1 is the detection by area.

    Args:
        grid: Cells and height bands.
        regions: Those that have numbers of their own.
        threshold_m: Distance within which a point counts as seen.
        min_sensor_counts: Numbers of sensors, k; more than the rig has are covered nowhere.
        has_area_weights: Whether the share is one of square metres, which frames are then to have; else one of points.
        kwargs: `rig` and `sights` of `FrameMetric`.

    Raises:
        ValueError: k below 1, a threshold that is negative, regions that the grid does not hold. From `update`: points
            of unknown sensors; no square metres where they are wanted.

    Example:
        >>> grid = BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0)
        >>> frame = Frame({"rig": torch.zeros(2, 3)}, torch.tensor([[0.3, 0.0, 0.0]]), 0, "a",
        ...               sensor_points={"rig": {"left": 1, "right": 1, "rear": 0}})
        >>> metric = KCover(grid, (), square_metres=False)
        >>> metric.update(frame)
        >>> [one.value for one in metric.compute()]
        [1.0, 1.0, 0.0]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        threshold_m: float = 0.4,
        min_sensor_counts: Sequence[int] = AT_LEAST,
        *,
        has_area_weights: bool = True,
        **kwargs: Any,  # noqa: ANN401  (of `FrameMetric`)
    ) -> None:
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        if (
            not min_sensor_counts
            or any(least < 1 for least in min_sensor_counts)
            or len(set(min_sensor_counts)) < len(min_sensor_counts)
        ):
            raise ValueError(
                f"at_least: different numbers of sensors from 1 on are needed; got {tuple(min_sensor_counts)}"
            )
        check_regions(regions, grid)
        places = RegionBands(regions, grid)
        names = ["", *(f":{region.name}_{band}" for region in places.regions for band in grid.heights)]
        counted = "reference points, by square metres" if has_area_weights else "reference points"
        ratios = [
            describe_number(f"k_cover_{k}_{threshold_m:g}m{name}", "share", counted, k=k, threshold_m=threshold_m)
            for k in min_sensor_counts
            for name in names
        ]
        meaning = {
            "threshold_m": float(threshold_m),
            "min_sensor_counts": tuple(min_sensor_counts),
            "has_area_weights": has_area_weights,
            "grid": grid,
            "regions": places.regions,
        }
        super().__init__(ratios, meaning, **kwargs)
        self.region_bands = places
        self.threshold_m = float(threshold_m)
        self.min_sensor_counts = tuple(min_sensor_counts)
        self.has_area_weights = has_area_weights
        self.query_cache.searches_by_sensor = True

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        weights = frame.reference_weights if self.has_area_weights else frame.reference.new_ones(len(frame.reference))
        if weights is None:
            raise ValueError(
                f"frame {frame.name!r}: the square metres of its reference points (reference_weights) are needed; got "
                "none; for a share of the points use square_metres=False"
            )
        within = (
            self.query_cache.find_sensor_distances_m(frame, get_rig_name(frame, self.rig_name), self.threshold_m)
            <= self.threshold_m
        )
        inside, of, cell = self.query_cache.assign_cells(frame, self.region_bands.grid)
        point = inside[of]
        sensors = within.sum(dim=0)[point]
        weight = weights.to(point.device)[point].double()
        seen = [weight * (sensors >= k) for k in self.min_sensor_counts]
        values = torch.stack([torch.ones_like(weight), weight, *seen])
        place, of_place = self.region_bands.assign_points(frame.reference.to(point.device)[point], cell)
        in_places = values.new_zeros(len(values), self.region_bands.num_region_bands).index_add_(
            1, place, values[:, of_place]
        )
        sums = torch.cat([values.sum(dim=1, keepdim=True), in_places], dim=1)
        count, base = (row.repeat(len(seen)) for row in sums[:2])
        return base, sums[2:].flatten(), count.long()


class PointDensity(SceneRatios):
    """Points of the rig in a frame; over the grid and in regions those for each square metre, and their uniformity.

    The density is over the ground as drawn, be it visible or not. The uniformity is (sum n)^2 / (C sum n^2) over the
    points n in C square cells: 1 if all cells have as many, 1 / C if one has all. Density and uniformity are what Cai
    et al. (2023) look at; their own formula of uniformity could not be read. It does not ask how many points there are:
    those that are missed may raise it, by 0.0004 within 3 m ahead of `kitti` in fog of 100 m.

    Args:
        grid: Where points count: its extent, its height bands, and the cells of the uniformity. The ground below a
            point is that below the reference point which, seen from above, is next to it.
        regions: Those that have numbers of their own.
        kwargs: `rig` and `sights` of `FrameMetric`.

    Raises:
        ValueError: Regions that the grid does not hold.

    Example:
        >>> metric = PointDensity(BevGrid(x=(0.0, 4.0), y=(0.0, 1.0), cell=1.0), ())
        >>> cloud = torch.tensor([[0.5, 0.5, 0.0], [1.5, 0.5, 0.0], [9.0, 0.0, 0.0]])
        >>> metric.update(Frame({"rig": cloud}, torch.zeros(0, 3), 0, "a"))
        >>> [(one.quantity.key, one.value) for one in metric.compute()]
        [('points', 3.0), ('point_density', 0.5), ('point_uniformity_1m', 0.5)]
    """

    def __init__(
        self,
        grid: BevGrid,
        regions: Sequence[Region],
        **kwargs: Any,  # noqa: ANN401  (of `FrameMetric`)
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
        everywhere = torch.ones(grid.shape[1:], dtype=torch.bool, device="cpu")
        self._members = torch.stack([everywhere, *(region.mask_cells(grid) for region in regions)]).flatten(1).double()

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        cloud = frame.get_cloud(get_rig_name(frame, self.rig_name))
        check_cloud(cloud, "sensor")
        height = None if self.grid.band_frame == "vehicle" else _heights_m(cloud, frame)
        each = self.grid.count_points_by_column(cloud, height).flatten().cpu()
        cells = self._members.sum(dim=1)
        points, squares = (self._members @ torch.stack([each, each.square()], dim=1)).T
        somewhere = (points > 0).double()
        uniformity = points.square() / (cells * squares).where(points > 0, 1.0)
        one, all_points = cells.new_ones(1), cells.new_tensor([len(cloud)])
        base = torch.cat([one, cells * self.grid.cell_m**2, somewhere])
        counts = torch.cat([one, torch.ones_like(cells), somewhere]).long()
        return base, torch.cat([all_points, points, uniformity]), counts


def _heights_m(cloud: Tensor, frame: Frame) -> Tensor:
    """(N,) how high points lie above the ground, NaN where it is unknown everywhere."""
    heights_m = frame.get_heights_m("ground")
    assert heights_m is not None  # those over z alone are
    known = heights_m.isfinite()
    ground_m = torch.cat([(frame.reference[:, 2] - heights_m)[known], heights_m.new_tensor([math.nan])])
    from_above = cloud.new_tensor([1.0, 1.0, 0.0])
    return cloud[:, 2] - ground_m[nearest(cloud * from_above, frame.reference[known] * from_above).index]
