"""Length units of LAS files: GeoKeys and well-known text (WKT) of the coordinate reference system."""

import os
import re
import struct
import warnings
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class LasRecord(NamedTuple):
    """Where the content of a variable length record is in the file."""

    identifier: int
    first_byte: int
    bytes: int


def list_records(file: BinaryIO, first_byte: int, count: int, *, extended: bool) -> Iterator[LasRecord]:
    """Yield the records about the coordinate system.

    Args:
        file: A LAS file.
        first_byte: Where the first header of a record is.
        count: Number of records.
        extended: Whether they are extended ones, which follow the points.

    Yields:
        Each record of `LASF_Projection`.
    """
    layout = struct.Struct("<H16sHQ32s" if extended else "<H16sHH32s")
    file_bytes = file.seek(0, os.SEEK_END)
    for _ in range(count):
        if first_byte + layout.size > file_bytes:
            return
        file.seek(first_byte)
        _, user, identifier, length, _ = layout.unpack(file.read(layout.size))
        first_byte += layout.size
        if user.rstrip(b"\0") == PROJECTION and length <= MAX_RECORD_BYTES:
            yield LasRecord(identifier, first_byte, length)
        first_byte += length


def read_scale(file: BinaryIO, records: list[LasRecord]) -> NDArray[np.float64]:
    """Return how many meters a unit of x, y and z is, of a file that may say it by WKT or GeoKeys.

    Args:
        file: A LAS file.
        records: Its records about the coordinate system.

    Returns:
        (3,) factors: 1 where nothing is said.

    Raises:
        ValueError: Degrees, or an unknown unit.

    Warns:
        UserWarning: Coordinates are converted, or only a code is given that does not say the unit.
    """
    contents = {}
    for record in records:
        file.seek(record.first_byte)
        contents[record.identifier] = file.read(record.bytes)
    units = _units_of_wkt(contents.get(WKT_RECORD, b"")) or _units_of_keys(contents.get(GEO_KEYS_RECORD, b""))
    if units is None:
        return np.ones(3)
    horizontal, vertical = units
    if (horizontal.meters, vertical.meters) != (1.0, 1.0):
        warnings.warn(
            f"LAS coordinates are converted to meters, as the file says: x and y are in {horizontal.name}, z in "
            f"{vertical.name}; give no recording.units",
            stacklevel=2,
        )
    return np.array([horizontal.meters, horizontal.meters, vertical.meters])


def _units_of_keys(data: bytes) -> tuple[_Unit, _Unit] | None:
    """Return the units of x and y, and of z, by GeoKeys; None where they say none."""
    numbers = np.frombuffer(data[: len(data) // 8 * 8], "<u2").reshape(-1, 4)[1:].tolist()
    keys = {key: value for key, location, _, value in numbers if location == 0}
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
    return horizontal, _unit_of_code(keys[VERTICAL_UNIT_KEY]) if VERTICAL_UNIT_KEY in keys else horizontal


def _unit_of_code(code: int) -> _Unit:
    if code not in EPSG_UNITS:
        known = ", ".join(f"{code} ({name})" for code, (name, _) in EPSG_UNITS.items())
        raise ValueError(f"unit EPSG:{code} of its GeoKeys is unknown; known are {known}; {REPROJECT}")
    return _Unit(*EPSG_UNITS[code])


def _units_of_wkt(data: bytes) -> tuple[_Unit, _Unit] | None:
    """Return the units of x and y, and of z, by WKT of version 1 or 2; None without any."""
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
        return horizontal, vertical or horizontal
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
