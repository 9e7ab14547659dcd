"""Grid, aggregations, metric, result, regions and paired differences: from clouds to coverage numbers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
