"""Simulated worlds: what a rig and a reference sensor see of a scenario."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
