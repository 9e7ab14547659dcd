"""Readers of CSV, JSON and NumPy arrays from untrusted sources, and text that is safe to print."""

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

from torchcover.files.bad_file import check_memory, decode_utf8, guard_reader

# Control characters of terminals, and marks that change the direction of text; line feeds and tabs are allowed.
CONTROL_CHARACTERS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
# Largest ratio of Deflate, which encodes 258 bytes with at least 2 bits.
DEFLATE_MAX_RATIO = 1032


def escape_control_chars(text: str) -> str:
    r"""Replace control characters by their escape sequences.

    Args:
        text: Text from a file or a user.

    Example:
        >>> print(escape_control_chars("roof\x1b[2J"))
        roof\x1b[2J
    """
    return CONTROL_CHARACTERS.sub(_escape_match, text)


def _escape_match(match: re.Match[str]) -> str:
    return match[0].encode("unicode_escape").decode()


def escape_cell(value: object) -> object:
    """Convert a value to a spreadsheet cell: text that begins like a formula gets a leading quote.

    Args:
        value: Any value; numbers do not change.

    Example:
        >>> escape_cell("=1+1"), escape_cell(-1.5)
        ("'=1+1", -1.5)
    """
    if not isinstance(value, str):
        return value
    text = escape_control_chars(value)
    return f"'{text}" if _is_formula(value) else text


def unescape_cell(text: str) -> str:
    """Remove the quote that `escape_cell` added.

    Args:
        text: Text of a cell.
    """
    return text[1:] if text[:1] == "'" and _is_formula(text[1:]) else text


def _is_formula(text: str) -> bool:
    """Return whether a spreadsheet would read a text as a formula."""
    is_number = re.fullmatch(r"[+-]?(\d+(\.\d*)?(e[+-]?\d+)?|inf)", text, re.IGNORECASE) is not None
    return re.match(r"[=+\-@\t\r]", text.lstrip("'")) is not None and not is_number


class CsvTable(NamedTuple):
    """Columns of a table by name.

    Args:
        numbers: (N,) float64 finite values of each numeric column.
        texts: N strings of each text column.
    """

    numbers: dict[str, NDArray[np.float64]]
    texts: dict[str, list[str]]


@guard_reader("a table in CSV")
def read_csv(
    path: Path,
    number_columns: Sequence[str],
    text_columns: Sequence[str] = (),
    optional_columns: Sequence[str] | None = (),
) -> CsvTable:
    """Read a CSV table whose first line names the columns, in any order.

    Args:
        path: File in UTF-8.
        number_columns: Columns of finite numbers.
        text_columns: Columns of text.
        optional_columns: Columns of numbers that may be missing. None: the file may have any further columns, which
            are not read.

    Raises:
        BadFileError: Columns are missing, repeated or unknown, a row has another width, or a value is no finite number;
            the message has the line and the column.
    """
    check_memory(20 * path.stat().st_size)  # Python objects of a row take at most 20 bytes per byte of the file
    rows = _iterate_rows(decode_utf8(path.read_bytes()))
    _, header = next(rows, (0, []))
    names = [name.strip() for name in header]
    _check_names(names, (*text_columns, *number_columns), optional_columns)
    lines, table = [], []
    for line, row in rows:
        if len(row) != len(names):
            raise ValueError(f"line {line}: {len(names)} columns are needed ({', '.join(names)}); got {len(row)}")
        lines.append(line)
        table.append(row)
    columns = dict(zip(names, zip(*table, strict=True) if table else [()] * len(names), strict=True))
    numbers, texts = {}, {}
    for name in (*number_columns, *(optional_columns or ())):
        if name in columns:
            numbers[name] = _parse_numbers(name, columns[name], lines)
    for name in text_columns:
        texts[name] = [unescape_cell(text.strip()) for text in columns[name]]
    return CsvTable(numbers, texts)


def format_csv(rows: Iterable[Iterable[object]]) -> str:
    """Format rows as CSV that is safe to open in a spreadsheet.

    Args:
        rows: Values of each row. None and NaN become empty fields, infinity becomes `inf`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in rows:
        writer.writerow(["" if value != value else escape_cell(value) for value in row])  # NaN differs from itself
    return text.getvalue()


def _iterate_rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the fields of each row that is not empty."""
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: not CSV ({error})") from error


