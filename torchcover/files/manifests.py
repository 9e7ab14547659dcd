"""Manifests: which files belong to a result or a recording, and how a reader finds out that they do not match."""

import hashlib
import json
import os
import stat
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

SUMMARY = "summary.json"  # of a result
RECORDING = "recording.json"
WRITING = "writing"  # key of a manifest while its files are written
MAX_MANIFEST_BYTES = 100_000_000  # larger files are not manifests; a million files of a recording take 60 MB
MAX_NAME_BYTES = 255  # of a listed path; what file systems allow for a name
FOLDER_DEPTH = 3  # files are listed at most this deep


def read_manifest(path: Path) -> dict[str, Any] | None:
    """Read a manifest: `files` by name, each with `bytes` and `sha256`, and its record.

    Returns None where there is none: no regular file, or another content. Entries that lead out of the folder are
    dropped.
    """
    try:
        status = path.lstat()
    except OSError:
        return None
    if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_MANIFEST_BYTES:
        return None
    return _parse_manifest(path, status.st_ino, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=4)
def _parse_manifest(path: Path, *_: int) -> dict[str, Any] | None:
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            record = json.loads(file.read(MAX_MANIFEST_BYTES))
        files = {str(name): entry for name, entry in record["files"].items() if _is_entry(name, entry)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return {**record, "files": files}


def _is_entry(name: str, entry: object) -> bool:
    is_short = len(os.fsencode(name)) <= MAX_NAME_BYTES
    is_within = is_short and "\0" not in name and {"", ".", ".."}.isdisjoint(name.split("/"))
    return is_within and isinstance(entry, dict) and isinstance(entry.get("bytes"), int)


def matches_entry(path: Path, entry: Mapping[str, Any]) -> bool:
    """Return whether a path is a regular file with the listed size and, where one is listed, SHA-256."""
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["bytes"]:
            return False
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            return entry.get("sha256") in (None, hashlib.file_digest(file, "sha256").hexdigest())
    except OSError:
        return False


def find_changed(folder: Path, files: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Find the listed files that are missing, no regular files, or of another size."""
    changed = []
    for name, entry in files.items():
        try:
            status = (folder / name).stat()
        except OSError:
            changed.append(name)
            continue
        if not stat.S_ISREG(status.st_mode) or status.st_size != entry["bytes"]:
            changed.append(name)
    return changed


def check_listed(path: Path) -> None:
    """Refuse a file of a result whose manifest lists another content, or that was not written to its end.

    A YAML document may have been edited on purpose, which is a warning.
    """
    path = path.absolute()
    for folder in path.parents[:FOLDER_DEPTH]:
        manifest = read_manifest(folder / SUMMARY)
        name = path.relative_to(folder).as_posix()
        entry = manifest["files"].get(name) if manifest else None
        if manifest and manifest.get(WRITING) and (entry is not None or name == SUMMARY):
            raise ValueError(f"an incomplete result: the process that wrote {folder} was ended; run it again")
        if entry is None or matches_entry(path, entry):
            continue
        if path.suffix != ".yaml":
            raise ValueError(
                f"an incomplete result: {folder / SUMMARY} lists this file with another content; run it again"
            )
        warnings.warn(f"{path}: edited since {SUMMARY} beside it was written", stacklevel=4)
