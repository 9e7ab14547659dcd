"""Clouds in Stanford's `.ply`: the vertices, ASCII or binary.

NumPy parses them instead of trimesh, which accepts truncated ASCII files without a warning, rejects binary files with
triangles and quads although their vertices are valid, and rounds ASCII coordinates to float32.
"""

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from torchcover.files import check_memory
from torchcover.recordings.clouds.arrays import Points, check_trailing_bytes
from torchcover.recordings.clouds.text import AXES, parse_rows, read_lines

BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Type names of the first specification, and names with a size (CARLA writes float32).
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass
class _Element:
    """Element of a PLY file with the types of its properties."""

    name: str
    rows: int
    types: dict[str, str] = field(default_factory=dict)
    has_list: bool = False

    @property
    def row_bytes(self) -> int:
        """Bytes of one row; a lower bound with a list, of which only the length counts."""
        return sum(np.dtype(type_code).itemsize for type_code in self.types.values())


def read_ply(path: Path) -> Points:
    """Read x y z of the element `vertex` of a PLY file.

    Args:
        path: File.

    Returns:
        (N, 3) points, float32 or float64 as stored, float64 from ASCII.

    Raises:
        ValueError: The header is invalid, coordinates are missing, or the file is shorter than its header claims.
    """
    check_memory(4 * path.stat().st_size)
    encoding, elements, body = _parse_header(path.read_bytes())
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError(f"no element vertex among the elements: {', '.join(names) or 'none'}")
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    _check_vertex(vertex)
    if encoding == "ascii":
        return _parse_ascii(elements, before, vertex, body)
    if any(element.has_list for element in before):
        raise ValueError("a binary element with a list stands before the vertices; store the vertices first")
    claimed_bytes = sum(element.rows * element.row_bytes for element in elements)
    _check_size(elements, claimed_bytes, len(body), "bytes")
    if not any(element.has_list for element in elements):
        check_trailing_bytes(body[claimed_bytes:])
    dtype = np.dtype([(name, BYTE_ORDERS[encoding] + type_code) for name, type_code in vertex.types.items()])
    offset_bytes = sum(element.rows * element.row_bytes for element in before)
    table = np.frombuffer(body, dtype, vertex.rows, offset_bytes)
    return np.column_stack([table[axis] for axis in AXES])


def _parse_ascii(elements: list[_Element], before: list[_Element], vertex: _Element, body: bytes) -> Points:
    """Parse the rows of vertices after those of the elements before them."""
    rows, claimed = sum(1 for _ in read_lines(body)), sum(element.rows for element in elements)
    _check_size(elements, claimed, rows, "rows")
    if rows > claimed:
        raise ValueError(f"the header claims {claimed} rows; {rows} rows follow it")
    if vertex.rows == 0:
        return np.empty((0, 3))
    first = sum(element.rows for element in before)
    properties = list(vertex.types)
    columns = [properties.index(axis) for axis in AXES]
    return parse_rows(islice(read_lines(body), first, first + vertex.rows), columns, len(properties))


def _parse_header(data: bytes) -> tuple[str, list[_Element], bytes]:
    """Parse encoding and elements; return them with the bytes that follow the header."""
    if data[:5].split()[:1] != [b"ply"]:
        raise ValueError(f"not a PLY file: it starts with {data[:12]!r}, not with a line ply")
    encoding = ""
    elements: list[_Element] = []
    max_header_bytes = 65536  # bounds the search for end_header in other files
    max_digits = 18  # fits into int64
    end = data.find(b"\n") + 1
    while True:
        start, end = end, data.find(b"\n", end, max_header_bytes) + 1
        if end == 0:
            raise ValueError("the PLY header has no end: a line end_header is missing")
        words = data[start:end].decode("ascii", "replace").split()
        match words:
            case ["end_header"]:
                break
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", encoding, _]:
                pass
            case ["element", name, rows] if rows.isascii() and rows.isdigit() and len(rows) <= max_digits:
                elements.append(_Element(name, int(rows)))
            case ["property", *declaration] if elements:
                _add_property(elements[-1], declaration)
            case _:
                raise ValueError(f"not a line of a PLY header: {' '.join(words)[:80]!r}")
    if encoding not in BYTE_ORDERS:
        raise ValueError(f"the PLY format is {encoding!r}; allowed are {', '.join(BYTE_ORDERS)}")
    return encoding, elements, data[end:]


def _add_property(element: _Element, declaration: list[str]) -> None:
    """Add a property line of the header to an element."""
    match declaration:
        case ["list", length_type, item_type, name] if length_type in TYPES and item_type in TYPES:
            element.types[name] = TYPES[length_type]
            element.has_list = True
        case [type_name, name] if type_name in TYPES and name not in element.types:
            element.types[name] = TYPES[type_name]
        case _:
            raise ValueError(
                f"element {element.name}: property {' '.join(declaration)[:80]!r} is repeated or of no known type; "
                f"types are {', '.join(TYPES)}"
            )


def _check_vertex(vertex: _Element) -> None:
    """Check that vertices have floating-point coordinates and no lists."""
    missing = sorted(set(AXES) - vertex.types.keys())
    if missing:
        raise ValueError(f"the vertices have no {', '.join(missing)}; got {', '.join(vertex.types) or 'nothing'}")
    if vertex.has_list:
        raise ValueError("the vertices have a list property; only single values are read")
    type_codes = {vertex.types[axis] for axis in AXES}
    if not type_codes <= {"f4", "f8"}:
        raise ValueError(f"x y z have to be float or double; got {', '.join(sorted(type_codes))}")


def _check_size(elements: list[_Element], claimed: int, available: int, unit: str) -> None:
    """Check that at least the claimed rows or bytes are available."""
    if claimed > available:
        counts = ", ".join(f"{element.rows} of {element.name}" for element in elements)
        raise ValueError(
            f"truncated: the header claims {counts}, at least {claimed} {unit}; {available} {unit} follow it"
        )
