"""Rigid transforms, boxes, height fields, and rays through voxels. Knows no other part of the house."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
