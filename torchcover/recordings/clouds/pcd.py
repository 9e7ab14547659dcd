"""Clouds of the Point Cloud Library (`.pcd`): ascii, binary and binary_compressed."""

import math
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from torchcover.files import check_memory
from torchcover.recordings.clouds.arrays import Points, check_trailing_bytes
from torchcover.recordings.clouds.text import AXES, parse_rows, read_lines
from torchcover.recordings.isolated_readers import decompress_lzf_block

ENCODINGS = ("ascii", "binary", "binary_compressed")
TYPES = ("F", "U", "I")


@dataclass(frozen=True)
class _Header:
    """Fields of a record with size in bytes, type and number of values each, and the number of records."""

    fields: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str

    @property
    def field_bytes(self) -> tuple[int, ...]:
        """Bytes of each field in a record."""
        return tuple(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    @property
    def record_bytes(self) -> int:
        """Bytes of a record."""
        return sum(self.field_bytes)


def read_pcd(path: Path) -> Points:
    """Read the fields x y z of a PCD file.

    Args:
        path: File.

    Returns:
        (N, 3) points, float32 or float64 as stored.

    Raises:
        ValueError: The header is invalid, fields are missing, or the file has another size than the header claims.
    """
    check_memory(4 * path.stat().st_size)
    header, body = _parse_header(path.read_bytes())
    axes = _find_axis_fields(header)
    if header.encoding == "ascii":
        return _parse_ascii(header, axes, body)
    if header.points == 0:
        check_trailing_bytes(body)
        return np.empty((0, 3), f"<f{max(header.sizes[axis] for axis in axes)}")
    _check_size(header, body)
    return _read_binary(path, header, axes, body)


def _parse_header(data: bytes) -> tuple[_Header, bytes]:
    """Parse and check the header; return it with the bytes that follow it."""
    entries, end = _read_entries(data)
    if "COLUMNS" in entries:  # early versions of the format
        entries.setdefault("FIELDS", entries["COLUMNS"])
    shape = [_parse_integer(entries[key][0], key) for key in ("WIDTH", "HEIGHT") if entries.get(key)]
    if shape:
        entries.setdefault("POINTS", [str(math.prod(shape))])
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if not entries.get(key)]
    if missing:
        raise ValueError(f"the PCD header lacks {', '.join(missing)}; it has {', '.join(entries)}")
    _warn_of_viewpoint(entries.get("VIEWPOINT", []))
    fields = tuple(entries["FIELDS"])
    header = _Header(
        fields=fields,
        sizes=_parse_positive(entries["SIZE"], "SIZE"),
        types=tuple(entries["TYPE"]),
        counts=tuple(_parse_integer(word, "COUNT") for word in entries.get("COUNT", ["1"] * len(fields))),
        points=_parse_integer(entries["POINTS"][0], "POINTS"),
        encoding=" ".join(entries["DATA"]),
    )
    lengths = [len(column) for column in (header.fields, header.sizes, header.types, header.counts)]
    if len(set(lengths)) > 1:
        raise ValueError(
            f"FIELDS, SIZE, TYPE and COUNT of the PCD header differ in length; got {str(lengths)[1:-1]}; "
            "give each field one entry in each line"
        )
    if header.encoding not in ENCODINGS:
        raise ValueError(f"DATA is {header.encoding[:40]!r}; allowed are {', '.join(ENCODINGS)}")
    unknown = set(header.types) - set(TYPES)
    if unknown:
        raise ValueError(f"TYPE of the PCD header is one of {', '.join(TYPES)}; got {', '.join(sorted(unknown))[:40]}")
    if len(shape) == 2 and math.prod(shape) != header.points:
        raise ValueError(f"WIDTH {shape[0]} times HEIGHT {shape[1]} of the PCD header is not POINTS {header.points}")
    return header, data[end:]


