"""The numbers of several rigs side by side on the terminal: the better ones marked, then the differences."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from torchcover.coverage import Coverage, Region, RegionSummary
from torchcover.report.paired import check_paired, differences
from torchcover.report.quantity import Quantity, quantities_of
from torchcover.report.table import notes_on
from torchcover.report.wording import percent

# Survive files and terminals without bold type.
BEST = "*"
SIGNIFICANT = "!"
# More characters than any table has in a line.
MAX_LINE_CHARS = 10_000


def comparison_tables(
    coverages: Mapping[str, Coverage], regions: Sequence[Region], notes: Sequence[str] = ()
) -> list[Table]:
    """The paper's table for the terminal: a part for the radius and one for each threshold, a column for each rig.

    The best number of each row is bold and marked `*`, and so are all that print the same. An unknown one never is.
    If the coverages have blocks, numbers come with standard errors, and as many parts follow with the differences to
    the first rig; those that are more than chance are bold and marked `!`.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig, from the same frames.
        regions: Regions within the grid.
        notes: More conditions for the caption.

    Returns:
        Tables for `rich.console.Console.print`; what they hold under, and what went wrong, is the caption of the last.

    Raises:
        ValueError: As `check_paired`, or as `Coverage.summary`.
    """
    check_paired(coverages)
    first = next(iter(coverages.values()))
    summaries = {name: coverage.summary(regions) for name, coverage in coverages.items()}
    parts = [_values(quantity, summaries) for quantity in quantities_of(first.thresholds)]
    if first.blocks is not None:
        parts += _differences(coverages, regions, list(coverages))
    numbers = max((cell_len(cell.plain) for part in parts for row in part.rows for cell in row), default=0)
    tables = [_table(part, next(iter(summaries.values())), len(first.grid.heights), numbers) for part in parts]
    tables[-1].caption = Text("\n".join([*_notes(coverages, summaries), *notes]))
    return tables


def narrowest_width(tables: Sequence[Table], rigs: Sequence[str]) -> int:
    """Characters in a line that the tables need at least, with the names folded and the numbers whole."""
    console = Console(width=MAX_LINE_CHARS)
    natural = max(Measurement.get(console, console.options, table).maximum for table in tables)
    numbers = max(column.min_width or 0 for table in tables for column in table.columns)
    return natural - sum(max(0, cell_len(name) - numbers) for name in rigs)


@dataclass(frozen=True)
class _Part:
    """A table to be: a title, the headings of its columns of numbers, and these numbers row by row."""

    title: str
    rigs: Sequence[str]
    rows: Sequence[Sequence[Text]]


def _values(quantity: Quantity, summaries: Mapping[str, Sequence[RegionSummary]]) -> _Part:
    cells = []
    for rows in zip(*summaries.values(), strict=True):
        words = [quantity.words(quantity.of(row), quantity.error_of(row)) for row in rows]
        cells.append([_cell(*cell, BEST) for cell in zip(words, quantity.best(rows), strict=True)])
    return _Part(quantity.title, list(summaries), cells)


def _differences(coverages: Mapping[str, Coverage], regions: Sequence[Region], rigs: Sequence[str]) -> list[_Part]:
    heights = next(iter(coverages.values())).grid.heights
    found = [differences(coverages, region, height) for region in regions for height in heights]
    parts = []
    for at, quantity in enumerate(quantities_of(next(iter(coverages.values())).thresholds)):
        cells = []
        for row in found:
            shown = [row[rig][at] for rig in rigs[1:]]
            cells.append(
                [_cell(quantity.difference_words(d.value, d.error), bool(d.significant), SIGNIFICANT) for d in shown]
            )
        parts.append(_Part(f"Difference to {rigs[0]}: {quantity.difference_title}", rigs[1:], cells))
    return parts


def _cell(words: str, marked: bool, mark: str) -> Text:
    return Text(f"{mark} {words}", style="bold") if marked else Text(words)


def _table(part: _Part, rows: Sequence[RegionSummary], bands: int, numbers: int) -> Table:
    left: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    table = Table(title=Text(part.title), title_style="bold", caption_style="", **left)
    table.add_column("region", no_wrap=True)
    table.add_column("height", no_wrap=True)
    for name in part.rigs:
        # However narrow the terminal, names are folded, numbers never.
        table.add_column(Text(name), justify="right", overflow="fold", min_width=numbers)
    table.add_column("known cells\n(%)", justify="right", no_wrap=True)
    for at, (row, cells) in enumerate(zip(rows, part.rows, strict=True), 1):
        known = percent(row.known_share)
        table.add_row(Text(row.region), Text(row.height), *cells, known, end_section=at % bands == 0)
    return table


def _notes(coverages: Mapping[str, Coverage], summaries: Mapping[str, Sequence[RegionSummary]]) -> list[str]:
    notes = {name: notes_on(coverage, summaries[name]) for name, coverage in coverages.items()}
    common = [note for note in next(iter(notes.values())) if all(note in other for other in notes.values())]
    own = [f"{name}: {note}" for name, lines in notes.items() for note in lines if note not in common]
    marks = [f"{BEST} the best of its row; equal numbers are all marked, unknown ones never."]
    if next(iter(coverages.values())).blocks is not None:
        marks.append(
            f"{SIGNIFICANT} more than chance, by Student's t at 95 %: of 20 rows without a difference, one is marked."
        )
    paired = "All rigs were measured against the same reference points, so they know the same cells."
    return [*marks, paired, *common, *own]
