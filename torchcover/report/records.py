"""The rows of a coverage as records: what CSV and JSON files hold."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchcover.coverage import Coverage, Region, RegionSummary

Record = dict[str, object]


def columns_of(coverage: Coverage) -> list[str]:
    """The keys of every record."""
    bounds = ["x_min_m", "x_max_m", "y_min_m", "y_max_m", "z_min_m", "z_max_m"]
    detection = [f"detection_{threshold:g}m" for threshold in coverage.thresholds]
    numbers = ["radius_m", *detection, "known_share", "known_cells", "cells", "cell_m", "steps"]
    return ["region", "height", *numbers, *bounds]


def records_of(coverage: Coverage, regions: Sequence[Region]) -> list[Record]:
    """A record for each region and height band; lengths in metres, detection and shares in [0, 1].

    Raises:
        ValueError: As `Coverage.summary`.
    """
    return [_record(coverage, region, row) for region in regions for row in coverage.summary([region])]


def write_records(columns: Sequence[str], records: Sequence[Record], path: str | Path) -> None:
    """Write records as CSV: an unknown number is an empty field, an infinite one is `inf`."""
    with Path(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(["" if _is_nan(value) else value for value in record.values()] for record in records)


def conditions_of(coverage: Coverage) -> dict[str, Any]:
    """What the numbers hold for, for JSON."""
    grid = coverage.grid
    return {
        "grid": {
            "x_m": list(grid.x),
            "y_m": list(grid.y),
            "cell_m": grid.cell,
            "heights_m": {name: list(band) for name, band in grid.heights.items()},
        },
        "thresholds_m": list(coverage.thresholds),
        "max_radius_m": _json_number(coverage.max_radius),
    }


def json_record(record: Mapping[str, object]) -> Record:
    """A record for JSON, which has neither NaN nor infinity: None is unknown, "Infinity" and "-Infinity" are words."""
    return {name: _json_number(value) for name, value in record.items()}


def _record(coverage: Coverage, region: Region, row: RegionSummary) -> Record:
    grid = coverage.grid
    sizes = (row.known_share, row.known_cells, row.cells, grid.cell, coverage.counts["steps"])
    bounds = (*region.x, *region.y, *grid.heights[row.height])
    values = (row.region, row.height, row.radius_m, *row.detection.values(), *sizes, *bounds)
    return dict(zip(columns_of(coverage), values, strict=True))


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _json_number(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    if math.isnan(value):
        return None
    return "Infinity" if value > 0 else "-Infinity"
