"""Clouds in text files: `.csv`, `.xyz`, and the rows of ASCII variants of other formats."""

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
# NaN and infinity as C libraries of Windows print them: -1.#IND, 1.#QNAN0, 1.#INF, -nan(ind).
NOT_FINITE = re.compile(r"(?<![\w.])[-+]?(?:1\.[#$][A-Za-z]*\d*|nan\([a-z]*\))", re.IGNORECASE)


def read_text(path: Path) -> NDArray[np.float64]:
    """Read one point per line, separated by commas or white space.

    The line before the points may name the columns (also as a comment); else the first three are x y z. All rows need
    the same number of columns as the header or the first row.

    Args:
        path: File.

    Returns:
        (N, 3) points.

    Raises:
        ValueError: A row has another number of columns or no numbers, or columns x, y and z are missing.
    """
    rows = read_lines(path.read_bytes())
    comment, first = "", next(rows, None)
    while first is not None and first.startswith(COMMENT_MARKS):
        comment, first = first, next(rows, None)
    if first is None:
        return np.empty((0, 3))
    points = (row for row in rows if not row.startswith(COMMENT_MARKS))
    names = _split(first)
    if not _is_numeric(names):
        columns = _find_axis_columns(names)
        if columns is None:
            raise ValueError(
                f"the header line has to name the columns x, y and z; got {first[:80]!r}. "
                "Without a header line the first three columns are x y z; numbers have a decimal point"
            )
        first_row = next(points, None)
        if first_row is None:
            return np.empty((0, 3))
        return parse_rows(chain([first_row], points), columns, len(names), "," if "," in first_row else None)
    comment_names = _split(comment.lstrip("#/"))
    comment_columns = _find_axis_columns(comment_names)
    num_columns = len(names) if comment_columns is None else len(comment_names)
    return parse_rows(chain([first], points), comment_columns or (0, 1, 2), num_columns, "," if "," in first else None)


def parse_rows(
    rows: Iterable[str], columns: Sequence[int], num_columns: int, delimiter: str | None = None
) -> NDArray[np.float64]:
    """Parse the coordinates of text rows.

    Args:
        rows: Rows, none of them blank.
        columns: Indices of x, y and z.
        num_columns: Number of columns of every row.
        delimiter: Character between columns; None for white space.

    Returns:
        (N, 3) numbers; float64 keeps all digits of UTM coordinates.

    Raises:
        ValueError: A row has another number of columns, or no three numbers.
    """
    checked_rows = _check_num_columns(rows, num_columns, delimiter)
    try:
        return np.loadtxt(checked_rows, np.float64, comments=None, delimiter=delimiter, usecols=columns, ndmin=2)
    except ValueError as error:
        raise ValueError(f"not three numbers in every row ({error})") from error


def read_lines(data: bytes) -> Iterator[str]:
    """Read the lines of UTF-8 text, with or without a byte order mark, and skip blank ones.

    Args:
        data: Content of a file.

    Returns:
        Stripped lines, in which NaN and infinity have one spelling.

    Raises:
        ValueError: A line is too long, or the text is not UTF-8.
    """
    row_bytes = 48  # three float64, twice while the array grows
    check_memory(2 * len(data) + row_bytes * max(data.count(b"\n"), data.count(b"\r")))
    return _iterate_lines(data)


def _iterate_lines(data: bytes) -> Iterator[str]:
    """Iterate over decoded lines; a very long line or an invalid byte raises a ValueError."""
    max_chars = 1_000_000  # a split line takes up to 50 times its size before its columns are counted
    stream = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig")
    try:
        for line in stream:
            if len(line) > max_chars:
                raise ValueError(f"a line of {len(line)} characters; at most {max_chars} are allowed")
            row = line.strip()
            if row:
                yield NOT_FINITE.sub("nan", row) if "#" in row or "(" in row else row
    except UnicodeDecodeError as error:
        raise ValueError(f"not text in UTF-8: there is a byte 0x{error.object[error.start]:02x}") from error


def _check_num_columns(rows: Iterable[str], num_columns: int, delimiter: str | None) -> Iterator[str]:
    """Pass rows through and raise a ValueError at the first one with another number of columns."""
    for number, row in enumerate(rows, 1):
        count = row.count(delimiter) + 1 if delimiter else len(row.split())
        if count != num_columns:
            raise ValueError(f"row {number} has {count} columns where {num_columns} are needed: {row[:80]!r}")
        yield row


def _split(line: str) -> list[str]:
    """Split at commas if there are any, else at white space."""
    return line.split(",") if "," in line else line.split()


def _is_numeric(words: Sequence[str]) -> bool:
    """Test whether all words that are not blank are numbers."""
    try:
        for word in words:
            if word.strip():
                float(word)
    except ValueError:
        return False
    return True


def _find_axis_columns(names: Sequence[str]) -> tuple[int, ...] | None:
    """Find the columns named x, y and z; None if one of them is missing."""
    bare = [name.strip(" \t\"'").lower() for name in names]
    if not set(AXES) <= set(bare):
        return None
    if any(bare.count(axis) > 1 for axis in AXES):
        raise ValueError(f"x, y and z name one column each; got {', '.join(bare)[:80]}")
    return tuple(bare.index(axis) for axis in AXES)
