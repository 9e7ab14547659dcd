"""Clouds as text: `.csv`, `.xyz`, and the rows of the ascii variants of other formats."""

import io
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory

COMMENT_MARKS = ("#", "//")
AXES = ("x", "y", "z")
# Of three float64, and once more while the array grows.
ROW_BYTES = 48
# NaN and infinity as C libraries of Windows print them: -1.#IND, 1.#QNAN0, 1.#INF, -nan(ind).
NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(?:1\.[#$][A-Za-z]*\d*|nan\([a-z]*\))", re.IGNORECASE)
MAX_LINE = 1_000_000  # characters: a word takes 50 times as much, until it is known how many there should be


def read_text(path: Path) -> NDArray[np.float64]:
    """Read one point a line, separated by commas or white space.

    A line above the points may name the columns (also as a comment); else the first three are x y z. All rows have as
    many columns as there are names, or as the first row.
    """
    rows = read_lines(path.read_bytes())
    above, first = "", next(rows, None)
    while first is not None and first.startswith(COMMENT_MARKS):
        above, first = first, next(rows, None)
    if first is None:
        return np.empty((0, 3))
    points = (row for row in rows if not row.startswith(COMMENT_MARKS))
    names = _split(first)
    if not _is_numeric(names):
        columns = _named_columns(names)
        if columns is None:
            raise ValueError(
                f"the header line has to name the columns x, y and z; got {first[:80]!r}. "
                "Without a header line the first three columns are x y z; numbers have a decimal point"
            )
        first_row = next(points, None)
        if first_row is None:
            return np.empty((0, 3))
        return parse_rows(chain([first_row], points), columns, len(names), "," if "," in first_row else None)
    commented = _split(above.lstrip("#/"))
    width = len(names) if _named_columns(commented) is None else len(commented)
    columns = _named_columns(commented) or (0, 1, 2)
    return parse_rows(chain([first], points), columns, width, "," if "," in first else None)


def parse_rows(
    rows: Iterable[str], columns: Sequence[int], num_columns: int, delimiter: str | None = None
) -> NDArray[np.float64]:
    """(N, 3) numbers of rows, of which none is blank; float64 keeps all digits of UTM-sized coordinates.

    ValueError: a row of another width, or one without three numbers.
    """
    checked = _of_width(rows, num_columns, delimiter)
    try:
        return np.loadtxt(checked, np.float64, comments=None, delimiter=delimiter, usecols=columns, ndmin=2)
    except ValueError as error:
        raise ValueError(f"not three numbers in every row ({error})") from error


def read_lines(data: bytes) -> Iterator[str]:
    """Lines of UTF-8, with or without a byte order mark; blank ones are left out."""
    check_memory(2 * len(data) + ROW_BYTES * max(data.count(b"\n"), data.count(b"\r")))
    return _lines(data)


def _lines(data: bytes) -> Iterator[str]:
    stream = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig")
    try:
        for line in stream:
            if len(line) > MAX_LINE:
                raise ValueError(f"a line of {len(line)} characters; at most {MAX_LINE} are read of one")
            if row := line.strip():
                yield NOT_FINITE.sub("nan", row) if "#" in row or "(" in row else row
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: there is a byte 0x{error.object[error.start]:02x}") from error


def _of_width(rows: Iterable[str], width: int, delimiter: str | None) -> Iterator[str]:
    for number, row in enumerate(rows, 1):
        found = row.count(delimiter) + 1 if delimiter else len(row.split())
        if found != width:
            raise ValueError(f"row {number} has {found} columns where {width} are needed: {row[:80]!r}")
        yield row


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
    if not set(AXES) <= set(bare):
        return None
    if any(bare.count(axis) > 1 for axis in AXES):
        raise ValueError(f"x, y and z name one column each; got {', '.join(bare)[:80]}")
    return tuple(bare.index(axis) for axis in AXES)
