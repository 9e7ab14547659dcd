"""Objects: their boxes, how much of each a rig could see, and which of them a detector found."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
