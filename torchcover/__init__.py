"""Blind spots and coverage of a vehicle's sensor rig, measured against a random reference sensor.

The public names are imported when first used: `import torchcover` costs nothing beyond the interpreter.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchcover import data as data
    from torchcover.cameras import Camera as Camera
    from torchcover.coverage import BevGrid as BevGrid
    from torchcover.coverage import Coverage as Coverage
    from torchcover.coverage import CoverageMetric as CoverageMetric
    from torchcover.coverage import Region as Region
    from torchcover.coverage import forward_regions as forward_regions
    from torchcover.neighbors import blind_spot_radius as blind_spot_radius
    from torchcover.neighbors import nearest as nearest
    from torchcover.simulation import Rig as Rig
    from torchcover.simulation import Scenario as Scenario

__version__ = "0.1.0"

_HOME = {
    "BevGrid": "torchcover.coverage",
    "Camera": "torchcover.cameras",
    "Coverage": "torchcover.coverage",
    "CoverageMetric": "torchcover.coverage",
    "Region": "torchcover.coverage",
    "Rig": "torchcover.simulation",
    "Scenario": "torchcover.simulation",
    "blind_spot_radius": "torchcover.neighbors",
    "forward_regions": "torchcover.coverage",
    "nearest": "torchcover.neighbors",
}
_ROOMS = ("data",)

__all__ = [
    "BevGrid",
    "Camera",
    "Coverage",
    "CoverageMetric",
    "Region",
    "Rig",
    "Scenario",
    "blind_spot_radius",
    "data",
    "forward_regions",
    "nearest",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401  (a module attribute can be anything)
    if name in _ROOMS:
        return import_module(f"torchcover.{name}")
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'torchcover' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
