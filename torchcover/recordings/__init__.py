"""Recordings: their scans, poses and objects as frames, the layouts that they are read from and written in."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
