"""Coverage beside the training of a detector: callbacks, loggers, adapters to other frameworks.

The names are imported when first used: this needs neither Lightning nor MMEngine, TensorBoard or matplotlib.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
