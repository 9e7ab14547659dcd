"""What every source of frames says of itself, be it a simulation, a recording or another format."""

import re
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from torchcover.frames.frame import Frame

if TYPE_CHECKING:  # what they are is no matter of frames; who draws or measures them knows
    from torchcover.simulation import Sensor

ValueT = TypeVar("ValueT")


class BadFrameError(ValueError):
    """One frame of a recording cannot be used; the others can.

    `name` and `index` say which frame. A caller that skips bad frames catches this around `next`, with and without
    worker processes.

    Args:
        message: `NAME (frame INDEX): reason`, or a worker's traceback that ends in it: DataLoader knows no other way to
            build an exception again than from its text.

    Example:
        >>> error = BadFrameError("night_7 (frame 6): the reference cloud has no points")
        >>> error.name, error.index
        ('night_7', 6)
    """

    def __init__(self, message: str) -> None:
        super().__init__(message.rpartition("BadFrameError: ")[2].strip())
        parts = re.match(r"(?P<name>.*?) \(frame (?P<index>\d+)\): ", str(self))
        self.name = parts["name"] if parts else ""
        self.index = int(parts["index"]) if parts else -1


@runtime_checkable
class FrameSource(Protocol):
    """A map-style torch Dataset of frames that knows whose they are and where they come from.

    A format of recordings is a class like this that is made from a path; see `FORMATS`.
    """

    @property
    def rigs(self) -> Collection[str]:
        """The names under which `Frame.clouds` has the rigs."""
        ...

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """The sensors of the rigs that they are known of, for drawings; may be empty."""
        ...

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """(K, 2) corners x, y of the ego in the vehicle frame in metres; None if unknown."""
        ...

    @property
    def description(self) -> Mapping[str, object]:
        """Where the frames come from, for `summary.json`: `scenario`, `vehicle` and `seed`, or `frames`; else None."""
        ...

    @property
    def square_metres(self) -> bool:
        """Whether all frames have `Frame.reference_weights`, the square metres of reference points; else none has."""
        ...

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """Where the reference comes from, for `summary.json`: `sensor` and its settings; None if unknown.

        It has `notes`, sentences that a reader of the numbers has to know, and if it was simulated `every_s`.
        """
        ...

    @property
    def content(self) -> Mapping[str, object]:
        """All that the frames depend on, under the names that a message calls it by; for JSON.

        A checkpoint is of frames of this content: it changes if, and only if, a frame may be another one. What is large
        may be a hash.
        """
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def __getitem__(self, index: int, /) -> Frame:
        """One frame.

        Raises:
            BadFrameError: It cannot be used; the others can.
        """
        ...


class FrameDataset(Dataset[Frame]):
    """A map-style torch Dataset of frames that a `for` loop goes through in order."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames."""

    def __iter__(self) -> Iterator[Frame]:
        """The frames, one after the other."""
        return (self[index] for index in range(len(self)))


class ChosenRigs(FrameDataset):
    """The same frames with the clouds of some rigs only, each under a name of one's own: a `FrameSource` of another.

    Args:
        frames: Where the frames come from.
        names: New name of each rig -> its name there, in the order that is wanted.

    Raises:
        ValueError: The source has no such rig.
    """

    def __init__(self, frames: FrameSource, names: Mapping[str, str]) -> None:
        unknown = [name for name in names.values() if name not in frames.rigs]
        if unknown:
            raise ValueError(f"no clouds of the rig {', '.join(unknown)}; the frames have {', '.join(frames.rigs)}")
        self.frames = frames
        self.names = dict(names)

    @property
    def rigs(self) -> tuple[str, ...]:
        """The new names."""
        return tuple(self.names)

    @property
    def sensors(self) -> Mapping[str, "Sequence[Sensor]"]:
        """The sensors of these rigs that they are known of."""
        return self._chosen(self.frames.sensors)

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """As there."""
        return self.frames.ego_outline_m

    @property
    def description(self) -> Mapping[str, object]:
        """As there."""
        return self.frames.description

    @property
    def square_metres(self) -> bool:
        """As there."""
        return self.frames.square_metres

    @property
    def reference_record(self) -> Mapping[str, object] | None:
        """As there."""
        return self.frames.reference_record

    @property
    def content(self) -> Mapping[str, object]:
        """As there, and which rigs."""
        return {**self.frames.content, "rigs of the recording": self.names}

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Frame:
        frame = self.frames[index]
        boxes = None if frame.boxes is None else replace(frame.boxes, hits=self._chosen(frame.boxes.hits))
        points = None if frame.sensor_points is None else self._chosen(frame.sensor_points)
        clouds = {name: frame.cloud_of(of) for name, of in self.names.items()}
        return replace(frame, clouds=clouds, boxes=boxes, sensor_points=points)

    def _chosen(self, by_rig: Mapping[str, ValueT]) -> dict[str, ValueT]:
        return {name: by_rig[of] for name, of in self.names.items() if of in by_rig}
