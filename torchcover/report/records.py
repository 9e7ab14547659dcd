"""Coverage table as records, one for each rig, region and band, and as CSV and JSON."""

import json
import math
from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter
from typing import Any, NamedTuple

from torchcover.coverage.averages import Average
from torchcover.coverage.redundancy import list_redundancy_quantities
from torchcover.estimation import Difference, Number
from torchcover.files import format_csv
from torchcover.report.number_format import format_percent, format_square_meters
from torchcover.report.sensor_failures import get_failure_sensors
from torchcover.report.table import CoverageTable, Row

Record = dict[str, object]
ColumnGetters = dict[str, Callable[[Row], object]]
NumberGetter = Callable[[Row], Number | Difference | None]


class Column(NamedTuple):
    """Column of records besides the numbers and their errors.

    Args:
        key: Name of the column.
        meaning: Meaning, for the documentation.
        heading: Heading in tables for readers; empty hides the column there.
        format_value: Function that formats the value in these tables.
        average: Average of the tables that show it; None for all.
    """

    key: str
    meaning: str
    heading: str = ""
    format_value: Callable[[Any], str] = str
    average: Average | None = None


COLUMNS = (
    Column("average", "average of the numbers: `area`, `cells`, or `target_positions` of a test target"),
    Column(
        "visible_m2",
        "mean area in square meters that the reference observes in a frame",
        "visible surface\n(m2)",
        format_square_meters,
        "area",
    ),
    Column("observed_share", "share of the cells that are observed", "observed cells\n(%)", format_percent, "cells"),
    Column(
        "observed_cells",
        "number of observed cells; of a test target, number of free positions",
        "free positions",
        average="target_positions",
    ),
    Column("cells", "cells of the region; of a test target, tested positions"),
    Column("cell_m", "side of a cell"),
    Column("num_frames", "number of measured frames"),
    Column("blocks", "number of blocks for the errors"),
    Column("frames_per_block", "of a full block"),
    Column("vehicle", "vehicle of the rig; empty if unknown"),
    Column("sensor_model", "`ideal`, or `real` with range-limited returns; empty if unknown"),
    Column("x_min_m", "rear end of the region"),
    Column("x_max_m", "front end of the region"),
    Column("y_min_m", "right end of the region"),
    Column("y_max_m", "left end of the region"),
    Column("band_frame", "origin of heights: `ground` or `vehicle`"),
    Column("z_min_m", "lower end of the band"),
    Column("z_max_m", "upper end of the band"),
)


def get_common_values(table: CoverageTable, row: Row) -> Record:
    """Return the values of `COLUMNS` in a row.

    Args:
        table: Table of the row.
        row: One region and band (or test target) of a rig.
    """
    summary, grid, conditions = row.summary, table.grid, table.conditions[row.rig]
    sensor_model = table.source.get("sensor_model")
    z_min_m, z_max_m = grid.heights.get(summary.band, (math.nan, math.nan))
    return {
        "average": summary.average,
        "visible_m2": summary.visible_m2,
        "observed_share": summary.observed_share,
        "observed_cells": summary.observed_cells,
        "cells": summary.num_cells,
        "cell_m": grid.cell_m,
        "num_frames": conditions.counts["num_frames"],
        "blocks": conditions.blocks,
        "frames_per_block": conditions.frames_per_block,
        "vehicle": table.source.get("vehicle"),
        "sensor_model": sensor_model.get(row.rig) if isinstance(sensor_model, Mapping) else sensor_model,
        "x_min_m": row.region.x_m[0],
        "x_max_m": row.region.x_m[1],
        "y_min_m": row.region.y_m[0],
        "y_max_m": row.region.y_m[1],
        "band_frame": grid.band_frame,
        "z_min_m": z_min_m,
        "z_max_m": z_max_m,
    }


def build_records(table: CoverageTable) -> list[Record]:
    """Build a record for each row, rig by rig: lengths in meters, rates and shares in [0, 1], NaN where unknown.

    Args:
        table: The table.
    """
    columns = build_columns(table)
    rows: list[Row] = []
    for rows_by_rig in (table.rows, table.target_rows):
        for rig_rows in rows_by_rig.values():
            rows += rig_rows
    records = []
    for row in rows:
        records.append({name: get_value(row) for name, get_value in columns.items()})
    return records


def build_columns(table: CoverageTable) -> ColumnGetters:
    """Build the columns of records.

    Args:
        table: The table.

    Returns:
        Name of each column -> function that returns its value in a row.
    """
    keys = [quantity.key for quantity in (*table.quantities, *table.target_quantities)]
    mean_keys = [quantity.key for quantity in table.mean_quantities]
    columns: ColumnGetters = {
        "rig": attrgetter("rig"),
        "region": attrgetter("summary.region"),
        "band": attrgetter("summary.band"),
    }
    for key in keys:
        columns |= _build_number_columns(key, partial(_get_number, key))
    for key in mean_keys if table.average == "area" else ():
        columns |= _build_number_columns(f"cells_{key}", partial(_get_cell_average, key))
    for column in COLUMNS:
        columns[column.key] = partial(_get_common_value, table, column.key)
    for key in keys if len(table.rigs) > 1 else ():
        columns[f"{key}_best"] = partial(_is_leading, key)
        columns |= _build_number_columns(f"{key}_difference", partial(_get_difference, key))
        columns[f"{key}_difference_significant"] = partial(_is_significant, partial(_get_difference, key))
    sensors: dict[str, None] = {}
    for rig_rows in table.rows.values():
        sensors |= dict.fromkeys(get_failure_sensors(rig_rows))
    if sensors:
        columns["most_critical_sensor"] = _get_most_critical_sensor
        for quantity in list_redundancy_quantities((), table.thresholds_m):
            columns |= _build_number_columns(quantity.key, partial(_get_redundancy, quantity.key))
    for sensor in sensors:
        for key in mean_keys:
            name = f"{key}_without_{sensor}"
            columns |= _build_number_columns(name, partial(_get_failure_number, sensor, key))
            columns |= _build_number_columns(f"{name}_change", partial(_get_failure_effect, sensor, key))
            columns[f"{name}_change_significant"] = partial(_is_significant, partial(_get_failure_effect, sensor, key))
    return columns