def _check_names(names: Sequence[str], required: Sequence[str], optional: Sequence[str] | None) -> None:
    """Check that a header has all required columns, and no unknown or repeated ones."""
    if optional is None:
        names, optional = [name for name in names if name in required], ()
    missing = [name for name in required if name not in names]
    unknown = [name for name in names if name not in (*required, *optional)]
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    for problem, columns in (("missing", missing), ("unknown", unknown), ("there twice", repeated)):
        if columns:
            raise ValueError(
                f"the first line has to name the columns {', '.join(required)}; {problem}: {', '.join(columns)}"
            )


def _parse_numbers(name: str, texts: Sequence[str], lines: Sequence[int]) -> NDArray[np.float64]:
    """Parse finite numbers; the error names the first other value."""
    with suppress(ValueError):
        values = np.array(texts, dtype=np.float64)
        if np.isfinite(values).all():
            return values
    for line, text in zip(lines, texts, strict=True):
        is_finite = False
        with suppress(ValueError):
            is_finite = math.isfinite(float(text))
        if not is_finite:
            raise ValueError(f"line {line}: {name}: a finite number is needed; got {text[:80]!r}")
    raise ValueError(f"{name}: finite numbers are needed")


class JsonTable(NamedTuple):
    """Table of JSON objects.

    Args:
        path: File of the table.
        rows: Rows in the order of the file.
        by_token: Rows with a `token` by this token.
    """

    path: Path
    rows: list[dict[str, Any]]
    by_token: dict[str, dict[str, Any]]

    def get_row(self, token: str) -> dict[str, Any]:
        """Return the row of a token.

        Args:
            token: Token that another table refers to.

        Raises:
            ValueError: No row has this token.
        """
        if token not in self.by_token:
            raise ValueError(f"{self.path}: no row has the token {str(token)[:40]!r}, which another table names")
        return self.by_token[token]


def parse_json(text: str) -> Any:  # noqa: ANN401  (JSON has no static types)
    """Parse JSON whose Python objects fit into the memory limit of a file.

    Args:
        text: JSON.

    Raises:
        ValueError: The text is not JSON, or too large.
    """
    # Bytes of the Python object that begins at each mark; a character takes up to 4.
    object_bytes = {"{": 240, "[": 96, ",": 64, ":": 64}
    check_memory(4 * len(text) + sum(size_bytes * text.count(mark) for mark, size_bytes in object_bytes.items()))
    return json.loads(text)


@guard_reader("a table of rows")
def read_json_table(path: Path) -> JsonTable:
    """Read a JSON list of objects.

    Args:
        path: File in UTF-8.

    Raises:
        BadFileError: The file has other content.
    """
    check_memory(path.stat().st_size)
    rows = parse_json(decode_utf8(path.read_bytes()))
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError(f"a list of objects is needed; got {type(rows).__name__}")
    return JsonTable(path, rows, {row["token"]: row for row in rows if "token" in row})


