"""The layouts of recordings, by name: a new one is a class and a line here."""

import os
from pathlib import Path
from typing import Protocol

from torchcover.recordings.formats.argoverse2 import Argoverse2
from torchcover.recordings.formats.carla import Carla
from torchcover.recordings.formats.folder import FolderRecording
from torchcover.recordings.formats.kitti_object import KittiObject
from torchcover.recordings.formats.kitti_raw import KittiRaw
from torchcover.recordings.formats.nuscenes import NuScenes
from torchcover.recordings.formats.ros2 import Ros2
from torchcover.recordings.recording import Recording


class RecordingFormat(Protocol):
    """A class of recordings."""

    @property
    def layout(self) -> str:
        """What such a recording looks like, for messages."""
        ...

    def recognises(self, path: Path, /) -> bool:
        """Whether what is at a path that exists is meant to be such a recording."""
        ...

    def __call__(self, path: Path, /) -> Recording:
        """Open it."""
        ...


# The first that recognises a path reads it.
FORMATS: dict[str, RecordingFormat] = {
    "nuscenes": NuScenes,
    "argoverse2": Argoverse2,
    "kitti_raw": KittiRaw,
    "kitti_object": KittiObject,
    "carla": Carla,
    "ros2": Ros2,
    "folder": FolderRecording,
}


def open_recording(path: str | os.PathLike[str], format_name: str | None = None) -> Recording:
    """Open a recording; `RecordedFrames` makes frames of it.

    Args:
        path: Where it is.
        format_name: A name in `FORMATS`; the first that recognises it if not given.

    Raises:
        FileNotFoundError: There is nothing at the path.
        ValueError: An unknown format, or no format that recognises it; what the format itself finds wrong.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such recording")
    if format_name is not None:
        if format_name not in FORMATS:
            raise ValueError(f"format {format_name!r}: no such format of recordings; there are {', '.join(FORMATS)}")
        return FORMATS[format_name](path)
    for recording_format in FORMATS.values():
        if recording_format.recognises(path):
            return recording_format(path)
    known = "; ".join(f"{name}: {recording_format.layout}" for name, recording_format in FORMATS.items())
    raise ValueError(f"{path}: a recording of no known format; known are {known}")
