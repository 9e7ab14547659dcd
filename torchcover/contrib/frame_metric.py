"""Base classes of the published metrics, and a cache of the queries that metrics share."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.coverage.grid import CellAssignment
from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection import Boxes, find_points_in_boxes
from torchcover.detection.inside import BoxPointPairs
from torchcover.devices import has_float64
from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.frames import Frame
from torchcover.metrics import BlockedSums, MergeableSums, get_figure
from torchcover.neighbors import check_cloud, check_tensor, nearest
from torchcover.neighbors.backend_choice import choose_shared_backend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        return self.get_or_compute(
            frame,
            ("rig", rig_name, max_distance_m),
            lambda: _find_distances_m(frame, frame.get_cloud(rig_name, max_error_m=max_distance_m), max_distance_m),
        )

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

        def search() -> Tensor:
            clouds = list(frame.get_clouds_by_sensor(rig_name, max_error_m=max_distance_m).values())
            backend = choose_shared_backend(frame.reference, clouds)
            return torch.stack([_find_distances_m(frame, cloud, max_distance_m, backend) for cloud in clouds])

        return self.get_or_compute(frame, ("sensors", rig_name, max_distance_m), search)

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
        return self.get_or_compute(
            frame, ("boxes",), lambda: find_points_in_boxes(frame.reference, self.get_boxes(frame))
        )

    def compute_membership(self, frame: Frame, strata: ObjectStrata) -> Tensor:
        """Compute which objects of a frame belong to which stratum.

        Args:
            frame: Frame with K boxes.
            strata: Strata of objects.

        Returns:
            (strata, K) float64, 1 where an object belongs to the stratum, else 0.
        """
        key = ("strata", *strata.definition.values())
        return self.get_or_compute(frame, key, lambda: strata.compute_membership(self.get_boxes(frame)))

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
        return self.get_or_compute(frame, ("hits", rig_name), lambda: count_points_in_boxes(points, boxes))

    def assign_cells(self, frame: Frame, grid: BevGrid) -> CellAssignment:
        """Assign the reference points of a frame to the cells of a grid.

        Args:
            frame: Frame with reference points.
            grid: Cells and height bands.

        Returns:
            Cells of the points.
        """
        return self.get_or_compute(
            frame, ("bins", grid), lambda: grid.assign_cells(frame.reference, frame.get_heights_m(grid.band_frame))
        )

    def get_or_compute(self, frame: Frame, key: tuple[Any, ...], compute: Callable[[], ResultT]) -> ResultT:
        """Return a result for a frame, computed at the first request.

        Args:
            frame: Frame; results of the previous frame are dropped.
            key: Name and parameters of the result.
            compute: Function that computes the result.

        Returns:
            The result.
        """
        if frame is not self._frame:
            self._frame, self._results = frame, {}
        if key not in self._results:
            self._results[key] = compute()
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


def _find_distances_m(frame: Frame, cloud: Tensor, max_distance_m: float, backend: str = "auto") -> Tensor:
    check_cloud(frame.reference, "reference")
    check_cloud(cloud, "sensor")
    return nearest(frame.reference, cloud, max_distance=max_distance_m, backend=backend).distance


# Number of blocks that `evaluate` uses for coverage, so that both can be resampled together.
BLOCKS = 16


class FrameMetric(MergeableSums):
    """Base class of metrics of one rig over frames, usable as an observer of `torchcover.evaluation`.

    A subclass adds a frame in `_add_frame` and computes its numbers in `_compute_numbers`.

    Args:
        definition: Parameters that the sums depend on, see `MergeableSums`.
        rig_name: Name of the rig; may be None if there is only one.
        query_cache: Cache that the metrics of a run share; default: a new one.
        kwargs: Arguments of the next base class.
    """

    def __init__(
        self,
        definition: Mapping[str, object],
        *,
        rig_name: str | None = None,
        query_cache: FrameQueryCache | None = None,
        **kwargs: Any,  # noqa: ANN401  (of `FrameMetric`)
    ) -> None:
        super().__init__({**definition, "rig_name": rig_name}, **kwargs)
        self.rig_name = rig_name
        self.query_cache = FrameQueryCache() if query_cache is None else query_cache

    @torch.no_grad()
    def update(self, frame: Frame | Sequence[Frame]) -> None:
        """Add one frame or several frames.

        Args:
            frame: Frame, or sequence of frames.

        Raises:
            ValueError: A frame lacks data that the metric needs; it is not added.
            TypeError: An element is not a frame, or a cloud is not a tensor.
        """
        frames = [frame] if isinstance(frame, Frame) else frame
        if not isinstance(frames, Sequence) or not all(isinstance(element, Frame) for element in frames):
            raise TypeError(f"frame: a Frame, or a list of frames, is needed; got {type(frame).__name__}")
        for added in frames:
            for name, cloud in {"reference": added.reference, **added.clouds}.items():
                check_tensor(cloud, name, is_floating=True)
        for added in frames:
            self._add_frame(added if has_float64(added.reference.device) else added.to("cpu"))
            self.num_frames += 1

    def _add_frame(self, frame: Frame) -> None:
        raise NotImplementedError

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        """Compute the estimate, and for each of its numbers the description, the count and the parameters."""
        raise NotImplementedError

    def estimate(self) -> Estimate:
        """Return the current numbers with their jackknife values over blocks of scenes, for errors of differences."""
        return self._compute_numbers()[0]

    def compute(self) -> tuple[Number, ...]:
        """Compute the numbers of all frames so far."""
        estimate, descriptions = self._compute_numbers()
        # The coverage probability of these intervals has not been measured.
        numbers = estimate.to_numbers().values()
        return tuple(
            description._replace(value=number.value, error=number.error, low=number.low, high=number.high)
            for description, number in zip(descriptions, numbers, strict=True)
        )

    def plot(self, val: Sequence[Number] | None = None, ax: "Axes | None" = None) -> "tuple[Figure, Axes]":
        """Plot the numbers and their standard errors, one row each; unknown numbers have an empty row.

        Args:
            val: Result of `compute` or `forward`; default: the current numbers.
            ax: Target axes; default: a new pyplot figure.

        Raises:
            TypeError: `val` contains anything but numbers.
        """
        numbers = self.compute() if val is None else val
        if not all(isinstance(number, Number) for number in numbers):
            raise TypeError(f"val: the numbers of compute() are needed; got {numbers!r}")
        fig, ax = get_figure(ax)
        rows = range(len(numbers))
        ax.errorbar([number.value for number in numbers], rows, xerr=[number.error for number in numbers], fmt="o")
        ax.set_yticks(rows, [f"{number.quantity.key} ({number.quantity.unit})" for number in numbers])
        ax.invert_yaxis()
        return fig, ax


def describe_number(
    key: str,
    unit: str,
    counted_items: str,
    *,
    lower_is_better: bool = False,
    **parameters: Any,  # noqa: ANN401  (any parameter of a metric)
) -> Number:
    """Describe a number of a metric that has no value yet.

    Args:
        key: Name with all parameters: "object_coverage_0.4m"; numbers of a stratum append ":car".
        unit: "share", "nats", "points", ...
        counted_items: Items over which the number is a mean: "objects", "voxels", ...
        lower_is_better: Direction according to the authors of the metric.
        parameters: Parameters of the computation.

    Returns:
        Number without a value.

    Example:
        >>> describe_number("k_cover_2_0.4m", "share", "reference points", k=2).parameters
        {'k': 2}
    """
    quantity = Quantity(key, key, unit, lower_is_better)
    return Number(quantity, math.nan, counted_items=counted_items, parameters=parameters)


class SceneRatios(BlockedSums, FrameMetric):
    """Ratios of sums over frames, stored in 16 blocks of contiguous scenes (`Frame.block_index`).

    A subclass passes its `ratios` and returns the sums of a frame from `_sum_frame`. Errors are those of the block
    jackknife, as for regions in `Coverage`; a ratio with fewer than 8 blocks, or with equal values in all blocks, has
    no error.

    Args:
        ratios: Descriptions of the ratios, see `describe_number`.
        definition: Parameters that the sums depend on.
        kwargs: `rig_name` and `query_cache` of `FrameMetric`.
    """

    denominators: Tensor
    numerators: Tensor
    counts: Tensor

    def __init__(self, ratios: Sequence[Number], definition: Mapping[str, object], **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(BLOCKS, definition, **kwargs)
        self.ratios = tuple(ratios)
        self.define_block_sum("denominators", (len(self.ratios),))
        self.define_block_sum("numerators", (len(self.ratios),))
        self.define_sum("counts", (len(self.ratios),), torch.int64)

    def _sum_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """Compute what a frame adds to each ratio: (V,) denominators, (V,) numerators and (V,) int64 counts."""
        raise NotImplementedError

    def _add_frame(self, frame: Frame) -> None:
        denominators, numerators, counts = self._sum_frame(frame)  # may raise, hence before any addition
        block = self._assign_block(frame.block_index)
        self.denominators[block] += denominators.to(self.denominators)
        self.numerators[block] += numerators.to(self.numerators)
        self.counts += counts.to(self.counts)

    def _compute_numbers(self) -> tuple[Estimate, Sequence[Number]]:
        descriptions = [
            ratio._replace(count=count) for ratio, count in zip(self.ratios, self.counts.tolist(), strict=True)
        ]
        estimate = Estimate.from_ratios(
            [description.quantity for description in descriptions],
            self.denominators,
            self.numerators,
            self.block_frame_counts,
        )
        has_enough_blocks = (self.denominators > 0).sum(dim=0) >= min(MIN_BLOCKS, len(estimate.frame_counts))
        return replace(
            estimate, jackknife_values=estimate.jackknife_values.where(has_enough_blocks, math.nan)
        ), descriptions
