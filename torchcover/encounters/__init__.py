"""In time or too late: when a rig detects what the vehicle is about to collide with.

The public names are imported when first used: who asks for help needs no ray caster.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
