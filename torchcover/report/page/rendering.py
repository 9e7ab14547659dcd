"""A page as one HTML file: nothing is loaded from anywhere, and every name is text."""

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

# What maps and pictures may take in a file that is sent by mail without a thought, and the maps in any case; and how
# many times that they may take before they are packed.
MOST_CHARS, LEAST_CHARS, MOST_PACKED = 440_000, 100_000, 8
ROUNDED = "Numbers of single cells are rounded, those of a wide scale by up to 4 %"
NO_ERRORS = "errors of single cells are left out"


def fit_maps(maps: Sequence[PageMap], max_chars: int = MOST_CHARS) -> tuple[list[PageMap], CellBuffer, list[str]]:
    """Round numbers, then leave out errors, then take cells together where most are, until what is packed is small.

    Returns:
        The maps, what is packed, and what was left out in words.
    """
    codes: CellCodes = {}
    kept, left_out = list(maps), []
    cells = _packed(kept, max_chars, codes)
    if cells is None:
        kept, left_out = [replace(one, num_bits=8) for one in kept], [ROUNDED]
        cells = _packed(kept, max_chars, codes)
    if cells is None and any(one.errors is not None for one in kept):
        kept, left_out = [replace(one, errors=None) for one in kept], [ROUNDED, NO_ERRORS]
        cells = _packed(kept, max_chars, codes)
    while cells is None:
        most = max(one.values.size for one in kept)
        kept = [downsample_map(one) if one.values.size > most / 4 else one for one in kept]
        cells = _packed(kept, max_chars, codes)
    sides = {round(one.cell_m / whole.cell_m) for one, whole in zip(kept, maps, strict=True)} - {1}
    if sides:
        left_out.append(f"some maps show {' or '.join(f'{side} x {side}' for side in sorted(sides))} cells as one")
    notes = [f"{'; '.join(left_out)}, so that this file stays small: the .npz files have each."] * bool(left_out)
    return kept, cells, notes


def _packed(maps: Sequence[PageMap], most_chars: int, codes: CellCodes) -> CellBuffer | None:
    """Their cells; None if they are too many."""
    if sum(int((~np.isnan(one.values)).sum()) * one.num_bits // 8 for one in maps) > MOST_PACKED * most_chars:
        return None
    cells = CellBuffer(codes)
    for one in maps:
        add_arrays(one, cells)
    return cells if len(cells.text) <= most_chars else None


def downsample_map(page_map: PageMap) -> PageMap:
    """A map with four cells in each, without errors: their mean as the weights say, or all alike.

    Example:
        >>> from torchcover.report.colors import ColorScale
        >>> scale = ColorScale("radius", "m", "viridis_r", 0.0, 4.0)
        >>> cells = np.array([[1.0, 3.0], [np.nan, 2.0]])
        >>> coarser(PageMap("radius", "ground", "rig", (0.0, 2.0), (0.0, 2.0), 1.0, cells, scale)).values
        array([[2.]])
    """
    known = ~np.isnan(page_map.values)
    weights = known.astype(float) if page_map.weights is None else np.where(known, page_map.weights, 0.0)
    base, sums = _sums(weights), _sums(np.where(known, weights * np.where(known, page_map.values, 0.0), 0.0))
    rows, columns = base.shape
    cell_m = 2 * page_map.cell_m
    return replace(
        page_map,
        x=(page_map.x[0], page_map.x[0] + columns * cell_m),
        y=(page_map.y[0], page_map.y[0] + rows * cell_m),
        cell_m=cell_m,
        values=np.where(base > 0, sums / np.where(base > 0, base, 1.0), np.nan),
        errors=None,
        weights=None if page_map.weights is None else np.where(base > 0, base, np.nan),
        opaque_weight=4 * page_map.opaque_weight,
        sides=None if page_map.sides is None else np.maximum(page_map.sides[::2, ::2] // 2, 1),
    )


def _sums(values: Array) -> Array:
    rows, columns = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2)))
    across: Array = even[:, ::2] + even[:, 1::2]
    return across[::2] + across[1::2]


SCRIPTS = ("cells.js", "map.js", "page.js", "controls.js")


