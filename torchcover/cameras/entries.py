"""Entries of calibration files: what they must be before anything is made of them."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from torchcover.geometry.rigid import Matrix

# Beyond, squares of float64 overflow.
MAX_NUMBER = 1e150


def told(value: object) -> str:
    """What arrived, for a message. YAML may hold lists of lists whose text has no end."""
    return repr(value)[:80] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def first(content: Mapping[str, Any], *names: str) -> tuple[str, Any]:
    """The first entry of these names that there is."""
    for name in names:
        if name in content:
            return name, content[name]
    raise ValueError(f"{' or '.join(names)} is missing")


def whole(content: Mapping[str, Any], *names: str) -> int:
    """The first of these entries, a whole number."""
    name, value = first(content, *names)
    if type(value) is not int:
        raise ValueError(f"{name}: a whole number is needed; got {told(value)}")
    return value


def numbers(content: Mapping[str, Any], *names: str) -> Matrix:
    """A matrix that is written as {rows, cols, data}, or a list of numbers."""
    name, value = first(content, *names)
    data = value.get("data") if isinstance(value, dict) else value
    if not has_numbers(data):
        raise ValueError(f"{name}: a list of finite numbers is needed; got {told(data)}")
    values = np.array([float(number) for number in data])
    if not isinstance(value, dict):
        return values
    rows, columns = whole(value, "rows"), whole(value, "cols")
    if min(rows, columns) < 0 or rows * columns != values.size:
        raise ValueError(f"{name}: {rows} rows and {columns} columns are not {values.size} numbers")
    return values.reshape(rows, columns)


def numbers_of(table: Mapping[str, Sequence[str]], key: str, length: int) -> Matrix:
    """The numbers behind a key of a KITTI file."""
    words = table.get(key, [])
    if not has_numbers(words, length):
        arrived = " ".join(words)[:120] or "nothing"
        raise ValueError(f"{key} with {length} numbers is needed; got {arrived}; the file holds {', '.join(table)}")
    return np.array(words, dtype=np.float64)


def has_numbers(values: object, length: int | None = None) -> TypeGuard[list[Any]]:
    """Whether it is a list of finite numbers, without a look into whatever else may be in it.

    YAML takes 1e-1, without a point, for text.
    """
    return (
        isinstance(values, list)
        and length in (None, len(values))
        and all(isinstance(value, int | float | str) and _is_finite(value) for value in values)
    )


def _is_finite(value: float | str) -> bool:
    try:
        return not isinstance(value, bool) and abs(float(value)) < MAX_NUMBER
    except (ValueError, OverflowError):
        return False
