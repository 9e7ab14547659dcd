"""Error against run time: which setting is worth its time."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

MARKERS = "osD^vP*X"
COLORMAP = "viridis"
MAX_LIGHTNESS = 0.85

Point = tuple[float, float]


class WorkPanel(NamedTuple):
    """One panel of the diagram. A point is the run time in seconds, and an error as it is shown.

    Args:
        label: What the errors are, with their unit.
        lines: Name of a line, such as a setting -> its points.
    """

    label: str
    lines: Mapping[str, Sequence[Point]]


def draw_work_precision(panels: Iterable[WorkPanel], *, title: str, legend_title: str = "") -> Figure:
    """Draw the work-precision diagram: error over time, both logarithmic.

    Args:
        panels: What is beside each other; all have the same lines.
        title: What was measured.
        legend_title: What the names of the lines are.

    Returns:
        A figure of its own, outside pyplot. Lines differ in marker and colour, by their order.
    """
    panels = list(panels)
    figure = Figure(figsize=(12.0, 5.6), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, parse_math=False)
    views = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, panel in zip(views, panels, strict=True):
        _draw_panel(axes, panel)
    handles, labels = views[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title=legend_title, frameon=False)
    return figure


def _draw_panel(axes: Axes, panel: WorkPanel) -> None:
    colours = colormaps[COLORMAP]
    for at, (name, points) in enumerate(panel.lines.items()):
        colour, marker = colours(MAX_LIGHTNESS * at / max(len(panel.lines) - 1, 1)), MARKERS[at % len(MARKERS)]
        axes.plot(*_xy(points), marker=marker, markersize=5, linewidth=1.2, color=colour, label=name)
    axes.set(xlabel="run time (s)", ylabel=panel.label)
    if not any(math.isfinite(error) for points in panel.lines.values() for _, error in points):
        return  # what is unknown has no logarithm
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        # Few numbers, written out: powers of ten lie on each other where there is less than a decade.
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.2)


def _xy(points: Sequence[Point]) -> tuple[list[float], list[float]]:
    return [x for x, _ in points], [y for _, y in points]
