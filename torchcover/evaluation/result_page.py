"""The page of a result: its tables, maps and rigs, under which settings, and where they come from."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel

from torchcover.coverage import Region
from torchcover.evaluation.omissions import Omission
from torchcover.evaluation.sensor_drawings import sensor_views
from torchcover.files import as_yaml
from torchcover.published.comparison import page_tables as metric_tables
from torchcover.report import BOLD_MARKS, PLACE_HEADINGS, Line, Page, PageRig, PageTable, Words, maps_of, parts_of
from torchcover.report.remarks import marks_on, notes_on
from torchcover.report.table import CoverageTable
from torchcover.simulation import Sensor

if TYPE_CHECKING:
    from torchcover.evaluation.result import Result

# What decides about the numbers, beside this package.
PACKAGES = ("torch", "numpy", "embreex", "trimesh", "pykdtree", "kornia")
OF_THE_RUN = ("torchcover", "seconds", "complete", "device", "skipped_frames")
ELSEWHERE = ("rows", "metrics", "counts", "frame_counts", "left_out", "rig", "rigs")


def page_of(result: "Result") -> Page:
    """All that a result knows, on one page."""
    rigs = list(result.coverages)
    return Page(
        title=" against ".join(rigs) if len(rigs) == 2 else ", ".join(rigs),
        lead=f"Blind spots and coverage in {_place(result)}, measured by torchcover.",
        tables=[*page_tables(result.table), *(metric_tables(result.metrics) if result.metrics else [])],
        maps=list(maps_of(result.coverages)),
        rigs=[_rig(name, result.sensors.get(name, ())) for name in rigs],
        ego_outline_m=result.ego_outline_m,
        outlines=[Line(region.name, _corners(region)) for region in result.regions],
        facts=_facts(result),
        more_tables=[_left_out(result.left_out)] if result.left_out else [],
    )


def page_tables(table: CoverageTable) -> list[PageTable]:
    """The parts of a table, with its notes below the last."""
    marks = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in marks_on(table).items()]
    parts = [PageTable(part.title, part.headings, part.rows, len(PLACE_HEADINGS)) for part in parts_of(table)]
    last = parts[-1]
    return [*parts[:-1], PageTable(last.title, last.headings, last.rows, last.words_first, [*marks, *notes_on(table)])]


def rig_document(name: str, sensors: Sequence[Sensor]) -> str:
    """A rig as YAML that `Rig.load` reads; empty if its sensors are not known, or are not of ours."""
    known = [sensor.model_dump(mode="json", exclude_unset=True) for sensor in sensors if isinstance(sensor, BaseModel)]
    if not known or len(known) < len(sensors):
        return ""
    return as_yaml({"name": name, "sensors": known})


def _rig(name: str, sensors: Sequence[Sensor]) -> PageRig:
    return PageRig(name, sensor_views(sensors), rig_document(name, sensors))


def _place(result: "Result") -> str:
    place = result.source.get("frames") or result.source.get("scenario")
    return f"{place}, on {result.vehicle}" if result.vehicle else str(place or "runs that were saved")


def _corners(region: Region) -> np.ndarray[Any, np.dtype[np.float64]]:
    if region.corners_m:
        return np.array(region.corners_m)
    (left, right), (low, high) = region.x, region.y
    return np.array([[left, low], [right, low], [right, high], [left, high]])


def _facts(result: "Result") -> dict[str, dict[str, str]]:
    record = result.record
    settings = {name: value for name, value in record.items() if name not in (*OF_THE_RUN, *ELSEWHERE)}
    steps = {"steps": next(iter(result.coverages.values())).counts["steps"]}
    run = {name: record[name] for name in OF_THE_RUN} | {"python": platform.python_version()} | _versions()
    rigs = {f"rig {name}": str(given) for name, given in result.rigs.items() if given is not None}
    return {"Settings": rigs | words_of(steps | settings), "Run": words_of(run)}


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # a part of a larger one
            continue
    return found


def words_of(facts: Mapping[str, Any]) -> dict[str, str]:
    """Facts of a record as a page says them; without those that nobody knows."""
    return {name.replace("_", " "): _value(value) for name, value in facts.items() if value not in (None, [], {})}


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_value(one)}" for name, one in value.items())
    if isinstance(value, list | tuple):
        return (
            "; ".join(map(_value, value))
            if any(isinstance(one, str) for one in value)
            else " to ".join(map(_value, value))
        )
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _left_out(omissions: Sequence[Omission]) -> PageTable:
    rows = [tuple(map(Words, _omission(one))) for one in omissions]
    return PageTable("Left out, for this run did not need it", ("what", "count", "of", "share"), rows)


def _omission(one: Omission) -> tuple[str, ...]:
    if one.count is None or one.of is None:
        return one.what, "", "", ""
    return one.what, f"{one.count:,}", f"{one.of:,}", f"{one.count / one.of:.1%}"
