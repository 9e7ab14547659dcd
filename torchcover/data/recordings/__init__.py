"""Readers of recordings, one file a layout, and what they share."""

from torchcover.data.recordings.formats import FORMATS, RecordingFormat, open_recording
from torchcover.data.recordings.recording import Recording, Scan

__all__ = ["FORMATS", "Recording", "RecordingFormat", "Scan", "open_recording"]
