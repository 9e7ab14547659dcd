"""In time or too late: when a rig detects what the vehicle is about to collide with."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
