"""Base classes of the published metrics."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcover.contrib.frame_queries import FrameQueryCache
from torchcover.devices import has_float64
from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.frames import Frame
from torchcover.metrics import BlockedSums, MergeableSums, get_figure
from torchcover.neighbors import check_tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        """Compute the numbers over all added frames."""
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
