"""Encounters: the time to collision at which a rig detects a road user on a collision course with the vehicle."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
