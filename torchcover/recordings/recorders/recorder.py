"""What a recorder is: another layout is a class with these members and a line in `RECORDERS`."""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torchcover.frames.frame import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix
from torchcover.recordings.clouds.arrays import Points


class RecordingSetup(NamedTuple):
    """What is the same at every step: the mounts of the rig's sensors, which of these are LiDARs, the vehicle.

    `square_metres` and `boxes` say whether the frames have those.
    """

    rig: str
    mounts: Mapping[str, Matrix]
    lidars: Collection[str]
    body: BoundingBox
    square_metres: bool
    boxes: bool


class RecordedStep(NamedTuple):
    """A step of a recording, by the name of its files.

    `clouds` are (N, 3) float32 points of each sensor in the vehicle frame, as they landed; the frame is everything
    together.
    """

    name: str
    time_s: float
    world_T_vehicle: Matrix
    clouds: Mapping[str, Points]
    frame: Frame


# Writes a file: its path within the folder, and what writes it to the path that it is given; see `AtomicOutput.add`.
Add = Callable[[str, Callable[[Path], object]], None]


class Recorder(Protocol):
    """Writes a recording step by step; another process may go on where one has ended."""

    def __init__(self, add: Add, setup: RecordingSetup, /) -> None:
        """Begin one. ValueError: a rig that the layout cannot hold."""
        ...

    def write(self, step: RecordedStep, /) -> Sequence[Any]:
        """Write the files of a step; returns what `finish` has to know of it, as JSON takes it."""
        ...

    def finish(self, steps: Sequence[Sequence[Any]], /) -> None:
        """Write the files that are about all steps, of each of which `write` said this."""
        ...
