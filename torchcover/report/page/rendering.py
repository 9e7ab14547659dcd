"""Rendering of a page as one HTML file that loads nothing and escapes every name."""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from html import escape
from importlib.resources import files
from string import Template

import numpy as np

from torchcover.notebooks import escape_html_attribute
from torchcover.report.page.content import Array, Page, PageMap, PagePicture, PageRig
from torchcover.report.page.map_content import CellBuffer, CellCodes, add_arrays, build_map_content
from torchcover.report.page.svg import (
    build_sensor_table,
    render_detection_shares,
    render_rig,
    render_target_maps,
    render_text_html,
)
from torchcover.report.table_layout import PageTable, TextCell

MAX_CHARS = 440_000  # of maps and pictures, so that the file can be sent by mail


def fit_maps(maps: Sequence[PageMap], max_chars: int = MAX_CHARS) -> tuple[list[PageMap], CellBuffer, list[str]]:
    """Reduce maps until they are small enough: round numbers, then remove errors, then merge cells of the largest maps.

    Args:
        maps: The maps.
        max_chars: Maximum number of characters of the packed maps.

    Returns:
        The reduced maps, their packed cells, and a note on the reduction.
    """
    codes: CellCodes = {}
    fitted, reductions = list(maps), []
    cells = _pack_maps(fitted, max_chars, codes)
    if cells is None:
        fitted = [replace(page_map, num_bits=8) for page_map in fitted]
        reductions.append("Numbers of single cells are rounded, those of a wide scale by up to 4 %")
        cells = _pack_maps(fitted, max_chars, codes)
    if cells is None and any(page_map.errors is not None for page_map in fitted):
        fitted = [replace(page_map, errors=None) for page_map in fitted]
        reductions.append("standard errors of single cells are omitted")
        cells = _pack_maps(fitted, max_chars, codes)
    while cells is None:
        largest = max(page_map.values.size for page_map in fitted)
        fitted = [downsample_map(page_map) if page_map.values.size > largest / 4 else page_map for page_map in fitted]
        cells = _pack_maps(fitted, max_chars, codes)
    sides = {round(page_map.cell_m / whole.cell_m) for page_map, whole in zip(fitted, maps, strict=True)} - {1}
    if sides:
        merged = " or ".join(f"{side} x {side}" for side in sorted(sides))
        reductions.append(f"some maps merge {merged} cells")
    notes = [f"{'; '.join(reductions)}, to keep this file small; the .npz files are complete."] if reductions else []
    return fitted, cells, notes


