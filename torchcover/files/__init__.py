"""Guards of all readers and their error, atomic writes, documents and tables, isolated readers, processes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
