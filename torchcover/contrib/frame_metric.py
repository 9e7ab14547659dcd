"""The base of the metrics that others published: frames in, numbers out; what several need of a frame is found once."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.coverage.grid import CellAssignment
from torchcover.coverage.quantity import MEASURED_WITHIN_M
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
    """All objects up to the last border, those of each category, and those in each bin of range, [lo, hi).

    An object's range is the distance of its centre from the vehicle's origin, over ground.

    `categories`: names; objects of others are among all of them only; `range_borders_m`: ascending, positive; what is
    farther than the last does not count. ValueError: a category that is named twice, borders out of order or none.

    Example:
        >>> ObjectStrata(("car",), (20.0, 40.0)).names
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
        """What sums over them depend on."""
        return {"categories": self.categories, "range_borders_m": self.range_borders_m}

    @property
    def name_suffixes(self) -> tuple[str, ...]:
        """What is appended to the name of a number; nothing for all objects."""
        bins = [f":{low:g}-{high:g}m" for low, high in pairwise((0.0, *self.range_borders_m))]
        return ("", *(f":{category}" for category in self.categories), *bins)

    def compute_membership(self, boxes: Boxes) -> Tensor:
        """(strata, K) float64: 1 where an object is one of them."""
        device = boxes.yaw_rad.device
        of_category = [[category == name for category in boxes.categories] for name in self.categories]
        category = torch.tensor(of_category, dtype=torch.float64, device=device).view(len(self.categories), len(boxes))
        range_m = torch.linalg.vector_norm(boxes.center_m[:, :2].double(), dim=1)
        borders = torch.tensor(self.range_borders_m, dtype=torch.float64, device=device)
        bins = torch.nn.functional.one_hot(torch.bucketize(range_m, borders, right=True), len(borders) + 1).T.double()
        near = 1.0 - bins[-1]
        return torch.cat([near[None], category * near, bins[:-1]])


Found = TypeVar("Found")

NO_BOXES = (
    "{}: the frame has no boxes, and the metric is about objects: SimulatedFrames(..., boxes=True) makes them, a "
    "recording has them if its format does; else use dataclasses.replace(frame, boxes=...)"
)


