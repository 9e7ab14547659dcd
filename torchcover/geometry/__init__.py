"""Geometry: rigid transforms, trajectories, boxes and height fields; independent of all other packages."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
