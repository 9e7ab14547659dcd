"""A table in words, before it is text: the parts of a page, which renderers for readers have in common."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from types import MappingProxyType
from typing import NamedTuple

from torchcover.estimation import Quantity
from torchcover.report.number_format import (
    UNKNOWN,
    capitalize,
    format_difference,
    format_difference_heading,
    format_heading,
    format_number,
)
from torchcover.report.records import COLUMNS
from torchcover.report.table import CoverageTable, Row
from torchcover.report.table_notes import (
    format_failure_cells,
    format_failure_headings,
    format_failure_title,
    get_failure_sensors,
    get_main_quantity,
)

MAX_HEADING_CHARS = 16
PLACE_HEADINGS = ("region", "height")
BODY_HEADINGS = ("region", "body")
PLACES = len(PLACE_HEADINGS)
Rows = tuple[Row, ...]
# What the marks look like, and what the legend calls that, where text may be bold.
BOLD_MARKS: Mapping[str, str] = MappingProxyType({"best": "In bold", "significant": "In bold among the differences"})


class TextCell(NamedTuple):
    """What a cell of a part says, and whether it is marked: as the best of its row, or as more than chance."""

    text: str
    mark: str = ""


@dataclass(frozen=True)
class PageTable:
    """A table of words.

    Args:
        title: Above it; empty for none.
        headings: Of its columns.
        rows: Its cells; marked ones are bold.
        num_text_columns: How many columns are words, on the left; numbers follow, on the right.
        notes: Below it.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[TextCell]]
    num_text_columns: int = 1
    notes: Sequence[str] = ()


def build_page_tables(table: CoverageTable, *, sensors_in_rows: bool = False) -> list[PageTable]:
    """The parts of a table.

    Args:
        table: The table.
        sensors_in_rows: With redundancy a row for each sensor with which something is lost, instead of columns.

    Returns:
        For one rig one part, a column for each quantity. For several the paper's layout: a part for each quantity, a
        column for each rig; and, if there are errors, as many parts with the differences to the first rig. Then the
        same of bodies beside the vehicle. With redundancy a part for each rig more, a column for each of its sensors.
    """
    of_failures = _of_each_failure if sensors_in_rows else _of_failures
    failures = [of_failures(table, rig) for rig in table.rigs if get_failure_sensors(table.rows[rig])]
    of_bodies = list(zip(*table.target_rows.values(), strict=True))
    parts = _of_rows(table, table.rows_by_region, table.quantities)
    return [*parts, *(_of_rows(table, of_bodies, table.target_quantities) if of_bodies else ()), *failures]


def _of_rows(table: CoverageTable, places: Sequence[Rows], quantities: Sequence[Quantity]) -> list[PageTable]:
    if len(table.rigs) == 1:
        headings = [fill(format_heading(quantity), MAX_HEADING_CHARS) for quantity in quantities]
        cells = [[_number(row, quantity) for quantity in quantities] for (row,) in places]
        return [_part(table, places, "", headings, cells)]
    (first, *others), parts = table.rigs, []
    for one in quantities:
        cells = [[_number(row, one) for row in rows] for rows in places]
        parts.append(_part(table, places, capitalize(format_heading(one)), table.rigs, cells))
    for one in quantities if table.first_conditions.blocks is not None else ():
        cells = [[_difference(row, one) for row in rows[1:]] for rows in places]
        title = f"Difference to {first}: {format_difference_heading(one)}"
        parts.append(_part(table, places, title, others, cells))
    return parts


def _of_failures(table: CoverageTable, rig: str) -> PageTable:
    rows = []
    for row in table.rows[rig]:
        cells = [TextCell(text, "significant" if marked else "") for text, marked in format_failure_cells(table, row)]
        rows.append((TextCell(row.summary.region), TextCell(row.summary.band), *cells))
    return PageTable(
        format_failure_title(table, rig), [*PLACE_HEADINGS, *format_failure_headings(table, rig)], rows, PLACES
    )


def _of_each_failure(table: CoverageTable, rig: str) -> PageTable:
    """As narrow as it can be: by how many sensors a place is seen, and what it loses with each, most first."""
    names, rows = get_failure_sensors(table.rows[rig]), []
    headings = format_failure_headings(table, rig)
    seen = len(headings) - len(names) - 1
    for row in table.rows[rig]:
        words = format_failure_cells(table, row)
        lost = sorted(
            (row.summary.redundancy.failure_effects[name][get_main_quantity(table).key].improvement, name, *said)
            for name, said in zip(names, words[seen:-1], strict=True)
            if row.summary.redundancy and said[0] not in ("0", UNKNOWN)
        )
        for at, (_, name, text, marked) in enumerate(lost or [(0.0, words[-1][0], "", False)]):
            of_place = [said[0] if at == 0 else "" for said in words[: min(seen, 1)]]
            last = TextCell(text, "significant" if marked else "")
            rows.append(
                (TextCell(row.summary.region), TextCell(row.summary.band), *map(TextCell, (*of_place, name)), last)
            )
    headings = [*PLACE_HEADINGS, *["sensors\nthat see it"][:seen], "without", "change"]
    return PageTable(format_failure_title(table, rig), headings, rows, PLACES)


def _part(
    table: CoverageTable,
    places: Sequence[Rows],
    title: str,
    headings: Sequence[str],
    numbers: Sequence[Sequence[TextCell]],
) -> PageTable:
    """A part with the columns that every part has: the place first, those of `COLUMNS` that are shown last."""
    measure = places[0][0].summary.average if places else table.average
    shown = [column for column in COLUMNS if column.heading and column.average in (None, measure)]
    rows = []
    for (row, *_), cells in zip(places, numbers, strict=True):
        last = [TextCell(column.format_value(column.get_value(table, row))) for column in shown]
        rows.append((TextCell(row.summary.region), TextCell(row.summary.band), *cells, *last))
    first = BODY_HEADINGS if measure == "target_positions" else PLACE_HEADINGS
    every = [*first, *headings, *(column.heading for column in shown)]
    return PageTable(title, every, rows, PLACES)


def _number(row: Row, quantity: Quantity) -> TextCell:
    words = format_number(row.summary.numbers[quantity.key])
    return TextCell(words, "best" if quantity.key in row.leading_keys else "")


def _difference(row: Row, quantity: Quantity) -> TextCell:
    difference = row.differences[quantity.key]
    return TextCell(format_difference(difference), "significant" if difference.is_significant else "")
