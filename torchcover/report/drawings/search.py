"""A search for a better rig, how it went on and what its variables do; a choice of sensors, what more of them bring."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from torchcover.report.maps.sheet import charts

Float64 = NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
MARKERS = "osD^"
BEST = "#000000"
COLUMNS = 3
BOUND = "#999999"


class Slice(NamedTuple):
    """What a model says about one variable, with all others as they are at the best candidate.

    Args:
        name: Of the variable.
        x: (n,) values of a number, or the places of options.
        mean: (n,) what the model expects there.
        deviation: (n,) its standard deviation.
        points: Name of an arm -> (k, 2) values of its candidates and what they gained, wherever they are otherwise.
        best: Where the best candidate is.
        options: Names of the options at the places; none for a number.
    """

    name: str
    x: Float64
    mean: Float64
    deviation: Float64
    points: Mapping[str, Float64]
    best: float
    options: Sequence[str] = ()


def draw_progress(lines: Mapping[str, Float64], *, label: str, title: str) -> Figure:
    """Draw how much was found after how much work.

    Args:
        lines: Name of an arm -> (k, 2) work and the best so far, a step each.
        label: What the best is, with its unit.
        title: What was searched.
    """
    figure, ((axes,),) = _sheet(1, 1, title)
    for at, (name, line) in enumerate(lines.items()):
        axes.step(*line.T, where="post", color=COLOURS[at], marker=MARKERS[at], markersize=3, label=name)
    axes.axhline(0.0, color="grey", linewidth=0.8, linestyle=":", label="start")
    axes.set(xlabel="instants that rigs were scored at", ylabel=label)
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def draw_slices(slices: Sequence[Slice], *, label: str, title: str) -> Figure:
    """Draw a model along each variable, with a band of two standard deviations.

    Args:
        slices: One for each variable.
        label: What is on the upright axis, with its unit.
        title: What was searched.
    """
    rows = -(-len(slices) // COLUMNS)
    figure, grid = _sheet(rows, min(len(slices), COLUMNS), title)
    views = [axes for row in grid for axes in row]
    for axes, one in zip(views, slices, strict=False):
        _draw_slice(axes, one)
    for axes in views[len(slices) :]:
        axes.set_axis_off()
    for row in grid:
        row[0].set_ylabel(label)
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    return figure


def _draw_slice(axes: Axes, one: Slice) -> None:
    low, high = one.mean - 2 * one.deviation, one.mean + 2 * one.deviation
    if one.options:
        axes.errorbar(
            one.x, one.mean, yerr=2 * one.deviation, fmt="s", color="grey", capsize=4, label="model, two deviations"
        )
        axes.set_xticks(one.x, one.options, rotation=20, ha="right", parse_math=False)
    else:
        axes.fill_between(one.x, low, high, color="grey", alpha=0.25, linewidth=0, label="two deviations")
        axes.plot(one.x, one.mean, color="grey", label="model at the best")
    for at, (name, points) in enumerate(one.points.items()):
        axes.plot(*points.T, linestyle="none", marker=MARKERS[at], markersize=3, color=COLOURS[at], label=name)
    axes.axvline(one.best, color=BEST, linewidth=0.8, linestyle="--", label="best")
    axes.set_xlabel(one.name, parse_math=False)
    axes.grid(visible=True, alpha=0.2)


def draw_fronts(
    names: Sequence[str], candidates: Mapping[str, Float64], fronts: Mapping[str, Float64], *, title: str
) -> Figure:
    """Draw the gains of candidates in each pair of objectives.

    Args:
        names: Of the objectives, with units.
        candidates: Name of an arm -> (k, objectives) gains.
        fronts: The same, of those that no other beats.
        title: What was searched.
    """
    pairs = [(one, other) for one in range(len(names)) for other in range(one + 1, len(names))]
    figure, grid = _sheet(1, len(pairs), title)
    for axes, (one, other) in zip(grid[0], pairs, strict=True):
        for at, name in enumerate(candidates):
            style: dict[str, Any] = {"color": COLOURS[at], "marker": MARKERS[at], "linestyle": "none"}
            axes.plot(*candidates[name][:, [one, other]].T, markersize=3, alpha=0.4, label=name, **style)
            axes.plot(*fronts[name][:, [one, other]].T, markersize=7, label=f"{name}: beaten by none", **style)
        axes.plot(0.0, 0.0, "*", color=BEST, markersize=10, label="start")
        axes.set_xlabel(names[one], parse_math=False)
        axes.set_ylabel(names[other], parse_math=False)
        axes.grid(visible=True, alpha=0.2)
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


class ChoiceSize(NamedTuple):
    """The best choice of so many sensors that was found.

    Args:
        sensors: How many.
        value: What they are worth, a share.
        upper_bound: No choice of so many is worth more.
    """

    sensors: int
    value: float
    upper_bound: float


def draw_choice(
    sizes: Sequence[ChoiceSize], drawn: Sequence[float], drawn_sensors: int, best: float, *, title: str
) -> Figure:
    """Draw what choices are worth over the number of their sensors.

    Args:
        sizes: Choices that were found.
        drawn: What random choices are worth.
        drawn_sensors: How many sensors these have, about.
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
    parts = axes.violinplot(100 * np.array(drawn), [drawn_sensors], widths=0.5, showmedians=True)
    for part in (*parts["bodies"], *(parts[key] for key in ("cmins", "cmaxes", "cbars", "cmedians"))):  # type: ignore[misc]
        part.set_color(COLOURS[1])
    axes.plot([], [], color=COLOURS[1], label=f"{len(drawn):,} random choices")
    axes.plot(
        [drawn_sensors], [100 * best], color=COLOURS[0], marker="*", markersize=12, linestyle="none", label="best"
    )
    axes.set(xlabel="sensors", ylabel="objective (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure


def _sheet(rows: int, columns: int, title: str) -> tuple[Figure, list[list[Axes]]]:
    return charts(rows, columns, (max(4.2 * columns, 6.4), 3.6 * rows + 0.9), title)
