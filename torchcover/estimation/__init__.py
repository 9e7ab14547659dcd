"""How sums over steps and worlds become numbers: quantities, estimates, standard errors, intervals, differences."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
