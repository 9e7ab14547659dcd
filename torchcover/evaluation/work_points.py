"""What the settings of a study have reached: the points of error and run time, the best of them, table and records."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from types import MappingProxyType
from typing import Any

from rich.table import Table

from torchcover.report import WorkPanel, error_words, json_record, text_table


@dataclass(frozen=True)
class WorkPoint:
    """What a setting reached in a time. Errors are root mean squares of the distance to a long run.

    Args:
        reference: Pattern of the reference sensor.
        rays: Its rays in each step.
        steps: Steps done.
        seconds: Time that they took, a mean over the runs.
        detection_error: Of the regions' detection, in [0, 1], over regions, bands and runs.
        radius_error_m: Of the regions' radius.
        cell_detection_error: Of the detection of the cells that both know.
        cell_radius_error_m: Of their radius.
    """

    reference: str
    rays: int
    steps: int
    seconds: float
    detection_error: float
    radius_error_m: float
    cell_detection_error: float
    cell_radius_error_m: float


# The errors whose fastest points are marked -> what the diagram calls them, and what it multiplies them with.
RANKED: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "detection_error": ("error of the regions' detection (percentage points)", 100.0),
        "radius_error_m": ("error of the regions' radius (m)", 1.0),
    }
)
HEADINGS = (
    "reference",
    "rays",
    "steps",
    "time (s)",
    "detection\nerror (pp)",
    "radius\nerror (m)",
    "cells:\ndet. (pp)",
    "cells:\nradius (m)",
)


def pareto_front(points: Sequence[WorkPoint], error: str) -> list[WorkPoint]:
    """The points that no other beats in both time and error, fastest first; none whose error is unknown.

    Args:
        points: Measured points.
        error: Which error, by the name of its field.

    Example:
        >>> def point(seconds, error):
        ...     return WorkPoint("even", 1, 1, seconds, error, 0, 0, 0)
        >>> front = pareto_front([point(1, 3), point(2, 4), point(3, 1)], "detection_error")
        >>> [one.seconds for one in front]
        [1, 3]
    """
    front: list[WorkPoint] = []
    known = [point for point in points if not math.isnan(getattr(point, error))]
    for point in sorted(known, key=lambda point: (point.seconds, getattr(point, error))):
        if not front or getattr(point, error) < getattr(front[-1], error):
            front.append(point)
    return front


def cheapest(points: Sequence[WorkPoint], error: str, at_most: float) -> WorkPoint | None:
    """The fastest point with an error of at most this; None if there is none.

    Example:
        >>> cheapest([], "detection_error", 0.01) is None
        True
    """
    good = [point for point in points if getattr(point, error) <= at_most]
    return min(good, key=lambda point: point.seconds, default=None)


def study_table(points: Sequence[WorkPoint]) -> Table:
    """A row for each point, the Pareto front of the detection marked `*`."""
    front = pareto_front(points, "detection_error")
    by_rays = (list(of_rays) for _, of_rays in groupby(points, lambda point: point.rays))
    return text_table(
        HEADINGS,
        [[_row(point, is_best=point in front) for point in section] for section in by_rays],
        caption="* no other setting is both faster and more accurate (regions' detection)",
    )


def _row(point: WorkPoint, *, is_best: bool) -> list[str]:
    return [
        f"{point.reference} *" if is_best else point.reference,
        f"{point.rays:,}",
        f"{point.steps:,}",
        f"{point.seconds:.1f}",
        error_words(point.detection_error, "share"),
        error_words(point.radius_error_m, "m"),
        error_words(point.cell_detection_error, "share"),
        error_words(point.cell_radius_error_m, "m"),
    ]


def stage_table(stages: Sequence[Mapping[str, Any]]) -> Table:
    """How a step of each setting divides into its parts; `Study.stages`."""
    rows = []
    for stage in stages:
        parts = [stage["rays_s"], stage["search_s"], stage["binning_s"]]
        shares = [f"{100 * part / sum(parts):.0f}" for part in parts]
        brute_force = "" if math.isnan(stage["cdist_s"]) else f"{1000 * stage['cdist_s']:.0f}"
        rows.append((stage["reference"], f"{stage['rays']:,}", f"{1000 * sum(parts):.0f}", *shares, brute_force))
    headings = ("reference", "rays", "step (ms)", "rays (%)", "search (%)", "binning (%)", "search by cdist (ms)")
    return text_table(headings, [rows], title="One step: where the time goes")


def work_panels(points: Sequence[WorkPoint], floor: Mapping[str, float]) -> Iterator[WorkPanel]:
    """What the work-precision diagram shows of them.

    Args:
        points: Measured points.
        floor: Standard error of the long run by the name of the field: errors below it say nothing.
    """
    for error, (label, factor) in RANKED.items():
        lines: dict[str, dict[str, list[tuple[float, float]]]] = {}
        for point in sorted(points, key=lambda point: point.rays):
            line = lines.setdefault(point.reference, {}).setdefault(f"{point.rays:,}", [])
            line.append((point.seconds, factor * getattr(point, error)))
        front = [(point.seconds, factor * getattr(point, error)) for point in pareto_front(points, error)]
        yield WorkPanel(label, lines, front, factor * floor[error])


def study_records(points: Sequence[WorkPoint]) -> list[dict[str, object]]:
    """The points for `study.json`."""
    fronts = {name: pareto_front(points, name) for name in RANKED}
    return [
        json_record({**asdict(point), **{f"best_{name}": point in front for name, front in fronts.items()}})
        for point in points
    ]
