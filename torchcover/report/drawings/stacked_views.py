"""Views in metres that have no cells: stacked on one paper, with one scale."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchcover.report.maps.sheet import BELOW_IN, DOTS_PER_INCH

Bounds = tuple[float, float]


def stack_views(x: Bounds, heights: Sequence[Bounds], *, width_in: float) -> tuple[Figure, list[Axes]]:
    """Empty views below each other, all with the same x axis and in equal metres.

    Args:
        x: Bounds of the axis to the right, in metres.
        heights: Bounds of the axis upwards in each view, from the top.
        width_in: Width in inches.

    Returns:
        The paper, and the views from the top.
    """
    inches_per_metre = width_in / (x[1] - x[0])
    heights_in = [inches_per_metre * (high - low) for low, high in heights]
    paper_in = sum(heights_in) + BELOW_IN * (len(heights) - 1)
    figure = Figure(figsize=(width_in, paper_in), dpi=DOTS_PER_INCH)
    top_in, views = paper_in, []
    for bounds, height_in in zip(heights, heights_in, strict=True):
        place = (0.0, (top_in - height_in) / paper_in, 1.0, height_in / paper_in)
        views.append(figure.add_axes(place, xlim=x, ylim=bounds))
        top_in -= height_in + BELOW_IN
    return figure, views
