"""Page of a result: tables, maps, rigs, settings and facts on the run."""

import math
import platform
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from pydantic import BaseModel

from torchcover.coverage import Coverage, Region
from torchcover.evaluation.settings import parse_file_kinds
from torchcover.files import to_yaml
from torchcover.report import (
    BOLD_MARKS,
    MapLine,
    PageTable,
    SensorView,
    build_page_tables,
)
from torchcover.report.map_layers import list_map_quantities
from torchcover.report.table import CoverageTable
from torchcover.report.table_notes import explain_marks, list_notes
from torchcover.simulation import Sensor, compute_vertical_fov_deg

# Keys of the record that the page shows under "Run".
RUN_FACTS = ("torchcover", "duration_s", "complete", "device", "skipped_frames")
# Keys of the record that the page shows in its tables.
FACTS_IN_TABLES = frozenset(
    ["verdict", "notes", "rows", "scenarios", "metrics", "counts", "frame_counts", "omissions", "rig", "rigs"]
)


@dataclass(frozen=True)
class RenderingCosts:
    """Cost of the page and the maps of a result, measured with 1 to 16 rigs on the default grid.

    Args:
        bytes_per_cell: Memory per cell and rig, independent of the quantities.
        bytes_per_value: Memory per cell, rig and quantity, for the value and its standard error.
        seconds_per_map: Time to plot one map; there are three maps per rig, height band and quantity.
        min_announced_s: Shorter times are not announced.
        min_announced_bytes: Less memory is not announced.
    """

    bytes_per_cell: int = 40
    bytes_per_value: int = 20
    seconds_per_map: float = 0.1
    min_announced_s: float = 60.0
    min_announced_bytes: float = 2e9


COSTS = RenderingCosts()


def estimate_rendering_cost(coverages: Mapping[str, Coverage], file_kinds: Container[str]) -> tuple[float, float]:
    """Estimate the cost of the page and the maps of a result.

    Args:
        coverages: Name of each rig -> its coverage.
        file_kinds: Requested files; only "maps" and "page" have a cost.

    Returns:
        Memory in bytes and time in seconds.
    """
    first_coverage = next(iter(coverages.values()))
    grid, num_quantities = first_coverage.grid, len(list_map_quantities(first_coverage))
    needed_bytes = seconds = 0.0
    if "maps" in file_kinds or "page" in file_kinds:
        bytes_per_cell = COSTS.bytes_per_cell + COSTS.bytes_per_value * num_quantities
        needed_bytes = float(len(coverages) * grid.num_cells * bytes_per_cell)
    if "maps" in file_kinds:
        seconds = 3 * COSTS.seconds_per_map * len(coverages) * num_quantities * len(grid.heights)
    return needed_bytes, seconds


def describe_rendering_cost(coverages: Mapping[str, Coverage], file_kinds: str | Iterable[str]) -> str:
    """Describe the cost of the page and the maps of a result in one sentence; empty if it is small.

    Args:
        coverages: Name of each rig -> its coverage.
        file_kinds: Requested files, as in `Result.save`.
    """
    needed_bytes, seconds = estimate_rendering_cost(coverages, parse_file_kinds(file_kinds))
    if needed_bytes < COSTS.min_announced_bytes and seconds < COSTS.min_announced_s:
        return ""
    return (
        f"page and maps of {len(coverages)} rigs take about {needed_bytes / 1e9:.2g} GB of memory and "
        f"{math.ceil(seconds / 60)} min, after the numbers are saved; omit them with `--files numbers`"
    )


def build_result_tables(table: CoverageTable) -> list[PageTable]:
    """Build the tables of a coverage table, with its notes below the last one.

    Args:
        table: The coverage table.
    """
    notes = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in explain_marks(table).items()]
    *tables, last_table = build_page_tables(table)
    return [*tables, replace(last_table, notes=[*notes, *list_notes(table)])]


