"""Observers of frames: coverage, and any other statistic of a run."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

from torchcover.coverage import Coverage, CoverageSums
from torchcover.coverage.frame_input import FrameSums
from torchcover.frames import Frame

ResultT = TypeVar("ResultT", covariant=True)


@runtime_checkable
class Stateful(Protocol):
    """Object that a checkpoint can save: an observer or a stopping rule.

    A state consists of tensors, numbers, texts and None, in lists and in dicts with names as keys. An object that loads
    a state continues exactly like the object that it came from.
    """

    def state_dict(self) -> Mapping[str, Any]:
        """Return the complete state; it is written at once and need not be a copy."""

    def load_state_dict(self, state_dict: Mapping[str, Any], /) -> object:
        """Take over the state of another object; its tensors are on the CPU and not shared."""


class Observer(Protocol[ResultT]):
    """Statistic over frames that are passed one after the other.

    Each process or rank has its own observer for its own frames; `merge_state` combines them. A run with a checkpoint
    also needs `Stateful`. An observer with `compute_sums(frame)` and `add_sums(sums)`, such as `CoverageObserver`,
    measures frames in the process that makes them.

    Example:
        >>> class PointCount:
        ...     def __init__(self) -> None:
        ...         self.points = 0
        ...     def update(self, frame: Frame) -> None:
        ...         self.points += sum(len(cloud) for cloud in frame.clouds.values())
        ...     def compute(self) -> int:
        ...         return self.points
        ...     def merge_state(self, other: "PointCount") -> None:
        ...         self.points += other.points
    """

    def update(self, frame: Frame) -> None:
        """Add a frame, whose tensors are on the device of the run."""

    def compute(self) -> ResultT:
        """Return the result of the frames so far."""

    def merge_state(self, other: Self, /) -> None:
        """Add the frames of another observer, which stays unchanged."""


class CoverageObserver:
    """Observer that passes the points of one rig and the reference points to a coverage metric.

    Args:
        metric: Coverage metric.
        rig: Name of the rig in the frames; not needed if the frames have one rig.

    Example:
        >>> import torch
        >>> from torchcover import BevGrid
        >>> observer = CoverageObserver(CoverageSums(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0)))
        >>> observer.update(Frame({"rig": torch.zeros(1, 3)}, torch.tensor([[0.5, 0.0, 0.0]]), index=0, name="a"))
        >>> observer.compute().radius[0].tolist()
        [[0.5, nan]]
    """

    def __init__(self, metric: CoverageSums, rig: str | None = None) -> None:
        self.metric = metric
        self.rig = rig

    def update(self, frame: Frame) -> None:
        """Add a frame.

        Args:
            frame: Frame of the rig.

        Raises:
            ValueError: As `compute_sums`.
        """
        self.add_sums(self.compute_sums(frame))

    def compute_sums(self, frame: Frame) -> list[FrameSums]:
        """Compute what a frame adds to the metric; the sums are small and equal in every process.

        Args:
            frame: Frame of the rig.

        Returns:
            Sums for `add_sums`.

        Raises:
            ValueError: Invalid points, several rigs without a chosen one, or reference points without the area weights,
                heights or sensors that the metric needs.
        """
        get_points = frame.get_clouds_by_sensor if self.metric.sensor_names else frame.get_cloud
        return self.metric.compute_sums(
            get_points(self.rig),
            frame.reference,
            errors_m=frame.get_errors_m(self.rig),
            weights=frame.reference_weights,
            heights_m=frame.get_heights_m(self.metric.grid.band_frame),
            block_index=frame.block_index,
        )

    def add_sums(self, sums: Sequence[FrameSums]) -> None:
        """Add the sums of a frame.

        Args:
            sums: Return value of `compute_sums` of an observer of the same rig with the same parameters.
        """
        for frame_sums in sums:
            self.metric.add_sums(frame_sums)

    def compute(self) -> Coverage:
        """Return the coverage of the frames so far."""
        coverage: Coverage = self.metric.compute()
        return coverage

    def state_dict(self) -> dict[str, Any]:
        """Return the sums of the metric."""
        return self.metric.metric_state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Replace the sums by the sums of another observer.

        Args:
            state_dict: Return value of its `state_dict`.

        Raises:
            ValueError: The metric of the other observer has other parameters.
        """
        self.metric.reset()
        self.metric.merge_state(state_dict)

    def merge_state(self, other: "CoverageObserver") -> None:
        """Add the frames of another observer.

        Args:
            other: Observer of the same rig.

        Raises:
            ValueError: The other observer has another rig, or a metric with other parameters.
        """
        if other.rig != self.rig:
            raise ValueError(f"cannot merge the coverage of rig {other.rig!r} into the coverage of {self.rig!r}")
        self.metric.merge_state(other.metric)


AnyObserver = Observer[Any]
