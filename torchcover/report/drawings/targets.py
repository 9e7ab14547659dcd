"""What a rig sees of a target at every place around the vehicle, from above."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from torchcover.coverage import BevGrid
from torchcover.report.maps.colours import UNKNOWN, ColourScale, draw_cells, draw_colour_bar
from torchcover.report.maps.overlay import HALO, draw_ego
from torchcover.report.maps.sheet import Sheet, fit_paper, lay_out, write_legend, write_title

Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

UNSEEN = "#d55e00"
ROBUST_PERCENTILE = 98
RINGS_M = (1.0, 2.0, 3.0)
CORNER_POINTS = 25


def draw_targets(
    points: Float64,
    enough: Bools,
    grid: BevGrid,
    *,
    vehicle_outline_m: Float64,
    vehicle_box_m: Float64,
    sensors_m: Float64,
    hits: int,
    title: str,
    subtitle: str = "",
) -> Figure:
    """Draw how many points there are on a target.

    Args:
        points: (Y, X) number of points, NaN where the target cannot stand.
        enough: (Y, X) whether that is enough to see it.
        grid: The cells.
        vehicle_outline_m: (K, 2) what the vehicle looks like from above.
        vehicle_box_m: (4, 2) its box, from which the dashed lines are 1, 2 and 3 m away.
        sensors_m: (S, 2) where sensors are.
        hits: How many points are enough, for the legend.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A figure of its own, outside pyplot. Lines divide places where it is seen from those where it is not.

    Raises:
        ValueError: Arrays of another shape than the grid.
    """
    for name, array in (("points", points), ("enough", enough)):
        if array.shape != grid.shape[1:]:
            raise ValueError(f"{name}: shape {grid.shape[1:]} is needed, as of the grid; got {array.shape}")
    (sheet,) = lay_out(grid)
    entries = _draw_points(sheet, points)
    entries += _draw_rings(sheet.axes, vehicle_box_m)
    entries += _draw_boundary(sheet.axes, enough, ~np.isnan(points), grid, hits)
    entries += draw_ego(sheet.axes, vehicle_outline_m)
    sheet.axes.plot(*sensors_m.T, linestyle="none", marker="o", markersize=3.5, color="black", zorder=4)
    entries.append(Line2D([], [], linestyle="none", marker="o", markersize=3.5, color="black", label="sensors"))
    write_title(sheet.axes, title, subtitle)
    write_legend(sheet.axes, entries, sheet.legend_columns)
    fit_paper(sheet.figure)
    return sheet.figure


def _draw_points(sheet: Sheet, points: Float64) -> list[Artist]:
    some = points[points > 0]
    high = max(float(np.percentile(some, ROBUST_PERCENTILE)), 10.0) if len(some) else 10.0
    scale = ColourScale("points on the target", "mean of the steps", "viridis", 1.0, high, logarithmic=True)
    # Fewer than one in the mean is as dark as one.
    shown = np.where(points > 0, np.maximum(points, 1.0), np.nan)
    draw_colour_bar(sheet, draw_cells(sheet.axes, shown, scale), shown, scale)
    unseen = np.ma.masked_where(points != 0, np.ones_like(points))
    sheet.axes.imshow(
        unseen,
        extent=(*sheet.axes.get_xlim(), *sheet.axes.get_ylim()),
        origin="lower",
        interpolation="nearest",
        cmap=ListedColormap([UNSEEN]),
    )
    entries: list[Artist] = []
    if (points == 0).any():
        entries.append(Patch(facecolor=UNSEEN, label="no point at all"))
    if np.isnan(points).any():
        entries.append(Patch(label="no room for it", **UNKNOWN))
    return entries


def _draw_boundary(axes: Axes, enough: Bools, free: Bools, grid: BevGrid, hits: int) -> list[Artist]:
    """Lines along the edges between cells that are seen and cells that are not."""
    x, y = np.linspace(*grid.x, enough.shape[1] + 1), np.linspace(*grid.y, enough.shape[0] + 1)
    row, column = np.nonzero((enough[:, 1:] != enough[:, :-1]) & free[:, 1:] & free[:, :-1])
    upright = [((x[c + 1], y[r]), (x[c + 1], y[r + 1])) for r, c in zip(row, column, strict=True)]
    row, column = np.nonzero((enough[1:] != enough[:-1]) & free[1:] & free[:-1])
    level = [((x[c], y[r + 1]), (x[c + 1], y[r + 1])) for r, c in zip(row, column, strict=True)]
    lines = LineCollection(upright + level, colors="black", linewidths=1.4, zorder=2, path_effects=HALO)
    axes.add_collection(lines)
    return [Line2D([], [], color="black", linewidth=1.4, label=f"between fewer than {hits} points and more")]


def _draw_rings(axes: Axes, box_m: Float64) -> list[Artist]:
    low, high = box_m.min(axis=0), box_m.max(axis=0)
    for ring_m in RINGS_M:
        axes.plot(*_ring(low, high, ring_m).T, color="white", linewidth=0.9, linestyle=(0, (4, 4)), zorder=1.5)
    words = ", ".join(f"{ring_m:g}" for ring_m in RINGS_M)
    patch = Line2D([], [], color="#808080", linewidth=0.9, linestyle=(0, (4, 4)), label=f"{words} m from the vehicle")
    return [patch]


def _ring(low: Float64, high: Float64, away_m: float) -> Float64:
    """(K, 2) closed line at a distance from a rectangle."""
    angles = np.linspace(0.0, 2 * np.pi, 4 * CORNER_POINTS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = np.array([high, (low[0], high[1]), low, (high[0], low[1])])
    ring = corners.repeat(CORNER_POINTS, axis=0) + away_m * circle
    return np.vstack([ring, ring[:1]])
