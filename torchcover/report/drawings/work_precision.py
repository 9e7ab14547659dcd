"""Error against run time: which setting is worth its time."""

import math
from collections.abc import Mapping, Sequence

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from torchcover.report.maps.sheet import charts

MARKERS = "osD^vP*X"
COLORMAP = "viridis"
MAX_LIGHTNESS = 0.85

Lines = Mapping[str, Sequence[tuple[float, float]]]


def draw_work_precision(panels: Mapping[str, Lines], *, title: str, legend_title: str = "") -> Figure:
    """Draw the work-precision diagram: error over time, both logarithmic.

    Args:
        panels: What is beside each other: what the errors are, with their unit -> name of a line, such as a setting ->
            its points, run time in seconds and error as it is shown. All have the same lines.
        title: What was measured.
        legend_title: What the names of the lines are.

    Returns:
        A figure of its own, outside pyplot. Lines differ in marker and colour, by their order.
    """
    figure, (views,) = charts(1, len(panels), (12.0, 5.6), title)
    for axes, (label, lines) in zip(views, panels.items(), strict=True):
        _draw_panel(axes, label, lines)
    handles, labels = views[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title=legend_title, frameon=False)
    return figure


def _draw_panel(axes: Axes, label: str, lines: Lines) -> None:
    colours = colormaps[COLORMAP]
    for at, (name, points) in enumerate(lines.items()):
        colour, marker = colours(MAX_LIGHTNESS * at / max(len(lines) - 1, 1)), MARKERS[at % len(MARKERS)]
        axes.plot(*zip(*points, strict=True), marker=marker, markersize=5, linewidth=1.2, color=colour, label=name)
    axes.set(xlabel="run time (s)", ylabel=label)
    if not any(math.isfinite(error) for points in lines.values() for _, error in points):
        return  # what is unknown has no logarithm
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        # Few numbers, written out: powers of ten lie on each other where there is less than a decade.
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.2)
