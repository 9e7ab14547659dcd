"""Built-in documents (rigs, scenarios, vehicles, LiDAR models and others) by name."""

import hashlib
from pathlib import Path
from typing import Any

from torchcover.files import get_builtin_folder as get_builtin_folder
from torchcover.files import guard_reader, parse_yaml


def list_builtin_names(kind: str) -> list[str]:
    """List the names of the built-in documents of a kind in alphabetical order.

    Args:
        kind: See `load_builtin_documents`.
    """
    return sorted(path.stem for path in get_builtin_folder(kind).glob("*.yaml"))


def load_builtin_documents(kind: str) -> dict[str, dict[str, Any]]:
    """Load the content of all built-in documents of a kind.

    Args:
        kind: "rigs", "scenarios", "vehicles", "lidars", "materials", "weather", "encounters" or "requirements".

    Returns:
        Name -> keys and values of the YAML file.

    Example:
        >>> load_builtin_documents("scenarios")["courtyard"]["description"].split(",")[0]
        'A static yard'
    """
    documents: dict[str, dict[str, Any]] = {}
    for name in list_builtin_names(kind):
        text = (get_builtin_folder(kind) / f"{name}.yaml").read_text(encoding="utf-8")
        documents[name] = parse_yaml(text)
    return documents


def hash_builtin_documents(kind: str) -> dict[str, str]:
    """Hash all built-in documents of a kind.

    Args:
        kind: See `load_builtin_documents`.

    Returns:
        Name -> SHA-256.
    """
    return {path.stem: hash_file(path) for path in sorted(get_builtin_folder(kind).glob("*.yaml"))}


@guard_reader("a file")
def hash_file(path: Path) -> str:
    """Compute the SHA-256 of the content of a file.

    Args:
        path: File.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
