"""Error against run time: which setting is worth its time."""

import math
from collections.abc import Mapping, Sequence

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchcover.report.study import WorkPoint, pareto_front

MARKERS = "osD^vP*X"
COLOURS = {"even": "viridis", "paper": "autumn"}
MAX_LIGHTNESS = 0.85
# Title of each panel, the number of it, and what to multiply it with.
PANELS = (
    ("error of the regions' detection (percentage points)", "detection_error", 100.0),
    ("error of the regions' radius (m)", "radius_error_m", 1.0),
)


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
