"""Frames, batches of frames, augmentation, and the base class of sources of frames."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
