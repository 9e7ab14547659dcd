"""A choice of sensors: what more of them bring, and what random choices are worth."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

CHOSEN, BOUND, DRAWN = "#0072b2", "#999999", "#d55e00"


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
    figure = Figure(figsize=(6.4, 4.0), dpi=120, layout="constrained")
    axes = figure.subplots()
    if sizes:
        numbers, values, bounds = 100 * np.array(sizes).T
        numbers = numbers / 100
        axes.fill_between(numbers, values, bounds, color=BOUND, alpha=0.3, linewidth=0, label="where the best lies")
        axes.plot(numbers, values, color=CHOSEN, marker="o", markersize=4, label="found")
    parts = axes.violinplot(100 * np.array(drawn), [drawn_sensors], widths=0.5, showmedians=True)
    for part in (*parts["bodies"], *(parts[key] for key in ("cmins", "cmaxes", "cbars", "cmedians"))):  # type: ignore[misc]
        part.set_color(DRAWN)
    axes.plot([], [], color=DRAWN, label=f"{len(drawn):,} random choices")
    axes.plot([drawn_sensors], [100 * best], color=CHOSEN, marker="*", markersize=12, linestyle="none", label="best")
    axes.set(title=title, xlabel="sensors", ylabel="objective (%)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=True, alpha=0.2)
    axes.legend(frameon=False)
    return figure
