"""File access: guarded and isolated readers, atomic writes, YAML documents, tables, child processes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
