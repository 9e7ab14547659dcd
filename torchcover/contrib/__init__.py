"""Published coverage metrics on the same frames; `PUBLISHED` lists them by name.

No other package imports this one: `evaluate(metrics=...)` loads it by its name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
