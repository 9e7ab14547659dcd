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

from torchcover.report.page.answer import plans_html, ranges_html, words_html
from torchcover.report.page.codes import CellBytes
from torchcover.report.page.content import Array, Page, PageMap, PagePicture, PageRig
from torchcover.report.page.map_content import ERROR_BITS, VALUE_BITS, map_content
from torchcover.report.page.rig_drawing import rig_drawing, sensor_table
from torchcover.report.renderers.layout import PageTable, Words

# Of maps that are beside those with errors.
MOST_HALVINGS = 2
VALUE_BYTES, ERROR_BYTES = VALUE_BITS // 8, ERROR_BITS // 8
NO_ERRORS = "Errors of single cells are left out, so that this file stays small: the .npz files have them."


def fitted(maps: Sequence[PageMap], most_bytes: float = Page.most_bytes) -> tuple[list[PageMap], list[str]]:
    """Take cells together where maps have no errors beside some that have; leave out errors; take all cells together.

    Returns:
        The maps, and what was left out in words.
    """
    kept, notes = list(maps), []
    with_errors = [one.errors is not None for one in kept]
    for _ in range(MOST_HALVINGS if any(with_errors) else 0):
        if bytes_of(kept) > most_bytes:
            kept = [one if has else coarser(one) for one, has in zip(kept, with_errors, strict=True)]
    if bytes_of(kept) > most_bytes and any(with_errors):
        kept, notes = [replace(one, errors=None) for one in kept], [NO_ERRORS]
    while bytes_of(kept) > most_bytes:
        kept = [coarser(one) for one in kept]
    sides = {round(one.cell_m / whole.cell_m) for one, whole in zip(kept, maps, strict=True)} - {1}
    if sides:
        words = " or ".join(f"{side} x {side}" for side in sorted(sides))
        notes.append(f"Some maps show {words} cells as one, so that this file stays small: the .npz files have each.")
    return kept, notes


def bytes_of(maps: Sequence[PageMap]) -> int:
    """What their numbers take; weights that several share count once."""
    values = sum(int((~np.isnan(one.values)).sum()) * _width(one) for one in maps)
    weights = {id(one.weights): one.weights for one in maps if one.weights is not None}
    return values + sum(VALUE_BYTES * int((~np.isnan(each)).sum()) for each in weights.values())


def coarser(one: PageMap) -> PageMap:
    """A map with four cells in each, without errors: their mean as the weights say, or all alike.

    Example:
        >>> from torchcover.report.maps.colours import ColourScale
        >>> scale = ColourScale("radius", "m", "viridis_r", 0.0, 4.0)
        >>> cells = np.array([[1.0, 3.0], [np.nan, 2.0]])
        >>> coarser(PageMap("radius", "ground", "rig", (0.0, 2.0), (0.0, 2.0), 1.0, cells, scale)).values
        array([[2.]])
    """
    known = ~np.isnan(one.values)
    weights = known.astype(float) if one.weights is None else np.where(known, one.weights, 0.0)
    base, sums = _sums(weights), _sums(np.where(known, weights * np.where(known, one.values, 0.0), 0.0))
    rows, columns = base.shape
    cell_m = 2 * one.cell_m
    return replace(
        one,
        x=(one.x[0], one.x[0] + columns * cell_m),
        y=(one.y[0], one.y[0] + rows * cell_m),
        cell_m=cell_m,
        values=np.where(base > 0, sums / np.where(base > 0, base, 1.0), np.nan),
        errors=None,
        weights=None if one.weights is None else np.where(base > 0, base, np.nan),
        full_weight=4 * one.full_weight,
        sides=None if one.sides is None else np.maximum(one.sides[::2, ::2] // 2, 1),
    )


def _width(one: PageMap) -> int:
    return VALUE_BYTES + (ERROR_BYTES if one.errors is not None else 0)


def _sums(values: Array) -> Array:
    rows, columns = values.shape
    even = np.pad(values, ((0, rows % 2), (0, columns % 2)))
    across: Array = even[:, ::2] + even[:, 1::2]
    return across[::2] + across[1::2]


SCRIPTS = ("cells.js", "map.js", "page.js", "controls.js")


def page_html(page: Page) -> str:
    """The text of its file."""
    cells = CellBytes()
    maps, notes = fitted(page.maps, page.most_bytes)
    content = as_json(map_content(replace(page, maps=maps), cells))
    script = "\n".join(map(_file, SCRIPTS))
    first = plans_html(page.plans) + "".join(map(_picture, page.pictures))
    more = "".join(f"<li>{words_html(words)}</li>" for words in page.verdict[1:])
    more = f'<ul class="more">{more}</ul>' if more else ""
    return Template(_file("page.html")).substitute(
        title=escape(page.title),
        lead=escape(page.lead),
        verdict="".join(f'<p class="verdict">{words_html(words)}</p>' for words in page.verdict[:1]),
        answer=first + more * bool(first or not maps) + ranges_html(page.ranges),
        more=more * bool(maps and not first),
        style=_file("page.css"),
        script_hash=script_hash(script),
        tables="\n".join(map(table_html, page.tables)),
        map_notes=_notes(notes),
        no_rigs="" if page.rigs else " hidden",
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


def table_html(table: PageTable) -> str:
    """A table, with its notes below."""
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    kinds = ["" if at < table.words_first else "number" for at in range(len(table.headings))]
    pairs = zip(kinds, table.headings, strict=True)
    head = "".join(f'<th scope="col" class="{kind}">{_broken(heading)}</th>' for kind, heading in pairs)
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, kinds))}</tr>" for row in table.rows)
    body = f"{caption}<thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody>"
    return f'<div class="wide"><table>{body}</table></div>{_notes(table.notes)}'


def _picture(picture: PagePicture) -> str:
    title, data = escape(picture.title), base64.b64encode(picture.png).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{title}">'
    return f'<figure class="picture">{image}<figcaption>{title}</figcaption></figure>'


def _notes(notes: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f'<ul class="notes">{items}</ul>' if notes else ""


def _cell(cell: Words, kind: str) -> str:
    if not kind:
        return f'<th scope="row">{escape(cell.text)}</th>'
    return f'<td class="{kind} {escape(cell.mark)}">{escape(cell.text)}</td>'


def _broken(heading: str) -> str:
    lines = (escape(line).replace("_", "_<wbr>") for line in heading.split("\n"))
    return "<br>".join(lines)


def _rig(rig: PageRig, ego_outline_m: Array | None, number: int) -> str:
    drawing = rig_drawing(rig.sensors, ego_outline_m, number) if rig.sensors else ""
    table = table_html(sensor_table(rig.sensors)) if rig.sensors else "<p>Its sensors are unknown.</p>"
    document = f"<details><summary>{escape(rig.name)} as YAML</summary><pre>{escape(rig.document)}</pre></details>"
    return f'<h3>{escape(rig.name)}</h3><div class="rig"><div>{drawing}</div><div>{table}</div></div>' + (
        document if rig.document else ""
    )


def _facts(heading: str, facts: Mapping[str, str]) -> str:
    each = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<h3>{escape(heading)}</h3><dl>{each}</dl>"
