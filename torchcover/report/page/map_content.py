"""Maps for the script of a page: JSON with lines and views, and packed numbers of cells.

Only observed cells are stored, with 16 bits for values and 8 bits for errors. A number is stored as a code on a scale
that is linear, or logarithmic if the largest number is far above the smallest; 0 and infinity have codes of their own.
With 16 bits a linear scale is exact to 1/131,000 of its range, and a logarithmic one to 0.02 % of each number over nine
decades.
"""

import base64
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from torchcover.report.colors import ColorScale
from torchcover.report.overlay import SensorView
from torchcover.report.page.content import Array, MapLine, Page, PageMap

# Identity of an array and number of bits -> the array, its codes, its mask of observed cells, and its scale.
CellCodes: TypeAlias = dict[tuple[int, int], tuple[NDArray[Any], bytes, bytes, Mapping[str, Any]]]


class CellBuffer:
    """Buffer of arrays of cells in which equal arrays are stored once.

    Args:
        codes: Codes of arrays that were encoded before; new codes are added.
    """

    def __init__(self, codes: CellCodes | None = None) -> None:
        self.arrays: list[dict[str, Any]] = []
        self._codes: CellCodes = {} if codes is None else codes
        self._parts: list[bytes] = []
        self._length = 0
        self._offsets: dict[bytes, int] = {}
        self._indices: dict[int, int] = {}
        self._text = ""

    def add(self, values: NDArray[Any], num_bits: int) -> int:
        """Add an array.

        Args:
            values: (Y, X) numbers; NaN is unobserved.
            num_bits: Bits of each number, 8 or 16.

        Returns:
            Index in `arrays`.
        """
        if id(values) in self._indices:
            return self._indices[id(values)]
        key = id(values), num_bits
        if key not in self._codes:
            # A reference to the array guarantees that no other object gets its identity.
            self._codes[key] = values, *pack_cells(values, num_bits)
        _, planes, mask, scale = self._codes[key]
        offsets = {"offset": self._append(planes), "mask": self._append(mask)}
        self.arrays.append({**offsets, "count": 8 * len(planes) // num_bits, "bits": num_bits, **scale})
        self._indices[id(values)] = len(self.arrays) - 1
        return len(self.arrays) - 1

    @property
    def text(self) -> str:
        """Content of the buffer, compressed by zlib, as base64."""
        if not self._text:
            self._text = base64.b64encode(zlib.compress(b"".join(self._parts), 6)).decode("ascii")
        return self._text

    def _append(self, content: bytes) -> int:
        """Append bytes unless they are already there, and return their offset."""
        if content not in self._offsets:
            self._offsets[content] = self._length
            self._parts.append(content)
            self._length += len(content)
            self._text = ""
        return self._offsets[content]


def pack_cells(values: NDArray[Any], num_bits: int) -> tuple[bytes, bytes, Mapping[str, Any]]:
    """Encode the observed cells of an array.

    Args:
        values: (Y, X) numbers; NaN is unobserved.
        num_bits: Bits of each number, 8 or 16.

    Returns:
        Codes of observed cells, high bytes first; mask of observed cells, one bit each; and the scale of the codes.
    """
    flat = np.asarray(values, dtype=np.float64).ravel()
    is_observed = ~np.isnan(flat)
    codes, scale = encode_values(flat[is_observed], num_bits)
    planes = (codes & 255).astype(np.uint8).tobytes()
    if num_bits > 8:
        planes = (codes >> 8).astype(np.uint8).tobytes() + planes
    return planes, np.packbits(is_observed, bitorder="little").tobytes(), scale


def encode_values(values: NDArray[np.float64], num_bits: int) -> tuple[NDArray[np.uint16], Mapping[str, Any]]:
    """Encode numbers; `cells.js` decodes them.

    Args:
        values: Numbers without NaN.
        num_bits: Bits of each number, 8 or 16.

    Returns:
        uint16 codes, and the scale: 0 and infinity have the first and the last code.
    """
    top = 2**num_bits - 1
    is_infinite, is_zero = np.isposinf(values), values == 0
    scaled = values[np.isfinite(values) & ~is_zero]
    low, high = (float(scaled.min()), float(scaled.max())) if len(scaled) else (0.0, 1.0)
    is_logarithmic = low > 0 and high > 50.0 * low  # equal relative errors matter over a wide range
    if is_logarithmic:
        low = max(low, high * 1e-9)
    transform = np.log if is_logarithmic else np.positive
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = transform(np.clip(values, low, high)) - transform(low)
        fraction = fraction / ((transform(high) - transform(low)) or 1.0)
    codes = 1 + np.rint((top - 2) * fraction)
    codes = np.where(is_infinite, top, np.where(is_zero, 0, codes)).astype(np.uint16)
    return codes, {"is_logarithmic": bool(is_logarithmic), "low": low, "high": high}


MAX_RANGE_M = 2000.0  # JSON has no infinity; beyond the maps all ranges look the same


def build_map_content(page: Page, cells: CellBuffer) -> dict[str, Any]:
    """Build the JSON that the script of a page reads.

    Args:
        page: Content of the page.
        cells: Buffer to which the arrays of the maps are added.
    """
    rasters: dict[tuple[Any, ...], list[PageMap]] = {}
    colormap_names: set[str] = set()
    for page_map in page.maps:
        rasters.setdefault((page_map.x, page_map.y, page_map.cell_m), []).append(page_map)
        colormap_names |= {scale.colormap for scale in (page_map.scale, page_map.difference_scale) if scale}
    raster_keys = list(rasters)
    maps = []
    for page_map in page.maps:
        raster = raster_keys.index((page_map.x, page_map.y, page_map.cell_m))
        maps.append(_build_map(page_map, raster, cells))
    rigs = []
    for rig in page.rigs:
        rigs.append({"name": rig.name, "sensors": [_build_sensor(view) for view in rig.sensors]})
    return {
        "maps": maps,
        "arrays": cells.arrays,
        "rasters": [_build_raster(raster_maps) for raster_maps in rasters.values()],
        "luts": {name: _build_lookup_table(name) for name in sorted(colormap_names)},
        "rigs": rigs,
        "ego": None if page.ego_outline_m is None else _round_points(page.ego_outline_m),
        "outlines": _build_lines(page.outlines),
        "views": _build_views(page),
    }


def _build_map(page_map: PageMap, raster: int, cells: CellBuffer) -> dict[str, Any]:
    """Build the record of one map with offsets into the packed cells."""
    return {
        "quantity": page_map.quantity,
        "band": page_map.band,
        "rig": page_map.rig,
        "raster": raster,
        "unobserved_label": page_map.unobserved_label,
        **add_arrays(page_map, cells),
        "weight_name": page_map.weight_name,
        "opaque_weight": page_map.opaque_weight,
        "scale": _build_scale(page_map.scale),
        "difference_scale": None if page_map.difference_scale is None else _build_scale(page_map.difference_scale),
        "lines": _build_lines(page_map.lines),
    }


def add_arrays(page_map: PageMap, cells: CellBuffer) -> dict[str, int | None]:
    """Add the arrays of a map to a buffer.

    Args:
        page_map: The map.
        cells: The buffer.

    Returns:
        Name of each array -> its index in the buffer; None if the map has no such array.
    """
    arrays = {
        "values": (page_map.values, page_map.num_bits),
        "errors": (page_map.errors, 8),
        "weights": (page_map.weights, page_map.num_bits),
        "sides": (page_map.sides, 8),
    }
    return {name: None if array is None else cells.add(array, num_bits) for name, (array, num_bits) in arrays.items()}


def _build_raster(maps: Sequence[PageMap]) -> dict[str, Any]:
    """Build the description of the raster that maps share, with the bounds of its observed cells."""
    first = maps[0]
    rows, columns = first.values.shape
    is_observed = np.any([~np.isnan(page_map.values) for page_map in maps], axis=0)
    return {
        "x": first.x,
        "y": first.y,
        "cell_m": first.cell_m,
        "rows": rows,
        "columns": columns,
        "observed_bounds": {
            "x": _find_observed_bounds(is_observed.any(axis=0), first.x, first.cell_m),
            "y": _find_observed_bounds(is_observed.any(axis=1), first.y, first.cell_m),
        },
    }


def _find_observed_bounds(is_observed: NDArray[np.bool_], bounds: tuple[float, float], cell_m: float) -> list[float]:
    """Find the outer edges of observed rows or columns in meters; all bounds if there are none."""
    indices = np.flatnonzero(is_observed)
    if not len(indices):
        return list(bounds)
    return [bounds[0] + cell_m * float(indices[0]), bounds[0] + cell_m * float(indices[-1] + 1)]


def _build_views(page: Page) -> list[dict[str, Any]]:
    """Build the views of the menu: near field, two vehicle lengths around the ego vehicle, and the regions."""
    if not page.maps:
        return []
    lows = np.array([(page_map.x[0], page_map.y[0]) for page_map in page.maps]).min(axis=0)
    highs = np.array([(page_map.x[1], page_map.y[1]) for page_map in page.maps]).max(axis=0)
    near_field = "near field"  # bounds of the first map, of which the findings speak
    named_points = [(near_field, np.array([page.maps[0].x, page.maps[0].y]).T)]
    if page.ego_outline_m is not None:
        low, high = page.ego_outline_m.min(axis=0), page.ego_outline_m.max(axis=0)
        distance = 2.0 * (high[0] - low[0])
        named_points.append(("two vehicle lengths", np.array([low - distance, high + distance])))
    named_points += [(line.name, line.points_m) for line in page.outlines]
    views = []
    for name, points_m in named_points:
        low = np.maximum(points_m.min(axis=0), lows)
        high = np.minimum(points_m.max(axis=0), highs)
        is_everything = name == near_field and (low <= lows).all() and (high >= highs).all()
        if (low < high).all() and not is_everything:
            views.append({"name": name, "x": [low[0], high[0]], "y": [low[1], high[1]]})
    return views


def _build_lines(lines: Iterable[MapLine]) -> list[dict[str, Any]]:
    """Build the records of named lines."""
    return [{"name": line.name, "points": _round_points(line.points_m)} for line in lines]


def _round_points(points_m: Array) -> list[list[float | None]]:
    """Round points to 0.1 mm; NaN, which separates lines, becomes None."""
    rounded = []
    for point in points_m:
        rounded.append([None if np.isnan(value) else round(float(value), 4) for value in point])
    return rounded


def _build_scale(scale: ColorScale) -> dict[str, Any]:
    """Build the record of a color scale."""
    return {
        "quantity": scale.quantity,
        "unit": scale.unit,
        "colormap": scale.colormap,
        "low": scale.low,
        "high": scale.high,
        "is_logarithmic": scale.logarithmic,
    }


def _build_lookup_table(name: str) -> str:
    """Return 256 colors of a colormap, six hexadecimal digits each."""
    colors = colormaps[name](np.linspace(0, 1, 256), bytes=True)[:, :3]
    return bytes(colors.ravel().tolist()).hex()


def _build_sensor(view: SensorView) -> dict[str, Any]:
    """Build a sensor with its field of view in bird's-eye view: an arc, or the outline of a tilted sensor."""
    position = {"x": view.x_m, "y": view.y_m}
    if view.is_tilted:
        outline_m = view.compute_outline_m(MAX_RANGE_M, num_points=181)  # a corner every 2 degrees
        return {**position, "outline": _round_points(outline_m.round(2))}
    return {
        **position,
        "yaw_deg": view.yaw_deg,
        "horizontal_fov_deg": view.horizontal_fov_deg,
        "range_m": view.compute_level_range_m(MAX_RANGE_M),
    }