def build_sensor_views(sensors: Sequence[Sensor]) -> list[SensorView]:
    """Build the poses and fields of view of sensors, for maps.

    Args:
        sensors: The sensors.

    Returns:
        One view for each sensor: pose in the vehicle frame, fields of view in degrees, range in meters.
    """
    views = []
    for sensor in sensors:
        view = SensorView(
            name=sensor.name,
            vehicle_T_sensor=sensor.mount.to_matrix(),
            horizontal_fov_deg=sensor.horizontal_fov_deg,
            vertical_fov_deg=compute_vertical_fov_deg(sensor),
            range_m=sensor.max_range_m,
        )
        views.append(view)
    return views


def check_drawable(sensors: Sequence[Sensor]) -> None:
    """Check before a run that its maps can show the sensors.

    Args:
        sensors: The sensors.

    Raises:
        ValueError: The rays in the middle row of a sensor have no horizontal field of view.
    """
    for sensor in sensors:
        if not 0 < sensor.horizontal_fov_deg <= 360:
            raise ValueError(
                f"sensor {sensor.name!r}: its rays span {sensor.horizontal_fov_deg:g} degrees in the middle row; above "
                "0 are needed, so check its lens and its principal point"
            )


def format_rig_yaml(name: str, sensors: Sequence[Sensor]) -> str:
    """Format a rig as YAML that `Rig.load` reads.

    Args:
        name: Name of the rig.
        sensors: Its sensors.

    Returns:
        The text; empty if the sensors are unknown or a sensor is a class of the user.
    """
    documents = []
    for sensor in sensors:
        if isinstance(sensor, BaseModel):
            documents.append(sensor.model_dump(mode="json", exclude_unset=True))
    # A rig with only some of its sensors would not be the measured rig.
    if not documents or len(documents) < len(sensors):
        return ""
    return to_yaml({"name": name, "sensors": documents})


def build_region_outline(region: Region) -> MapLine:
    """Build the outline of a region on maps.

    Args:
        region: Polygon or rectangle.
    """
    (rear, front), (right, left) = region.x_m, region.y_m
    rectangle = [[rear, right], [front, right], [front, left], [rear, left]]
    return MapLine(region.name, np.array(region.corners_m or rectangle))


def collect_facts(
    record: Mapping[str, Any], rigs: Mapping[str, str | None], num_frames: int
) -> dict[str, dict[str, str]]:
    """Collect the settings and the facts on the run, as a page shows them.

    Args:
        record: Content of `summary.json`.
        rigs: Name of each rig -> name or file that the user gave; None if the rig came from a recording.
        num_frames: Number of measured frames.

    Returns:
        Heading -> name of a fact -> its text.
    """
    rig_facts = {f"rig {name}": str(source) for name, source in rigs.items() if source is not None}
    settings = {"num_frames": num_frames}
    settings |= {name: value for name, value in record.items() if name not in FACTS_IN_TABLES.union(RUN_FACTS)}
    run = {name: record[name] for name in RUN_FACTS} | {"python": platform.python_version()} | _find_versions()
    return {"Settings": rig_facts | format_facts(settings), "Run": format_facts(run)}


def _find_versions() -> dict[str, str]:
    """Find the versions of the packages that may change numbers."""
    versions = {}
    for package in ("torch", "numpy", "embreex", "trimesh", "pykdtree", "kornia"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:  # installed as part of another package, or missing
            continue
    return versions


def format_facts(facts: Mapping[str, Any]) -> dict[str, str]:
    """Format the values of a record for readers; facts without a value are omitted.

    Args:
        facts: Name -> value.

    Returns:
        Name with spaces -> text.
    """
    texts = {}
    for name, value in facts.items():
        text = _format_value(value)
        if text:
            texts[name.replace("_", " ")] = text
    return texts


def _format_value(value: object) -> str:
    """Format one value; texts of a list are separated by semicolons, numbers by "to"."""
    if isinstance(value, Mapping):
        texts = {name: _format_value(item) for name, item in value.items()}
        return ", ".join(f"{name} {text}" for name, text in texts.items() if text)
    if isinstance(value, list | tuple):
        has_texts = any(isinstance(item, str) for item in value)
        return ("; " if has_texts else " to ").join([_format_value(item) for item in value])
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)
