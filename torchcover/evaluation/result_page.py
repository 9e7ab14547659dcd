"""The parts of the page of a result: tables, rigs as they are drawn and written, settings, what was left out."""

import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from pydantic import BaseModel

from torchcover.coverage import AGGREGATIONS, Aggregation, Coverage, Region
from torchcover.files import to_yaml
from torchcover.report import BOLD_MARKS, MapLine, PageTable, SensorView, TextCell, build_page_tables
from torchcover.report.table import CoverageTable
from torchcover.report.table_notes import explain_marks, list_notes
from torchcover.simulation import CameraSensor, Sensor, compute_vertical_fov_deg

# What decides about the numbers, with this package.
PACKAGES = ("torch", "numpy", "embreex", "trimesh", "pykdtree", "kornia")
OF_THE_RUN = ("torchcover", "duration_s", "complete", "device", "skipped_frames")
ELSEWHERE = ("verdict", "notes", "rows", "scenarios", "metrics", "counts", "frame_counts", "omissions", "rig", "rigs")
# What it is, how often it was left out, and of how many; the counts are those of the frames, added up.
COUNTED = (
    ("moving bodies out of every sensor's range: not placed", "moving_bodies_out_of_range", "moving_bodies"),
    ("road users of SUMO or a recording where bodies cannot be: not there", "road_users_omitted", "moving_bodies"),
    ("pairs of a ray and a moving body that cannot meet: not cast", "ray_body_pairs_omitted", "ray_body_pairs"),
    ("rays of sensors where nothing moves: cast once, for all steps", "sensor_rays_reused", "sensor_rays"),
    ("rays of sensors that hit nothing near a reference point: not cast", "sensor_rays_omitted", "sensor_rays"),
    ("rays that end on the ego itself: known from the first scan", "sensor_self_hits_reused", "sensor_self_hits"),
)
# Packages that take long to import, and what would have needed them; not all lenses with distortion need kornia, but
# where there is one, nobody is to think that its distortion was left out.
HEAVY = {"kornia": "lenses with distortion", "lightning": "training"}


@dataclass(frozen=True)
class Omission:
    """Something that a run left out.

    Args:
        description: What it is, and why it could be left out.
        count: How often; None where there is nothing to count.
        total: Of how many; likewise.
    """

    description: str
    count: int | None = None
    total: int | None = None


def list_omissions(
    frame_counts: Mapping[str, int],
    coverages: Sequence[Coverage],
    aggregations: Sequence[Aggregation] = (),
    sensors: Sequence[Sensor] = (),
    *,
    num_workers: int = 0,
    num_ranks: int = 1,
) -> list[Omission]:
    """List what was left out of a run, at its end: later, other modules may have been imported for other reasons.

    Args:
        frame_counts: Sums of `Frame.counts`.
        coverages: What the metrics gave, one for each rig.
        aggregations: Those that were asked for.
        sensors: Those that are known of all rigs.
        num_workers: Processes that made the frames of each rank. What they have imported is unknown.
        num_ranks: Ranks that shared the run.
    """
    steps = max((coverage.counts["num_frames"] for coverage in coverages), default=0)
    is_static = 0 < frame_counts.get("sensor_rays", 0) == frame_counts.get("sensor_rays_reused", 0)
    # Where nothing moves, each process casts the rays of its first step.
    first_steps = min(steps, num_ranks * max(num_workers, 1)) if is_static else 0
    found = []
    for what, count, of in COUNTED:
        omitted = frame_counts.get(count, 0)
        if first_steps and count.endswith("_reused"):
            omitted = omitted * (steps - first_steps) // steps
        if omitted:
            found.append(Omission(what, omitted, frame_counts[of]))
    outside = sum(coverage.counts["outside_points"] for coverage in coverages)
    inside = sum(coverage.counts["inside_points"] for coverage in coverages)
    if outside:
        found.append(Omission("reference points outside every cell: not searched for", outside, inside + outside))
    asked_for = {aggregation.name for aggregation in aggregations}
    others = [aggregation.description for aggregation in AGGREGATIONS if aggregation.name not in asked_for]
    if others:
        found.append(Omission(f"{', '.join(others)}: not asked for, not kept"))
    used = set(HEAVY) if num_workers else set(sys.modules)
    if any(isinstance(sensor, CameraSensor) and sensor.lens != "pinhole" for sensor in sensors):
        used.add("kornia")
    unused = [package for package in HEAVY if package not in used]
    return found + [Omission(f"{package}, for {HEAVY[package]}: not imported") for package in unused]


