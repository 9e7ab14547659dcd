"""The numbers of a coverage, a row for each region and height band: on the terminal, as CSV and as JSON."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from torchcover.coverage import Coverage, Region, RegionSummary
from torchcover.coverage.blocks import MIN_BLOCKS
from torchcover.report.records import columns_of, conditions_of, json_record, records_of, write_records
from torchcover.report.wording import blocks_of_steps, metres, percent, span, steps_and_cell


def coverage_table(coverage: Coverage, regions: Sequence[Region], notes: Sequence[str] = ()) -> Table:
    """The table for the terminal; the conditions it holds under, and what went wrong, are its caption.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        regions: Regions within the grid.
        notes: More conditions for the caption.

    Returns:
        A table for `rich.console.Console.print`: mean blind spot radius in metres, detection and known cells in
        percent, with standard errors if there are any. A number over no known cell reads "unknown".

    Raises:
        ValueError: As `Coverage.summary`.
    """
    rows = coverage.summary(regions)
    caption = Text("\n".join([*notes_on(coverage, rows), *notes]))
    table = Table(caption=caption, caption_justify="left", caption_style="")
    table.add_column("region")
    table.add_column("height")
    table.add_column("mean blind spot\nradius (m)", justify="right")
    for threshold in coverage.thresholds:
        table.add_column(f"detection within\n{threshold:g} m (%)", justify="right")
    table.add_column("known cells\n(%)", justify="right")
    for at, row in enumerate(rows, 1):
        table.add_row(*_cells(row), end_section=at % len(coverage.grid.heights) == 0)
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
    write_records(columns_of(coverage), records_of(coverage, regions, coverage.summary(regions)), path)


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
        "rows": [json_record(record) for record in records_of(coverage, regions, coverage.summary(regions))],
    }


def notes_on(coverage: Coverage, rows: Sequence[RegionSummary]) -> list[str]:
    """The conditions that the rows of a coverage hold under, and what went wrong, a sentence each."""
    bands = ", ".join(f"{name} z {span(band)}" for name, band in coverage.grid.heights.items())
    notes = [f"{steps_and_cell(coverage.counts['steps'], coverage.grid)}; {bands}."]
    if not rows:
        notes.append("No region, so no number: the maps cover the whole grid.")
    if any(row.known_cells < row.cells for row in rows):
        notes.append("Means over the known cells only; the fewer are known, the more the numbers may flatter the rig.")
    return notes + _on_errors(coverage, rows) + _trouble(coverage)


def _on_errors(coverage: Coverage, rows: Sequence[RegionSummary]) -> list[str]:
    blocks, steps = blocks_of_steps(coverage)
    if blocks is None:
        return []
    if blocks < MIN_BLOCKS:
        return [f"Not enough steps for errors: {blocks} block{'s' * (blocks != 1)}, {MIN_BLOCKS} are needed."]
    notes = [f"± is one standard error, from {blocks} blocks of up to {steps:,} steps in a row."]
    if any(math.isfinite(row.radius_m) and math.isnan(row.radius_error_m) for row in rows):
        notes.append("No ± where one block alone has probed the region.")
    return notes


def _cells(row: RegionSummary) -> list[Text]:
    radius = metres(row.radius_m, row.radius_error_m)
    detection = [percent(row.detection[threshold], row.detection_error[threshold]) for threshold in row.detection]
    # As Text, for names may hold what rich takes for markup.
    return [Text(cell) for cell in (row.region, row.height, radius, *detection, percent(row.known_share))]


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
