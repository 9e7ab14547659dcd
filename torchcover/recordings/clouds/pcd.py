"""Clouds of the Point Cloud Library: `.pcd`, ascii, binary and binary_compressed."""

import math
import struct
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from torchcover.files import check_memory
from torchcover.recordings.clouds.arrays import Points, check_rest
from torchcover.recordings.clouds.text import AXES, parse_rows, read_lines
from torchcover.recordings.isolated_readers import lzf_block

# The real ones have about 300 bytes; this bounds the search for the DATA line in a file that is no PCD.
MAX_HEADER_BYTES = 65536
# An LZF back reference turns 3 bytes into at most 264.
LZF_MAX_RATIO = 88
MAX_DIGITS = 18
ENCODINGS = ("ascii", "binary", "binary_compressed")
TYPES = ("F", "U", "I")
# The origin, without a rotation: x y z qw qx qy qz.
NO_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Header:
    fields: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str

    @property
    def field_bytes(self) -> tuple[int, ...]:
        return tuple(size * count for size, count in zip(self.sizes, self.counts, strict=True))

    @property
    def record_bytes(self) -> int:
        return sum(self.field_bytes)


def read_pcd(path: Path) -> Points:
    """Read the fields x y z of a PCD file."""
    check_memory(4 * path.stat().st_size)
    header, body = _parse_header(path.read_bytes())
    axes = _axis_positions(header)
    if header.encoding == "ascii":
        return _parse_ascii(header, axes, body)
    if header.points == 0:
        check_rest(body)
        return np.empty((0, 3), f"<f{max(header.sizes[axis] for axis in axes)}")
    _check_size(header, body)
    return _columns(path, header, axes, body)


def _parse_header(data: bytes) -> tuple[_Header, bytes]:
    entries, end = _read_entries(data)
    if "COLUMNS" in entries:  # early versions of the format
        entries.setdefault("FIELDS", entries["COLUMNS"])
    sides = [_whole(entries[key][0], key) for key in ("WIDTH", "HEIGHT") if entries.get(key)]
    if sides:
        entries.setdefault("POINTS", [str(math.prod(sides))])
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if not entries.get(key)]
    if missing:
        raise ValueError(f"the PCD header lacks {', '.join(missing)}; it has {', '.join(entries)}")
    _warn_of_viewpoint(entries.get("VIEWPOINT", []))
    fields = tuple(entries["FIELDS"])
    header = _Header(
        fields=fields,
        sizes=_positive(entries["SIZE"], "SIZE"),
        types=tuple(entries["TYPE"]),
        counts=tuple(_whole(word, "COUNT") for word in entries.get("COUNT", ["1"] * len(fields))),
        points=_whole(entries["POINTS"][0], "POINTS"),
        encoding=" ".join(entries["DATA"]),
    )
    lengths = [len(entries) for entries in (header.fields, header.sizes, header.types, header.counts)]
    if len(set(lengths)) > 1:
        raise ValueError(
            f"FIELDS, SIZE, TYPE and COUNT of the PCD header differ in length; got {', '.join(map(str, lengths))}; "
            "give each field one entry in each line"
        )
    if header.encoding not in ENCODINGS:
        raise ValueError(f"DATA is {header.encoding[:40]!r}; allowed are {', '.join(ENCODINGS)}")
    unknown = set(header.types) - set(TYPES)
    if unknown:
        raise ValueError(f"TYPE of the PCD header is one of {', '.join(TYPES)}; got {', '.join(sorted(unknown))[:40]}")
    if len(sides) == 2 and math.prod(sides) != header.points:
        raise ValueError(f"WIDTH {sides[0]} times HEIGHT {sides[1]} of the PCD header is not POINTS {header.points}")
    return header, data[end:]


def _read_entries(data: bytes) -> tuple[dict[str, list[str]], int]:
    """The words behind each key of the header, and where it ends."""
    entries: dict[str, list[str]] = {}
    end = 0
    while "DATA" not in entries:
        start, end = end, data.find(b"\n", end, MAX_HEADER_BYTES) + 1
        if end == 0:
            raise ValueError(f"not a PCD file: no line DATA ends the header; it starts with {data[:12]!r}")
        words = data[start:end].decode("ascii", "replace").split("#")[0].split()
        if words and words[0] in entries:
            raise ValueError(f"the PCD header has two lines {words[0][:40]}")
        if words:
            entries[words[0]] = words[1:]
    return entries, end