def build_result_tables(table: CoverageTable) -> list[PageTable]:
    """The parts of a table, with its notes below the last."""
    marks = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in explain_marks(table).items()]
    *parts, last = build_page_tables(table)
    return [*parts, replace(last, notes=[*marks, *list_notes(table)])]


def build_sensor_views(sensors: Sequence[Sensor]) -> list[SensorView]:
    """Where sensors are and what they see."""
    return [
        SensorView(
            name=sensor.name,
            vehicle_T_sensor=sensor.mount.to_matrix(),
            horizontal_fov_deg=sensor.horizontal_fov_deg,
            vertical_fov_deg=compute_vertical_fov_deg(sensor),
            range_m=sensor.max_range_m,
        )
        for sensor in sensors
    ]


def check_drawable(sensors: Sequence[Sensor]) -> None:
    """Find out before a run, not after it, whether its maps can show the sensors.

    ValueError: a sensor none of whose rays in the middle row is one, so that it is unknown how wide it sees.
    """
    for sensor in sensors:
        if not 0 < sensor.horizontal_fov_deg <= 360:
            raise ValueError(
                f"sensor {sensor.name!r}: its rays span {sensor.horizontal_fov_deg:g} degrees in the middle row; above "
                "0 are needed, so check its lens and its principal point"
            )


def format_rig_yaml(name: str, sensors: Sequence[Sensor]) -> str:
    """A rig as YAML that `Rig.load` reads; empty if its sensors are not known, or are not of ours."""
    known = [sensor.model_dump(mode="json", exclude_unset=True) for sensor in sensors if isinstance(sensor, BaseModel)]
    if not known or len(known) < len(sensors):
        return ""
    return to_yaml({"name": name, "sensors": known})


def build_region_outline(region: Region) -> MapLine:
    """Its outline on the maps."""
    (left, right), (low, high) = region.x_m, region.y_m
    return MapLine(region.name, np.array(region.corners_m or [[left, low], [right, low], [right, high], [left, high]]))


def collect_facts(
    record: Mapping[str, Any], rigs: Mapping[str, str | None], num_frames: int
) -> dict[str, dict[str, str]]:
    """Under which settings, and how the run went.

    `record`: what stands in `summary.json`; `rigs`: what the user called each rig, by its name; `num_frames`: steps that
    were measured.
    """
    settings = {name: value for name, value in record.items() if name not in (*OF_THE_RUN, *ELSEWHERE)}
    run = {name: record[name] for name in OF_THE_RUN} | {"python": platform.python_version()} | _versions()
    named = {f"rig {name}": str(given) for name, given in rigs.items() if given is not None}
    return {"Settings": named | format_facts({"num_frames": num_frames} | settings), "Run": format_facts(run)}


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # a part of a larger one
            continue
    return found


def format_facts(facts: Mapping[str, Any]) -> dict[str, str]:
    """Facts of a record as a page says them; without those that are unknown."""
    return {name.replace("_", " "): words for name, value in facts.items() if (words := _value(value))}


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {words}" for name, one in value.items() if (words := _value(one)))
    if isinstance(value, list | tuple):
        return ("; " if any(isinstance(one, str) for one in value) else " to ").join(map(_value, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def build_omissions_table(omissions: Sequence[Omission]) -> PageTable:
    """What a run left out."""
    rows = [tuple(map(TextCell, _omission(one))) for one in omissions]
    return PageTable("Left out, for this run did not need it", ("what", "count", "of", "share"), rows)


def _omission(one: Omission) -> tuple[str, ...]:
    if one.count is None or one.total is None:
        return one.description, "", "", ""
    return one.description, f"{one.count:,}", f"{one.total:,}", f"{one.count / one.total:.1%}"
