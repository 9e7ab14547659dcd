"""Renderers: a table as text for a terminal and as Markdown; `RENDERERS` has all formats by name."""

import errno
import io
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from types import MappingProxyType
from typing import Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from torchcover.files import shown
from torchcover.report.layout import BOLD_MARKS, PageTable, Words, parts_of
from torchcover.report.records import render_csv, render_json
from torchcover.report.remarks import marks_on, notes_on, verdict
from torchcover.report.table import CoverageTable

# Survive files and terminals without bold type.
SIGNS = {"best": "*", "significant": "!"}
# More characters than any table has in a line.
MAX_LINE_CHARS = 10_000
# Words of headings that are longer may be cut, where there are too many columns.
LEAST_HEADING_CHARS = 10


class Terminal(Console):
    """Rich's console, on which control characters in names of others are shown and not obeyed."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """What is to be printed: our own control codes, such as a cursor's, are segments of their own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=shown(segment.text))

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, of which the program makes an exit code; rich would exit with 1."""
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def render_text(table: CoverageTable) -> str:
    """The table as it is printed where lines may be as long as they like."""
    file = io.StringIO()
    print_table(table, Terminal(file=file, width=1))
    return file.getvalue()


def print_table(table: CoverageTable, console: Console | None = None) -> None:
    """Print a table, as wide as its numbers need; on a terminal that is narrower, names and intervals are folded.

    Args:
        table: The table.
        console: Where to; the terminal if not given.
    """
    console = console or Terminal()
    folded = table.rigs if console.is_terminal and len(table.rigs) > 1 else ()
    tables = rich_tables(table, console.width if console.is_terminal else None)
    # Rather lines that are too long than numbers that are cut off; in a file the names are whole too.
    widths = [max(console.width, narrowest_width([part], folded)) for part in tables]
    for part, width in zip(tables, widths if console.is_terminal else [max(widths)] * len(tables), strict=True):
        console.width = width
        console.print(part)


def rich_tables(table: CoverageTable, width: int | None = None) -> list[Table]:
    """The parts of a table for `rich.console.Console.print`.

    The best number of each row is bold and marked `*`; a difference that is more than chance is bold and marked `!`.

    `width`: characters in a line; where more are needed, intervals stand below numbers, and sensors in rows. Returns a
    table for each part; what they hold under, and what went wrong, is the caption of the last.
    """
    parts = parts_of(table)
    if width is not None and narrowest_width([*map(_rich_table, parts)]) > width:
        folded = table.rigs if len(table.rigs) > 1 else ()
        forms = [[*map(_below, each)] for each in (parts, parts_of(table, sensors_in_rows=True))]
        parts = [
            form if narrowest_width([_rich_table(form)], folded) <= width else narrow
            for form, narrow in zip(*forms, strict=True)
        ]
    tables = [*map(_rich_table, parts)]
    marks = [f"{SIGNS[mark]} {meaning}" for mark, meaning in marks_on(table).items()]
    tables[-1].caption = Text("\n".join([*marks, *notes_on(table)]))
    return tables


def print_whole(tables: Sequence[PageTable]) -> None:
    """Print tables, folded between words where the terminal is narrower, or 80 columns if that is not known.

    Rather lines that are too long than words and numbers that are cut.
    """
    console = Terminal()
    whole = [_in_words(table, console.width) for table in tables]
    console.width = max(console.width, narrowest_width(whole))
    for table in whole:
        console.print(table)


def _in_words(table: PageTable, limit: int) -> Table:
    """The first column left, the others right; no words are markup. The widest are folded until it is `limit` wide."""
    columns = [(name, [row[at].text for row in table.rows]) for at, name in enumerate(table.headings)]
    widths = [_longest([name, *cells], "\n") for name, cells in columns]
    least = [max(min(_longest([name]), LEAST_HEADING_CHARS), _longest(cells)) for name, cells in columns]
    beside = int(sum(least) + 3 * len(least) < limit)
    room = max(limit - 1 - (1 + 2 * beside) * len(least), sum(least))
    folded = sum(widths) > room
    while sum(widths) > room:
        widths[max((k for k in range(len(least)) if widths[k] > least[k]), key=widths.__getitem__)] -= 1
    title, caption = (Text(words) if words else None for words in (table.title, "\n".join(table.notes)))
    shown = Table(title=title, caption=caption, padding=(0, beside))
    for at, (heading, width) in enumerate(zip(table.headings, widths, strict=True)):
        shown.add_column(Text(heading), justify="right" if at else "left", width=width, overflow="fold")
    above = ""
    for first, *others in table.rows:
        again = folded and first.text == above  # whose many lines are not read twice
        shown.add_row("" if again else Text(first.text), *(Text(cell.text) for cell in others))
        above = first.text
    return shown


def _longest(texts: Iterable[str], between: str | None = None) -> int:
    """Of all words, or of what else is between."""
    return max((cell_len(part) for text in texts for part in text.split(between)), default=0)


def narrowest_width(tables: Sequence[Table], folded: Sequence[str] = ()) -> int:
    """Characters in a line that tables need at least.

    `tables`: tables for rich, whose numbers stay whole; `folded`: headings that may be folded to the width of the
    numbers below.
    """
    console = Console(width=MAX_LINE_CHARS)
    natural = [Measurement.get(console, console.options, table).maximum for table in tables]
    spared = [
        sum(max(0, cell_len(str(of.header)) - (of.min_width or 0)) for of in table.columns if str(of.header) in folded)
        for table in tables
    ]
    return max(width - less for width, less in zip(natural, spared, strict=True))


def _rich_table(part: PageTable) -> Table:
    """With a line after the rows of each region."""
    left: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    table = Table(title=Text(part.title) if part.title else None, title_style="bold", caption_style="", **left)
    for name in part.headings[:2]:
        table.add_column(name, no_wrap=True)
    for at, name in enumerate(part.headings[2:-1], 2):
        # As Text, for names may hold what rich takes for markup. Names are folded, numbers never.
        widest = max((cell_len(line) for row in part.rows for line in _text(row[at]).plain.split("\n")), default=0)
        table.add_column(Text(name), justify="right", overflow="fold", min_width=widest)
    table.add_column(part.headings[-1], justify="right", no_wrap=True)
    for _, rows in groupby(part.rows, itemgetter(0)):
        for row in rows:
            table.add_row(*map(_text, row))
        table.add_section()
    return table


def _below(part: PageTable) -> PageTable:
    """With intervals below their numbers."""
    return replace(
        part, rows=[[cell._replace(text=cell.text.replace("  [", "\n[")) for cell in row] for row in part.rows]
    )


def _text(cell: Words) -> Text:
    return Text(f"{SIGNS[cell.mark]} {cell.text}", style="bold") if cell.mark else Text(cell.text)


# What Markdown would take for something else: an underscore does so at the end of a word only.
SPECIAL = re.compile(r"[\\`*|\[\]]|<(?=[A-Za-z/!?])|&(?=[\w#]+;)|(?<![^\W_])_|_(?![^\W_])")


def render_markdown(table: CoverageTable) -> str:
    """The table as Markdown text; what is marked is bold."""
    marks = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in marks_on(table).items()]
    notes = [f"* {escaped(note)}" for note in (*marks, *notes_on(table))]
    told = escaped(" ".join(verdict(table)))
    first = [told, ""] if told else []
    return "\n".join([*first, *(line for part in parts_of(table) for line in _markdown_lines(part)), *notes, ""])


def _markdown_lines(part: PageTable) -> Iterator[str]:
    if part.title:
        yield f"{escaped(part.title)}\n"
    yield _markdown_line(map(escaped, part.headings))
    yield _markdown_line(["---"] * part.words_first + ["---:"] * (len(part.headings) - part.words_first))
    yield from (_markdown_line(map(_markdown_cell, row)) for row in part.rows)
    yield ""


def _markdown_cell(cell: Words) -> str:
    return f"**{escaped(cell.text)}**" if cell.mark else escaped(cell.text)


def escaped(words: str) -> str:
    """Words that Markdown takes for nothing else."""
    return SPECIAL.sub(r"\\\g<0>", shown(" ".join(words.split())))


def _markdown_line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


RENDERERS: Mapping[str, Callable[[CoverageTable], str]] = MappingProxyType(
    {"text": render_text, "csv": render_csv, "json": render_json, "markdown": render_markdown}
)
