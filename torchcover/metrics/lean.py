"""torchmetrics, without the `scipy.signal` that it loads to give it back a name which scipy has dropped.

That takes as much processor time as torch does. While torchmetrics is being loaded, a stand-in has the name, and loads
the real module for whoever wants more of it.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

SIGNAL = "scipy.signal"


class _StandIn(ModuleType):
    """`scipy.signal` to torchmetrics, which asks for one name."""

    hamming = None

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  (whatever there is)
        _take_away()
        return getattr(import_module(SIGNAL), name)


def _take_away() -> None:
    if isinstance(sys.modules.get(SIGNAL), _StandIn):
        del sys.modules[SIGNAL]


if not {SIGNAL, "torchmetrics"} & sys.modules.keys():
    sys.modules[SIGNAL] = _StandIn(SIGNAL)
try:
    from torchmetrics import Metric
    from torchmetrics.utilities.distributed import gather_all_tensors
finally:
    _take_away()

__all__ = ["Metric", "gather_all_tensors"]
