"""File names for what users may call as they like."""

import re
from collections.abc import Sequence

MAX_FILE_NAME = 48


def file_stems(names: Sequence[str]) -> list[str]:
    """A name for each that every file system takes and that no other has.

    Example:
        >>> file_stems(["low/high", "low high", "ground"])
        ['low_high', 'low_high_1', 'ground']
    """
    stems: list[str] = []
    for number, name in enumerate(names):
        stem = re.sub(r"[^\w.-]+", "_", name)[:MAX_FILE_NAME]
        while stem.lower() in (other.lower() for other in stems):
            stem += f"_{number}"
        stems.append(stem)
    return stems
