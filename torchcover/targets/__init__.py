"""Visibility of test targets around the vehicle: which positions a rig detects, and how much of the target."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
