"""What a run shows: a table and its renderers, maps, drawings, a page."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
