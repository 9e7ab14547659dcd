"""The base of the metrics that others published: frames in, numbers out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcover.contrib.sights import Sights
from torchcover.devices import has_float64
from torchcover.estimation import MIN_BLOCKS, Estimate, Number, Quantity
from torchcover.frames import Frame
from torchcover.metrics import MergeableMetric, SumsInBlocks, figure_of
from torchcover.neighbors import check_tensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# As many as `evaluate` keeps of the coverage, so that both can be drawn again together.
BLOCKS = 16


class FrameMetric(MergeableMetric):
    """A metric of one rig that is fed with frames: an observer of `torchcover.evaluation`, as it is.

    A metric says in `_add_frame` what a frame adds, and in `_found` what all of them say.

    Args:
        meaning: What the sums depend on, as in `MergeableMetric`.
        rig: Whose clouds; those of the only rig if not given.
        sights: What metrics of a run share; its own if not given.
        kwargs: For `torchmetrics.Metric`.
    """

    def __init__(
        self,
        meaning: Mapping[str, object],
        *,
        rig: str | None = None,
        sights: Sights | None = None,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        super().__init__({**meaning, "rig": rig}, **kwargs)
        self.rig = rig
        self.sights = Sights() if sights is None else sights

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
                check_tensor(cloud, name, floating=True)
        for each in frames:
            self._add_frame(each if has_float64(each.reference.device) else each.to("cpu"))
            self.steps += 1

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
        numbers = estimate.numbers().values()
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
        fig, ax = figure_of(ax)
        places = range(len(numbers))
        ax.errorbar([one.value for one in numbers], places, xerr=[one.error for one in numbers], fmt="o")
        ax.set_yticks(places, [f"{one.quantity.key} ({one.quantity.unit})" for one in numbers])
        ax.invert_yaxis()
        return fig, ax


def said(key: str, unit: str, count_of: str, *, lower_is_better: bool = False, **parameters: Any) -> Number:  # noqa: ANN401
    """What a number of a metric is, before it has a value.

    Args:
        key: With all that decides it: "object_coverage_0.4m"; of a part of it ":car" is appended.
        unit: "share", "nats", "points", ...
        count_of: What it is over: "objects", "voxels", ...
        lower_is_better: As its authors say it.
        parameters: What it is computed with.

    Example:
        >>> said("k_cover_2_0.4m", "share", "reference points", k=2).parameters
        {'k': 2}
    """
    quantity = Quantity(key, key, unit, lower_is_better)
    return Number(quantity, math.nan, count_of=count_of, parameters=parameters)


class WorldRatios(SumsInBlocks, FrameMetric):
    """Ratios S / A of sums over frames, kept in 16 blocks of contiguous worlds (`Frame.place_in_time`).

    A metric gives its `ratios`, and in `_of_frame` what a frame adds to each: a_j, s_j, and how many these are. Errors
    are the block jackknife's, as those of regions in `Coverage`; a ratio that fewer than 8 blocks know has none, nor
    has one of which all blocks say the same.

    Args:
        ratios: What they are, as from `said`.
        meaning: What the sums depend on.
        kwargs: `rig` and `sights` of `FrameMetric`, and those of `torchmetrics.Metric`.
    """

    base: Tensor
    sums: Tensor
    counts: Tensor

    def __init__(self, ratios: Sequence[Number], meaning: Mapping[str, object], **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(BLOCKS, meaning, **kwargs)
        self.ratios = tuple(ratios)
        self.add_block_sum("base", (len(self.ratios),))
        self.add_block_sum("sums", (len(self.ratios),))
        self.add_sum("counts", (len(self.ratios),), torch.int64)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """(V,) what a frame adds to what is divided by, to the sums, and to the int64 counts of each ratio."""
        raise NotImplementedError

    def _add_frame(self, frame: Frame) -> None:
        base, sums, counts = self._of_frame(frame)  # before anything is added
        block = self._block_of(frame.place_in_time)
        self.base[block] += base.to(self.base)
        self.sums[block] += sums.to(self.sums)
        self.counts += counts.to(self.counts)

    def _found(self) -> tuple[Estimate, Sequence[Number]]:
        about = [one._replace(count=count) for one, count in zip(self.ratios, self.counts.tolist(), strict=True)]
        estimate = Estimate.of_ratios([one.quantity for one in about], self.base, self.sums, self.block_steps)
        enough = (self.base > 0).sum(dim=0) >= min(MIN_BLOCKS, len(estimate.steps))
        return replace(estimate, left_out=estimate.left_out.where(enough, math.nan)), about
