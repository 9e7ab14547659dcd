"""A table as JSON."""

import json
import math
from collections.abc import Mapping
from typing import Any

from torchcover.report.renderers.records import Record, records_of
from torchcover.report.table import CoverageTable


def render(table: CoverageTable) -> str:
    """The table as JSON text."""
    return json.dumps(table_dict(table), indent=2, allow_nan=False) + "\n"


def table_dict(table: CoverageTable) -> dict[str, Any]:
    """Everything of a table that JSON can hold, for `summary.json`.

    Returns:
        A dict that `json.dumps(..., allow_nan=False)` takes: lengths in metres, detection and shares in [0, 1]; the
        counts of several rigs by their names. A difference is this rig minus the first. JSON has neither NaN nor
        infinity: an unknown number is None, an infinite one the string "Infinity".
    """
    grid = table.grid
    counts = {rig: dict(conditions.counts) for rig, conditions in table.conditions.items()}
    return {
        "band_frame": grid.band_frame,
        "grid": {
            "x_m": list(grid.x),
            "y_m": list(grid.y),
            "cell_m": grid.cell,
            "heights_m": {name: list(band) for name, band in grid.heights.items()},
        },
        "regions": {
            row.region.name: {"x_m": row.region.x, "y_m": row.region.y, "corners_m": row.region.corners_m}
            for row in table.rows[table.rigs[0]]
        },
        "thresholds_m": list(table.thresholds),
        "max_radius_m": _number(table.max_radius),
        "blocks": table.first.blocks,
        "steps_per_block": table.first.steps_per_block,
        "counts": counts if len(counts) > 1 else counts[table.rigs[0]],
        "rows": [json_record(record) for record in records_of(table)],
    }


def json_record(record: Mapping[str, object]) -> Record:
    """A record for JSON, which has neither NaN nor infinity: None is unknown, "Infinity" and "-Infinity" are words.

    Example:
        >>> json_record({"radius_m": float("inf"), "radius_m_error": float("nan"), "steps": 3})
        {'radius_m': 'Infinity', 'radius_m_error': None, 'steps': 3}
    """
    return {name: _number(value) for name, value in record.items()}


def _number(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    if math.isnan(value):
        return None
    return "Infinity" if value > 0 else "-Infinity"
