"""A table as records, one for each rig, region and band, and as CSV and JSON."""

import json
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

from torchcover.coverage.measures import Average
from torchcover.coverage.redundancy import list_redundancy_quantities
from torchcover.estimation import Difference, Number
from torchcover.files import format_csv
from torchcover.report.number_format import format_percent, format_square_meters
from torchcover.report.table import CoverageTable, Row
from torchcover.report.table_notes import get_failure_sensors

Record = dict[str, object]
ColumnGetters = dict[str, Callable[[Row], object]]


class Column(NamedTuple):
    """What stands in a row besides its numbers and their errors, of tables of one measure or of all.

    `meaning` is for the documentation. In words it stands under its heading, if it has one, as `format_value` makes it text.
    """

    key: str
    meaning: str
    get_value: Callable[[CoverageTable, Row], object]
    heading: str = ""
    format_value: Callable[[Any], str] = str
    average: Average | None = None


def _sensor_model(table: CoverageTable, row: Row) -> object:
    of_rigs = table.source.get("sensor_model")
    return of_rigs.get(row.rig) if isinstance(of_rigs, Mapping) else of_rigs


NO_BAND = math.nan, math.nan
COLUMNS = (
    Column(
        "average",
        "average of the numbers: `area`, `cells`, or `target_positions` of a test target",
        lambda _, r: r.summary.average,
    ),
    Column(
        "visible_m2",
        "mean of the square metres that the reference sees in a step",
        lambda _, row: row.summary.visible_m2,
        "visible surface\n(m2)",
        format_square_meters,
        "area",
    ),
    Column(
        "observed_share",
        "share of the cells that are known",
        lambda _, row: row.summary.observed_share,
        "known cells\n(%)",
        format_percent,
        "cells",
    ),
    Column(
        "observed_cells",
        "how many are known; of a body, places with room",
        lambda _, row: row.summary.observed_cells,
        "free places",
        average="target_positions",
    ),
    Column("cells", "of the region; of a body, places that were tried", lambda _, row: row.summary.num_cells),
    Column("cell_m", "side of a cell", lambda table, _: table.grid.cell_m),
    Column(
        "num_frames", "number of measured frames", lambda table, row: table.conditions[row.rig].counts["num_frames"]
    ),
    Column("blocks", "how many the errors come from", lambda table, row: table.conditions[row.rig].blocks),
    Column("frames_per_block", "of a full one", lambda table, row: table.conditions[row.rig].frames_per_block),
    Column("vehicle", "what carries the rig; empty if unknown", lambda table, _: table.source.get("vehicle")),
    Column("sensor_model", "what sensors make of their hits: `ideal` or `real`; empty if unknown", _sensor_model),
    Column("x_min_m", "where the region begins", lambda _, row: row.region.x_m[0]),
    Column("x_max_m", "where it ends", lambda _, row: row.region.x_m[1]),
    Column("y_min_m", "its right border", lambda _, row: row.region.y_m[0]),
    Column("y_max_m", "its left border", lambda _, row: row.region.y_m[1]),
    Column("band_frame", "what the band is over: `ground` or `vehicle`", lambda table, _: table.grid.band_frame),
    Column("z_min_m", "where the band begins", lambda table, row: table.grid.heights.get(row.summary.band, NO_BAND)[0]),
    Column("z_max_m", "where it ends", lambda table, row: table.grid.heights.get(row.summary.band, NO_BAND)[1]),
)


def build_records(table: CoverageTable) -> list[Record]:
    """A record for each row, rig by rig; lengths in metres, detection and shares in [0, 1], NaN where unknown."""
    columns = build_columns(table)
    rows = [row for each in (table.rows, table.target_rows) for of_rig in each.values() for row in of_rig]
    return [{name: of(row) for name, of in columns.items()} for row in rows]


def build_columns(table: CoverageTable) -> ColumnGetters:
    """What each record has, and where it is in a row."""
    keys = [quantity.key for quantity in (*table.quantities, *table.target_quantities)]
    means = [quantity.key for quantity in table.mean_quantities]
    columns: ColumnGetters = {
        "rig": lambda row: row.rig,
        "region": lambda row: row.summary.region,
        "band": lambda row: row.summary.band,
    }
    for key in keys:
        columns |= _of_summary(key)
    for key in means if table.average == "area" else ():
        columns |= _known(key)
    columns |= {column.key: partial(column.get_value, table) for column in COLUMNS}
    for key in keys if len(table.rigs) > 1 else ():
        columns |= _compared(key)
    sensors = dict.fromkeys(sensor for rows in table.rows.values() for sensor in get_failure_sensors(rows))
    if sensors:
        columns |= {"most_important_sensor": _get_most_important_sensor}
        for quantity in list_redundancy_quantities((), table.thresholds_m):
            columns |= _seen_by(quantity.key)
    for sensor in sensors:
        for key in means:
            columns |= _without(sensor, key)
    return columns


