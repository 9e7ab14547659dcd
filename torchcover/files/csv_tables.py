"""Tables in CSV: poses of frames, boxes of objects."""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import check_memory, decode, reads
from torchcover.files.shown import as_cell, of_cell

# Of a word of a row, once it is an object of Python, for each byte of the file.
BYTES_PER_BYTE = 20


class CsvTable(NamedTuple):
    """Columns of a table by name: `numbers` (N,) float64, finite, and `words`, N of them each."""

    numbers: dict[str, NDArray[np.float64]]
    words: dict[str, list[str]]


@reads("a table in CSV")
def read_csv(
    path: Path, numbers: Sequence[str], words: Sequence[str] = (), optional: Sequence[str] | None = ()
) -> CsvTable:
    """Read a table whose first line names its columns, of numbers or of any words, in any order.

    Optional columns of numbers may be missing; None: any others may be there, and are not read. BadFileError: columns
    that are missing, doubled or unknown, a row of another width, or what is no finite number; it names line and column.
    """
    check_memory(BYTES_PER_BYTE * path.stat().st_size)
    rows = _rows(decode(path.read_bytes()))
    _, header = next(rows, (0, []))
    names = [name.strip() for name in header]
    _check_names(names, (*words, *numbers), optional)
    lines, table = [], []
    for line, row in rows:
        if len(row) != len(names):
            raise ValueError(f"line {line}: {len(names)} columns are needed ({', '.join(names)}); got {len(row)}")
        lines.append(line)
        table.append(row)
    columns = dict(zip(names, zip(*table, strict=True) if table else [()] * len(names), strict=True))
    return CsvTable(
        {name: _finite(name, columns[name], lines) for name in (*numbers, *(optional or ())) if name in columns},
        {name: [of_cell(word.strip()) for word in columns[name]] for name in words},
    )


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows as CSV; an empty field for None and NaN, infinity is `inf`, and text is safe to show in a spreadsheet."""
    text = io.StringIO()
    cells = (["" if value != value else as_cell(value) for value in row] for row in rows)
    csv.writer(text, lineterminator="\n").writerows(cells)
    return text.getvalue()


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: not CSV ({error})") from error


def _check_names(names: Sequence[str], needed: Sequence[str], optional: Sequence[str] | None) -> None:
    if optional is None:
        names, optional = [name for name in names if name in needed], ()
    missing = [name for name in needed if name not in names]
    unknown = [name for name in names if name not in (*needed, *optional)]
    doubled = sorted({name for name in names if names.count(name) > 1})
    for what, which in (("missing", missing), ("unknown", unknown), ("there twice", doubled)):
        if which:
            raise ValueError(f"the first line has to name the columns {', '.join(needed)}; {what}: {', '.join(which)}")


def _finite(name: str, words: Sequence[str], lines: Sequence[int]) -> NDArray[np.float64]:
    try:
        values = np.array(words, dtype=np.float64)
        if np.isfinite(values).all():
            return values
    except ValueError:
        pass
    line, word = next((line, word) for line, word in zip(lines, words, strict=True) if not _is_finite(word))
    raise ValueError(f"line {line}: {name}: a finite number is needed; got {word[:80]!r}")


def _is_finite(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False
