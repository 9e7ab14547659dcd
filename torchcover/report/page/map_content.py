"""Maps for the script of a page, as JSON, with what lies over them, places to look at, and packed numbers of cells.

Only known cells are kept, with 16 bits each where a reader reads values and 8 where errors. A number x is kept as a
code on a scale that is even in x, or in log x where the largest is far above the least; 0 and infinity have codes of
their own. With 16 bits an even scale is exact to 1/131,000 of its span, and a logarithmic one to 0.02 % of each number
over nine decades.
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

# Beyond this ratio of the largest to the least, equal ratios are kept equally well.
WIDE_RATIO = 50.0
DECADES = 9
COMPRESSION = 6

# The array, its codes, which cells are known, and the scale, by which array it is and its bits.
CellCodes: TypeAlias = dict[tuple[int, int], tuple[NDArray[Any], bytes, bytes, Mapping[str, Any]]]


class CellBuffer:
    """Collects arrays of cells in one run of bytes; what is the same is kept once.

    Args:
        codes: What arrays were encoded to already, for another choice of them; more is added.
    """

    def __init__(self, codes: CellCodes | None = None) -> None:
        self.arrays: list[dict[str, Any]] = []
        self._codes: CellCodes = {} if codes is None else codes
        self._parts: list[bytes] = []
        self._length = 0
        self._at: dict[bytes, int] = {}
        self._kept: dict[int, int] = {}
        self._text = ""

    def add(self, values: NDArray[Any], num_bits: int) -> int:
        """Keep an array.

        `values`: (Y, X) numbers; NaN is unknown; `num_bits`: of each, 8 or 16. Returns its place in `arrays`.
        """
        if id(values) in self._kept:
            return self._kept[id(values)]
        key = id(values), num_bits
        if key not in self._codes:
            self._codes[key] = values, *pack_cells(values, num_bits)  # held, so that no other object is at its place
        _, planes, mask, scale = self._codes[key]
        where = {"at": self._place(planes), "mask": self._place(mask)}
        self.arrays.append({**where, "count": 8 * len(planes) // num_bits, "bits": num_bits, **scale})
        self._kept[id(values)] = len(self.arrays) - 1
        return len(self.arrays) - 1

    @property
    def text(self) -> str:
        """All of it, deflated (zlib), as base64."""
        if not self._text:
            self._text = base64.b64encode(zlib.compress(b"".join(self._parts), COMPRESSION)).decode("ascii")
        return self._text

    def _place(self, content: bytes) -> int:
        if content not in self._at:
            self._at[content] = self._length
            self._parts.append(content)
            self._length += len(content)
            self._text = ""
        return self._at[content]


def pack_cells(values: NDArray[Any], num_bits: int) -> tuple[bytes, bytes, Mapping[str, Any]]:
    """The codes of known cells, high bytes first; which are known, a bit each; and the scale of the codes."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    known = ~np.isnan(flat)
    codes, scale = encode_values(flat[known], num_bits)
    planes = (codes & 255).astype(np.uint8).tobytes()
    if num_bits > 8:
        planes = (codes >> 8).astype(np.uint8).tobytes() + planes
    return planes, np.packbits(known, bitorder="little").tobytes(), scale


def encode_values(values: NDArray[np.float64], num_bits: int) -> tuple[NDArray[np.uint16], Mapping[str, Any]]:
    """Codes of numbers that are not NaN, and what a reader needs to have them back (`cells.js`)."""
    top = 2**num_bits - 1
    endless, nothing = np.isposinf(values), values == 0
    usual = values[np.isfinite(values) & ~nothing]
    low, high = (float(usual.min()), float(usual.max())) if len(usual) else (0.0, 1.0)
    logarithmic = low > 0 and high > WIDE_RATIO * low
    if logarithmic:
        low = max(low, high * 10.0**-DECADES)
    bend = np.log if logarithmic else np.positive
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (bend(np.clip(values, low, high)) - bend(low)) / ((bend(high) - bend(low)) or 1.0)
    codes = 1 + np.rint((top - 2) * share)
    codes = np.where(endless, top, np.where(nothing, 0, codes)).astype(np.uint16)
    return codes, {"log": bool(logarithmic), "low": low, "high": high}


# The near field, in lengths of the ego to all sides.
NEAR, NEAR_LENGTHS = "near the ego", 2.0
BESIDE = "beside the ego"
# JSON knows no infinity; beyond every map all ranges are alike.
FARTHEST_M = 2000.0
# Corners of the field of view of a tilted sensor: one every 2 degrees.
OUTLINE_POINTS = 181


