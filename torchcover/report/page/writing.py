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

from torchcover.report.page.codes import CellBytes
from torchcover.report.page.content import Array, Page, PagePicture, PageRig, PageTable
from torchcover.report.page.fitting import fitted
from torchcover.report.page.map_content import map_content
from torchcover.report.page.rig_drawing import rig_drawing, sensor_table
from torchcover.report.renderers.layout import Words

SCRIPTS = ("cells.js", "map.js", "page.js", "controls.js")


def page_html(page: Page) -> str:
    """The text of the file.

    Args:
        page: What it shows.
    """
    cells = CellBytes()
    maps, notes = fitted(page.maps)
    content = as_json(map_content(replace(page, maps=maps), cells))
    script = "\n".join(map(_file, SCRIPTS))
    return Template(_file("page.html")).substitute(
        title=escape(page.title),
        lead=escape(page.lead),
        style=_file("page.css"),
        script_hash=script_hash(script),
        tables="\n".join(map(table_html, page.tables)),
        pictures="\n".join(map(_picture, page.pictures)),
        map_notes=_notes(notes),
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
    table = table_html(sensor_table(rig.sensors)) if rig.sensors else "<p>Nobody knows its sensors.</p>"
    document = f"<details><summary>{escape(rig.name)} as YAML</summary><pre>{escape(rig.document)}</pre></details>"
    return f'<h3>{escape(rig.name)}</h3><div class="rig"><div>{drawing}</div><div>{table}</div></div>' + (
        document if rig.document else ""
    )


def _facts(heading: str, facts: Mapping[str, str]) -> str:
    each = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<h3>{escape(heading)}</h3><dl>{each}</dl>"
