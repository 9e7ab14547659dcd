"""Coverage metrics that others published, on the same frames: `PUBLISHED` has them by name.

Nothing imports this package: `evaluate(metrics=...)` loads it by its name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
