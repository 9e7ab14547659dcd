"""Error against run time: which setting is worth its time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from torchcover.report.records import json_record

MARKERS = "osD^vP*X"
COLOURS = {"even": "viridis", "paper": "autumn"}
MAX_LIGHTNESS = 0.85


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


# Title of each panel, the number of it, and what to multiply it with.
PANELS = (
    ("error of the regions' detection (percentage points)", "detection_error", 100.0),
    ("error of the regions' radius (m)", "radius_error_m", 1.0),
)


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


def draw_work_precision(points: Sequence[WorkPoint], floor: Mapping[str, float], title: str) -> Figure:
    """Draw the work-precision diagram: error over time, both logarithmic, a line for each setting.

    Args:
        points: Measured points.
        floor: Standard error of the long run for each of `PANELS`' fields: errors below it say nothing.
        title: What was measured.
    """
    figure = Figure(figsize=(12.0, 5.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    panels = figure.subplots(1, len(PANELS), squeeze=False)[0]
    for axes, (label, error, factor) in zip(panels, PANELS, strict=True):
        _draw_lines(axes, points, error, factor)
        front = pareto_front(points, error)
        axes.plot(
            [point.seconds for point in front],
            [factor * getattr(point, error) for point in front],
            color="black",
            linewidth=4.5,
            alpha=0.25,
            zorder=1,
            label="Pareto front",
        )
        if math.isfinite(floor[error]):
            axes.axhline(factor * floor[error], color="grey", linestyle=":", label="standard error of the long run")
        axes.set(xscale="log", yscale="log", xlabel="run time (s)", ylabel=label)
        axes.grid(visible=True, which="both", alpha=0.2)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title="rays a step", frameon=False)
    return figure


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
            *_shown(point.detection_error, point.completed_detection_error, factor=100),
            *_shown(point.radius_error_m, point.completed_radius_error_m),
            *_shown(point.cell_detection_error, factor=100),
            *_shown(point.cell_radius_error_m),
            f"{100 * point.known_share:.0f}",
        )
    return table


def study_records(points: Sequence[WorkPoint]) -> list[dict[str, object]]:
    """The points for `study.json`."""
    fronts = {name: pareto_front(points, name) for _, name, _ in PANELS}
    return [
        json_record({**asdict(point), **{f"best_{name}": point in front for name, front in fronts.items()}})
        for point in points
    ]


def _draw_lines(axes: Axes, points: Sequence[WorkPoint], error: str, factor: float) -> None:
    for reference in dict.fromkeys(point.reference for point in points):
        rays = sorted({point.rays for point in points if point.reference == reference})
        for at, count in enumerate(rays):
            line = [point for point in points if (point.reference, point.rays) == (reference, count)]
            axes.plot(
                [point.seconds for point in line],
                [factor * getattr(point, error) for point in line],
                marker=MARKERS[at % len(MARKERS)],
                markersize=5,
                linewidth=1.2,
                linestyle="-" if reference == "even" else "--",
                color=colormaps[COLOURS.get(reference, "winter")](MAX_LIGHTNESS * at / max(len(rays) - 1, 1)),
                label=f"{reference} {count:,}",
            )


def _shown(*values: float, factor: float = 1.0) -> list[str]:
    return ["unknown" if math.isnan(value) else f"{factor * value:.2f}" for value in values]
