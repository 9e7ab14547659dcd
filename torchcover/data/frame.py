"""One instant: what the rig saw and what was there to be seen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Frame:
    """The clouds of one time step, in the vehicle frame (x forward, y left, z up, metres).

    Args:
        sensors: Name of each rig -> (N, 3) float32 points of all its sensors; one rig, unless several were simulated
            side by side.
        reference: (M, 3) float32 points of the reference sensor.
        index: Position in its dataset.
        name: What a user calls it: a file stem, or scenario and step.
        counts: What was left out on the way here, by name (`sensor_self_hits`, `reference_nonfinite`, ...).
    """

    sensors: Mapping[str, Tensor]
    reference: Tensor
    index: int
    name: str
    counts: Mapping[str, int] = field(default_factory=dict)

    @property
    def sensor(self) -> Tensor:
        """(N, 3) points of the only rig.

        Raises:
            ValueError: There are several rigs: say which, `frame.sensors[name]`.
        """
        if len(self.sensors) != 1:
            raise ValueError(f"the frame has clouds of {len(self.sensors)} rigs ({', '.join(self.sensors)}): say which")
        return next(iter(self.sensors.values()))

    def pin_memory(self) -> "Frame":
        """A copy in page-locked memory; DataLoader calls it when `pin_memory=True`."""
        sensors = {name: cloud.pin_memory() for name, cloud in self.sensors.items()}
        return replace(self, sensors=sensors, reference=self.reference.pin_memory())

    def to(self, device: torch.device | str) -> "Frame":
        """A copy on another device."""
        sensors = {name: cloud.to(device) for name, cloud in self.sensors.items()}
        return replace(self, sensors=sensors, reference=self.reference.to(device))


@dataclass(frozen=True)
class FrameBatch:
    """Frames side by side, as `CoverageMetric.update(batch.sensor, batch.reference)` takes them.

    Args:
        frames: The frames in order.
    """

    frames: tuple[Frame, ...]

    @property
    def sensor(self) -> list[Tensor]:
        """One (N, 3) cloud a frame, of the only rig; N differs."""
        return [frame.sensor for frame in self.frames]

    def sensors(self, rig: str) -> list[Tensor]:
        """One (N, 3) cloud a frame, of one of several rigs."""
        return [frame.sensors[rig] for frame in self.frames]

    @property
    def reference(self) -> list[Tensor]:
        """One (M, 3) cloud a frame; M differs."""
        return [frame.reference for frame in self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def pin_memory(self) -> "FrameBatch":
        """A copy in page-locked memory; DataLoader calls it when `pin_memory=True`."""
        return FrameBatch(tuple(frame.pin_memory() for frame in self.frames))

    def to(self, device: torch.device | str) -> "FrameBatch":
        """A copy on another device."""
        return FrameBatch(tuple(frame.to(device) for frame in self.frames))


def collate_frames(frames: Sequence[Frame]) -> FrameBatch:
    """Batch frames without padding, for `DataLoader(..., collate_fn=collate_frames)`.

    Args:
        frames: Frames whose clouds may differ in size.

    Returns:
        A `FrameBatch` of all of them.

    Example:
        >>> frame = Frame({"rig": torch.zeros(5, 3)}, torch.zeros(9, 3), index=0, name="a")
        >>> [len(cloud) for cloud in collate_frames([frame, frame]).reference]
        [9, 9]
    """
    return FrameBatch(tuple(frames))
