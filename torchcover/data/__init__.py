"""Datasets of frames: simulated worlds, recordings, and the readers of cloud files.

The door to the rooms `frames`, `recordings` and `simulation`: a name loads its own room only, when it is first used.
"""

import ast
from importlib import import_module
from pathlib import Path

_stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_ROOM_OF = {one.name: str(line.module) for line in _stub.body if isinstance(line, ast.ImportFrom) for one in line.names}
__all__ = list(_ROOM_OF)


def __getattr__(name: str) -> object:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_ROOM_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