def build_map_content(page: Page, cells: CellBuffer) -> dict[str, Any]:
    """What the script reads."""
    rasters: dict[tuple[Any, ...], list[PageMap]] = {}
    for one in page.maps:
        rasters.setdefault((one.x, one.y, one.cell_m), []).append(one)
    places = list(rasters)
    names = {scale.colormap for one in page.maps for scale in (one.scale, one.difference_scale) if scale}
    return {
        "maps": [_map(one, places.index((one.x, one.y, one.cell_m)), cells) for one in page.maps],
        "arrays": cells.arrays,
        "rasters": [_raster(maps) for maps in rasters.values()],
        "luts": {name: _lut(name) for name in sorted(names)},
        "rigs": [{"name": rig.name, "sensors": [_sensor(view) for view in rig.sensors]} for rig in page.rigs],
        "ego": None if page.ego_outline_m is None else _points(page.ego_outline_m),
        "outlines": _lines(page.outlines),
        "views": _views(page),
    }


def _map(one: PageMap, raster: int, cells: CellBuffer) -> dict[str, Any]:
    return {
        "quantity": one.quantity,
        "band": one.band,
        "rig": one.rig,
        "raster": raster,
        "unknown": one.unobserved_label,
        **add_arrays(one, cells),
        "weight_name": one.weight_name,
        "full": one.opaque_weight,
        "scale": _scale(one.scale),
        "difference": None if one.difference_scale is None else _scale(one.difference_scale),
        "lines": _lines(one.lines),
    }


def add_arrays(page_map: PageMap, cells: CellBuffer) -> dict[str, int | None]:
    """Its numbers, as places in the arrays of the cells."""
    bits = {"values": page_map.num_bits, "errors": 8, "weights": page_map.num_bits, "sides": 8}
    arrays = {name: getattr(page_map, name) for name in bits}
    return {name: None if array is None else cells.add(array, bits[name]) for name, array in arrays.items()}


def _raster(maps: Sequence[PageMap]) -> dict[str, Any]:
    """Where its cells are, and where any is known."""
    first = maps[0]
    rows, columns = first.values.shape
    known = np.any([~np.isnan(one.values) for one in maps], axis=0)
    across, along = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    bounds = [
        [low + first.cell_m * float(at[0]), low + first.cell_m * float(at[-1] + 1)] if len(at) else list(whole)
        for whole, low, at in ((first.x, first.x[0], along), (first.y, first.y[0], across))
    ]
    known_x, known_y = bounds
    return {
        "x": first.x,
        "y": first.y,
        "cell": first.cell_m,
        "rows": rows,
        "columns": columns,
        "known": {"x": known_x, "y": known_y},
    }


def _views(page: Page) -> list[dict[str, Any]]:
    """Places to look at: what was asked for, and near the ego as far as there are cells."""
    views = [(line.name, line.points_m) for line in page.outlines]
    if page.ego_outline_m is not None:
        low, high = page.ego_outline_m.min(axis=0), page.ego_outline_m.max(axis=0)
        reach = NEAR_LENGTHS * (high[0] - low[0])
        views.insert(0, (NEAR, np.array([low - reach, high + reach])))
    if page.maps:  # which is what is told of, and may be of a part of what others show
        views.insert(0, (BESIDE, np.array([page.maps[0].x, page.maps[0].y]).T))
    ends = np.array([[(one.x[0], one.y[0]), (one.x[1], one.y[1])] for one in page.maps])
    found = []
    for name, points_m in views if page.maps else ():
        low = np.maximum(points_m.min(axis=0), ends[:, 0].min(axis=0))
        high = np.minimum(points_m.max(axis=0), ends[:, 1].max(axis=0))
        whole = name == BESIDE and (low <= ends[:, 0].min(axis=0)).all() and (high >= ends[:, 1].max(axis=0)).all()
        if (low < high).all() and not whole:
            found.append({"name": name, "x": [low[0], high[0]], "y": [low[1], high[1]]})
    return found


def _lines(lines: Iterable[MapLine]) -> list[dict[str, Any]]:
    return [{"name": line.name, "points": _points(line.points_m)} for line in lines]


def _points(points_m: Array) -> list[list[float | None]]:
    return [[None if np.isnan(value) else round(float(value), 4) for value in point] for point in points_m]


def _scale(scale: ColorScale) -> dict[str, Any]:
    return {
        "quantity": scale.quantity,
        "unit": scale.unit,
        "colours": scale.colormap,
        "low": scale.low,
        "high": scale.high,
        "log": scale.logarithmic,
    }


def _lut(name: str) -> str:
    """256 colours, six hexadecimal digits each."""
    colours = colormaps[name](np.linspace(0, 1, 256), bytes=True)[:, :3]
    return bytes(colours.ravel().tolist()).hex()


def _sensor(view: SensorView) -> dict[str, Any]:
    """A sensor with its field of view from above: an arc, or the outline of a tilted sensor."""
    place = {"x": view.x_m, "y": view.y_m}
    if view.is_tilted:
        return {**place, "outline": _points(view.compute_outline_m(FARTHEST_M, num_points=OUTLINE_POINTS).round(2))}
    return {
        **place,
        "yaw": view.yaw_deg,
        "wide": view.horizontal_fov_deg,
        "range": view.compute_level_range_m(FARTHEST_M),
    }
