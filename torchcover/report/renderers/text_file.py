"""A table as text for a terminal."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from typing import Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from torchcover.files import shown
from torchcover.report.remarks import marks_on, notes_on
from torchcover.report.renderers.layout import PageTable, Words, parts_of
from torchcover.report.table import CoverageTable

# Survive files and terminals without bold type.
SIGNS = {"best": "*", "significant": "!"}
# More characters than any table has in a line.
MAX_LINE_CHARS = 10_000


class Terminal(Console):
    """Rich's console, on which control characters in names of others are shown and not obeyed."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """What is to be printed: our own control codes, such as a cursor's, are segments of their own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=shown(segment.text))


def render(table: CoverageTable) -> str:
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
    tables = rich_tables(table)
    if console.is_terminal and narrowest_width(tables) > console.width:
        tables = rich_tables(table, two_lines=True)
    folded = table.rigs if console.is_terminal and len(table.rigs) > 1 else ()
    # Rather lines that are too long than numbers that are cut off; in a file the names are whole too.
    console.width = max(console.width, narrowest_width(tables, folded))
    for part in tables:
        console.print(part)


def rich_tables(table: CoverageTable, *, two_lines: bool = False) -> list[Table]:
    """The parts of a table for `rich.console.Console.print`.

    The best number of each row is bold and marked `*`; a difference that is more than chance is bold and marked `!`.

    `two_lines`: whether intervals stand below their numbers. Returns a table for each part; what they hold under, and
    what went wrong, is the caption of the last.
    """
    parts = parts_of(table)
    if two_lines:
        parts = [replace(part, rows=[[*map(_below, row)] for row in part.rows]) for part in parts]
    lines = [
        line for part in parts for row in part.rows for cell in row[2:-1] for line in _text(cell).plain.split("\n")
    ]
    widest = max(map(cell_len, lines), default=0)
    tables = [_rich_table(part, widest) for part in parts]
    marks = [f"{SIGNS[mark]} {meaning}" for mark, meaning in marks_on(table).items()]
    tables[-1].caption = Text("\n".join([*marks, *notes_on(table)]))
    return tables


def print_whole(tables: Sequence[PageTable]) -> None:
    """Print tables as wide as they are: rather lines that are too long than numbers that are cut off."""
    console, whole = Terminal(), [_in_words(table) for table in tables]
    console.width = max(console.width, narrowest_width(whole))
    for table in whole:
        console.print(table)


def _in_words(table: PageTable) -> Table:
    """The first column left, the others right; no words are markup."""
    title, caption = (Text(words) if words else None for words in (table.title, "\n".join(table.notes)))
    shown = Table(title=title, caption=caption)
    for at, heading in enumerate(table.headings):
        shown.add_column(Text(heading), justify="right" if at else "left")
    for row in table.rows:
        shown.add_row(*(Text(cell.text) for cell in row))
    return shown


def narrowest_width(tables: Sequence[Table], folded: Sequence[str] = ()) -> int:
    """Characters in a line that tables need at least.

    `tables`: tables for rich, whose numbers stay whole; `folded`: headings, each of one column, that may be folded to
    the width of the numbers below.
    """
    console = Console(width=MAX_LINE_CHARS)
    natural = max(Measurement.get(console, console.options, table).maximum for table in tables)
    numbers = max(column.min_width or 0 for table in tables for column in table.columns)
    return natural - sum(max(0, cell_len(name) - numbers) for name in folded)


def _rich_table(part: PageTable, widest: int) -> Table:
    """With a line after the rows of each region."""
    left: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    table = Table(title=Text(part.title) if part.title else None, title_style="bold", caption_style="", **left)
    for name in part.headings[:2]:
        table.add_column(name, no_wrap=True)
    for name in part.headings[2:-1]:
        # As Text, for names may hold what rich takes for markup. Names are folded, numbers never.
        table.add_column(Text(name), justify="right", overflow="fold", min_width=widest)
    table.add_column(part.headings[-1], justify="right", no_wrap=True)
    for _, rows in groupby(part.rows, itemgetter(0)):
        for row in rows:
            table.add_row(*map(_text, row))
        table.add_section()
    return table


def _below(cell: Words) -> Words:
    return cell._replace(text=cell.text.replace("  [", "\n["))


def _text(cell: Words) -> Text:
    return Text(f"{SIGNS[cell.mark]} {cell.text}", style="bold") if cell.mark else Text(cell.text)
