"""Surveys: LAS, versions 1.0 to 1.4, and LAZ, which is LAS compressed and read by laspy."""

import struct
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory, laz_points
from torchcover.recordings.clouds.las_units import list_records, read_scale

HEADER_BYTES, HEADER_BYTES_1_4 = 227, 375
COMPRESSED = 0x80  # of the point format
# Of what stands before and behind the points, at least.
RECORD_HEADER_BYTES, LATER_RECORD_HEADER_BYTES = 54, 60
# Of x, y and z as float64, while they are made of whole numbers.
COORDINATE_BYTES = 72


class _Header(NamedTuple):
    first_byte: int
    record_bytes: int
    points: int
    compressed: bool
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    # Of records before and behind the points: first byte, count.
    records: tuple[int, int]
    later_records: tuple[int, int]


def read_las(path: Path) -> NDArray[np.float64]:
    """Read x y z of a LAS or LAZ file in meters, its scales, offsets and units applied."""
    size_bytes = path.stat().st_size
    with path.open("rb") as file:
        header = _header(file.read(HEADER_BYTES_1_4), size_bytes)
        records = [*list_records(file, *header.records, extended=False)]
        records += list_records(file, *header.later_records, extended=True)
        meters = read_scale(file, records)
        check_memory(header.points * (header.record_bytes + COORDINATE_BYTES))
        if header.compressed:
            _check_chunks(file, header, size_bytes)
    if header.compressed:
        return laz_points(path, header.points)["xyz"] * (header.scale * meters) + header.offset * meters
    claimed_bytes = header.points * header.record_bytes
    if header.first_byte + claimed_bytes > size_bytes:
        raise ValueError(
            f"the header claims {header.points} points of {header.record_bytes} bytes from byte {header.first_byte} "
            f"on; the file has {size_bytes} bytes"
        )
    columns = np.dtype({"names": ["xyz"], "formats": [("<i4", 3)], "offsets": [0], "itemsize": header.record_bytes})
    records = np.fromfile(path, columns, header.points, offset=header.first_byte)
    return records["xyz"] * (header.scale * meters) + header.offset * meters


def _header(data: bytes, size_bytes: int) -> _Header:
    if not data.startswith(b"LASF"):
        raise ValueError(f"not a LAS file: it starts with {data[:4]!r}, not with b'LASF'")
    if len(data) < HEADER_BYTES:
        raise ValueError(f"a header of {HEADER_BYTES} bytes is needed; the file has {len(data)}")
    header_bytes, first_byte, records, kind, record_bytes, points = struct.unpack_from("<HIIBHI", data, 94)
    numbers = np.frombuffer(data, "<f8", 6, offset=131)
    later_byte = later_records = 0
    if (data[24], data[25]) >= (1, 4):
        if len(data) < HEADER_BYTES_1_4:
            raise ValueError(f"a header of {HEADER_BYTES_1_4} bytes is needed; the file has {len(data)}")
        later_byte, later_records, points = struct.unpack_from("<QIQ", data, 235)
        if later_records and later_byte + LATER_RECORD_HEADER_BYTES * later_records > size_bytes:
            raise ValueError(
                f"{later_records} records from byte {later_byte} on are claimed; there is no room for them"
            )
    if header_bytes + RECORD_HEADER_BYTES * records > first_byte or first_byte > size_bytes:
        raise ValueError(f"{records} records before the points, which start at byte {first_byte}, are impossible")
    if record_bytes < 20:
        raise ValueError(f"records of 20 bytes or more are needed; got {record_bytes}")
    if not (np.isfinite(numbers).all() and numbers[:3].all()):
        raise ValueError(f"finite scales, not 0, and finite offsets are needed; got {numbers.tolist()}")
    return _Header(
        first_byte,
        record_bytes,
        points,
        bool(kind & COMPRESSED),
        numbers[:3],
        numbers[3:],
        (header_bytes, records),
        (later_byte, later_records),
    )


def _check_chunks(file: BinaryIO, header: _Header, size_bytes: int) -> None:
    """The decompressor reserves memory for whatever number of chunks is claimed, and where there is none, it aborts."""
    file.seek(header.first_byte)
    (table_byte,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
    if table_byte == -1:  # who could not go back to write it down left it at the end
        file.seek(max(0, size_bytes - 8))
        (table_byte,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
    if not header.first_byte <= table_byte <= size_bytes - 8:
        raise ValueError(f"the table of chunks is said to be at byte {table_byte}; the file has {size_bytes} bytes")
    file.seek(table_byte)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks > header.points + 1:
        raise ValueError(f"the header claims {header.points} points, the table of chunks {chunks} chunks of them")
