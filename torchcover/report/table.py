"""The numbers of a coverage, a row for each region and height band: on the terminal, as CSV and as JSON."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from torchcover.coverage import Coverage, Region, RegionSummary
from torchcover.report.records import columns_of, conditions_of, json_record, records_of, write_records
from torchcover.report.wording import metres, percent, span, steps_and_cell


def coverage_table(coverage: Coverage, regions: Sequence[Region]) -> Table:
    """The table for the terminal; the conditions it holds under, and what went wrong, are its caption.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        regions: Regions within the grid.

    Returns:
        A table for `rich.console.Console.print`: mean blind spot radius in metres, detection and known cells in
        percent. A number over no known cell reads "unknown".

    Raises:
        ValueError: As `Coverage.summary`.
    """
    notes = "\n".join(notes_on(coverage, coverage.summary(regions)))
    table = Table(caption=Text(notes), caption_justify="left", caption_style="")
    table.add_column("region")
    table.add_column("height")
    table.add_column("mean blind spot\nradius (m)", justify="right")
    for threshold in coverage.thresholds:
        table.add_column(f"detection within\n{threshold:g} m (%)", justify="right")
    table.add_column("known cells\n(%)", justify="right")
    for region in regions:
        for row in coverage.summary([region]):
            table.add_row(*_cells(row))
        table.add_section()
    return table


def write_csv(coverage: Coverage, regions: Sequence[Region], path: str | Path) -> None:
    """Write the rows as CSV, with the bounds of region and band, the cell size and the steps on every row.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        regions: Regions within the grid.
        path: File to write. An unknown number is an empty field, an infinite one is `inf`.

    Raises:
        ValueError: As `Coverage.summary`.
    """
    write_records(columns_of(coverage), records_of(coverage, regions), path)


def summary_dict(coverage: Coverage, regions: Sequence[Region]) -> dict[str, Any]:
    """Everything but the maps, for `summary.json`.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        regions: Regions within the grid.

    Returns:
        A dict that `json.dumps(..., allow_nan=False)` takes: lengths in metres, detection and shares in [0, 1]. JSON
        has neither NaN nor infinity: an unknown number is None, an infinite one the string "Infinity".

    Raises:
        ValueError: As `Coverage.summary`.
    """
    return {
        **conditions_of(coverage),
        "counts": dict(coverage.counts),
        "rows": [json_record(record) for record in records_of(coverage, regions)],
    }


def notes_on(coverage: Coverage, rows: Sequence[RegionSummary]) -> list[str]:
    """The conditions that the rows of a coverage hold under, and what went wrong, a sentence each."""
    bands = ", ".join(f"{name} z {span(band)}" for name, band in coverage.grid.heights.items())
    notes = [f"{steps_and_cell(coverage.counts['steps'], coverage.grid)}; {bands}."]
    if not rows:
        notes.append("No region, so no number: the maps cover the whole grid.")
    if any(row.known_cells < row.cells for row in rows):
        notes.append("Means over the known cells only; the fewer are known, the more the numbers may flatter the rig.")
    return notes + _trouble(coverage)


def _cells(row: RegionSummary) -> list[Text]:
    detection = [percent(probability) for probability in row.detection.values()]
    # As Text, for names may hold what rich takes for markup.
    return [Text(c) for c in (row.region, row.height, metres(row.radius_m), *detection, percent(row.known_share))]


def _trouble(coverage: Coverage) -> list[str]:
    counts, limit_m = coverage.counts, coverage.max_radius
    steps, inside = counts["steps"], int(coverage.points.sum())
    far = "infinitely far" if math.isinf(limit_m) else f"{limit_m:.4g} m far, the limit"
    notes = {
        "empty_sensor_steps": f"of {steps:,} steps had no sensor point: they count as blind, not as missing.",
        "empty_reference_steps": f"of {steps:,} steps had no reference point: they say nothing.",
        "saturated_points": f"of {inside:,} reference points count as {far}: no sensor point was nearer.",
        "outside_points": f"of {inside + counts['outside_points']:,} reference points lie outside the grid: left out.",
    }
    return [f"{counts[name]:,} {note}" for name, note in notes.items() if counts[name]]
