"""Datasets of frames: simulated scenes, recordings and readers of cloud files.

Names come from the packages `frames`, `recordings` and `simulation`, which are loaded on first use.
"""

import ast
from importlib import import_module
from pathlib import Path

_stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_package_by_name = {}
for _statement in _stub.body:
    if isinstance(_statement, ast.ImportFrom):
        _package_by_name |= dict.fromkeys((_alias.name for _alias in _statement.names), str(_statement.module))
__all__ = list(_package_by_name)


def __getattr__(name: str) -> object:
    if name not in _package_by_name:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_package_by_name[name]), name)


def __dir__() -> list[str]:
    return __all__
