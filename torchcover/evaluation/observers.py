"""What is fed with frames: coverage, and whatever else a user wants to know of them."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

from torchcover.coverage import Coverage, CoverageSums
from torchcover.coverage.steps import FrameSums
from torchcover.frames import Frame

ResultT = TypeVar("ResultT", covariant=True)


@runtime_checkable
class Stateful(Protocol):
    """What a checkpoint can keep: an observer, or a stopping rule, that hands out all that it knows and takes it back.

    A state consists of tensors, numbers, texts and None, in lists and in dicts with names as keys. An object to which
    one is given goes on as the other would have, bit for bit.
    """

    def state_dict(self) -> Mapping[str, Any]:
        """All that the frames so far have left; it is written at once, so that it need not be a copy."""

    def load_state_dict(self, state_dict: Mapping[str, Any], /) -> object:
        """Be what the other was; the tensors are on the CPU, and nobody else's."""


class Observer(Protocol[ResultT]):
    """Something that looks at frames, one after the other, and says something in the end.

    Over several processes or ranks each has an observer of its own over other frames; one merges the others. A run with
    a checkpoint needs those that are `Stateful`, too. One that has `compute_sums`, from a frame to what is to `add`, as
    `CoverageObserver` has, measures frames where they are made.

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
        """Add a frame; its tensors are on the device of the run."""

    def compute(self) -> ResultT:
        """What the frames so far say."""

    def merge_state(self, other: Self, /) -> None:
        """Add the frames of another observer, which is left as it was."""


class CoverageObserver:
    """Coverage of one rig: feeds frames to a `CoverageSums`.

    Args:
        metric: Where the sums are.
        rig: Whose clouds; those of the only rig if not given.

    Example:
        >>> import torch
        >>> from torchcover import BevGrid
        >>> observer = CoverageObserver(CoverageSums(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0)))
        >>> observer.update(Frame({"rig": torch.zeros(1, 3)}, torch.tensor([[0.5, 0.0, 0.0]]), index=0, name="a"))
        >>> observer.compute().radius[0].tolist()
        [[0.5, nan]]
    """

    def __init__(self, metric: CoverageSums, rig: str | None = None) -> None:
        self.metric = metric
        self.rig = rig

    def update(self, frame: Frame) -> None:
        """Add a frame: what is made of it by `compute_sums`."""
        self.add_sums(self.compute_sums(frame))

    def compute_sums(self, frame: Frame) -> list[FrameSums]:
        """What a frame is to `add`, with the weights and the heights of its reference points and its place in time.

        It is small, and the same in every process, so that frames are measured where they are made.

        Raises:
            ValueError: As `CoverageSums.update`, several rigs and none was named, or reference points without the
                square metres or the heights that the metric wants, or it is unknown which points are of which sensor
                and it wants that.
        """
        clouds = frame.get_clouds_by_sensor if self.metric.sensor_names else frame.get_cloud
        return self.metric.compute_sums(
            clouds(self.rig),
            frame.reference,
            errors_m=frame.get_errors_m(self.rig),
            weights=frame.reference_weights,
            heights_m=frame.get_heights_m(self.metric.grid.band_frame),
            block_index=frame.block_index,
        )

    def add_sums(self, sums: Sequence[FrameSums]) -> None:
        """Add a frame that `compute_sums` an observer of the same rig and parameters has measured."""
        for one in sums:
            self.metric.add_sums(one)

    def compute(self) -> Coverage:
        """The coverage so far."""
        coverage: Coverage = self.metric.compute()
        return coverage

    def state_dict(self) -> dict[str, Any]:
        """The sums of the metric."""
        return self.metric.metric_state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Take the sums of another one.

        Raises:
            ValueError: Of a metric with other parameters.
        """
        self.metric.reset()
        self.metric.merge_state(state_dict)

    def merge_state(self, other: "CoverageObserver") -> None:
        """Add the frames of another one of the same rig.

        Raises:
            ValueError: Of another rig, or metrics with other parameters.
        """
        if other.rig != self.rig:
            raise ValueError(f"cannot merge the coverage of rig {other.rig!r} into that of {self.rig!r}")
        self.metric.merge_state(other.metric)


AnyObserver = Observer[Any]