class FrameQueryCache:
    """Remembers what was found in the last frame. Metrics of a run, of all its rigs, share one; a copy starts anew.

    Example:
        >>> frame = Frame({"rig": torch.zeros(1, 3)}, torch.tensor([[0.3, 0.0, 0.0], [3.0, 0.0, 0.0]]), 0, "a")
        >>> Sights().distance(frame, "rig", 0.4)
        tensor([0.3000,    inf])
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._found: dict[tuple[Any, ...], Any] = {}
        self._of_all: tuple[tuple[Any, ...], Any] | None = None
        # Whether a metric asks for single sensors: then the rig as a whole takes no search of its own.
        self.searches_by_sensor = False

    def __reduce__(self) -> tuple[type["FrameQueryCache"], tuple[()], dict[str, bool]]:
        return FrameQueryCache, (), {"searches_by_sensor": self.searches_by_sensor}

    def find_distances_m(self, frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
        """(M,) metres from each reference point to the nearest point of the rig; infinite where none is within reach.

        Points that were measured farther off than that are none.
        """
        if self.searches_by_sensor:
            return self.find_sensor_distances_m(frame, rig_name, max_distance_m).amin(dim=0)
        return self.get_or_compute(
            frame,
            ("rig", rig_name, max_distance_m),
            lambda: _search(frame, frame.get_cloud(rig_name, max_error_m=max_distance_m), max_distance_m),
        )

    def find_sensor_distances_m(self, frame: Frame, rig_name: str, max_distance_m: float) -> Tensor:
        """(S, M) the same for each sensor of the rig.

        Raises:
            ValueError: Which points are of which sensor is unknown.
        """

        def search() -> Tensor:
            clouds = list(frame.get_clouds_by_sensor(rig_name, max_error_m=max_distance_m).values())
            backend = choose_shared_backend(frame.reference, clouds)
            return torch.stack([_search(frame, cloud, max_distance_m, backend) for cloud in clouds])

        return self.get_or_compute(frame, ("sensors", rig_name, max_distance_m), search)

    def get_boxes(self, frame: Frame) -> Boxes:
        """The objects of the frame.

        Raises:
            ValueError: The frame has none; the message says how to get them.
        """
        if frame.boxes is None:
            raise ValueError(NO_BOXES.format(f"frame {frame.name!r}"))
        return frame.boxes

    def find_reference_in_boxes(self, frame: Frame) -> BoxPointPairs:
        """Which reference points lie in which objects."""
        return self.get_or_compute(
            frame, ("boxes",), lambda: find_points_in_boxes(frame.reference, self.get_boxes(frame))
        )

    def compute_membership(self, frame: Frame, strata: ObjectStrata) -> Tensor:
        """(strata, K) float64: 1 where an object is one of them."""
        what = ("strata", *strata.definition.values())
        return self.get_or_compute(frame, what, lambda: strata.compute_membership(self.get_boxes(frame)))

    def count_points_in_boxes(self, frame: Frame, rig_name: str) -> Tensor:
        """(K,) int64 how many points of the rig lie in each object."""
        boxes = self.get_boxes(frame)
        if rig_name in boxes.points_in_box:
            return boxes.points_in_box[rig_name]
        points = frame.get_cloud(rig_name, max_error_m=MEASURED_WITHIN_M)
        return self.get_or_compute(frame, ("hits", rig_name), lambda: count_points_in_boxes(points, boxes))

    def assign_cells(self, frame: Frame, grid: BevGrid) -> CellAssignment:
        """In which cells of a grid the reference points are."""
        return self.get_or_compute(
            frame, ("bins", grid), lambda: grid.assign_cells(frame.reference, frame.get_heights_m(grid.band_frame))
        )

    def get_or_compute(self, frame: Frame, key: tuple[Any, ...], compute: Callable[[], Found]) -> Found:
        """Whatever is to be found in a frame; looked for when it is first asked for."""
        if frame is not self._frame:
            self._frame, self._found = frame, {}
        if key not in self._found:
            self._found[key] = compute()
        found: Found = self._found[key]
        return found

    def get_or_compute_total(self, key: tuple[Any, ...], compute: Callable[[], Found]) -> Found:
        """Whatever is to be found from what all frames left; remembered until something else is asked for."""
        if self._of_all is None or self._of_all[0] != key:
            self._of_all = key, compute()
        found: Found = self._of_all[1]
        return found


def get_rig_name(frame: Frame, rig_name: str | None) -> str:
    """The name of the rig; of the only one if none is given. ValueError: there is no such rig, or there are several."""
    frame.get_cloud(rig_name)
    return next(iter(frame.clouds)) if rig_name is None else rig_name


def count_points_in_boxes(cloud: Tensor, boxes: Boxes) -> Tensor:
    """(K,) int64 how many points lie in each of K boxes."""
    return torch.bincount(find_points_in_boxes(cloud, boxes).box_indices, minlength=len(boxes))


def _search(frame: Frame, cloud: Tensor, within_m: float, backend: str = "auto") -> Tensor:
    check_cloud(frame.reference, "reference")
    check_cloud(cloud, "sensor")
    return nearest(frame.reference, cloud, max_distance=within_m, backend=backend).distance


# As many as `evaluate` keeps of the coverage, so that both can be drawn again together.
BLOCKS = 16


class FrameMetric(MergeableSums):
    """A metric of one rig that is fed with frames: an observer of `torchcover.evaluation`, as it is.

    A metric says in `_add_frame` what a frame adds, and in `_found` what all of them say.

    Args:
        meaning: What the sums depend on, as in `MergeableSums`.
        rig_name: Whose clouds; those of the only rig if not given.
        query_cache: What metrics of a run share; its own if not given.
        kwargs: For the next base.
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
        """Add a frame, or several.

        Raises:
            ValueError: A frame that lacks what the metric needs; nothing of it is added.
            TypeError: No frame, or a cloud that is no tensor.
        """
        frames = [frame] if isinstance(frame, Frame) else frame
        if not isinstance(frames, Sequence) or not all(isinstance(each, Frame) for each in frames):
            raise TypeError(f"frame: a Frame, or a list of them, is needed; got {type(frame).__name__}")
        for each in frames:
            for name, cloud in {"reference": each.reference, **each.clouds}.items():
                check_tensor(cloud, name, is_floating=True)
        for each in frames:
            self._add_frame(each if has_float64(each.reference.device) else each.to("cpu"))
            self.num_frames += 1

    def _add_frame(self, frame: Frame) -> None:
        raise NotImplementedError

    def _found(self) -> tuple[Estimate, Sequence[Number]]:
        """The estimate; and of each of its numbers what it is, how many it is over, and what it was computed with."""
        raise NotImplementedError

    def estimate(self) -> Estimate:
        """The numbers so far with what they become without each block of worlds, for errors of differences."""
        return self._found()[0]

    def compute(self) -> tuple[Number, ...]:
        """What the frames so far say."""
        estimate, about = self._found()
        # How often an interval around such a number holds the truth has not been measured.
        numbers = estimate.to_numbers().values()
        return tuple(
            one._replace(value=number.value, error=number.error, low=number.low, high=number.high)
            for one, number in zip(about, numbers, strict=True)
        )

    def plot(self, val: Sequence[Number] | None = None, ax: "Axes | None" = None) -> "tuple[Figure, Axes]":
        """Draw the numbers and their standard errors, one below the other; what is unknown has its name only.

        Args:
            val: What `compute` or `forward` returned; the numbers so far if not given.
            ax: Where to; a new figure of pyplot's if not given.

        Raises:
            TypeError: `val` holds anything else.
        """
        numbers = self.compute() if val is None else val
        if not all(isinstance(number, Number) for number in numbers):
            raise TypeError(f"val: the numbers of compute() are needed; got {numbers!r}")
        fig, ax = get_figure(ax)
        places = range(len(numbers))
        ax.errorbar([one.value for one in numbers], places, xerr=[one.error for one in numbers], fmt="o")
        ax.set_yticks(places, [f"{one.quantity.key} ({one.quantity.unit})" for one in numbers])
        ax.invert_yaxis()
        return fig, ax


