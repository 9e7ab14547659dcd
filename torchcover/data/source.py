"""What every source of frames says of itself, be it a simulation, a folder or another format."""

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from torchcover.data.frame import Frame
from torchcover.simulation import Sensor


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
    def sensors(self) -> Mapping[str, Sequence[Sensor]]:
        """The sensors of the rigs that they are known of, for drawings; may be empty."""
        ...

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """(K, 2) corners x, y of the ego in the vehicle frame in metres; None if nobody knows."""
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
        """Where the reference comes from, for `summary.json`: `sensor` and its settings; None if nobody knows.

        One that was simulated says `every_s`, any other `notes`: sentences that a reader of the numbers has to know.
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
