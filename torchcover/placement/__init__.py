"""Sensor placement: score rigs on common frames, compare them in pairs, and validate the best on held-out scenes.

Public names are imported on first use, so that command help does not load the ray caster.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
