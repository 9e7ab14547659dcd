"""A study of error against run time: its points, the best of them, and its table."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from rich.table import Table

from torchcover.report.renderers.json_file import json_record
from torchcover.report.wording import error_words, percent


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
        completed_detection_error: Of the detection with the cells that are still to be seen.
        completed_radius_error_m: Of the radius with them.
        cell_detection_error: Of the detection of the cells that both know.
        cell_radius_error_m: Of their radius.
        known_share: Known cells over all, a mean over regions, bands and runs.
    """

    reference: str
    rays: int
    steps: int
    seconds: float
    detection_error: float
    radius_error_m: float
    completed_detection_error: float
    completed_radius_error_m: float
    cell_detection_error: float
    cell_radius_error_m: float
    known_share: float


# The errors whose fastest points are marked.
RANKED = ("detection_error", "radius_error_m")


def pareto_front(points: Sequence[WorkPoint], error: str) -> list[WorkPoint]:
    """The points that no other beats in both time and error, fastest first; none whose error is unknown.

    Args:
        points: Measured points.
        error: Which error, by the name of its field.

    Example:
        >>> def point(seconds, error):
        ...     return WorkPoint("even", 1, 1, seconds, error, 0, 0, 0, 0, 0, 1)
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
    table = Table(caption="* no other setting is both faster and more accurate (regions' detection)")
    table.add_column("reference")
    for column in ("rays", "steps", "time (s)", "detection\nerror (pp)", "completed\n(pp)"):
        table.add_column(column, justify="right")
    for column in ("radius\nerror (m)", "completed\n(m)", "cells:\ndet. (pp)", "cells:\nradius (m)", "known\n(%)"):
        table.add_column(column, justify="right")
    for at, point in enumerate(points):
        if at and points[at - 1].rays != point.rays:
            table.add_section()
        table.add_row(
            f"{point.reference} *" if point in front else point.reference,
            f"{point.rays:,}",
            f"{point.steps:,}",
            f"{point.seconds:.1f}",
            *(error_words(error, "share") for error in (point.detection_error, point.completed_detection_error)),
            *(error_words(error, "m") for error in (point.radius_error_m, point.completed_radius_error_m)),
            error_words(point.cell_detection_error, "share"),
            error_words(point.cell_radius_error_m, "m"),
            percent(point.known_share),
        )
    return table


def study_records(points: Sequence[WorkPoint]) -> list[dict[str, object]]:
    """The points for `study.json`."""
    fronts = {name: pareto_front(points, name) for name in RANKED}
    return [
        json_record({**asdict(point), **{f"best_{name}": point in front for name, front in fronts.items()}})
        for point in points
    ]
