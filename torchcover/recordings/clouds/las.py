"""Survey clouds: LAS 1.0 to 1.4 with scales and units, and LAZ (compressed LAS), which laspy decompresses."""

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
from torchcover.recordings.isolated_readers import read_laz_points

# Header sizes of LAS 1.0 to 1.3 and of LAS 1.4.
HEADER_BYTES = 227
HEADER_BYTES_1_4 = 375
# GeoTIFF key of the unit of z.
VERTICAL_UNIT_KEY = 4099
# EPSG code of a unit with its name and length in meters.
EPSG_UNITS = {9001: ("meter", 1.0), 9002: ("foot", 0.3048), 9003: ("US survey foot", 1200 / 3937)}
REPROJECT = "reproject the file into a coordinate system in meters (pdal translate, las2las)"


class _Unit(NamedTuple):
    """Unit of length."""

    name: str
    meters: float


def _read_projection(file: BinaryIO, first_byte: int, count: int, header: struct.Struct) -> dict[int, bytes]:
    """Read the variable length records about the coordinate system, by their identifiers."""
    max_record_bytes = 1 << 16  # a record of text or keys is smaller
    contents: dict[int, bytes] = {}
    end_byte = file.seek(0, os.SEEK_END)
    for _ in range(count):
        if first_byte + header.size > end_byte:
            break
        file.seek(first_byte)
        _, user, identifier, length, _ = header.unpack(file.read(header.size))
        if user.rstrip(b"\0") == b"LASF_Projection" and length <= max_record_bytes:
            contents[identifier] = file.read(length)
        first_byte += header.size + length
    return contents


