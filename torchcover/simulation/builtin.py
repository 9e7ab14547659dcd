"""The built-in documents: rigs, scenarios, vehicles and LiDAR models by name."""

from typing import Any

from torchcover.files import get_builtin_folder as get_builtin_folder
from torchcover.files import parse_yaml


def list_builtin_names(kind: str) -> list[str]:
    """Names of the built-in documents of a kind, in alphabetical order."""
    return sorted(path.stem for path in get_builtin_folder(kind).glob("*.yaml"))


def load_builtin_documents(kind: str) -> dict[str, dict[str, Any]]:
    """The built-in documents of a kind as they are written, by name.

    Args:
        kind: "rigs", "scenarios", "vehicles", "lidars", "materials", "weather", "encounters" or "requirements".

    Example:
        >>> load_builtin_documents("scenarios")["courtyard"]["description"].split(",")[0]
        'A static yard'
    """
    folder = get_builtin_folder(kind)
    return {
        name: parse_yaml((folder / f"{name}.yaml").read_text(encoding="utf-8")) for name in list_builtin_names(kind)
    }