def _pack_maps(maps: Sequence[PageMap], max_chars: int, codes: CellCodes) -> CellBuffer | None:
    """Pack the cells of maps; None if they need too many characters."""
    num_bytes = sum(int((~np.isnan(page_map.values)).sum()) * page_map.num_bits // 8 for page_map in maps)
    if num_bytes > 8 * max_chars:  # compression saves less than this factor
        return None
    cells = CellBuffer(codes)
    for page_map in maps:
        add_arrays(page_map, cells)
    return cells if len(cells.text) <= max_chars else None


def downsample_map(page_map: PageMap) -> PageMap:
    """Merge 2 x 2 cells of a map into one with their weighted mean, without errors.

    Args:
        page_map: The map; without weights all cells count equally.

    Example:
        >>> from torchcover.report.colors import ColorScale
        >>> scale = ColorScale("radius", "m", "viridis_r", 0.0, 4.0)
        >>> cells = np.array([[1.0, 3.0], [np.nan, 2.0]])
        >>> downsample_map(PageMap("radius", "ground", "rig", (0.0, 2.0), (0.0, 2.0), 1.0, cells, scale)).values
        array([[2.]])
    """
    is_observed = ~np.isnan(page_map.values)
    weights = is_observed.astype(float) if page_map.weights is None else np.where(is_observed, page_map.weights, 0.0)
    weighted_values = np.where(is_observed, weights * np.where(is_observed, page_map.values, 0.0), 0.0)
    weight_sums, value_sums = _sum_blocks(weights), _sum_blocks(weighted_values)
    rows, columns = weight_sums.shape
    cell_m = 2 * page_map.cell_m
    return replace(
        page_map,
        x=(page_map.x[0], page_map.x[0] + columns * cell_m),
        y=(page_map.y[0], page_map.y[0] + rows * cell_m),
        cell_m=cell_m,
        values=np.where(weight_sums > 0, value_sums / np.where(weight_sums > 0, weight_sums, 1.0), np.nan),
        errors=None,
        weights=None if page_map.weights is None else np.where(weight_sums > 0, weight_sums, np.nan),
        opaque_weight=4 * page_map.opaque_weight,
        sides=None if page_map.sides is None else np.maximum(page_map.sides[::2, ::2] // 2, 1),
    )


def _sum_blocks(values: Array) -> Array:
    """Sum blocks of 2 x 2 cells."""
    rows, columns = values.shape
    padded = np.pad(values, ((0, rows % 2), (0, columns % 2)))
    column_sums: Array = padded[:, ::2] + padded[:, 1::2]
    return column_sums[::2] + column_sums[1::2]


def render_page(page: Page) -> str:
    """Render a page as HTML.

    Args:
        page: Content of the page.
    """
    overview = render_target_maps(page.target_maps) + "".join(map(_render_picture, page.pictures))
    maps, cells, notes = fit_maps(page.maps, max(MAX_CHARS - len(overview), 100_000))
    content = to_json(build_map_content(replace(page, maps=maps), cells))
    script = "\n".join(map(_read_file, ("cells.js", "map.js", "page.js", "controls.js")))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    more = "".join(f"<li>{render_text_html(words)}</li>" for words in page.findings[1:])
    more = f'<ul class="more">{more}</ul>' if more else ""
    return Template(_read_file("page.html")).substitute(
        title=escape_html_attribute(page.title),
        heading=render_text_html(page.title),
        lead=render_text_html(page.lead),
        verdict="".join(f'<p class="verdict">{render_text_html(words)}</p>' for words in page.findings[:1]),
        answer=overview + more * bool(overview or not maps) + render_detection_shares(page.detection_shares),
        more=more * bool(maps and not overview),
        style=_read_file("page.css"),
        script_hash=f"sha256-{digest}",
        tables="\n".join(map(render_table, page.tables)),
        map_notes=_render_notes(notes),
        no_rigs="" if page.rigs else " hidden",
        rigs_heading="Rigs" if len(page.rigs) > 1 else "Rig",
        rigs="\n".join(_render_rig_section(rig, page.ego_outline_m, index) for index, rig in enumerate(page.rigs)),
        facts="\n".join(_render_facts(heading, facts) for heading, facts in page.facts.items()),
        more_tables="\n".join(map(render_table, page.more_tables)),
        content=content,
        cells=cells.text,
        script=script,
    )


def to_json(content: object) -> str:
    r"""Convert content to JSON that is safe inside a script element.

    Args:
        content: Content for `json.dumps`.

    Example:
        >>> print(to_json({"rig": "</script>"}))
        {"rig":"\u003c/script\u003e"}
    """
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _read_file(name: str) -> str:
    """Read a file of the page template once."""
    return files("torchcover.report.page").joinpath(name).read_text(encoding="utf-8")


def render_table(table: PageTable) -> str:
    """Render a table with its notes.

    Args:
        table: The table.
    """
    caption = f"<caption>{render_text_html(table.title)}</caption>" if table.title else ""
    kinds = ["" if index < table.num_text_columns else "number" for index in range(len(table.headings))]
    headings = [render_text_html(heading).replace("_", "_<wbr>").replace("\n", "<br>") for heading in table.headings]
    pairs = zip(kinds, headings, strict=True)
    head = "".join(f'<th scope="col" class="{kind}">{heading}</th>' for kind, heading in pairs)
    rows = "\n".join(f"<tr>{''.join(map(_render_cell, row, kinds))}</tr>" for row in table.rows)
    body = f"{caption}<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody>"
    return f'<div class="wide"><table>{body}</table></div>{_render_notes(table.notes)}'


def _render_picture(picture: PagePicture) -> str:
    """Render a picture with its title as a data URL."""
    title, data = picture.title, base64.b64encode(picture.png).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape_html_attribute(title)}">'
    return f'<figure class="picture">{image}<figcaption>{render_text_html(title)}</figcaption></figure>'


def _render_notes(notes: Sequence[str]) -> str:
    """Render notes as a list; empty without notes."""
    items = "".join(f"<li>{render_text_html(note)}</li>" for note in notes)
    return f'<ul class="notes">{items}</ul>' if notes else ""


def _render_cell(cell: TextCell, kind: str) -> str:
    """Render a cell: text columns are row headers, others have the class of their mark."""
    if not kind:
        return f'<th scope="row">{render_text_html(cell.text)}</th>'
    return f'<td class="{kind} {escape_html_attribute(cell.mark)}">{render_text_html(cell.text)}</td>'


def _render_rig_section(rig: PageRig, ego_outline_m: Array | None, number: int) -> str:
    """Render the drawing, the sensors and the YAML document of a rig."""
    drawing = render_rig(rig.sensors, ego_outline_m, number) if rig.sensors else ""
    table = render_table(build_sensor_table(rig.sensors)) if rig.sensors else "<p>Sensors unknown.</p>"
    document = (
        f"<details><summary>{render_text_html(rig.name)} as YAML</summary><pre>{escape(rig.document)}</pre></details>"
    )
    return f'<h3>{render_text_html(rig.name)}</h3><div class="rig"><div>{drawing}</div><div>{table}</div></div>' + (
        document if rig.document else ""
    )


def _render_facts(heading: str, facts: Mapping[str, str]) -> str:
    """Render named facts as a definition list under a heading."""
    each = "".join(
        f"<dt>{render_text_html(name)}</dt><dd>{render_text_html(value)}</dd>" for name, value in facts.items()
    )
    return f"<h3>{render_text_html(heading)}</h3><dl>{each}</dl>"