def _choose_scale(contents: Mapping[int, bytes]) -> NDArray[np.float64]:
    """Choose the length of a unit of x, y and z from the records about the coordinate system.

    Args:
        contents: Records by their identifiers; WKT takes precedence over GeoKeys.

    Returns:
        (3,) meters per unit; 1 without a statement.

    Raises:
        ValueError: Coordinates are degrees, or their unit is unknown.

    Warns:
        UserWarning: Coordinates are converted, or only a code without a unit is given.
    """
    wkt_record, geo_keys_record = contents.get(2112, b""), contents.get(34735, b"")  # identifiers of the LAS format
    numbers = np.frombuffer(geo_keys_record[: len(geo_keys_record) // 8 * 8], "<u2").reshape(-1, 4)[1:]
    keys = dict(numbers[numbers[:, 1] == 0][:, [0, 3]].tolist())  # keys whose values are in the record itself
    units = _find_wkt_units(wkt_record) or _find_geo_key_units(keys)
    if units is None:
        return np.ones(3)
    horizontal, vertical = units
    if vertical is None:
        vertical = _find_epsg_unit(keys[VERTICAL_UNIT_KEY]) if VERTICAL_UNIT_KEY in keys else horizontal
    if (horizontal.meters, vertical.meters) != (1.0, 1.0):
        warnings.warn(
            f"LAS coordinates are converted to meters, as the file says: x and y are in {horizontal.name}, z in "
            f"{vertical.name}; leave out recording.units",
            stacklevel=2,
        )
    return np.array([horizontal.meters, horizontal.meters, vertical.meters])


def _find_geo_key_units(keys: Mapping[int, int]) -> tuple[_Unit, _Unit | None] | None:
    """Find the unit of x and y, with None for z, in GeoKeys; None without a statement."""
    model_key, geographic_model, crs_key, horizontal_unit_key = 1024, 2, 3072, 3076  # numbers of GeoTIFF
    if keys.get(model_key) == geographic_model:
        raise ValueError(f"x and y are degrees (GTModelTypeGeoKey 2); {REPROJECT}")
    code = keys.get(crs_key)
    if horizontal_unit_key in keys:
        horizontal = _find_epsg_unit(keys[horizontal_unit_key])
    elif code is None:
        return None
    else:
        # UTM zones of WGS84, ETRS89 and NAD83 are in meters.
        if not (32601 <= code <= 32760 or 25828 <= code <= 25838 or 26901 <= code <= 26923):
            warnings.warn(
                f"LAS coordinates of EPSG:{code} without a unit (ProjLinearUnitsGeoKey) are read as meters; if they "
                "are feet: --set recording.units=ft",
                stacklevel=3,
            )
        horizontal = _Unit("meter", 1.0)
    return horizontal, None


def _find_epsg_unit(code: int) -> _Unit:
    """Find a unit by its EPSG code; an unknown code raises a ValueError."""
    if code not in EPSG_UNITS:
        known = ", ".join(f"{known_code} ({name})" for known_code, (name, _) in EPSG_UNITS.items())
        raise ValueError(f"unit EPSG:{code} of its GeoKeys is unknown; known are {known}; {REPROJECT}")
    return _Unit(*EPSG_UNITS[code])


def _find_wkt_units(data: bytes) -> tuple[_Unit, _Unit | None] | None:
    """Find the units of x and y, and of z if stated, in WKT of version 1 or 2; None without units."""
    projected_systems = {"PROJCS", "PROJCRS", "PROJECTEDCRS", "GEOCCS"}
    vertical_systems = {"VERT_CS", "VERTCRS", "VERTICALCRS"}
    geographic_systems = {"GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "BASEGEOGCRS", "BASEGEODCRS", "GEODCRS"}
    text = data.rstrip(b"\0").decode("utf-8", "replace")
    horizontal = vertical = None
    is_geographic = False
    for systems, unit in _list_units(text):
        if unit is None:
            is_geographic |= bool(geographic_systems & systems)
        elif vertical_systems & systems:
            vertical = unit
        elif projected_systems & systems and not (geographic_systems | {"CONVERSION"}) & systems:
            horizontal = unit
    if horizontal is not None:
        return horizontal, vertical
    if is_geographic:
        raise ValueError(f"x and y are degrees (its WKT has a geographic coordinate system only); {REPROJECT}")
    return None


def _list_units(text: str) -> Iterator[tuple[set[str], _Unit | None]]:
    """Yield each unit of WKT with the keywords that enclose it; None stands for an angular unit."""
    enclosing: list[str] = []
    for token in re.finditer(r'"[^"]*"|([A-Za-z_]\w*)\s*[\[(]|[\])]', text):
        keyword = (token[1] or "").upper()
        if keyword:
            value = re.compile(r'\s*"([^"]*)"\s*,\s*([0-9.eE+-]+)').match(text, token.end())
            if keyword in ("UNIT", "LENGTHUNIT", "ANGLEUNIT") and value is not None:
                is_angle = keyword == "ANGLEUNIT" or value[1].lower() in ("degree", "radian", "grad")
                yield set(enclosing), None if is_angle else _Unit(value[1], float(value[2]))
            enclosing.append(keyword)
        elif token[0] in "])" and enclosing:
            enclosing.pop()


class _Header(NamedTuple):
    """Header fields that locate and scale the points."""

    first_byte: int
    record_bytes: int
    points: int
    is_compressed: bool
    scale: NDArray[np.float64]
    offset: NDArray[np.float64]
    # First byte and number of the records before and after the points.
    records: tuple[int, int]
    extended_records: tuple[int, int]


def read_las_scale(path: Path) -> NDArray[np.float64]:
    """Read the length of a unit of x, y and z that a LAS or LAZ file states.

    Args:
        path: File.

    Returns:
        (3,) meters per unit; 1 without a statement.

    Raises:
        ValueError: The header is invalid, coordinates are degrees, or their unit is unknown.
    """
    with path.open("rb") as file:
        return _read_meters_per_unit(file, _parse_header(file.read(HEADER_BYTES_1_4), path.stat().st_size))


def _read_meters_per_unit(file: BinaryIO, header: _Header) -> NDArray[np.float64]:
    """Read the (3,) meters per unit from the records before and after the points."""
    contents = _read_projection(file, *header.records, struct.Struct("<H16sHH32s"))
    contents |= _read_projection(file, *header.extended_records, struct.Struct("<H16sHQ32s"))
    return _choose_scale(contents)


def read_las(path: Path) -> NDArray[np.float64]:
    """Read x y z of a LAS or LAZ file in meters and apply its scales, offsets and units.

    Args:
        path: File.

    Returns:
        (N, 3) points in meters.

    Raises:
        ValueError: The header is invalid, the file is truncated, or coordinates are degrees or cut off.
        ImportError: laspy is not installed and the file is a `.laz`.
    """
    size_bytes = path.stat().st_size
    with path.open("rb") as file:
        header = _parse_header(file.read(HEADER_BYTES_1_4), size_bytes)
        meters_per_unit = _read_meters_per_unit(file, header)
        coordinate_bytes = 72  # float64 copies during the conversion
        check_memory(header.points * (header.record_bytes + coordinate_bytes))
        if header.is_compressed:
            _check_chunks(file, header, size_bytes)
    scale, offset_m = header.scale * meters_per_unit, header.offset * meters_per_unit
    if header.is_compressed:
        return _to_meters(read_laz_points(path, header.points)["xyz"], scale, offset_m)
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
    """Convert (N, 3) stored integers to meters; coordinates that a program cut off to 32 bits raise a ValueError."""
    bounds = np.iinfo(np.int32)
    cut_off = int(((stored == bounds.min) | (stored == bounds.max)).any(axis=1).sum())
    if cut_off:
        raise ValueError(
            f"{cut_off:,} of {len(stored):,} points have coordinates at an end of 32-bit whole numbers "
            f"({bounds.min} or {bounds.max}): the program that wrote the file cut them off; export it again with "
            "offsets near the points"
        )
    return np.asarray(stored * scale + offset_m)


def _parse_header(data: bytes, size_bytes: int) -> _Header:
    """Parse and check the header of a file of `size_bytes`."""
    if not data.startswith(b"LASF"):
        raise ValueError(f"not a LAS file: it starts with {data[:4]!r}, not with b'LASF'")
    if len(data) < HEADER_BYTES:
        raise ValueError(f"a header of {HEADER_BYTES} bytes is needed; the file has {len(data)}")
    header_bytes, first_byte, records, point_format, record_bytes, points = struct.unpack_from("<HIIBHI", data, 94)
    numbers = np.frombuffer(data, "<f8", 6, offset=131)
    record_header_bytes, extended_header_bytes = 54, 60  # of records before and after the points
    extended_byte = extended_records = 0
    if (data[24], data[25]) >= (1, 4):
        if len(data) < HEADER_BYTES_1_4:
            raise ValueError(f"a header of {HEADER_BYTES_1_4} bytes is needed; the file has {len(data)}")
        extended_byte, extended_records, points = struct.unpack_from("<QIQ", data, 235)
        if extended_records and extended_byte + extended_header_bytes * extended_records > size_bytes:
            raise ValueError(
                f"{extended_records} records from byte {extended_byte} on are claimed; there is no room for them"
            )
    if header_bytes + record_header_bytes * records > first_byte or first_byte > size_bytes:
        raise ValueError(f"{records} records before the points, which start at byte {first_byte}, are impossible")
    if record_bytes < 20:
        raise ValueError(f"records of 20 bytes or more are needed; got {record_bytes}")
    if not (np.isfinite(numbers).all() and numbers[:3].all()):
        raise ValueError(f"finite scales, not 0, and finite offsets are needed; got {numbers.tolist()}")
    return _Header(
        first_byte,
        record_bytes,
        points,
        bool(point_format & 0x80),
        numbers[:3],
        numbers[3:],
        (header_bytes, records),
        (extended_byte, extended_records),
    )


def _check_chunks(file: BinaryIO, header: _Header, size_bytes: int) -> None:
    """Check the table of chunks, since the decompressor trusts its size and aborts without a table."""
    file.seek(header.first_byte)
    (table_byte,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
    if table_byte == -1:  # a program that writes to a stream stores the offset at the end
        file.seek(max(0, size_bytes - 8))
        (table_byte,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
    if not header.first_byte <= table_byte <= size_bytes - 8:
        raise ValueError(f"the table of chunks is claimed at byte {table_byte}; the file has {size_bytes} bytes")
    file.seek(table_byte)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks > header.points + 1:
        raise ValueError(f"the header claims {header.points} points, the table of chunks {chunks} chunks of them")
