"""Tables of others: CSV, JSON, NumPy's arrays and archives, and words of them that are safe to show."""

import csv
import io
import json
import math
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import check_memory, decode, reads

# Of terminals: control characters, and marks that turn the direction of what follows. Lines and tabs may stay.
CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
FORMULA = re.compile(r"[=+\-@\t\r]")  # at the start of a cell of a spreadsheet
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?(e[+-]?\d+)?|inf)", re.IGNORECASE)
QUOTE = "'"  # in front of a formula, makes text of it


def shown(text: str) -> str:
    r"""Text whose control characters are written out.

    Example:
        >>> print(shown("roof\x1b[2J"))
        roof\x1b[2J
    """
    return CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def as_cell(value: object) -> object:
    """A value as a cell of a spreadsheet: text that begins like a formula begins with a quote, numbers stay.

    Example:
        >>> as_cell("=1+1"), as_cell(-1.5)
        ("'=1+1", -1.5)
    """
    return f"{QUOTE * _is_formula(value)}{shown(value)}" if isinstance(value, str) else value


def of_cell(text: str) -> str:
    """The text that `as_cell` made a cell of."""
    return text[1:] if text[:1] == QUOTE and _is_formula(text[1:]) else text


def _is_formula(text: str) -> bool:
    return FORMULA.match(text.lstrip(QUOTE)) is not None and NUMBER.fullmatch(text) is None


BYTES_PER_BYTE = 20  # of the words of a row, as objects of Python, for each byte of the file


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
    doubled = sorted(name for name, count in Counter(names).items() if count > 1)
    for what, which in (("missing", missing), ("unknown", unknown), ("there twice", doubled)):
        if which:
            raise ValueError(f"the first line has to name the columns {', '.join(needed)}; {what}: {', '.join(which)}")


def _finite(name: str, words: Sequence[str], lines: Sequence[int]) -> NDArray[np.float64]:
    with suppress(ValueError):
        values = np.array(words, dtype=np.float64)
        if np.isfinite(values).all():
            return values
    line, word = next((line, word) for line, word in zip(lines, words, strict=True) if not _is_finite(word))
    raise ValueError(f"line {line}: {name}: a finite number is needed; got {word[:80]!r}")


def _is_finite(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False


# Bytes of the object of Python that begins at each mark of JSON; a character takes up to 4.
JSON_OBJECT_BYTES = {"{": 240, "[": 96, ",": 64, ":": 64}


class JsonTable(NamedTuple):
    """A table. `rows`: as they were written; `by_token`: the same by their `token`."""

    path: Path
    rows: list[dict[str, Any]]
    by_token: dict[str, dict[str, Any]]

    def row(self, token: str) -> dict[str, Any]:
        """The row of a token."""
        if token not in self.by_token:
            raise ValueError(f"{self.path}: no row has the token {str(token)[:40]!r}, which another table names")
        return self.by_token[token]


def parse_json(text: str) -> Any:  # noqa: ANN401  (JSON knows no types)
    """Parse JSON whose objects fit into the memory of a file. ValueError: not JSON, or too large."""
    check_memory(4 * len(text) + sum(size * text.count(mark) for mark, size in JSON_OBJECT_BYTES.items()))
    return json.loads(text)


@reads("a table of rows")
def read_json_table(path: Path) -> JsonTable:
    """Read a JSON list of objects. BadFileError: another content."""
    check_memory(path.stat().st_size)
    rows = parse_json(decode(path.read_bytes()))
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"a list of objects is needed; got {type(rows).__name__}")
    return JsonTable(path, rows, {row["token"]: row for row in rows if "token" in row})


