"""Entries of calibration files: lookup, and checks of their types and sizes."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from torchcover.geometry.rigid import Matrix


def describe_value(value: object) -> str:
    """Describe a value for an error message; lists of lists from YAML may have an endless text.

    Args:
        value: The value.
    """
    return repr(value)[:80] if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def get_first_entry(content: Mapping[str, Any], *names: str) -> tuple[str, Any]:
    """Get the first entry that exists.

    Args:
        content: Names and values of a file.
        *names: Names in the order of preference.

    Returns:
        Name and value.

    Raises:
        ValueError: None of them exists.
    """
    for name in names:
        if name in content:
            return name, content[name]
    raise ValueError(f"{' or '.join(names)} is missing")


def get_integer(content: Mapping[str, Any], *names: str) -> int:
    """Get the first entry that exists as an integer.

    Args:
        content: Names and values of a file.
        *names: Names in the order of preference.

    Raises:
        ValueError: None of them exists, or the value is not an integer.
    """
    name, value = get_first_entry(content, *names)
    if type(value) is not int:
        raise ValueError(f"{name}: a whole number is needed; got {describe_value(value)}")
    return value


def get_matrix(content: Mapping[str, Any], *names: str) -> Matrix:
    """Get the first entry that exists as a matrix.

    Args:
        content: Names and values of a file.
        *names: Names in the order of preference.

    Returns:
        The matrix of {rows, cols, data}, or the vector of a list.

    Raises:
        ValueError: None of them exists, or its numbers do not form a matrix.
    """
    name, value = get_first_entry(content, *names)
    data = value.get("data") if isinstance(value, dict) else value
    if not is_number_list(data):
        raise ValueError(f"{name}: a list of finite numbers is needed; got {describe_value(data)}")
    values = np.array([float(number) for number in data])
    if not isinstance(value, dict):
        return values
    rows, columns = get_integer(value, "rows"), get_integer(value, "cols")
    if min(rows, columns) < 0 or rows * columns != values.size:
        raise ValueError(f"{name}: {rows} rows and {columns} columns are not {values.size} numbers")
    return values.reshape(rows, columns)


def get_numbers(entries: Mapping[str, Sequence[str]], key: str, count: int) -> Matrix:
    """Get the numbers of an entry of a KITTI file.

    Args:
        entries: Words of each entry.
        key: Name of the entry.
        count: Number of its numbers.

    Raises:
        ValueError: The entry is missing, or has other numbers.
    """
    words = entries.get(key, [])
    if not is_number_list(words, count):
        actual = " ".join(words)[:120] or "nothing"
        raise ValueError(f"{key} with {count} numbers is needed; got {actual}; the file contains {', '.join(entries)}")
    return np.array(words, dtype=np.float64)


def is_number_list(values: object, count: int | None = None) -> TypeGuard[list[Any]]:
    """Test whether a value is a list of finite numbers; text counts, since YAML reads 1e-1 without a point as text.

    Args:
        values: The value.
        count: Required length; any if not given.
    """
    return (
        isinstance(values, list)
        and count in (None, len(values))
        and all(isinstance(value, int | float | str) and _is_finite(value) for value in values)
    )


def _is_finite(value: float | str) -> bool:
    max_number = 1e150  # squares of larger float64 numbers overflow
    try:
        return not isinstance(value, bool) and abs(float(value)) < max_number
    except (ValueError, OverflowError):
        return False
