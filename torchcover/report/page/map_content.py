"""What the script of a page reads: maps, what lies over them, and the places to look at, for JSON."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps

from torchcover.report.maps.colours import ColourScale
from torchcover.report.maps.overlay import SensorView
from torchcover.report.page.codes import CellBytes
from torchcover.report.page.content import Array, Line, Page, PageMap

# The near field, in lengths of the ego to all sides.
NEAR, NEAR_LENGTHS = "near the ego", 2.0
BESIDE = "beside the ego"
# JSON knows no infinity; beyond every map all ranges are alike.
FARTHEST_M = 1e6


def map_content(page: Page, cells: CellBytes) -> dict[str, Any]:
    """What the script reads."""
    rasters: dict[tuple[Any, ...], list[PageMap]] = {}
    for one in page.maps:
        rasters.setdefault((one.x, one.y, one.cell_m), []).append(one)
    places = list(rasters)
    names = {scale.colormap for one in page.maps for scale in (one.scale, one.difference) if scale}
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


def _map(one: PageMap, raster: int, cells: CellBytes) -> dict[str, Any]:
    return {
        "quantity": one.quantity,
        "band": one.band,
        "rig": one.rig,
        "raster": raster,
        "unknown": one.unknown,
        **arrays_of(one, cells),
        "weight_name": one.weight_name,
        "full": one.full_weight,
        "scale": _scale(one.scale),
        "difference": None if one.difference is None else _scale(one.difference),
        "lines": _lines(one.lines),
    }


def arrays_of(one: PageMap, cells: CellBytes) -> dict[str, int | None]:
    """Its numbers, as places in the arrays of the cells."""
    bits = {"values": one.bits, "errors": 8, "weights": one.bits, "sides": 8}
    arrays = {name: getattr(one, name) for name in bits}
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


def _lines(lines: Iterable[Line]) -> list[dict[str, Any]]:
    return [{"name": line.name, "points": _points(line.points_m)} for line in lines]


def _points(points_m: Array) -> list[list[float | None]]:
    return [[None if np.isnan(value) else round(float(value), 4) for value in point] for point in points_m]


def _scale(scale: ColourScale) -> dict[str, Any]:
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
    reach = min(float(view.range_m), FARTHEST_M)
    return {"x": view.x_m, "y": view.y_m, "yaw": view.yaw_deg, "wide": view.horizontal_fov_deg, "range": reach}
