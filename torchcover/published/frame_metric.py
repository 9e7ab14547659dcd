"""The base of the metrics that others published: frames in, numbers out."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchcover.frames import Frame
from torchcover.metrics import MergeableMetric, figure_of
from torchcover.neighbors import check_tensor
from torchcover.published.number import PublishedNumber

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class FrameMetric(MergeableMetric):
    """A metric of one rig that is fed with frames: an observer of `torchcover.evaluation`, as it is.

    A metric says in `_add_frame` what a frame adds, and in `compute` what all of them say.

    Args:
        meaning: What the sums depend on, as in `MergeableMetric`.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.
    """

    def __init__(self, meaning: Mapping[str, object], rig: str | None = None, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__({**meaning, "rig": rig}, **kwargs)
        self.rig = rig

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
            self._add_frame(each)
            self.steps += 1

    def _add_frame(self, frame: Frame) -> None:
        raise NotImplementedError

    def compute(self) -> tuple[PublishedNumber, ...]:
        """What the frames so far say."""
        raise NotImplementedError

    def resampled(self, weights: Tensor) -> Tensor | None:
        """(R, V) the V numbers of `compute` if each block of worlds had come as often as it is weighted.

        Args:
            weights: (R, 16) how often.

        Returns:
            None if they are unknown, as here.
        """
        return None

    def plot(self, val: Sequence[PublishedNumber] | None = None, ax: "Axes | None" = None) -> "tuple[Figure, Axes]":
        """Draw the numbers and their standard errors, one below the other; what is unknown has its name only.

        Args:
            val: What `compute` or `forward` returned; the numbers so far if not given.
            ax: Where to; a new figure of pyplot's if not given.

        Returns:
            The figure and the axes.

        Raises:
            TypeError: `val` holds anything else.
        """
        numbers = self.compute() if val is None else val
        if not all(isinstance(number, PublishedNumber) for number in numbers):
            raise TypeError(f"val: the numbers of compute() are needed; got {numbers!r}")
        fig, ax = figure_of(ax)
        places = range(len(numbers))
        ax.errorbar([one.value for one in numbers], places, xerr=[one.standard_error for one in numbers], fmt="o")
        ax.set_yticks(places, [f"{one.name} ({one.unit})" for one in numbers])
        ax.invert_yaxis()
        return fig, ax
