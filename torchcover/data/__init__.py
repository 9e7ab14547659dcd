"""Datasets of frames: simulated worlds, recordings, and the readers of cloud files."""

from torchcover.data.augmentation import Augmentation, flip, rotate, scale
from torchcover.data.boxes import Boxes, points_in_boxes
from torchcover.data.clouds import read_cloud
from torchcover.data.frame import Frame, FrameBatch, collate_frames
from torchcover.data.recorded import BadFrameError, RecordedFrames
from torchcover.data.simulated import SimulatedFrames

__all__ = [
    "Augmentation",
    "BadFrameError",
    "Boxes",
    "Frame",
    "FrameBatch",
    "RecordedFrames",
    "SimulatedFrames",
    "collate_frames",
    "flip",
    "points_in_boxes",
    "read_cloud",
    "rotate",
    "scale",
]