def _parse_ascii(header: _Header, axes: Sequence[int], body: bytes) -> Points:
    rows = sum(1 for _ in read_lines(body))
    if rows != header.points:
        raise ValueError(f"the header claims {header.points} points; {rows} rows follow it")
    if rows == 0:
        return np.empty((0, 3))
    return parse_rows(read_lines(body), [sum(header.counts[:axis]) for axis in axes], sum(header.counts))


def _warn_of_viewpoint(words: Sequence[str]) -> None:
    """Warn about a pose of the sensor, which other programs apply to the points or ignore."""
    if words and tuple(map(float, words)) != NO_VIEWPOINT:
        warnings.warn(
            f"VIEWPOINT {' '.join(words)[:80]} of PCD files is not applied: points are in the frame in which they "
            "are stored",
            stacklevel=2,
        )


def _whole(word: str, key: str) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS):
        raise ValueError(f"{key} of the PCD header has to be a whole number; got {word[:40]!r}")
    return int(word)


def _positive(words: Sequence[str], key: str) -> tuple[int, ...]:
    numbers = tuple(_whole(word, key) for word in words)
    if 0 in numbers:
        raise ValueError(f"{key} of the PCD header has to be positive; got {' '.join(words)[:80]}")
    return numbers


def _axis_positions(header: _Header) -> list[int]:
    missing = [axis for axis in AXES if axis not in header.fields]
    if missing:
        raise ValueError(f"no field {', '.join(missing)} among the fields {' '.join(header.fields)[:80]}")
    if any(header.fields.count(axis) > 1 for axis in AXES):
        raise ValueError(f"x, y and z name one field each; got the fields {' '.join(header.fields)[:80]}")
    positions = [header.fields.index(axis) for axis in AXES]
    for position in positions:
        kind, size, count = header.types[position], header.sizes[position], header.counts[position]
        if kind != "F" or size not in (4, 8) or count != 1:
            raise ValueError(
                f"field {header.fields[position]} is TYPE {kind} SIZE {size} COUNT {count}; "
                "TYPE F, SIZE 4 or 8, COUNT 1 is needed"
            )
    return positions


def _check_size(header: _Header, body: bytes) -> None:
    claimed_bytes = header.points * header.record_bytes
    if header.encoding == "binary":
        available_bytes = len(body)
    else:
        if len(body) < 8:
            raise ValueError(f"truncated: the sizes of the compressed block are missing; {len(body)} bytes follow")
        compressed_bytes, available_bytes = struct.unpack_from("<II", body)
        if compressed_bytes > len(body) - 8 or available_bytes > LZF_MAX_RATIO * compressed_bytes:
            raise ValueError(
                f"truncated: the compressed block claims {compressed_bytes} bytes that grow to {available_bytes} "
                f"(at most {LZF_MAX_RATIO} times is possible); {len(body) - 8} bytes follow"
            )
        check_memory(2 * len(body) + 3 * available_bytes)
    # Compressed, the sizes agree; else writers pad the file to whole memory pages.
    if claimed_bytes > available_bytes or (header.encoding != "binary" and claimed_bytes < available_bytes):
        raise ValueError(
            f"truncated or too long: the header claims {header.points} points of {header.record_bytes} bytes = "
            f"{claimed_bytes} bytes; there are {available_bytes}"
        )


def _columns(path: Path, header: _Header, axes: Sequence[int], body: bytes) -> Points:
    """Records stand one after the other; compressed, all values of one field do, then those of the next."""
    starts = [0, *accumulate(header.field_bytes)]
    columns: list[tuple[bytes | memoryview, int, int]]
    if header.encoding == "binary":
        check_rest(body[header.points * header.record_bytes :])
        columns = [(body, starts[axis], header.record_bytes) for axis in axes]
    else:
        compressed_bytes, plain_bytes = struct.unpack_from("<II", body)
        check_rest(body[8 + compressed_bytes :])
        block_start = path.stat().st_size - len(body) + 8
        plain = lzf_block(path, block_start, compressed_bytes, plain_bytes)["plain"].data
        columns = [(plain, starts[axis] * header.points, header.sizes[axis]) for axis in axes]
    kinds = [f"<f{header.sizes[axis]}" for axis in axes]
    return np.column_stack(
        [
            np.ndarray((header.points,), kind, data, start, (stride,))
            for kind, (data, start, stride) in zip(kinds, columns, strict=True)
        ]
    )
