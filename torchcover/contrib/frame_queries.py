"""Queries of frames that published metrics share: points in boxes, distances and cells, and strata of objects."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.coverage.grid import CellAssignment
from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection import Boxes, find_points_in_boxes
from torchcover.detection.inside import BoxPointPairs
from torchcover.frames import Frame
from torchcover.neighbors import check_cloud, nearest
from torchcover.neighbors.backend_choice import choose_shared_backend

CATEGORIES = ("car", "truck", "bus", "cyclist", "motorcycle", "pedestrian")
RANGE_BORDERS_M = (20.0, 40.0, 80.0)


class ObjectStrata:
    """Strata of objects: all objects within the last range border, each category, each range bin [lo, hi).

    The range of an object is the distance of its center from the vehicle origin, over ground.

    Args:
        categories: Categories; objects of other categories count in the stratum of all objects only.
        range_borders_m: Ascending positive borders; objects beyond the last border are excluded.

    Raises:
        ValueError: A repeated category, or borders that are empty or not ascending.

    Example:
        >>> ObjectStrata(("car",), (20.0, 40.0)).name_suffixes
        ('', ':car', ':0-20m', ':20-40m')
    """

    def __init__(self, categories: Sequence[str], range_borders_m: Sequence[float]) -> None:
        self.categories = tuple(categories)
        self.range_borders_m = tuple(float(border) for border in range_borders_m)
        if len(set(self.categories)) < len(self.categories):
            raise ValueError(f"categories: each may be given once; got {', '.join(self.categories)}")
        if not self.range_borders_m or not all(low < high for low, high in pairwise((0.0, *self.range_borders_m))):
            raise ValueError(f"range_borders_m: ascending numbers > 0 are needed; got {self.range_borders_m}")

    @property
    def definition(self) -> dict[str, object]:
        """Parameters that sums over the strata depend on."""
        return {"categories": self.categories, "range_borders_m": self.range_borders_m}

    @property
    def name_suffixes(self) -> tuple[str, ...]:
        """Suffix of the name of a number for each stratum; empty for all objects."""
        bins = [f":{low:g}-{high:g}m" for low, high in pairwise((0.0, *self.range_borders_m))]
        return ("", *(f":{category}" for category in self.categories), *bins)

    def compute_membership(self, boxes: Boxes) -> Tensor:
        """Compute which objects belong to which stratum.

        Args:
            boxes: K objects.

        Returns:
            (strata, K) float64, 1 where an object belongs to the stratum, else 0.
        """
        device = boxes.yaw_rad.device
        is_category = [[category == name for category in boxes.categories] for name in self.categories]
        category = torch.tensor(is_category, dtype=torch.float64, device=device).view(len(self.categories), len(boxes))
        range_m = torch.linalg.vector_norm(boxes.center_m[:, :2].double(), dim=1)
        borders = torch.tensor(self.range_borders_m, dtype=torch.float64, device=device)
        bins = torch.nn.functional.one_hot(torch.bucketize(range_m, borders, right=True), len(borders) + 1).T.double()
        in_range = 1.0 - bins[-1]
        return torch.cat([in_range[None], category * in_range, bins[:-1]])


ResultT = TypeVar("ResultT")

NO_BOXES = (
    "{}: the frame has no boxes, and the metric needs objects: SimulatedFrames(..., boxes=True) makes them, a "
    "recording has them if its format does; else use dataclasses.replace(frame, boxes=...)"
)


class FrameQueryCache:
    """Cache of the queries of the last frame, shared by the metrics of all rigs of a run; copies start empty.

    Example:
        >>> frame = Frame({"rig": torch.zeros(1, 3)}, torch.tensor([[0.3, 0.0, 0.0], [3.0, 0.0, 0.0]]), 0, "a")
        >>> FrameQueryCache().find_distances_m(frame, "rig", 0.4)
        tensor([0.3000,    inf])
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._results: dict[tuple[Any, ...], Any] = {}
        self._total: tuple[tuple[Any, ...], Any] | None = None
        # True if a metric needs single sensors: the distances of the rig are then the minimum over its sensors.
        self.searches_by_sensor = False

    def __reduce__(self) -> tuple[type["FrameQueryCache"], tuple[()], dict[str, bool]]:
        return FrameQueryCache, (), {"searches_by_sensor": self.searches_by_sensor}

    def find_distances_m(self, frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
        """Find the distance from each reference point to the nearest point of the rig.

        Args:
            frame: Frame with M reference points.
            rig_name: Name of the rig.
            max_distance_m: Search radius; points with a larger measurement error are excluded.

        Returns:
            (M,) distances in meters; infinite beyond the search radius.
        """
        if self.searches_by_sensor:
            return self.find_sensor_distances_m(frame, rig_name, max_distance_m).amin(dim=0)
        key = ("rig", rig_name, max_distance_m)
        return self.get_or_compute(frame, key, _find_rig_distances_m, frame, rig_name, max_distance_m)

    def find_sensor_distances_m(self, frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
        """Find the distance from each reference point to the nearest point of each sensor.

        Args:
            frame: Frame with M reference points.
            rig_name: Name of the rig with S sensors.
            max_distance_m: Search radius; points with a larger measurement error are excluded.

        Returns:
            (S, M) distances in meters; infinite beyond the search radius.

        Raises:
            ValueError: The sensor of each point is unknown.
        """
        key = ("sensors", rig_name, max_distance_m)
        return self.get_or_compute(frame, key, _find_sensor_distances_m, frame, rig_name, max_distance_m)

    def get_boxes(self, frame: Frame) -> Boxes:
        """Return the objects of a frame.

        Args:
            frame: Frame with boxes.

        Returns:
            The boxes.

        Raises:
            ValueError: The boxes of the frame are unknown.
        """
        if frame.boxes is None:
            raise ValueError(NO_BOXES.format(f"frame {frame.name!r}"))
        return frame.boxes

    def find_reference_in_boxes(self, frame: Frame) -> BoxPointPairs:
        """Find the reference points in each object.

        Args:
            frame: Frame with boxes.

        Returns:
            Pairs of a box and a reference point in it.
        """
        return self.get_or_compute(frame, ("boxes",), find_points_in_boxes, frame.reference, self.get_boxes(frame))

    def compute_membership(self, frame: Frame, strata: ObjectStrata) -> Tensor:
        """Compute which objects of a frame belong to which stratum.

        Args:
            frame: Frame with K boxes.
            strata: Strata of objects.

        Returns:
            (strata, K) float64, 1 where an object belongs to the stratum, else 0.
        """
        key = ("strata", *strata.definition.values())
        return self.get_or_compute(frame, key, strata.compute_membership, self.get_boxes(frame))

    def count_points_in_boxes(self, frame: Frame, rig_name: str) -> Tensor:
        """Count the points of a rig in each object.

        Args:
            frame: Frame with K boxes.
            rig_name: Name of the rig.

        Returns:
            (K,) int64 counts.
        """
        boxes = self.get_boxes(frame)
        if rig_name in boxes.points_in_box:
            return boxes.points_in_box[rig_name]
        points = frame.get_cloud(rig_name, max_error_m=MEASURED_WITHIN_M)
        return self.get_or_compute(frame, ("hits", rig_name), count_points_in_boxes, points, boxes)

    def assign_cells(self, frame: Frame, grid: BevGrid) -> CellAssignment:
        """Assign the reference points of a frame to the cells of a grid.

        Args:
            frame: Frame with reference points.
            grid: Cells and height bands.

        Returns:
            Cells of the points.
        """
        heights_m = frame.get_heights_m(grid.band_frame)
        return self.get_or_compute(frame, ("bins", grid), grid.assign_cells, frame.reference, heights_m)

    def get_or_compute(
        self,
        frame: Frame,
        key: tuple[Any, ...],
        compute: Callable[..., ResultT],
        *arguments: Any,  # noqa: ANN401  (of `compute`)
    ) -> ResultT:
        """Return a result for a frame, computed at the first request.

        Args:
            frame: Frame; results of the previous frame are dropped.
            key: Name and parameters of the result.
            compute: Function that computes the result.
            *arguments: Its arguments.

        Returns:
            The result.
        """
        if frame is not self._frame:
            self._frame, self._results = frame, {}
        if key not in self._results:
            self._results[key] = compute(*arguments)
        result: ResultT = self._results[key]
        return result

    def get_or_compute_total(self, key: tuple[Any, ...], compute: Callable[[], ResultT]) -> ResultT:
        """Return a result over all frames, computed at the first request and kept until another key is requested.

        Args:
            key: Name and inputs of the result.
            compute: Function that computes the result.

        Returns:
            The result.
        """
        if self._total is None or self._total[0] != key:
            self._total = key, compute()
        result: ResultT = self._total[1]
        return result


def get_rig_name(frame: Frame, rig_name: str | None) -> str:
    """Return the name of an existing rig.

    Args:
        frame: Frame with clouds of the rig.
        rig_name: Name of the rig; None for the only rig.

    Returns:
        Name of the rig.

    Raises:
        ValueError: The frame has no such rig, or several rigs and `rig_name` is None.
    """
    frame.get_cloud(rig_name)
    return next(iter(frame.clouds)) if rig_name is None else rig_name


def count_points_in_boxes(cloud: Tensor, boxes: Boxes) -> Tensor:
    """Count the points in each box.

    Args:
        cloud: (N, 3) points in the vehicle frame.
        boxes: K boxes.

    Returns:
        (K,) int64 counts.
    """
    return torch.bincount(find_points_in_boxes(cloud, boxes).box_indices, minlength=len(boxes))


def _find_rig_distances_m(frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
    """Find (M,) distances from reference points to the cloud of a rig."""
    return _find_distances_m(frame, frame.get_cloud(rig_name, max_error_m=max_distance_m), max_distance_m)


def _find_sensor_distances_m(frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
    """Find (S, M) distances from reference points to the cloud of each sensor."""
    clouds = list(frame.get_clouds_by_sensor(rig_name, max_error_m=max_distance_m).values())
    backend = choose_shared_backend(frame.reference, clouds)
    return torch.stack([_find_distances_m(frame, cloud, max_distance_m, backend) for cloud in clouds])


def _find_distances_m(frame: Frame, cloud: Tensor, max_distance_m: float, backend: str = "auto") -> Tensor:
    """Find (M,) distances from reference points to a cloud, infinite beyond the maximum distance."""
    check_cloud(frame.reference, "reference")
    check_cloud(cloud, "sensor")
    return nearest(frame.reference, cloud, max_distance=max_distance_m, backend=backend).distance
