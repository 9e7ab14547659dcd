"""Charts: when encounters are detected, how a search went on, what more sensors bring, error against run time."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from torchcover.report.plot_layout import create_charts

# Speed in km/h, least and most time to collision in s.
DetectionBand = Sequence[tuple[float, float, float]]


def plot_encounters(
    panels: Sequence[tuple[str, Mapping[str, DetectionBand], Sequence[tuple[float, float]]]], *, title: str
) -> Figure:
    """Draw when rigs detected whom they met: a panel each encounter, a band each rig, a line for what is needed.

    Args:
        panels: Name of each encounter, the band of each rig, and what is needed: speed in km/h, time to collision in s.
        title: Above all.

    Returns:
        A figure of its own, outside pyplot.
    """
    across = min(len(panels), 3)
    down = -(-len(panels) // across)
    figure, grid = create_charts(down, across, (1.5 + 4.2 * across, 0.8 + 3.6 * down), title, sharey=True)
    views = [axes for row in grid for axes in row]
    for axes, (name, bands, needed) in zip(views, panels, strict=False):
        for number, (rig, band) in enumerate(bands.items()):
            speed_kmh, low_s, high_s = np.array(band).T
            colour = colormaps["tab10"](number % 10)
            axes.fill_between(speed_kmh, low_s, high_s, color=colour, alpha=0.25, linewidth=0)
            # Of one speed alone there is no area.
            axes.vlines(speed_kmh, low_s, high_s, color=colour, linewidth=1.5, label=rig)
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

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
MARKERS = "osD^vP*X"
BEST = "#000000"
BOUND = "#999999"


def plot_progress(lines: Mapping[str, Float64], *, title: str) -> Figure:
    """Draw how much was gained after how many candidates.

    Args:
        lines: Label with unit -> (k, 2) number of the candidate, and the best so far.
        title: Name of the search space.
    """
    figure, ((axes,),) = _sheet(1, 1, title)
    for at, (label, line) in enumerate(lines.items()):
        style: dict[str, Any] = {"color": COLOURS[at], "marker": MARKERS[at], "markersize": 3}
        axes.step(*line[np.isfinite(line[:, 1])].T, where="post", label=label, **style)
    axes.axhline(0.0, color="grey", linewidth=0.8, linestyle=":", label="start")
    axes.set(xlabel="candidates", ylabel="best so far")
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def plot_fronts(
    names: Sequence[str], candidates: Mapping[str, Float64], fronts: Mapping[str, Float64], *, title: str
) -> Figure:
    """Draw the gains of candidates in each pair of objectives.

    Args:
        names: Of the objectives, with units.
        candidates: Name of a strategy -> (k, objectives) gains.
        fronts: The same, of those that no other dominates.
        title: What was searched.
    """
    pairs = [(one, other) for one in range(len(names)) for other in range(one + 1, len(names))]
    figure, grid = _sheet(1, len(pairs), title)
    for axes, (one, other) in zip(grid[0], pairs, strict=True):
        for at, name in enumerate(candidates):
            style: dict[str, Any] = {"color": COLOURS[at], "marker": MARKERS[at], "linestyle": "none"}
            axes.plot(*candidates[name][:, [one, other]].T, markersize=3, alpha=0.4, label=name, **style)
            axes.plot(*fronts[name][:, [one, other]].T, markersize=7, label=f"{name}: front", **style)
        axes.plot(0.0, 0.0, "*", color=BEST, markersize=10, label="start")
        axes.set_xlabel(names[one], parse_math=False)
        axes.set_ylabel(names[other], parse_math=False)
        axes.grid(visible=True, alpha=0.2)
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


class SelectionSize(NamedTuple):
    """The best choice of so many sensors that was found.

    Args:
        num_sensors: How many.
        value: What they are worth, a share.
        upper_bound: No choice of so many is worth more.
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
    """Draw what choices are worth over the number of their sensors.

    Args:
        sizes: Choices that were found.
        sampled_values: What random choices are worth.
        num_sampled_sensors: How many sensors these have, about.
        best: What the best choice is worth.
        title: What there was to choose from.

    Returns:
        A figure of its own, outside pyplot.
    """
    figure, ((axes,),) = _sheet(1, 1, title)
    if sizes:
        numbers, values, bounds = 100 * np.array(sizes).T
        numbers = numbers / 100
        axes.fill_between(numbers, values, bounds, color=BOUND, alpha=0.3, linewidth=0, label="where the best lies")
        axes.plot(numbers, values, color=COLOURS[0], marker="o", markersize=4, label="found")
    parts = axes.violinplot(100 * np.array(sampled_values), [num_sampled_sensors], widths=0.5, showmedians=True)
    for part in (*parts["bodies"], *(parts[key] for key in ("cmins", "cmaxes", "cbars", "cmedians"))):  # type: ignore[misc]
        part.set_color(COLOURS[1])
    axes.plot([], [], color=COLOURS[1], label=f"{len(sampled_values):,} random choices")
    axes.plot(
        [num_sampled_sensors], [100 * best], color=COLOURS[0], marker="*", markersize=12, linestyle="none", label="best"
    )
    axes.set(xlabel="sensors", ylabel="objective (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def _sheet(rows: int, columns: int, title: str) -> tuple[Figure, list[list[Axes]]]:
    return create_charts(rows, columns, (max(4.2 * columns, 6.4), 3.6 * rows + 0.9), title)


COLORMAP = "viridis"
MAX_LIGHTNESS = 0.85

Lines = Mapping[str, Sequence[tuple[float, float]]]


def plot_work_precision(panels: Mapping[str, Lines], *, title: str, legend_title: str = "") -> Figure:
    """Draw the work-precision diagram: error over time, both logarithmic.

    Args:
        panels: What is beside each other: what the errors are, with their unit -> name of a line, such as a setting ->
            its points, run time in seconds and error as it is shown. All have the same lines.
        title: What was measured.
        legend_title: What the names of the lines are.

    Returns:
        A figure of its own, outside pyplot. Lines differ in marker and colour, by their order.
    """
    figure, (views,) = create_charts(1, len(panels), (12.0, 5.6), title)
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
