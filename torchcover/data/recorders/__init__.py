"""Writers of what a simulated rig saw, one file a layout."""

from torchcover.data.recorders.writing import RECORDERS, write_recording

__all__ = ["RECORDERS", "write_recording"]
