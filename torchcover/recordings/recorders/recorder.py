"""What a recorder is: another layout is a class with these members and a line in `RECORDERS`."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from torchcover.frames.frame import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import Points


class RecordingSetup(NamedTuple):
    """What is recorded, the same at every step.

    Args:
        rig: The name of the rig.
        mounts: Name of each sensor -> (4, 4) `vehicle_T_sensor`.
        lidars: The sensors that are LiDARs.
        body: The vehicle itself, in its own frame.
        square_metres: Whether frames have the square metres of their reference points.
        boxes: Whether the frames have boxes.
    """

    rig: str
    mounts: Mapping[str, Matrix]
    lidars: Collection[str]
    body: BoundingBox
    square_metres: bool
    boxes: bool


class RecordedStep(NamedTuple):
    """A step of a recording.

    Args:
        name: What its files are called.
        time_s: When it was.
        world_T_vehicle: (4, 4) where the vehicle was.
        clouds: Name of each sensor -> (N, 3) float32 points in the vehicle frame.
        frame: Everything together.
    """

    name: str
    time_s: float
    world_T_vehicle: Matrix
    clouds: Mapping[str, Points]
    frame: Frame


class Recorder(Protocol):
    """Writes a recording step by step."""

    def __init__(self, folder: Path, setup: RecordingSetup, /) -> None:
        """Begin one in an empty or a new folder.

        Raises:
            ValueError: A rig that the layout cannot hold.
        """
        ...

    def write(self, step: RecordedStep, /) -> None:
        """Write a step; what was written before stays good if this one fails."""
        ...
