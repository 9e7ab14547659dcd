"""A page as one HTML file: nothing is loaded from anywhere, and every name is text."""

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
from matplotlib import colormaps

from torchcover.report.maps.colours import ColourScale
from torchcover.report.maps.overlay import SensorView
from torchcover.report.page.codes import CellBytes
from torchcover.report.page.content import Array, Line, Page, PageMap, PageRig, PageTable
from torchcover.report.page.rig_drawing import rig_drawing, sensor_table
from torchcover.report.renderers.layout import Words

SCRIPTS = ("cells.js", "map.js", "page.js", "controls.js")
VALUE_BITS, ERROR_BITS = 16, 8
# The near field, in lengths of the ego to all sides.
NEAR_LENGTHS = 2.0


def page_html(page: Page) -> str:
    """The text of the file.

    Args:
        page: What it shows.
    """
    cells = CellBytes()
    content = as_json(_content(page, cells))
    script = "\n".join(map(_file, SCRIPTS))
    return Template(_file("page.html")).substitute(
        title=escape(page.title),
        lead=escape(page.lead),
        style=_file("page.css"),
        script_hash=script_hash(script),
        tables="\n".join(map(table_html, page.tables)),
        rigs_heading="Rigs" if len(page.rigs) > 1 else "Rig",
        rigs="\n".join(_rig(rig, page.ego_outline_m, at) for at, rig in enumerate(page.rigs)),
        facts="\n".join(_facts(heading, facts) for heading, facts in page.facts.items()),
        more_tables="\n".join(map(table_html, page.more_tables)),
        content=content,
        cells=cells.text(),
        script=script,
    )


def as_json(content: object) -> str:
    r"""JSON that ends no script and opens no comment, whatever its names are.

    Example:
        >>> print(as_json({"rig": "</script>"}))
        {"rig":"\u003c/script\u003e"}
    """
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def script_hash(script: str) -> str:
    """What the page's policy calls the only script that may run."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"


@cache
def _file(name: str) -> str:
    return files("torchcover.report.page").joinpath(name).read_text(encoding="utf-8")


def _content(page: Page, cells: CellBytes) -> dict[str, Any]:
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
        "values": cells.add(one.values, VALUE_BITS),
        "errors": None if one.errors is None else cells.add(one.errors, ERROR_BITS),
        "weights": None if one.weights is None else cells.add(one.weights, VALUE_BITS),
        "weight_name": one.weight_name,
        "full": one.full_weight,
        "sides": None if one.sides is None else cells.add(one.sides, ERROR_BITS),
        "scale": _scale(one.scale),
        "difference": None if one.difference is None else _scale(one.difference),
        "lines": _lines(one.lines),
    }


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
    """Places to look at: what was asked for, and near the ego."""
    views = [(line.name, line.points_m) for line in page.outlines]
    if page.ego_outline_m is not None:
        low, high = page.ego_outline_m.min(axis=0), page.ego_outline_m.max(axis=0)
        reach = NEAR_LENGTHS * (high[0] - low[0])
        views.insert(0, ("near the ego", np.array([low - reach, high + reach])))
    each = [(name, np.asarray(points).min(axis=0), np.asarray(points).max(axis=0)) for name, points in views]
    return [
        {"name": name, "x": [float(low[0]), float(high[0])], "y": [float(low[1]), float(high[1])]}
        for name, low, high in each
    ]


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
    }


def _lut(name: str) -> str:
    """256 colours, six hexadecimal digits each."""
    colours = colormaps[name](np.linspace(0, 1, 256), bytes=True)[:, :3]
    return bytes(colours.ravel().tolist()).hex()


def _sensor(view: SensorView) -> dict[str, Any]:
    # JSON knows no infinity; beyond every map all ranges are alike.
    reach = min(float(view.range_m), 1e6)
    return {"x": view.x_m, "y": view.y_m, "yaw": view.yaw_deg, "wide": view.horizontal_fov_deg, "range": reach}


def table_html(table: PageTable) -> str:
    """A table, with its notes below."""
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    kinds = ["" if at < table.words_first else "number" for at in range(len(table.headings))]
    pairs = zip(kinds, table.headings, strict=True)
    head = "".join(f'<th scope="col" class="{kind}">{_broken(heading)}</th>' for kind, heading in pairs)
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, kinds))}</tr>" for row in table.rows)
    notes = "".join(f"<li>{escape(note)}</li>" for note in table.notes)
    return f'<div class="wide"><table>{caption}<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table></div>' + (
        f'<ul class="notes">{notes}</ul>' if notes else ""
    )


def _cell(cell: Words, kind: str) -> str:
    if not kind:
        return f'<th scope="row">{escape(cell.text)}</th>'
    return f'<td class="{kind} {escape(cell.mark)}">{escape(cell.text)}</td>'


def _broken(heading: str) -> str:
    return "<br>".join(escape(line) for line in heading.split("\n"))


def _rig(rig: PageRig, ego_outline_m: Array | None, number: int) -> str:
    drawing = rig_drawing(rig.sensors, ego_outline_m, number) if rig.sensors else ""
    table = table_html(sensor_table(rig.sensors)) if rig.sensors else "<p>Nobody knows its sensors.</p>"
    document = f"<details><summary>{escape(rig.name)} as YAML</summary><pre>{escape(rig.document)}</pre></details>"
    return f'<h3>{escape(rig.name)}</h3><div class="rig"><div>{drawing}</div><div>{table}</div></div>' + (
        document if rig.document else ""
    )


def _facts(heading: str, facts: Mapping[str, str]) -> str:
    each = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<h3>{escape(heading)}</h3><dl>{each}</dl>"
