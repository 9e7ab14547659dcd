"""Renderers of a coverage table: text for a terminal and Markdown; `RENDERERS` has all formats by name."""

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

from torchcover.files import escape_control_chars
from torchcover.report.findings import summarize_findings
from torchcover.report.records import render_csv, render_json
from torchcover.report.table import CoverageTable
from torchcover.report.table_layout import BOLD_MARKS, PageTable, TextCell, build_page_tables
from torchcover.report.table_notes import explain_marks, list_notes

SIGNS = {"best": "*", "significant": "!"}  # marks in text files and terminals without bold type


class Terminal(Console):
    """Console of rich that shows control characters in names instead of executing them."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Render segments, with escaped control characters in text; control codes of rich are separate segments.

        Args:
            renderable: Object to print.
            options: Options of rich.
        """
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=escape_control_chars(segment.text))

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, which the program turns into an exit code; rich would exit with 1."""
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def render_text(table: CoverageTable) -> str:
    """Render a table as text with lines of any length.

    Args:
        table: The table.
    """
    file = io.StringIO()
    print_table(table, Terminal(file=file, width=1))
    return file.getvalue()


def print_table(table: CoverageTable, console: Console | None = None) -> None:
    """Print a table as wide as its numbers need; a narrow terminal wraps names and intervals.

    Args:
        table: The table.
        console: Console to print to; None takes the terminal.
    """
    console = console or Terminal()
    wrapped_headings = table.rigs if console.is_terminal and len(table.rigs) > 1 else ()
    rich_tables = build_rich_tables(table, console.width if console.is_terminal else None)
    # Lines that are too long are better than truncated numbers; in files, names are complete too.
    widths = [max(console.width, compute_min_width([rich_table], wrapped_headings)) for rich_table in rich_tables]
    if not console.is_terminal:
        widths = [max(widths)] * len(rich_tables)
    for rich_table, width in zip(rich_tables, widths, strict=True):
        console.width = width
        console.print(rich_table)


def build_rich_tables(table: CoverageTable, width: int | None = None) -> list[Table]:
    """Build the tables for `rich.console.Console.print`.

    The best number of each row is bold and marked `*`; a significant difference is bold and marked `!`.

    Args:
        table: The table.
        width: Characters per line; in tables that need more, intervals are below numbers and sensors in rows. None
            allows any width.

    Returns:
        Tables of rich; the notes are the caption of the last.
    """
    page_tables = build_page_tables(table)
    if width is not None and compute_min_width([_build_rich_table(page_table) for page_table in page_tables]) > width:
        wrapped_headings = table.rigs if len(table.rigs) > 1 else ()
        narrow_tables = build_page_tables(table, sensors_in_rows=True)
        pairs = list(zip(page_tables, narrow_tables, strict=True))
        page_tables = []
        for page_table, narrow_table in pairs:
            wrapped = _wrap_intervals(page_table)
            fits = compute_min_width([_build_rich_table(wrapped)], wrapped_headings) <= width
            page_tables.append(wrapped if fits else _wrap_intervals(narrow_table))
    rich_tables = [_build_rich_table(page_table) for page_table in page_tables]
    marks = [f"{SIGNS[mark]} {meaning}" for mark, meaning in explain_marks(table).items()]
    rich_tables[-1].caption = Text("\n".join([*marks, *list_notes(table)]))
    return rich_tables


def print_page_tables(tables: Sequence[PageTable]) -> None:
    """Print tables of text, wrapped between words to the width of the terminal, or 80 columns if it is unknown.

    Words and numbers are never truncated; lines may be too long instead.

    Args:
        tables: The tables.
    """
    console = Terminal()
    rich_tables = [_build_wrapped_table(table, console.width) for table in tables]
    console.width = max(console.width, compute_min_width(rich_tables))
    for rich_table in rich_tables:
        console.print(rich_table)


def _build_wrapped_table(table: PageTable, limit: int) -> Table:
    """Build a table without markup whose widest columns are wrapped to at most `limit` characters per line."""
    widths, min_widths = [], []
    max_word_chars = 10  # longer words of headings may be broken
    for index, name in enumerate(table.headings):
        cells = [row[index].text for row in table.rows]
        widths.append(_find_longest([name, *cells], "\n"))
        min_widths.append(max(min(_find_longest([name]), max_word_chars), _find_longest(cells)))
    padding = int(sum(min_widths) + 3 * len(min_widths) < limit)
    available = max(limit - 1 - (1 + 2 * padding) * len(min_widths), sum(min_widths))
    is_wrapped = sum(widths) > available
    while sum(widths) > available:
        shrinkable = [index for index in range(len(widths)) if widths[index] > min_widths[index]]
        widths[max(shrinkable, key=widths.__getitem__)] -= 1
    rich_table = Table(
        title=Text(table.title) if table.title else None,
        caption=Text("\n".join(table.notes)) if table.notes else None,
        padding=(0, padding),
    )
    for index, (heading, width) in enumerate(zip(table.headings, widths, strict=True)):
        rich_table.add_column(Text(heading), justify="right" if index else "left", width=width, overflow="fold")
    previous = ""
    for first, *other_cells in table.rows:
        is_repeated = is_wrapped and first.text == previous  # a long name is printed once
        rich_table.add_row("" if is_repeated else Text(first.text), *(Text(cell.text) for cell in other_cells))
        previous = first.text
    return rich_table


def _find_longest(texts: Iterable[str], separator: str | None = None) -> int:
    """Return the width of the longest word, or of the longest part between separators."""
    longest = 0
    for text in texts:
        longest = max([longest, *(cell_len(part) for part in text.split(separator))])
    return longest


def compute_min_width(tables: Sequence[Table], folded_headings: Sequence[str] = ()) -> int:
    """Compute the characters per line that tables need at least.

    Args:
        tables: Tables of rich, whose numbers are not wrapped.
        folded_headings: Headings that may be wrapped to the width of the numbers below.
    """
    console = Console(width=10_000)  # wider than any table
    min_widths = []
    for table in tables:
        width = Measurement.get(console, console.options, table).maximum
        for column in table.columns:
            if str(column.header) in folded_headings:
                width -= max(0, cell_len(str(column.header)) - (column.min_width or 0))
        min_widths.append(width)
    return max(min_widths)


def _build_rich_table(table: PageTable) -> Table:
    """Build a table with a line below the rows of each region."""
    alignment: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    title = Text(table.title) if table.title else None
    rich_table = Table(title=title, title_style="bold", caption_style="", **alignment)
    for name in table.headings[:2]:
        rich_table.add_column(name, no_wrap=True)
    for index, name in enumerate(table.headings[2:-1], 2):
        lines: list[str] = []
        for row in table.rows:
            lines += _format_cell(row[index]).plain.split("\n")
        # Names are Text, since they may contain the markup of rich. They are wrapped, numbers are not.
        min_width = max((cell_len(line) for line in lines), default=0)
        rich_table.add_column(Text(name), justify="right", overflow="fold", min_width=min_width)
    rich_table.add_column(table.headings[-1], justify="right", no_wrap=True)
    for _, rows in groupby(table.rows, itemgetter(0)):
        for row in rows:
            rich_table.add_row(*(_format_cell(cell) for cell in row))
        rich_table.add_section()
    return rich_table


def _wrap_intervals(table: PageTable) -> PageTable:
    """Move intervals below their numbers."""
    rows = []
    for row in table.rows:
        rows.append([cell._replace(text=cell.text.replace("  [", "\n[")) for cell in row])
    return replace(table, rows=rows)


def _format_cell(cell: TextCell) -> Text:
    """Format a cell for rich: marked cells are bold and have the sign of their mark."""
    return Text(f"{SIGNS[cell.mark]} {cell.text}", style="bold") if cell.mark else Text(cell.text)


def render_markdown(table: CoverageTable) -> str:
    """Render a table as Markdown; marked numbers are bold.

    Args:
        table: The table.
    """
    lines = []
    if findings := escape_markdown(" ".join(summarize_findings(table))):
        lines += [findings, ""]
    for page_table in build_page_tables(table):
        lines += _render_markdown_table(page_table)
    marks = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in explain_marks(table).items()]
    lines += [f"* {escape_markdown(note)}" for note in (*marks, *list_notes(table))]
    return "\n".join([*lines, ""])


def _render_markdown_table(table: PageTable) -> Iterator[str]:
    """Yield the lines of a table, with numbers aligned to the right."""
    if table.title:
        yield f"{escape_markdown(table.title)}\n"
    yield _join_cells([escape_markdown(heading) for heading in table.headings])
    num_number_columns = len(table.headings) - table.num_text_columns
    yield _join_cells(["---"] * table.num_text_columns + ["---:"] * num_number_columns)
    for row in table.rows:
        yield _join_cells([f"**{escape_markdown(text)}**" if mark else escape_markdown(text) for text, mark in row])
    yield ""


def escape_markdown(text: str) -> str:
    """Escape characters that have a meaning in Markdown.

    Args:
        text: The text.
    """
    # An underscore has a meaning only at the end of a word.
    special = r"[\\`*|\[\]]|<(?=[A-Za-z/!?])|&(?=[\w#]+;)|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, r"\\\g<0>", escape_control_chars(" ".join(text.split())))


def _join_cells(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


RENDERERS: Mapping[str, Callable[[CoverageTable], str]] = MappingProxyType(
    {"text": render_text, "csv": render_csv, "json": render_json, "markdown": render_markdown}
)
