"""The numbers of several rigs side by side, the better ones marked: on the terminal, as CSV and as JSON."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from torchcover.coverage import Coverage, Region, RegionSummary
from torchcover.report.paired import check_paired
from torchcover.report.records import Record, columns_of, conditions_of, json_record, records_of, write_records
from torchcover.report.table import notes_on
from torchcover.report.wording import metres, percent

# Survives files and terminals without bold type.
MARK = "*"
# A marked number is never broken, however narrow the terminal.
NARROWEST_COLUMN = len(f"{MARK} infinite")
# More characters than any table has in a line.
WIDEST = 10_000


def comparison_tables(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> list[Table]:
    """The paper's table for the terminal: a part for the radius and one for each threshold, a column for each rig.

    The best number of each row is bold and marked `*`, and so are all that print the same. An unknown one never is.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig, from the same frames.
        regions: Regions within the grid.

    Returns:
        Tables for `rich.console.Console.print`; what they hold under, and what went wrong, is the caption of the last.

    Raises:
        ValueError: As `check_paired`, or as `Coverage.summary`.
    """
    check_paired(coverages)
    tables = [_table(coverages, regions, quantity) for quantity in _quantities(coverages)]
    tables[-1].caption = Text("\n".join(_notes(coverages, regions)))
    return tables


def narrowest_width(tables: Sequence[Table], rigs: Sequence[str]) -> int:
    """Characters in a line that the tables need at least, with the names folded and the numbers whole."""
    console = Console(width=WIDEST)
    natural = max(Measurement.get(console, console.options, table).maximum for table in tables)
    return natural - sum(max(0, cell_len(name) - NARROWEST_COLUMN) for name in rigs)


def write_comparison(coverages: Mapping[str, Coverage], regions: Sequence[Region], path: str | Path) -> None:
    """Write a CSV row for each rig, region and band: the columns of `write_csv`, marks, differences to the first rig.

    Args:
        coverages: As in `comparison_tables`.
        regions: Regions within the grid.
        path: File to write.

    Raises:
        ValueError: As `comparison_tables`.
    """
    check_paired(coverages)
    names = [quantity.column for quantity in _quantities(coverages)]
    own = [f"{name}_{suffix}" for name in names for suffix in ("best", "difference")]
    columns = ["rig", *columns_of(_first(coverages)), *own]
    write_records(columns, list(_records(coverages, regions)), path)


def comparison_dict(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> dict[str, Any]:
    """Everything but the maps, for `summary.json`; see `write_comparison`.

    Args:
        coverages: As in `comparison_tables`.
        regions: Regions within the grid.

    Returns:
        A dict that `json.dumps(..., allow_nan=False)` takes. A difference is this rig minus the first; an unknown
        number is None.

    Raises:
        ValueError: As `comparison_tables`.
    """
    check_paired(coverages)
    return {
        **conditions_of(_first(coverages)),
        "counts": {name: dict(coverage.counts) for name, coverage in coverages.items()},
        "rows": [json_record(record) for record in _records(coverages, regions)],
    }


@dataclass(frozen=True)
class _Quantity:
    column: str
    title: str
    words: Callable[[float], str]
    lower_is_better: bool
    threshold: float | None = None

    def of(self, row: RegionSummary) -> float:
        return row.radius_m if self.threshold is None else row.detection[self.threshold]

    def best(self, values: Sequence[float]) -> list[bool]:
        """Which values are the best to the digits that are shown."""
        known = [value for value in values if not math.isnan(value)]
        if not known:
            return [False] * len(values)
        best = self.words(min(known) if self.lower_is_better else max(known))
        return [self.words(value) == best for value in values]


def _quantities(coverages: Mapping[str, Coverage]) -> list[_Quantity]:
    detection = [
        _Quantity(f"detection_{threshold:g}m", f"Detection within {threshold:g} m (%)", percent, False, threshold)
        for threshold in _first(coverages).thresholds
    ]
    return [_Quantity("radius_m", "Mean blind spot radius (m)", metres, True), *detection]


def _first(coverages: Mapping[str, Coverage]) -> Coverage:
    return next(iter(coverages.values()))


def _table(coverages: Mapping[str, Coverage], regions: Sequence[Region], quantity: _Quantity) -> Table:
    left: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    table = Table(title=quantity.title, title_style="bold", caption_style="", **left)
    table.add_column("region", no_wrap=True)
    table.add_column("height", no_wrap=True)
    for name in coverages:
        table.add_column(Text(name), justify="right", overflow="fold", min_width=NARROWEST_COLUMN)
    table.add_column("known cells\n(%)", justify="right", no_wrap=True)
    for region in regions:
        for rows in zip(*(coverage.summary([region]) for coverage in coverages.values()), strict=True):
            values = [quantity.of(row) for row in rows]
            cells = map(_cell, map(quantity.words, values), quantity.best(values))
            table.add_row(Text(region.name), Text(rows[0].height), *cells, percent(rows[0].known_share))
        table.add_section()
    return table


def _cell(words: str, best: bool) -> Text:
    return Text(f"{MARK} {words}", style="bold") if best else Text(words)


def _records(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> Iterator[Record]:
    quantities = _quantities(coverages)
    summaries = [coverage.summary(regions) for coverage in coverages.values()]
    for rig, (name, coverage) in enumerate(coverages.items()):
        for record, rows in zip(records_of(coverage, regions), zip(*summaries, strict=True), strict=True):
            compared: Record = {}
            for quantity in quantities:
                values = [quantity.of(row) for row in rows]
                compared[f"{quantity.column}_best"] = quantity.best(values)[rig]
                compared[f"{quantity.column}_difference"] = _difference(values[rig], values[0])
            yield {"rig": name, **record, **compared}


def _difference(value: float, first: float) -> float:
    # Two infinite numbers are equal; their difference would be NaN, which means unknown.
    return 0.0 if value == first else value - first


def _notes(coverages: Mapping[str, Coverage], regions: Sequence[Region]) -> list[str]:
    notes = {name: notes_on(coverage, coverage.summary(regions)) for name, coverage in coverages.items()}
    common = [note for note in next(iter(notes.values())) if all(note in other for other in notes.values())]
    own = [f"{name}: {note}" for name, lines in notes.items() for note in lines if note not in common]
    mark = f"{MARK} the best of its row; equal numbers are all marked, unknown ones never."
    paired = "All rigs were measured against the same reference points, so they know the same cells."
    return [mark, paired, *common, *own]