def _of_summary(key: str) -> ColumnGetters:
    return _number(key, lambda row: row.summary.numbers.get(key))


def _known(key: str) -> ColumnGetters:
    return _number(f"cells_{key}", lambda row: row.summary.cell_averages.get(key))


def _compared(key: str) -> ColumnGetters:
    return {
        f"{key}_best": lambda row: key in row.leading_keys,
        **_number(f"{key}_difference", lambda row: row.differences.get(key)),
        f"{key}_difference_significant": lambda row: getattr(row.differences.get(key), "is_significant", None),
    }


def _get_most_important_sensor(row: Row) -> object:
    return "" if row.summary.redundancy is None else row.summary.redundancy.most_critical_sensor or ""


def _seen_by(key: str) -> ColumnGetters:
    def number(row: Row) -> Number | None:
        return row.summary.redundancy.detecting_sensors[key] if row.summary.redundancy else None

    return _number(key, number)


def _without(sensor: str, key: str) -> ColumnGetters:
    """NaN for a rig that has no such sensor."""

    def number(row: Row) -> Number | None:
        return row.summary.redundancy.failure_numbers.get(sensor, {}).get(key) if row.summary.redundancy else None

    def change(row: Row) -> Difference | None:
        return row.summary.redundancy.failure_effects.get(sensor, {}).get(key) if row.summary.redundancy else None

    without = f"{key}_without_{sensor}"
    significant = f"{without}_change_significant"
    columns = _number(without, number) | _number(f"{without}_change", change)
    return {**columns, significant: lambda row: getattr(change(row), "is_significant", None)}


def _number(key: str, number: Callable[[Row], Number | Difference | None]) -> ColumnGetters:
    """A number, its standard error and the ends of its interval."""
    parts = {"value": key, "error": f"{key}_error", "low": f"{key}_low", "high": f"{key}_high"}
    return {name: partial(_part, number, part) for part, name in parts.items()}


def _part(number: Callable[[Row], Number | Difference | None], part: str, row: Row) -> object:
    return getattr(number(row), part, math.nan)


def render_json(table: CoverageTable) -> str:
    """The table as JSON text."""
    return json.dumps(build_table_dict(table), indent=2, allow_nan=False) + "\n"


def build_table_dict(table: CoverageTable) -> dict[str, Any]:
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
            "x_m": list(grid.x_m),
            "y_m": list(grid.y_m),
            "cell_m": grid.cell_m,
            "heights_m": {name: list(band) for name, band in grid.heights.items()},
        },
        "regions": {
            row.region.name: {"x_m": row.region.x_m, "y_m": row.region.y_m, "corners_m": row.region.corners_m}
            for row in table.rows[table.rigs[0]]
        },
        "thresholds_m": list(table.thresholds_m),
        "max_radius_m": _json_number(table.max_radius_m),
        "blocks": table.first_conditions.blocks,
        "frames_per_block": table.first_conditions.frames_per_block,
        "counts": counts if len(counts) > 1 else counts[table.rigs[0]],
        "rows": [to_json_record(record) for record in build_records(table)],
    }


def to_json_record(record: Mapping[str, object]) -> Record:
    """A record for JSON, which has neither NaN nor infinity: None is unknown, "Infinity" and "-Infinity" are words.

    Example:
        >>> to_json_record({"radius_m": float("inf"), "radius_m_error": float("nan"), "steps": 3})
        {'radius_m': 'Infinity', 'radius_m_error': None, 'steps': 3}
    """
    return {name: _json_number(value) for name, value in record.items()}


def _json_number(value: object) -> object:
    if not isinstance(value, float) or math.isfinite(value):
        return value
    if math.isnan(value):
        return None
    return "Infinity" if value > 0 else "-Infinity"


def render_csv(table: CoverageTable) -> str:
    """A line for each rig, region and band, under a header; an unknown number is an empty field, infinity is `inf`."""
    return format_csv([build_columns(table), *(record.values() for record in build_records(table))])
