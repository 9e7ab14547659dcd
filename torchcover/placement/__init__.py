"""Where sensors should go: rigs scored on common instants, compared in pairs, and tested on fresh worlds.

The public names are imported when first used: who asks for help needs no ray caster.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
