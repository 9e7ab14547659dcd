"""Datasets of frames: simulated worlds, recordings, and the readers of cloud files."""

from torchcover.data.accumulated_reference import AccumulatedReference
from torchcover.data.augmentation import Augmentation, flip, rotate, scale
from torchcover.data.bad_frame import BadFrameError
from torchcover.data.chosen_rigs import ChosenRigs
from torchcover.data.clouds import read_cloud
from torchcover.data.frame import Frame, FrameBatch, collate_frames
from torchcover.data.recorded import RecordedFrames, reference_of_recording
from torchcover.data.recorded_reference import RecordedReference, Reference
from torchcover.data.recorded_rig import rig_document
from torchcover.data.recorders import RECORDERS, write_recording
from torchcover.data.recordings import FORMATS, Recording, RecordingFormat, Scan, open_recording
from torchcover.data.reference import DEFAULT_REFERENCE, reference_called, reference_of_objects
from torchcover.data.regions_of_interest import GRID_X_M, GRID_Y_M, Asked, RegionsOfInterest
from torchcover.data.simulated import SimulatedFrames
from torchcover.data.source import FrameSource

__all__ = [
    "DEFAULT_REFERENCE",
    "FORMATS",
    "GRID_X_M",
    "GRID_Y_M",
    "RECORDERS",
    "AccumulatedReference",
    "Asked",
    "Augmentation",
    "BadFrameError",
    "ChosenRigs",
    "Frame",
    "FrameBatch",
    "FrameSource",
    "RecordedFrames",
    "RecordedReference",
    "Recording",
    "RecordingFormat",
    "Reference",
    "RegionsOfInterest",
    "Scan",
    "SimulatedFrames",
    "collate_frames",
    "flip",
    "open_recording",
    "read_cloud",
    "reference_called",
    "reference_of_objects",
    "reference_of_recording",
    "rig_document",
    "rotate",
    "scale",
    "write_recording",
]
