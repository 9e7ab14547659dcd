"""Surveys: LAS, versions 1.0 to 1.4, and LAZ, which is LAS compressed and read by laspy; scales and units."""

import os
import re
import struct
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.files import check_memory
from torchcover.recordings.isolated_readers import laz_points

HEADER_BYTES, HEADER_BYTES_1_4 = 227, 375
COMPRESSED = 0x80  # of the point format
# Of what stands before and behind the points, at least.
RECORD_HEADER_BYTES, LATER_RECORD_HEADER_BYTES = 54, 60
# Of x, y and z as float64, while they are made of whole numbers.
COORDINATE_BYTES = 72
# Records about the coordinate system.
PROJECTION = b"LASF_Projection"
WKT_RECORD, GEO_KEYS_RECORD = 2112, 34735
# GeoTIFF keys, and values of the first one.
MODEL_KEY, CRS_KEY, HORIZONTAL_UNIT_KEY, VERTICAL_UNIT_KEY = 1024, 3072, 3076, 4099
GEOGRAPHIC = 2
# EPSG code of a unit -> its name and meters.
EPSG_UNITS = {9001: ("meter", 1.0), 9002: ("foot", 0.3048), 9003: ("US survey foot", 1200 / 3937)}
# EPSG codes of UTM zones of WGS84, ETRS89 and NAD83, which are in meters.
UTM_CODES = (range(32601, 32761), range(25828, 25839), range(26901, 26924))
# A record of text or of keys is smaller.
MAX_RECORD_BYTES = 1 << 16
# Keywords of coordinate systems in WKT.
PROJECTED_SYSTEMS = frozenset({"PROJCS", "PROJCRS", "PROJECTEDCRS", "GEOCCS"})
VERTICAL_SYSTEMS = frozenset({"VERT_CS", "VERTCRS", "VERTICALCRS"})
GEOGRAPHIC_SYSTEMS = frozenset({"GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "BASEGEOGCRS", "BASEGEODCRS", "GEODCRS"})
REPROJECT = "reproject the file into a coordinate system in meters (pdal translate, las2las)"


class _Unit(NamedTuple):
    name: str
    meters: float


def _read_projection(file: BinaryIO, first_byte: int, count: int, header: struct.Struct) -> dict[int, bytes]:
    """Read the variable length records about the coordinate system, by their identifiers."""
    contents: dict[int, bytes] = {}
    end_byte = file.seek(0, os.SEEK_END)
    for _ in range(count):
        if first_byte + header.size > end_byte:
            break
        file.seek(first_byte)
        _, user, identifier, length, _ = header.unpack(file.read(header.size))
        if user.rstrip(b"\0") == PROJECTION and length <= MAX_RECORD_BYTES:
            contents[identifier] = file.read(length)
        first_byte += header.size + length
    return contents


def _choose_scale(contents: Mapping[int, bytes]) -> NDArray[np.float64]:
    """Return how many meters a unit of x, y and z is, by the records about the coordinate system.

    Args:
        contents: Records by their identifiers, of which WKT wins over GeoKeys.

    Returns:
        (3,) factors: 1 where nothing is said.

    Raises:
        ValueError: Degrees, or an unknown unit.

    Warns:
        UserWarning: Coordinates are converted, or only a code is given that does not say the unit.
    """
    keys = _read_keys(contents.get(GEO_KEYS_RECORD, b""))
    units = _units_of_wkt(contents.get(WKT_RECORD, b"")) or _units_of_keys(keys)
    if units is None:
        return np.ones(3)
    horizontal, vertical = units
    if vertical is None:
        vertical = _unit_of_code(keys[VERTICAL_UNIT_KEY]) if VERTICAL_UNIT_KEY in keys else horizontal
    if (horizontal.meters, vertical.meters) != (1.0, 1.0):
        warnings.warn(
            f"LAS coordinates are converted to meters, as the file says: x and y are in {horizontal.name}, z in "
            f"{vertical.name}; give no recording.units",
            stacklevel=2,
        )
    return np.array([horizontal.meters, horizontal.meters, vertical.meters])


def _read_keys(data: bytes) -> dict[int, int]:
    """Read the GeoKeys whose values are in the record itself."""
    numbers = np.frombuffer(data[: len(data) // 8 * 8], "<u2").reshape(-1, 4)[1:].tolist()
    return {key: value for key, location, _, value in numbers if location == 0}


def _units_of_keys(keys: Mapping[int, int]) -> tuple[_Unit, _Unit | None] | None:
    """Return the unit of x and y, and None for z, by GeoKeys; None where they say none."""
    if keys.get(MODEL_KEY) == GEOGRAPHIC:
        raise ValueError(f"x and y are degrees (GTModelTypeGeoKey 2); {REPROJECT}")
    code = keys.get(CRS_KEY)
    if HORIZONTAL_UNIT_KEY in keys:
        horizontal = _unit_of_code(keys[HORIZONTAL_UNIT_KEY])
    elif code is None:
        return None
    else:
        if not any(code in zones for zones in UTM_CODES):
            warnings.warn(
                f"LAS coordinates of EPSG:{code} without a unit (ProjLinearUnitsGeoKey) are taken for meters; if they "
                "are feet: --set recording.units=ft",
                stacklevel=3,
            )
        horizontal = _Unit("meter", 1.0)
    return horizontal, None


def _unit_of_code(code: int) -> _Unit:
    if code not in EPSG_UNITS:
        known = ", ".join(f"{code} ({name})" for code, (name, _) in EPSG_UNITS.items())
        raise ValueError(f"unit EPSG:{code} of its GeoKeys is unknown; known are {known}; {REPROJECT}")
    return _Unit(*EPSG_UNITS[code])


def _units_of_wkt(data: bytes) -> tuple[_Unit, _Unit | None] | None:
    """Return the units of x and y, and of z if it is stated, by WKT of version 1 or 2; None without any."""
    text = data.rstrip(b"\0").decode("utf-8", "replace")
    horizontal = vertical = None
    is_geographic = False
    for systems, unit in _list_units(text):
        if unit is None:
            is_geographic |= bool(GEOGRAPHIC_SYSTEMS & systems)
        elif VERTICAL_SYSTEMS & systems:
            vertical = unit
        elif PROJECTED_SYSTEMS & systems and not (GEOGRAPHIC_SYSTEMS | {"CONVERSION"}) & systems:
            horizontal = unit
    if horizontal is not None:
        return horizontal, vertical
    if is_geographic:
        raise ValueError(f"x and y are degrees (its WKT has a geographic coordinate system only); {REPROJECT}")
    return None


def _list_units(text: str) -> Iterator[tuple[set[str], _Unit | None]]:
    """Yield the length units of WKT with the keywords that they are inside of, and None for an angular unit."""
    inside: list[str] = []
    for token in re.finditer(r'"[^"]*"|([A-Za-z_]\w*)\s*[\[(]|[\])]', text):
        keyword = (token[1] or "").upper()
        if keyword:
            value = re.compile(r'\s*"([^"]*)"\s*,\s*([0-9.eE+-]+)').match(text, token.end())
            if keyword in ("UNIT", "LENGTHUNIT", "ANGLEUNIT") and value is not None:
                is_angle = keyword == "ANGLEUNIT" or value[1].lower() in ("degree", "radian", "grad")
                yield set(inside), None if is_angle else _Unit(value[1], float(value[2]))
            inside.append(keyword)
        elif token[0] in "])" and inside:
            inside.pop()


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


def read_las_scale(path: Path) -> NDArray[np.float64]:
    """Read how many meters a unit of x, y and z is, as a LAS or LAZ file says: (3,), 1 where it says nothing."""
    with path.open("rb") as file:
        return _read_scale(file, _header(file.read(HEADER_BYTES_1_4), path.stat().st_size))


def _read_scale(file: BinaryIO, header: _Header) -> NDArray[np.float64]:
    contents = _read_projection(file, *header.records, struct.Struct("<H16sHH32s"))
    contents |= _read_projection(file, *header.later_records, struct.Struct("<H16sHQ32s"))
    return _choose_scale(contents)


def read_las(path: Path) -> NDArray[np.float64]:
    """Read x y z of a LAS or LAZ file in meters, its scales, offsets and units applied."""
    size_bytes = path.stat().st_size
    with path.open("rb") as file:
        header = _header(file.read(HEADER_BYTES_1_4), size_bytes)
        meters = _read_scale(file, header)
        check_memory(header.points * (header.record_bytes + COORDINATE_BYTES))
        if header.compressed:
            _check_chunks(file, header, size_bytes)
    scale, offset_m = header.scale * meters, header.offset * meters
    if header.compressed:
        return _to_meters(laz_points(path, header.points)["xyz"], scale, offset_m)
    claimed_bytes = header.points * header.record_bytes
    if header.first_byte + claimed_bytes > size_bytes:
        raise ValueError(
            f"the header claims {header.points} points of {header.record_bytes} bytes from byte {header.first_byte} "
            f"on; the file has {size_bytes} bytes"
        )
    columns = np.dtype({"names": ["xyz"], "formats": [("<i4", 3)], "offsets": [0], "itemsize": header.record_bytes})
    points = np.fromfile(path, columns, header.points, offset=header.first_byte)
    return _to_meters(points["xyz"], scale, offset_m)


def _to_meters(
    stored: NDArray[np.int32], scale: NDArray[np.float64], offset_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Convert (N, 3) stored whole numbers; ValueError if a program cut off coordinates that do not fit into them."""
    bounds = np.iinfo(np.int32)
    cut_off = int(((stored == bounds.min) | (stored == bounds.max)).any(axis=1).sum())
    if cut_off:
        raise ValueError(
            f"{cut_off:,} of {len(stored):,} points have coordinates at an end of 32-bit whole numbers "
            f"({bounds.min} or {bounds.max}): the program that wrote the file cut them off; export it again with "
            "offsets near the points"
        )
    return np.asarray(stored * scale + offset_m)


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
