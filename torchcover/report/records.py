"""The rows of a coverage as records: what CSV and JSON files hold."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchcover.coverage import Coverage, Region, RegionNumbers, RegionSummary
from torchcover.report.wording import blocks_of_steps

Record = dict[str, object]


def columns_of(coverage: Coverage) -> list[str]:
    """The keys of every record."""
    bounds = ["x_min_m", "x_max_m", "y_min_m", "y_max_m", "z_min_m", "z_max_m"]
    names = [f"detection_{threshold:g}m" for threshold in coverage.thresholds]
    detection = [column for name in names for column in (name, f"{name}_error")]
    numbers = ["radius_m", "radius_error_m", *detection]
    completed = [f"completed_{name}" for name in numbers]
    conditions = ["known_share", "known_cells", "unseen_cells", "cells", "cell_m", "steps", "blocks", "steps_per_block"]
    return ["region", "height", *numbers, *completed, *conditions, *bounds]


def records_of(coverage: Coverage, regions: Sequence[Region], rows: Sequence[RegionSummary]) -> list[Record]:
    """A record for each region and height band; lengths in metres, detection and shares in [0, 1].

    Args:
        coverage: What `CoverageMetric.compute` returned.
        regions: Regions within the grid.
        rows: Its summary over these regions.

    Returns:
        Records in which an unknown error is NaN, and numbers of blocks are None if there are none.
    """
    places = [region for region in regions for _ in coverage.grid.heights]
    return [_record(coverage, region, row) for region, row in zip(places, rows, strict=True)]


def write_records(columns: Sequence[str], records: Sequence[Record], path: str | Path) -> None:
    """Write records as CSV: an unknown number is an empty field, an infinite one is `inf`."""
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(["" if _is_nan(value) else value for value in record.values()] for record in records)


def conditions_of(coverage: Coverage) -> dict[str, Any]:
    """What the numbers hold for, for JSON."""
    grid, (blocks, steps_per_block) = coverage.grid, blocks_of_steps(coverage)
    return {
        "grid": {
            "x_m": list(grid.x),
            "y_m": list(grid.y),
            "cell_m": grid.cell,
            "heights_m": {name: list(band) for name, band in grid.heights.items()},
        },
        "thresholds_m": list(coverage.thresholds),
        "max_radius_m": _json_number(coverage.max_radius),
        "blocks": blocks,
        "steps_per_block": steps_per_block,
    }


def json_record(record: Mapping[str, object]) -> Record:
    """A record for JSON, which has neither NaN nor infinity: None is unknown, "Infinity" and "-Infinity" are words."""
    return {name: _json_number(value) for name, value in record.items()}


def _record(coverage: Coverage, region: Region, row: RegionSummary) -> Record:
    grid = coverage.grid
    sizes = (row.known_share, row.known_cells, row.unseen_cells, row.cells, grid.cell, coverage.counts["steps"])
    bounds = (*region.x, *region.y, *grid.heights[row.height])
    numbers = (*_numbers(row), *_numbers(row.completed))
    values = (row.region, row.height, *numbers, *sizes, *blocks_of_steps(coverage), *bounds)
    return dict(zip(columns_of(coverage), values, strict=True))


def _numbers(of: RegionNumbers) -> list[float]:
    detection = [number for at in of.detection for number in (of.detection[at], of.detection_error[at])]
    return [of.radius_m, of.radius_error_m, *detection]


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _json_number(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    if math.isnan(value):
        return None
    return "Infinity" if value > 0 else "-Infinity"