def _get_common_value(table: CoverageTable, key: str, row: Row) -> object:
    return get_common_values(table, row)[key]


def _get_number(key: str, row: Row) -> Number | None:
    return row.summary.numbers.get(key)


def _get_cell_average(key: str, row: Row) -> Number | None:
    return row.summary.cell_averages.get(key)


def _get_difference(key: str, row: Row) -> Difference | None:
    return row.differences.get(key)


def _is_leading(key: str, row: Row) -> bool:
    return key in row.leading_keys


def _is_significant(get_difference: Callable[[Row], Difference | None], row: Row) -> bool | None:
    """Return whether a difference is significant; None if there is no difference or no error."""
    difference = get_difference(row)
    return None if difference is None else difference.is_significant


def _get_most_critical_sensor(row: Row) -> str:
    """Return the sensor whose failure changes most; empty without redundancy or effect."""
    return "" if row.summary.redundancy is None else row.summary.redundancy.most_critical_sensor or ""


def _get_redundancy(key: str, row: Row) -> Number | None:
    """Return a number of redundancy; None without redundancy."""
    return row.summary.redundancy.detecting_sensors[key] if row.summary.redundancy else None


def _get_failure_number(sensor: str, key: str, row: Row) -> Number | None:
    """Return a number of the rig without a sensor; None if it was not computed."""
    return row.summary.redundancy.failure_numbers.get(sensor, {}).get(key) if row.summary.redundancy else None


def _get_failure_effect(sensor: str, key: str, row: Row) -> Difference | None:
    """Return the change of a number without a sensor; None if it was not computed."""
    return row.summary.redundancy.failure_effects.get(sensor, {}).get(key) if row.summary.redundancy else None


def _build_number_columns(key: str, get_number: NumberGetter) -> ColumnGetters:
    """Build the columns of a number, its standard error and the ends of its interval."""
    parts = {"value": key, "error": f"{key}_error", "low": f"{key}_low", "high": f"{key}_high"}
    return {name: partial(_get_part, get_number, part) for part, name in parts.items()}


def _get_part(get_number: NumberGetter, part: str, row: Row) -> object:
    """Return a part of a number, such as its error; NaN if there is no number."""
    return getattr(get_number(row), part, math.nan)


def render_json(table: CoverageTable) -> str:
    """Render a table as JSON.

    Args:
        table: The table.
    """
    return json.dumps(build_table_dict(table), indent=2, allow_nan=False) + "\n"


def build_table_dict(table: CoverageTable) -> dict[str, Any]:
    """Build the content of `summary.json`.

    Args:
        table: The table.

    Returns:
        A dict for `json.dumps(..., allow_nan=False)`: lengths in meters, rates and shares in [0, 1], counts of several
        rigs by name. A difference is the rig minus the first rig. JSON has neither NaN nor infinity: an unknown number
        is None, an infinite one the string "Infinity".
    """
    grid = table.grid
    counts = {rig: dict(conditions.counts) for rig, conditions in table.conditions.items()}
    regions = {}
    for row in table.rows[table.rigs[0]]:
        region = row.region
        regions[region.name] = {"x_m": region.x_m, "y_m": region.y_m, "corners_m": region.corners_m}
    return {
        "band_frame": grid.band_frame,
        "grid": {
            "x_m": list(grid.x_m),
            "y_m": list(grid.y_m),
            "cell_m": grid.cell_m,
            "heights_m": {name: list(band) for name, band in grid.heights.items()},
        },
        "regions": regions,
        "thresholds_m": list(table.thresholds_m),
        "max_radius_m": _to_json_number(table.max_radius_m),
        "blocks": table.first_conditions.blocks,
        "frames_per_block": table.first_conditions.frames_per_block,
        "counts": counts if len(counts) > 1 else counts[table.rigs[0]],
        "rows": [to_json_record(record) for record in build_records(table)],
    }


def to_json_record(record: Mapping[str, object]) -> Record:
    """Convert a record for JSON: NaN becomes None, infinities become "Infinity" and "-Infinity".

    Args:
        record: Column -> value.

    Example:
        >>> to_json_record({"radius_m": float("inf"), "radius_m_error": float("nan"), "num_frames": 3})
        {'radius_m': 'Infinity', 'radius_m_error': None, 'num_frames': 3}
    """
    return {name: _to_json_number(value) for name, value in record.items()}


def _to_json_number(value: object) -> object:
    """Convert a float for JSON, which has neither NaN nor infinity."""
    if not isinstance(value, float) or math.isfinite(value):
        return value
    if math.isnan(value):
        return None
    return "Infinity" if value > 0 else "-Infinity"


def render_csv(table: CoverageTable) -> str:
    """Render a table as CSV: a header, then a line for each rig, region and band; NaN is empty, infinity `inf`.

    Args:
        table: The table.
    """
    return format_csv([build_columns(table), *(record.values() for record in build_records(table))])