def render_page(page: Page) -> str:
    """The text of its file."""
    first = render_target_maps(page.target_maps) + "".join(map(_picture, page.pictures))
    maps, cells, notes = fit_maps(page.maps, max(MOST_CHARS - len(first), LEAST_CHARS))
    content = to_json(build_map_content(replace(page, maps=maps), cells))
    script = "\n".join(map(_file, SCRIPTS))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    more = "".join(f"<li>{render_text_html(words)}</li>" for words in page.findings[1:])
    more = f'<ul class="more">{more}</ul>' if more else ""
    return Template(_file("page.html")).substitute(
        title=escape_html_attribute(page.title),
        heading=render_text_html(page.title),
        lead=render_text_html(page.lead),
        verdict="".join(f'<p class="verdict">{render_text_html(words)}</p>' for words in page.findings[:1]),
        answer=first + more * bool(first or not maps) + render_detection_shares(page.detection_shares),
        more=more * bool(maps and not first),
        style=_file("page.css"),
        script_hash=f"sha256-{digest}",
        tables="\n".join(map(render_table, page.tables)),
        map_notes=_notes(notes),
        no_rigs="" if page.rigs else " hidden",
        rigs_heading="Rigs" if len(page.rigs) > 1 else "Rig",
        rigs="\n".join(_rig(rig, page.ego_outline_m, at) for at, rig in enumerate(page.rigs)),
        facts="\n".join(_facts(heading, facts) for heading, facts in page.facts.items()),
        more_tables="\n".join(map(render_table, page.more_tables)),
        content=content,
        cells=cells.text,
        script=script,
    )


def to_json(content: object) -> str:
    r"""JSON that ends no script and opens no comment, whatever its names are.

    Example:
        >>> print(to_json({"rig": "</script>"}))
        {"rig":"\u003c/script\u003e"}
    """
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


@cache
def _file(name: str) -> str:
    return files("torchcover.report.page").joinpath(name).read_text(encoding="utf-8")


def render_table(table: PageTable) -> str:
    """A table, with its notes below."""
    caption = f"<caption>{render_text_html(table.title)}</caption>" if table.title else ""
    kinds = ["" if at < table.num_text_columns else "number" for at in range(len(table.headings))]
    headings = [render_text_html(heading).replace("_", "_<wbr>").replace("\n", "<br>") for heading in table.headings]
    pairs = zip(kinds, headings, strict=True)
    head = "".join(f'<th scope="col" class="{kind}">{heading}</th>' for kind, heading in pairs)
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, kinds))}</tr>" for row in table.rows)
    body = f"{caption}<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody>"
    return f'<div class="wide"><table>{body}</table></div>{_notes(table.notes)}'


def _picture(picture: PagePicture) -> str:
    title, data = picture.title, base64.b64encode(picture.png).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{escape_html_attribute(title)}">'
    return f'<figure class="picture">{image}<figcaption>{render_text_html(title)}</figcaption></figure>'


def _notes(notes: Sequence[str]) -> str:
    items = "".join(f"<li>{render_text_html(note)}</li>" for note in notes)
    return f'<ul class="notes">{items}</ul>' if notes else ""


def _cell(cell: TextCell, kind: str) -> str:
    if not kind:
        return f'<th scope="row">{render_text_html(cell.text)}</th>'
    return f'<td class="{kind} {escape_html_attribute(cell.mark)}">{render_text_html(cell.text)}</td>'


def _rig(rig: PageRig, ego_outline_m: Array | None, number: int) -> str:
    drawing = render_rig(rig.sensors, ego_outline_m, number) if rig.sensors else ""
    table = render_table(build_sensor_table(rig.sensors)) if rig.sensors else "<p>Its sensors are unknown.</p>"
    document = (
        f"<details><summary>{render_text_html(rig.name)} as YAML</summary><pre>{escape(rig.document)}</pre></details>"
    )
    return f'<h3>{render_text_html(rig.name)}</h3><div class="rig"><div>{drawing}</div><div>{table}</div></div>' + (
        document if rig.document else ""
    )


def _facts(heading: str, facts: Mapping[str, str]) -> str:
    each = "".join(
        f"<dt>{render_text_html(name)}</dt><dd>{render_text_html(value)}</dd>" for name, value in facts.items()
    )
    return f"<h3>{render_text_html(heading)}</h3><dl>{each}</dl>"
