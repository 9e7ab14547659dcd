"""Some rigs of a source of frames, under other names."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.data.frame import Frame
from torchcover.data.source import FrameDataset, FrameSource
from torchcover.simulation import Sensor

ValueT = TypeVar("ValueT")


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
    def sensors(self) -> Mapping[str, Sequence[Sensor]]:
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
