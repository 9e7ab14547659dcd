"""The pipeline: frames in, observers fed from them, results out.

The public names are imported when first used: who only feeds a metric needs no maps.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
