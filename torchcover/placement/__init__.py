"""Where the sensors should go: a search over the places, models and numbers of a rig's sensors.

The public names are imported when first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
