"""Writers of recordings, one file a layout."""

from torchcover.recordings.recorders.folder import FolderRecorder
from torchcover.recordings.recorders.kitti import KittiRecorder
from torchcover.recordings.recorders.recorder import Recorder

RECORDERS: dict[str, type[Recorder]] = {"folder": FolderRecorder, "kitti": KittiRecorder}

__all__ = ["RECORDERS", "Recorder"]
