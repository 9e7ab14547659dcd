"""Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor.

The public names are imported when first used: `import torchcover` costs nothing beyond the interpreter.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