class NpyHeader(NamedTuple):
    """Shape of the array in a `.npy` file, and the type of its elements, which are never Python objects."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


def check_dtype_kind(allowed_kinds: str, header: NpyHeader) -> None:
    """Check the kind of the elements of an array.

    Args:
        allowed_kinds: Letters of `numpy.dtype.kind`.
        header: Header of the array.

    Raises:
        ValueError: The array has another kind.
    """
    if header.dtype.kind not in allowed_kinds:
        raise ValueError(f"an array of {header.dtype}")


def read_npy(path: Path, check: Callable[[NpyHeader], None]) -> NDArray[Any]:
    """Read a `.npy` file.

    Args:
        path: File.
        check: Function that raises ValueError for unsuitable headers, called before memory is allocated.

    Raises:
        ValueError: The file is not a `.npy`, contains Python objects, has another size than its array, or is too large.
    """
    return _load_array(lambda: path.open("rb"), path.stat().st_size, check)


def read_npz(
    path: Path,
    check: Callable[[NpyHeader], None],
    select_names: Callable[[Collection[str]], Collection[str]] | None = None,
) -> dict[str, NDArray[Any]]:
    """Read arrays of a `.npz` archive, compressed or not.

    Args:
        path: File.
        check: Function that raises ValueError for unsuitable headers, called before memory is allocated.
        select_names: Function from the names in the archive to those to read; by default all.

    Returns:
        Arrays by name.

    Raises:
        ValueError: The file is not such an archive, damaged, or exceeds the memory limit when decompressed.
    """
    # Besides its own errors, zipfile raises RuntimeError (encrypted), NotImplementedError (unsupported compression),
    # zlib.error, EOFError, and OSError for offsets outside of the file.
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if len(members) < len(archive.infolist()):
                raise ValueError("two arrays of one name")
            names = members if select_names is None else select_names(members)
            for name in names:
                _check_growth(members[name])
            check_memory(sum(members[name].file_size for name in names))
            arrays = {}
            for name in names:
                arrays[name] = _load_array(partial(archive.open, members[name]), members[name].file_size, check)
            return arrays
    except (ValueError, MemoryError):
        raise
    except Exception as error:
        # The message may contain a damaged name that is as long as the rest of the archive.
        raise ValueError(f"not a readable .npz archive ({str(error)[:100]})") from error


def read_npz_headers(path: Path) -> dict[str, NpyHeader]:
    """Read the headers of the arrays of a `.npz` archive; other members are skipped.

    Args:
        path: File.

    Raises:
        ValueError: The file is not such an archive, or damaged.
    """
    headers = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            _check_growth(member)
            with archive.open(member) as stream, suppress(ValueError):
                headers[member.filename.removesuffix(".npy")] = _read_npy_header(stream)
    return headers


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a compressed `.npz` archive that NumPy can read.

    Args:
        path: File.
        arrays: Arrays by name, without Python objects.

    Raises:
        ValueError: An array contains Python objects.
    """
    # `numpy.savez_compressed` has only the default level, which takes twice as long for an eighth less.
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)


def _check_growth(member: zipfile.ZipInfo) -> None:
    """Check that a member is compressed as NumPy does it, and cannot grow beyond the size in its header."""
    max_ratios = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: DEFLATE_MAX_RATIO}
    if member.compress_type not in max_ratios:  # Python decompresses other types in steps of unlimited size
        raise ValueError(f"{member.filename} is compressed otherwise than NumPy does it; use numpy.savez_compressed")
    max_bytes = max_ratios[member.compress_type] * member.compress_size
    if member.file_size > max_bytes:
        raise ValueError(
            f"{member.filename} claims {member.file_size} bytes out of {member.compress_size} compressed ones; "
            f"at most {max_bytes} are possible"
        )


def _load_array(
    open_stream: Callable[[], IO[bytes]], size_bytes: int, check: Callable[[NpyHeader], None]
) -> NDArray[Any]:
    """Load an array after its header, size and memory were checked."""
    with open_stream() as stream:
        header = _read_npy_header(stream)
        data_bytes = size_bytes - stream.tell()
    if header.dtype.hasobject:
        raise ValueError("an array of numbers is needed; got pickled Python objects")
    check(header)
    # Checked before NumPy, which allocates memory for any shape in the header.
    shape, dtype = header
    claimed_bytes = math.prod(shape) * dtype.itemsize
    if claimed_bytes != data_bytes:
        raise ValueError(f"the header claims {shape} {dtype} = {claimed_bytes} bytes; {data_bytes} bytes follow it")
    check_memory(2 * claimed_bytes)  # callers that select columns copy them
    with open_stream() as stream, warnings.catch_warnings(action="ignore"):
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array


def _read_npy_header(stream: IO[bytes]) -> NpyHeader:
    """Read the header of a `.npy` stream."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    # The header is a Python literal: NumPy, the parser and the tokenizer each have exceptions of their own.
    try:
        version = np.lib.format.read_magic(stream)
        if version not in readers:
            raise ValueError(f"version {version[0]}.{version[1]} of the format")
        # NumPy warns about valid headers of Python 2, and Python about unusual literals in them.
        with warnings.catch_warnings(action="ignore"):
            shape, _, dtype = readers[version](stream)
    except Exception as error:
        raise ValueError(f"not a readable .npy header ({error})") from error
    return NpyHeader(shape, dtype)
