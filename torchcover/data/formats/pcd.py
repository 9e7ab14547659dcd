"""Clouds of the Point Cloud Library: `.pcd`, ascii, binary and binary_compressed.

pypcd4 decodes the binary variants. It never sees the header as it arrived, but one written anew from what was
checked here: left alone it reserves the memory that a header claims, refuses VERSION .6 and a missing COUNT, and
draws names for padding fields from Python's global random numbers. Its ascii reader wants single spaces.
"""

import io
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchcover.data.formats.arrays import Points
from torchcover.data.formats.text import AXES, decode, parse_rows

# The real ones have about 300 bytes; this bounds the search for the DATA line in a file that is no PCD.
MAX_HEADER_BYTES = 65536
# An LZF back reference turns 3 bytes into at most 264.
LZF_MAX_RATIO = 88
ENCODINGS = ("ascii", "binary", "binary_compressed")


@dataclass(frozen=True)
class _Header:
    fields: tuple[str, ...]
    sizes: tuple[int, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str

    @property
    def record_bytes(self) -> int:
        return sum(size * count for size, count in zip(self.sizes, self.counts, strict=True))


def read_pcd(path: Path) -> Points:
    """Read the fields x y z of a PCD file."""
    data = path.read_bytes()
    header, body = _parse_header(data)
    axes = _axis_positions(header)
    if header.encoding == "ascii":
        rows = [row for row in decode(body).splitlines() if row.strip()]
        if len(rows) != header.points:
            raise ValueError(f"the header claims {header.points} points; {len(rows)} rows follow it")
        return parse_rows(rows, [sum(header.counts[:position]) for position in axes])
    _check_size(header, body)
    return _decode_binary(header, axes, body)


def _parse_header(data: bytes) -> tuple[_Header, bytes]:
    entries: dict[str, list[str]] = {}
    end = 0
    while "DATA" not in entries:
        start, end = end, data.find(b"\n", end, MAX_HEADER_BYTES) + 1
        if end == 0:
            raise ValueError(f"not a PCD file: no line DATA ends the header; it starts with {data[:12]!r}")
        words = data[start:end].decode("ascii", "replace").split("#")[0].split()
        if words:
            entries[words[0]] = words[1:]
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "POINTS") if not entries.get(key)]
    if missing:
        raise ValueError(f"the PCD header lacks {', '.join(missing)}; it has {', '.join(entries)}")
    fields = tuple(entries["FIELDS"])
    header = _Header(
        fields=fields,
        sizes=_positive(entries["SIZE"], "SIZE"),
        types=tuple(entries["TYPE"]),
        counts=_positive(entries.get("COUNT", ["1"] * len(fields)), "COUNT"),
        points=_whole(entries["POINTS"][0], "POINTS"),
        encoding=" ".join(entries["DATA"]),
    )
    lengths = {len(header.fields), len(header.sizes), len(header.types), len(header.counts)}
    if len(lengths) > 1:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of the PCD header differ in length")
    if header.encoding not in ENCODINGS:
        raise ValueError(f"DATA is {header.encoding!r}; allowed are {', '.join(ENCODINGS)}")
    return header, data[end:]


def _whole(word: str, key: str) -> int:
    if not (word.isascii() and word.isdigit()):
        raise ValueError(f"{key} of the PCD header has to be a whole number; got {word[:40]!r}")
    return int(word)


def _positive(words: Sequence[str], key: str) -> tuple[int, ...]:
    numbers = tuple(_whole(word, key) for word in words)
    if 0 in numbers:
        raise ValueError(f"{key} of the PCD header has to be positive; got {' '.join(words)}")
    return numbers


def _axis_positions(header: _Header) -> list[int]:
    missing = [axis for axis in AXES if axis not in header.fields]
    if missing:
        raise ValueError(f"no field {', '.join(missing)} among the fields {' '.join(header.fields)}")
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
        if header.points == 0:
            return
        if len(body) < 8:
            raise ValueError(f"truncated: the sizes of the compressed block are missing; {len(body)} bytes follow")
        compressed_bytes, available_bytes = struct.unpack_from("<II", body)
        if compressed_bytes > len(body) - 8 or available_bytes > LZF_MAX_RATIO * compressed_bytes:
            raise ValueError(
                f"truncated: the compressed block claims {compressed_bytes} bytes that grow to {available_bytes} "
                f"(at most {LZF_MAX_RATIO} times is possible); {len(body) - 8} bytes follow"
            )
    # More is fine: writers pad the file to whole memory pages.
    if claimed_bytes > available_bytes:
        raise ValueError(
            f"truncated: the header claims {header.points} points of {header.record_bytes} bytes = "
            f"{claimed_bytes} bytes; there are {available_bytes}"
        )


def _decode_binary(header: _Header, axes: Sequence[int], body: bytes) -> Points:
    from pypcd4 import PointCloud

    names = [f"field{position}" for position in range(len(header.fields))]
    for axis, position in zip(AXES, axes, strict=True):
        names[position] = axis
    rewritten = (
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(map(str, header.sizes))}\n"
        f"TYPE {' '.join(header.types)}\nCOUNT {' '.join(map(str, header.counts))}\n"
        f"WIDTH {header.points}\nHEIGHT 1\nPOINTS {header.points}\nDATA {header.encoding}\n"
    )
    # pypcd4 lets through what its parts raise: pydantic, struct, lzf (which returns None), NumPy.
    try:
        columns = PointCloud.from_fileobj(io.BytesIO(rewritten.encode("ascii") + body)).pc_data
    except Exception as error:
        raise ValueError(f"the {header.encoding} PCD data cannot be decoded ({error})") from error
    return np.column_stack([columns[axis] for axis in AXES])
