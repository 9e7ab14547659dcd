"""A frame of a scenario from above: the ego, the actors, and what a rig and the reference sensor saw."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import NDArray

from torchcover.report.maps.overlay import draw_ego
from torchcover.report.maps.sheet import Bounds, fit_paper, stack_views, write_legend, write_title

Points = NDArray[np.floating]

WIDTH_IN = 13.0
REFERENCE, SENSOR = "#c8c8c8", "#3b6ea5"
# These have the same colours in every picture; others take what follows.
CATEGORIES = ("car", "truck", "bus", "cyclist", "motorcycle", "pedestrian")
COLOURS = ("#d55e00", "#7a3fa0", "#e6b400", "#009e73", "#8b5a2b", "#d62598", "#a3122f", "#555555", "#000000")


@dataclass(frozen=True, eq=False)
class ActorMark:
    """An actor as a frame shows it.

    Args:
        category: What it is; one colour each.
        outline_m: (K, 2) corners x, y in the vehicle frame in metres.
    """

    category: str
    outline_m: Points


def draw_scene(
    x: Bounds,
    y: Bounds,
    *,
    ego_outline_m: Points,
    actors: Sequence[ActorMark],
    sensor: Points,
    reference: Points,
    title: str,
    subtitle: str = "",
) -> Figure:
    """Draw a frame.

    Args:
        x: Bounds forward in metres.
        y: Bounds to the left in metres.
        ego_outline_m: (K, 2) corners of the ego in the vehicle frame in metres.
        actors: The others; what lies beyond the bounds is left out.
        sensor: (N, 3) points of the rig.
        reference: (M, 3) points of the reference sensor.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot.
    """
    figure, (axes,) = stack_views(x, [y], width_in=WIDTH_IN)
    axes.set(xlabel="x forward (m)", ylabel="y left (m)")
    inside = [actor for actor in actors if _is_inside(actor.outline_m, x, y)]
    entries = [
        *_draw_cloud(axes, reference, REFERENCE, "reference points"),
        *_draw_cloud(axes, sensor, SENSOR, "points of the rig"),
        *_draw_actors(axes, inside),
        *draw_ego(axes, ego_outline_m),
    ]
    write_title(axes, title, subtitle)
    write_legend(axes, entries, columns=4)
    fit_paper(figure)
    return figure


def _draw_cloud(axes: Axes, points: Points, colour: str, label: str) -> list[Artist]:
    # A point is a pixel, however many there are.
    axes.plot(points[:, 0], points[:, 1], linestyle="none", marker=",", color=colour, zorder=1)
    return [Line2D([], [], linestyle="none", marker=".", color=colour, label=f"{label} ({len(points):,})")]


def _draw_actors(axes: Axes, actors: Sequence[ActorMark]) -> list[Artist]:
    counts = Counter(actor.category for actor in actors)
    known = [*CATEGORIES, *sorted(set(counts) - set(CATEGORIES))]
    colours = {category: COLOURS[at % len(COLOURS)] for at, category in enumerate(known) if category in counts}
    for actor in actors:
        colour = colours[actor.category]
        axes.add_patch(Polygon(actor.outline_m, facecolor=(colour, 0.45), edgecolor=colour, linewidth=0.9, zorder=2))
    return [
        Patch(facecolor=(colour, 0.45), edgecolor=colour, label=f"{category} ({counts[category]})")
        for category, colour in colours.items()
    ]


def _is_inside(outline_m: Points, x: Bounds, y: Bounds) -> bool:
    low, high = outline_m.min(axis=0), outline_m.max(axis=0)
    return bool(high[0] >= x[0] and low[0] <= x[1] and high[1] >= y[0] and low[1] <= y[1])
