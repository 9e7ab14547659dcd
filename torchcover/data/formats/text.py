"""Clouds as text: `.csv`, `.xyz`, and the rows of the ascii variants of other formats."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

COMMENT_MARKS = ("#", "//")
AXES = ("x", "y", "z")


def read_text(path: Path) -> NDArray[np.float64]:
    """Read one point a line, separated by commas or white space.

    A line above the points may name the columns (also as a comment); else the first three are x y z.
    """
    lines = [line for line in map(str.strip, decode(path.read_bytes()).splitlines()) if line]
    rows = [line for line in lines if not line.startswith(COMMENT_MARKS)]
    if not rows:
        return np.empty((0, 3))
    names = _split(rows[0])
    if not _is_numeric(names):
        columns = _named_columns(names)
        if columns is None:
            raise ValueError(
                f"the header line has to name the columns x, y and z; got {rows[0][:80]!r}. "
                "Without a header line the first three columns are x y z"
            )
        return parse_rows(rows[1:], columns)
    above = lines[: lines.index(rows[0])]
    commented = _named_columns(_split(above[-1].lstrip("#/"))) if above else None
    return parse_rows(rows, commented or (0, 1, 2))


def parse_rows(rows: Sequence[str], columns: Sequence[int]) -> NDArray[np.float64]:
    """Parse `columns` of every row into (N, 3) float64, which keeps all digits of UTM-sized coordinates."""
    if not rows:
        return np.empty((0, 3))
    delimiter = "," if "," in rows[0] else None
    try:
        return np.loadtxt(rows, np.float64, comments=None, delimiter=delimiter, usecols=columns, ndmin=2)
    except ValueError as error:
        raise ValueError(f"not three numbers in every row ({error})") from error


def decode(data: bytes) -> str:
    """Decode UTF-8, with or without a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"not text: byte {error.start} is 0x{data[error.start]:02x}") from error


def _split(line: str) -> list[str]:
    return line.split(",") if "," in line else line.split()


def _is_numeric(words: Sequence[str]) -> bool:
    try:
        [float(word) for word in words if word.strip()]
    except ValueError:
        return False
    return True


def _named_columns(names: Sequence[str]) -> tuple[int, ...] | None:
    bare = [name.strip(" \t\"'").lower() for name in names]
    return tuple(bare.index(axis) for axis in AXES) if set(AXES) <= set(bare) else None
