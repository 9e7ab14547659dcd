"""Time to collision at detection against speed."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from torchcover.report.maps.sheet import charts

COLOURS = "tab10"

# Speed in km/h, least and most time to collision in s.
Band = Sequence[tuple[float, float, float]]


def draw_encounters(
    panels: Sequence[tuple[str, Mapping[str, Band], Sequence[tuple[float, float]]]], *, title: str
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
    figure, grid = charts(down, across, (1.5 + 4.2 * across, 0.8 + 3.6 * down), title, sharey=True)
    views = [axes for row in grid for axes in row]
    for axes, (name, bands, needed) in zip(views, panels, strict=False):
        for number, (rig, band) in enumerate(bands.items()):
            speed_kmh, low_s, high_s = np.array(band).T
            colour = colormaps[COLOURS](number % 10)
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