def _read_entries(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Read the words after each key of the header, and the offset of its end."""
    max_header_bytes = 65536  # headers have about 300 bytes; the limit bounds the search in other files
    entries: dict[str, list[str]] = {}
    end = 0
    while "DATA" not in entries:
        start, end = end, data.find(b"\n", end, max_header_bytes) + 1
        if end == 0:
            raise ValueError(f"not a PCD file: no line DATA ends the header; it starts with {data[:12]!r}")
        words = data[start:end].decode("ascii", "replace").split("#")[0].split()
        if words and words[0] in entries:
            raise ValueError(f"the PCD header has two lines {words[0][:40]}")
        if words:
            entries[words[0]] = words[1:]
    return entries, end


def _parse_ascii(header: _Header, axes: Sequence[int], body: bytes) -> Points:
    """Parse as many rows as the header claims."""
    rows = sum(1 for _ in read_lines(body))
    if rows != header.points:
        raise ValueError(f"the header claims {header.points} points; {rows} rows follow it")
    if rows == 0:
        return np.empty((0, 3))
    return parse_rows(read_lines(body), [sum(header.counts[:axis]) for axis in axes], sum(header.counts))


def _warn_of_viewpoint(words: Sequence[str]) -> None:
    """Warn about a pose of the sensor, which some programs apply to the points and others ignore."""
    identity = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]  # x y z qw qx qy qz
    if words and [float(word) for word in words] != identity:
        warnings.warn(
            f"VIEWPOINT {' '.join(words)[:80]} of PCD files is not applied: points are in the frame in which they "
            "are stored",
            stacklevel=2,
        )


def _parse_integer(word: str, key: str) -> int:
    """Parse a number without sign, decimal point or excessive length."""
    max_digits = 18  # fits into int64
    if not (word.isascii() and word.isdigit() and len(word) <= max_digits):
        raise ValueError(f"{key} of the PCD header has to be a whole number; got {word[:40]!r}")
    return int(word)


def _parse_positive(words: Sequence[str], key: str) -> tuple[int, ...]:
    """Parse several integers, none of them 0."""
    numbers = tuple(_parse_integer(word, key) for word in words)
    if 0 in numbers:
        raise ValueError(f"{key} of the PCD header has to be positive; got {' '.join(words)[:80]}")
    return numbers


def _find_axis_fields(header: _Header) -> list[int]:
    """Find the indices of the fields x, y and z, which have to be single floats."""
    missing = sorted(set(AXES) - set(header.fields))
    if missing:
        raise ValueError(f"no field {', '.join(missing)} among the fields {' '.join(header.fields)[:80]}")
    if any(header.fields.count(axis) > 1 for axis in AXES):
        raise ValueError(f"x, y and z name one field each; got the fields {' '.join(header.fields)[:80]}")
    positions = [header.fields.index(axis) for axis in AXES]
    for position in positions:
        type_name, size, count = header.types[position], header.sizes[position], header.counts[position]
        if type_name != "F" or size not in (4, 8) or count != 1:
            raise ValueError(
                f"field {header.fields[position]} is TYPE {type_name} SIZE {size} COUNT {count}; "
                "TYPE F, SIZE 4 or 8, COUNT 1 is needed"
            )
    return positions


def _check_size(header: _Header, body: bytes) -> None:
    """Check the size of binary data before memory is allocated."""
    max_lzf_ratio = 88  # an LZF back reference turns 3 bytes into at most 264
    claimed_bytes = header.points * header.record_bytes
    if header.encoding == "binary":
        available_bytes = len(body)
    else:
        if len(body) < 8:
            raise ValueError(f"truncated: the sizes of the compressed block are missing; {len(body)} bytes follow")
        compressed_bytes, available_bytes = struct.unpack_from("<II", body)
        if compressed_bytes > len(body) - 8 or available_bytes > max_lzf_ratio * compressed_bytes:
            raise ValueError(
                f"truncated: the compressed block claims {compressed_bytes} bytes that grow to {available_bytes} "
                f"(at most {max_lzf_ratio} times is possible); {len(body) - 8} bytes follow"
            )
        check_memory(2 * len(body) + 3 * available_bytes)
    # The size of a compressed block is exact; writers pad uncompressed files to whole memory pages.
    if claimed_bytes > available_bytes or (header.encoding != "binary" and claimed_bytes < available_bytes):
        raise ValueError(
            f"truncated or too long: the header claims {header.points} points of {header.record_bytes} bytes = "
            f"{claimed_bytes} bytes; there are {available_bytes}"
        )


def _read_binary(path: Path, header: _Header, axes: Sequence[int], body: bytes) -> Points:
    """Read the columns of records, or of a compressed block, which stores one field after the other."""
    data: bytes | memoryview = body
    is_compressed = header.encoding != "binary"
    if is_compressed:
        compressed_bytes, plain_bytes = struct.unpack_from("<II", body)
        check_trailing_bytes(body[8 + compressed_bytes :])
        block_start = path.stat().st_size - len(body) + 8
        data = decompress_lzf_block(path, block_start, compressed_bytes, plain_bytes)["plain"].data
    else:
        check_trailing_bytes(body[header.points * header.record_bytes :])
    field_offsets = [0, *accumulate(header.field_bytes)]
    columns = []
    for axis in axes:
        start = field_offsets[axis] * header.points if is_compressed else field_offsets[axis]
        stride = header.sizes[axis] if is_compressed else header.record_bytes
        columns.append(np.ndarray((header.points,), f"<f{header.sizes[axis]}", data, start, (stride,)))
    return np.column_stack(columns)
