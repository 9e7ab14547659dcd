"""Datasets of frames: simulated worlds, recordings, and the readers of cloud files."""

from torchcover.data.augmentation import Augmentation, flip, rotate, scale
from torchcover.data.clouds import read_cloud
from torchcover.data.frame import Frame, FrameBatch, collate_frames
from torchcover.data.recorded import BadFrameError, RecordedFrames
from torchcover.data.simulated import SimulatedFrames

__all__ = [
    "Augmentation",
    "BadFrameError",
    "Frame",
    "FrameBatch",
    "RecordedFrames",
    "SimulatedFrames",
    "collate_frames",
    "flip",
    "read_cloud",
    "rotate",
    "scale",
]
