"""Write what a simulated rig saw as a recording, for any tool that reads its layout."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

from torchcover.data.recorders.folder import FolderRecorder
from torchcover.data.recorders.kitti import KittiRecorder
from torchcover.data.recorders.step import Recorder, simulated_step
from torchcover.data.simulated import SimulatedFrames


class RecorderOfLayout(Protocol):
    """A class of recorders."""

    def __call__(self, folder: Path, frames: SimulatedFrames, /) -> Recorder:
        """Begin a recording in an empty folder."""
        ...


RECORDERS: dict[str, RecorderOfLayout] = {"folder": FolderRecorder, "kitti": KittiRecorder}


def write_recording(
    frames: SimulatedFrames,
    folder: str | os.PathLike[str],
    layout: str = "folder",
    *,
    progress: Callable[[range], Iterable[int]] = iter,
) -> None:
    """Write what a simulated rig saw: clouds, the reference, boxes where the frames have them, mounts and poses.

    Args:
        frames: A simulation of one rig.
        folder: Where to; made if it does not exist.
        layout: A name in `RECORDERS`: "folder" (`FolderRecording` reads it, with the numbers of the simulation), or
            "kitti" (KITTI's object layout, of one LiDAR).
        progress: Is given the numbers of the steps and passes them on, as `tqdm.tqdm` does.

    Raises:
        ValueError: An unknown layout, a folder that is not empty, several rigs, or sensors that the layout cannot hold.

    Example:
        >>> import tempfile
        >>> from torchcover.data import RecordedFrames
        >>> frames = SimulatedFrames("courtyard", "front_roof_32", steps=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_recording(frames, folder)
        ...     again = RecordedFrames(folder)[0]
        >>> len(again.sensor) == len(frames[0].sensor), again.reference_weights is None
        (True, False)
    """
    folder = Path(folder)
    if layout not in RECORDERS:
        raise ValueError(f"format {layout!r}: recordings are written as {' or '.join(RECORDERS)}")
    if len(frames.rigs) != 1:
        raise ValueError(f"a recording is of one rig; got {', '.join(frames.rigs)}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder}: {'not empty' if folder.is_dir() else 'a file'}; a new or empty folder is needed")
    recorder = RECORDERS[layout](folder, frames)
    for index in progress(range(len(frames))):
        recorder.write(simulated_step(frames, index))