DEFLATE_MAX_RATIO = 1032  # Deflate spends at least 2 bits on 258 bytes
# How often its compressed size a member can have.
MAX_RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: DEFLATE_MAX_RATIO}
_HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class NpyHeader(NamedTuple):
    """What a `.npy` says about its array. `dtype`: of its elements, never Python objects."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def check_kind(kinds: str, header: NpyHeader) -> None:
    """Raise unless an array is of one of these kinds, by their letters in `numpy.dtype.kind`."""
    if header.dtype.kind not in kinds:
        raise ValueError(f"an array of {header.dtype}")


def read_npy(path: Path, check: Callable[[NpyHeader], None]) -> NDArray[Any]:
    """Read a `.npy`.

    `check`: called with the header, before memory is reserved; raises ValueError if it is not what is needed. Returns
    the array. ValueError: not such a file, Python objects, an array of another size than the file, or too large a one.
    """
    return _load(lambda: path.open("rb"), path.stat().st_size, check)


def read_npz(
    path: Path,
    check: Callable[[NpyHeader], None],
    choose: Callable[[Collection[str]], Collection[str]] = lambda names: names,
) -> dict[str, NDArray[Any]]:
    """Read arrays of a `.npz` by name, compressed or not; those that `choose` returns of all names, else all.

    `check` gets each header before memory is reserved, and raises ValueError if it is not what is needed. ValueError:
    not such an archive, a damaged one, or one that grows beyond what a file may take.
    """
    # zipfile raises, beside its own: RuntimeError (encrypted), NotImplementedError (a compression it lacks),
    # zlib.error, EOFError, OSError on offsets that lead out of the file.
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if len(members) < len(archive.infolist()):
                raise ValueError("two arrays of one name")
            wanted = {name: members[name] for name in choose(members)}
            for member in wanted.values():
                _check_growth(member)
            check_memory(sum(member.file_size for member in wanted.values()))
            return {
                name: _load(partial(archive.open, member), member.file_size, check) for name, member in wanted.items()
            }
    except (ValueError, MemoryError):
        raise
    except Exception as error:
        # A damaged name may be as long as the rest of the archive.
        raise ValueError(f"not a readable .npz archive ({str(error)[:100]})") from error


def npz_headers(path: Path) -> dict[str, NpyHeader]:
    """What the arrays of a `.npz` are, unread; members that are no arrays are left out.

    ValueError: not such an archive, or a damaged one.
    """
    found = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            _check_growth(member)
            with archive.open(member) as stream, suppress(ValueError):
                found[member.filename.removesuffix(".npy")] = _npy_header(stream)
    return found


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a compressed `.npz`, as NumPy reads it.

    `arrays`: by their names; no Python objects. ValueError: an array of Python objects.
    """
    # `numpy.savez_compressed` knows the slow default only, which takes twice as long for an eighth less.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def _check_growth(member: zipfile.ZipInfo) -> None:
    if member.compress_type not in MAX_RATIOS:  # Python decompresses megabytes of these at once, without a bound
        raise ValueError(f"{member.filename} is compressed otherwise than NumPy does it; use numpy.savez_compressed")
    largest_bytes = MAX_RATIOS[member.compress_type] * member.compress_size
    if member.file_size > largest_bytes:
        raise ValueError(
            f"{member.filename} claims {member.file_size} bytes out of {member.compress_size} compressed ones; "
            f"at most {largest_bytes} are possible"
        )


def _load(open_stream: Callable[[], IO[bytes]], size_bytes: int, check: Callable[[NpyHeader], None]) -> NDArray[Any]:
    with open_stream() as stream:
        header = _npy_header(stream)
        data_bytes = size_bytes - stream.tell()
    if header.dtype.hasobject:
        raise ValueError("an array of numbers is needed; got pickled Python objects")
    check(header)
    # Before NumPy sees it: it reserves memory for whatever shape the header claims.
    shape, dtype = header
    claimed_bytes = math.prod(shape) * dtype.itemsize
    if claimed_bytes != data_bytes:
        raise ValueError(f"the header claims {shape} {dtype} = {claimed_bytes} bytes; {data_bytes} bytes follow it")
    check_memory(2 * claimed_bytes)  # whoever takes some columns copies them
    with open_stream() as stream, warnings.catch_warnings(action="ignore"):
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def _npy_header(stream: IO[bytes]) -> NpyHeader:
    # The header is a Python literal: NumPy, the parser and the tokenizer each fail with exceptions of their own.
    try:
        version = np.lib.format.read_magic(stream)
        if version not in _HEADER_READERS:
            raise ValueError(f"version {version[0]}.{version[1]} of the format")
        # NumPy warns of headers that Python 2 wrote (they read well), and Python of doubtful literals in them.
        with warnings.catch_warnings(action="ignore"):
            shape, _, dtype = _HEADER_READERS[version](stream)
    except Exception as error:
        raise ValueError(f"not a readable .npy header ({error})") from error
    return NpyHeader(shape, dtype)
