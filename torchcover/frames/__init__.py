"""What the metrics are fed with: frames, batches of them, their augmentation, and what a source of them is."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