def describe_number(
    key: str, unit: str, counted_items: str, *, lower_is_better: bool = False, **parameters: Any
) -> Number:  # noqa: ANN401
    """What a number of a metric is, before it has a value.

    Args:
        key: With all that decides it: "object_coverage_0.4m"; of a part of it ":car" is appended.
        unit: "share", "nats", "points", ...
        counted_items: What it is over: "objects", "voxels", ...
        lower_is_better: As its authors say it.
        parameters: What it is computed with.

    Example:
        >>> said("k_cover_2_0.4m", "share", "reference points", k=2).parameters
        {'k': 2}
    """
    quantity = Quantity(key, key, unit, lower_is_better)
    return Number(quantity, math.nan, counted_items=counted_items, parameters=parameters)


class SceneRatios(BlockedSums, FrameMetric):
    """Ratios S / A of sums over frames, kept in 16 blocks of contiguous worlds (`Frame.block_index`).

    A metric gives its `ratios`, and in `_of_frame` what a frame adds to each: a_j, s_j, and how many these are. Errors
    are the block jackknife's, as those of regions in `Coverage`; a ratio that fewer than 8 blocks know has none, nor
    has one of which all blocks say the same.

    Args:
        ratios: What they are, as from `said`.
        meaning: What the sums depend on.
        kwargs: `rig` and `sights` of `FrameMetric`.
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

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """(V,) what a frame adds to what is divided by, to the sums, and to the int64 counts of each ratio."""
        raise NotImplementedError

    def _add_frame(self, frame: Frame) -> None:
        base, sums, counts = self._of_frame(frame)  # before anything is added
        block = self._assign_block(frame.block_index)
        self.denominators[block] += base.to(self.denominators)
        self.numerators[block] += sums.to(self.numerators)
        self.counts += counts.to(self.counts)

    def _found(self) -> tuple[Estimate, Sequence[Number]]:
        about = [one._replace(count=count) for one, count in zip(self.ratios, self.counts.tolist(), strict=True)]
        estimate = Estimate.from_ratios(
            [one.quantity for one in about], self.denominators, self.numerators, self.block_frame_counts
        )
        enough = (self.denominators > 0).sum(dim=0) >= min(MIN_BLOCKS, len(estimate.frame_counts))
        return replace(estimate, jackknife_values=estimate.jackknife_values.where(enough, math.nan)), about
