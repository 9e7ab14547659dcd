"""Coverage table as tables of text, which all renderers for readers share."""

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
from torchcover.report.records import COLUMNS, get_common_values
from torchcover.report.sensor_failures import (
    MAX_HEADING_CHARS,
    format_failure_cells,
    format_failure_headings,
    format_failure_title,
    get_failure_sensors,
    get_main_quantity,
)
from torchcover.report.table import CoverageTable, Row

REGION_HEADINGS = ("region", "band")
# Explanation of marks in formats with bold text.
BOLD_MARKS: Mapping[str, str] = MappingProxyType({"best": "In bold", "significant": "In bold among the differences"})


class TextCell(NamedTuple):
    """Cell of a table of text.

    Args:
        text: Its text.
        mark: "best" for the best number of a row, "significant" for a significant difference, else empty.
    """

    text: str
    mark: str = ""


def build_text_cells(*texts: str) -> tuple[TextCell, ...]:
    """Build the cells of a row without marks.

    Args:
        texts: Text of each cell.
    """
    return tuple(TextCell(text) for text in texts)


@dataclass(frozen=True)
class PageTable:
    """Table of text.

    Args:
        title: Title above the table; empty for none.
        headings: Headings of the columns.
        rows: Cells; marked ones are shown in bold.
        num_text_columns: Number of left-aligned columns; the others are right-aligned numbers.
        notes: Notes below the table.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[TextCell]]
    num_text_columns: int = 1
    notes: Sequence[str] = ()


def build_page_tables(table: CoverageTable, *, sensors_in_rows: bool = False) -> list[PageTable]:
    """Build the tables of text of a coverage table.

    Args:
        table: The table.
        sensors_in_rows: Whether sensor failures have a row for each sensor with an effect, instead of columns.

    Returns:
        For one rig, a table with a column for each quantity. For several, the layout of the paper: a table for each
        quantity with a column for each rig, and with standard errors also a table of differences to the first rig.
        Then the same for test targets. With redundancy, a table of sensor failures for each rig.
    """
    build_failures = _build_failure_rows if sensors_in_rows else _build_failure_columns
    failures = [build_failures(table, rig) for rig in table.rigs if get_failure_sensors(table.rows[rig])]
    tables = _build_number_tables(table, table.rows_by_region, table.quantities)
    target_rows = list(zip(*table.target_rows.values(), strict=True))
    if target_rows:
        tables += _build_number_tables(table, target_rows, table.target_quantities)
    return [*tables, *failures]


def _build_number_tables(
    table: CoverageTable, rows_by_region: Sequence[tuple[Row, ...]], quantities: Sequence[Quantity]
) -> list[PageTable]:
    """Build the tables of numbers: one for a single rig, else one for each quantity."""
    if len(table.rigs) == 1:
        headings = [fill(format_heading(quantity), MAX_HEADING_CHARS) for quantity in quantities]
        cells = []
        for (row,) in rows_by_region:
            cells.append([_format_number_cell(row, quantity) for quantity in quantities])
        return [_add_common_columns(table, rows_by_region, "", headings, cells)]
    tables = []
    for quantity in quantities:
        cells = []
        for rows in rows_by_region:
            cells.append([_format_number_cell(row, quantity) for row in rows])
        title = capitalize(format_heading(quantity))
        tables.append(_add_common_columns(table, rows_by_region, title, table.rigs, cells))
    for quantity in quantities if table.first_conditions.blocks is not None else ():
        cells = []
        for rows in rows_by_region:
            cells.append([_format_difference_cell(row, quantity) for row in rows[1:]])
        title = f"Difference to {table.rigs[0]}: {format_difference_heading(quantity)}"
        tables.append(_add_common_columns(table, rows_by_region, title, table.rigs[1:], cells))
    return tables


def _build_failure_columns(table: CoverageTable, rig: str) -> PageTable:
    """Build the table of sensor failures with a column for each sensor."""
    rows = []
    for row in table.rows[rig]:
        cells = [TextCell(row.summary.region), TextCell(row.summary.band)]
        for text, is_significant in format_failure_cells(table, row):
            cells.append(TextCell(text, "significant" if is_significant else ""))
        rows.append(cells)
    headings = [*REGION_HEADINGS, *format_failure_headings(table, rig)]
    return PageTable(format_failure_title(table, rig), headings, rows, len(REGION_HEADINGS))


def _build_failure_rows(table: CoverageTable, rig: str) -> PageTable:
    """Build the narrow table of sensor failures: a row for each sensor with an effect, the largest loss first."""
    sensors, key = get_failure_sensors(table.rows[rig]), get_main_quantity(table).key
    num_redundancy_columns = len(format_failure_headings(table, rig)) - len(sensors) - 1
    rows = []
    for row in table.rows[rig]:
        cells = format_failure_cells(table, row)
        effects: list[tuple[float, str, str, bool]] = []
        for sensor, (text, is_significant) in zip(sensors, cells[num_redundancy_columns:-1], strict=True):
            if row.summary.redundancy and text not in ("0", UNKNOWN):
                improvement = row.summary.redundancy.failure_effects[sensor][key].improvement
                effects.append((improvement, sensor, text, is_significant))
        effects.sort()
        for index, (_, sensor, text, is_significant) in enumerate(effects or [(0.0, cells[-1][0], "", False)]):
            texts = [row.summary.region, row.summary.band]
            texts += [cell[0] if index == 0 else "" for cell in cells[: min(num_redundancy_columns, 1)]]
            change = TextCell(text, "significant" if is_significant else "")
            rows.append([*build_text_cells(*texts, sensor), change])
    redundancy_headings = ["detecting\nsensors"][:num_redundancy_columns]
    headings = [*REGION_HEADINGS, *redundancy_headings, "without", "change"]
    return PageTable(format_failure_title(table, rig), headings, rows, len(REGION_HEADINGS))


def _add_common_columns(
    table: CoverageTable,
    rows_by_region: Sequence[tuple[Row, ...]],
    title: str,
    headings: Sequence[str],
    numbers: Sequence[Sequence[TextCell]],
) -> PageTable:
    """Build a table with region and band in front of the numbers, and the shown ones of `COLUMNS` behind them."""
    average = rows_by_region[0][0].summary.average if rows_by_region else table.average
    columns = []
    for column in COLUMNS:
        if column.heading and column.average in (None, average):
            columns.append(column)
    rows = []
    for (row, *_), cells in zip(rows_by_region, numbers, strict=True):
        values = get_common_values(table, row)
        common = [TextCell(column.format_value(values[column.key])) for column in columns]
        rows.append((TextCell(row.summary.region), TextCell(row.summary.band), *cells, *common))
    region_headings = ("region", "target") if average == "target_positions" else REGION_HEADINGS
    all_headings = [*region_headings, *headings, *(column.heading for column in columns)]
    return PageTable(title, all_headings, rows, len(REGION_HEADINGS))


def _format_number_cell(row: Row, quantity: Quantity) -> TextCell:
    """Format a number with its interval, marked if it leads significantly."""
    text = format_number(row.summary.numbers[quantity.key])
    return TextCell(text, "best" if quantity.key in row.leading_keys else "")


def _format_difference_cell(row: Row, quantity: Quantity) -> TextCell:
    """Format a difference with its interval, marked if it is significant."""
    difference = row.differences[quantity.key]
    return TextCell(format_difference(difference), "significant" if difference.is_significant else "")
