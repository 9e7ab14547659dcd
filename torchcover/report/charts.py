"""Charts of encounters, placement searches, sensor selections, and errors against run time."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain, combinations
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from torchcover.report.overlay import SENSOR_COLORS
from torchcover.report.plot_layout import create_charts

# Speed in km/h, smallest and largest time to collision at detection in s.
DetectionBand = Sequence[tuple[float, float, float]]


def plot_encounters(
    panels: Sequence[tuple[str, Mapping[str, DetectionBand], Sequence[tuple[float, float]]]], *, title: str
) -> Figure:
    """Plot the time to collision at detection: a panel for each encounter, a band for each rig, a line for the need.

    Args:
        panels: Name of each encounter, band of each rig, and needed time to collision in s by speed in km/h.
        title: Title of the figure.

    Returns:
        A new figure outside pyplot.
    """
    across = min(len(panels), 3)
    down = -(-len(panels) // across)
    figure, grid = create_charts(down, across, (1.5 + 4.2 * across, 0.8 + 3.6 * down), title, sharey=True)
    views = list(chain.from_iterable(grid))
    for axes, (name, bands, needed) in zip(views, panels, strict=False):
        for number, (rig, band) in enumerate(bands.items()):
            speed_kmh, low_s, high_s = np.array(band).T
            color = colormaps["tab10"](number % 10)
            axes.fill_between(speed_kmh, low_s, high_s, color=color, alpha=0.25, linewidth=0)
            # A single speed has no area.
            axes.vlines(speed_kmh, low_s, high_s, color=color, linewidth=1.5, label=rig)
        axes.plot(*np.array(needed).T, color="black", linestyle="--", marker=".", linewidth=1.2, label="needed")
        axes.set_title(name, fontsize="small", parse_math=False)
        axes.set(xlabel="speed of the vehicle (km/h)")
        axes.set_ylim(bottom=0.0)
        axes.grid(visible=True, alpha=0.2)
    for axes in views[len(panels) :]:
        axes.set_visible(False)
    views[0].set_ylabel("time to collision at detection (s)")
    handles, labels = views[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False)
    return figure


Float64 = NDArray[np.float64]

MARKERS = "osD^vP*X"


def plot_progress(lines: Mapping[str, Float64], *, title: str) -> Figure:
    """Plot the best improvement so far against the number of candidates.

    Args:
        lines: Label with unit -> (k, 2) number of the candidate, and the best improvement so far.
        title: Name of the search space.
    """
    figure, ((axes,),) = _create_charts(1, 1, title)
    for index, (label, line) in enumerate(lines.items()):
        style: dict[str, Any] = {"color": SENSOR_COLORS[index], "marker": MARKERS[index], "markersize": 3}
        axes.step(*line[np.isfinite(line[:, 1])].T, where="post", label=label, **style)
    axes.axhline(0.0, color="grey", linewidth=0.8, linestyle=":", label="start")
    axes.set(xlabel="candidates", ylabel="best so far")
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def plot_fronts(
    names: Sequence[str], candidates: Mapping[str, Float64], fronts: Mapping[str, Float64], *, title: str
) -> Figure:
    """Plot the improvements of candidates in each pair of objectives.

    Args:
        names: Names of the objectives with units.
        candidates: Name of a strategy -> (k, objectives) improvements.
        fronts: Name of a strategy -> (k, objectives) improvements of candidates on the Pareto front.
        title: Name of the search space.
    """
    pairs = list(combinations(range(len(names)), 2))
    figure, grid = _create_charts(1, len(pairs), title)
    for axes, (first, second) in zip(grid[0], pairs, strict=True):
        for index, name in enumerate(candidates):
            style: dict[str, Any] = {"color": SENSOR_COLORS[index], "marker": MARKERS[index], "linestyle": "none"}
            axes.plot(*candidates[name][:, [first, second]].T, markersize=3, alpha=0.4, label=name, **style)
            axes.plot(*fronts[name][:, [first, second]].T, markersize=7, label=f"{name}: front", **style)
        axes.plot(0.0, 0.0, "*", color="black", markersize=10, label="start")
        axes.set_xlabel(names[first], parse_math=False)
        axes.set_ylabel(names[second], parse_math=False)
        axes.grid(visible=True, alpha=0.2)
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


class SelectionSize(NamedTuple):
    """Best selection with a given number of sensors.

    Args:
        num_sensors: Number of sensors.
        value: Value of the objective, a share.
        upper_bound: Upper bound of the value of any selection with this number of sensors.
    """

    num_sensors: int
    value: float
    upper_bound: float


def plot_selection_sizes(
    sizes: Sequence[SelectionSize],
    sampled_values: Sequence[float],
    num_sampled_sensors: int,
    best: float,
    *,
    title: str,
) -> Figure:
    """Plot the objective of selections against their number of sensors.

    Args:
        sizes: Best selections, by number of sensors.
        sampled_values: Objective of random selections.
        num_sampled_sensors: Approximate number of sensors of the random selections.
        best: Objective of the best selection.
        title: Name of the selection space.

    Returns:
        A new figure outside pyplot.
    """
    figure, ((axes,),) = _create_charts(1, 1, title)
    if sizes:
        numbers, values, bounds = 100 * np.array(sizes).T
        numbers = numbers / 100
        axes.fill_between(numbers, values, bounds, color="#999999", alpha=0.3, linewidth=0, label="possible optimum")
        axes.plot(numbers, values, color=SENSOR_COLORS[0], marker="o", markersize=4, label="best selection")
    parts = axes.violinplot(100 * np.array(sampled_values), [num_sampled_sensors], widths=0.5, showmedians=True)
    for part in (*parts["bodies"], *(parts[key] for key in ("cmins", "cmaxes", "cbars", "cmedians"))):  # type: ignore[misc]
        part.set_color(SENSOR_COLORS[1])
    axes.plot([], [], color=SENSOR_COLORS[1], label=f"{len(sampled_values):,} random selections")
    axes.plot(
        [num_sampled_sensors],
        [100 * best],
        color=SENSOR_COLORS[0],
        marker="*",
        markersize=12,
        linestyle="none",
        label="best",
    )
    axes.set(xlabel="sensors", ylabel="objective (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def _create_charts(rows: int, columns: int, title: str) -> tuple[Figure, list[list[Axes]]]:
    """Create charts of the usual size in rows under a title."""
    return create_charts(rows, columns, (max(4.2 * columns, 6.4), 3.6 * rows + 0.9), title)


Lines = Mapping[str, Sequence[tuple[float, float]]]


def plot_work_precision(panels: Mapping[str, Lines], *, title: str, legend_title: str = "") -> Figure:
    """Plot the work-precision diagram: error against run time, both logarithmic.

    Args:
        panels: Label of the errors with unit -> name of a line, such as a setting -> points: run time in seconds and
            error. All panels have the same lines.
        title: Title of the figure.
        legend_title: Title of the legend.

    Returns:
        A new figure outside pyplot. Lines differ in marker and color.
    """
    figure, (views,) = create_charts(1, len(panels), (12.0, 5.6), title)
    for axes, (label, lines) in zip(views, panels.items(), strict=True):
        _plot_panel(axes, label, lines)
    handles, labels = views[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", title=legend_title, frameon=False)
    return figure


def _plot_panel(axes: Axes, label: str, lines: Lines) -> None:
    """Plot one panel: a line per setting with a marker of its own."""
    for index, (name, points) in enumerate(lines.items()):
        color = colormaps["viridis"](0.85 * index / max(len(lines) - 1, 1))  # lighter colors are hard to see
        marker = MARKERS[index % len(MARKERS)]
        axes.plot(*zip(*points, strict=True), marker=marker, markersize=5, linewidth=1.2, color=color, label=name)
    axes.set(xlabel="run time (s)", ylabel=label)
    if not any(math.isfinite(error) for _, error in chain.from_iterable(lines.values())):
        return  # without errors there is no logarithm
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        # Few numbers, written out: powers of ten overlap within less than a decade.
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="both", alpha=0.2)
