"""Logging of coverage during the training of a detector: callbacks, loggers and adapters to frameworks.

Names are imported on first use, so the package needs neither Lightning nor MMEngine, TensorBoard or matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
