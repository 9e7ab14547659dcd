"""Plots of the points on a test target by its position around a vehicle."""

from dataclasses import dataclass

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
from torchcover.report.colors import UNOBSERVED_STYLE, ColorScale, plot_cells, plot_color_bar
from torchcover.report.overlay import HALO, plot_ego
from torchcover.report.plot_layout import Sheet, create_sheets, fit_paper, write_legend, write_title

Float64 = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class TargetPlotParams:
    """Colors and lines of plots of test targets.

    Args:
        undetected_color: Color of cells in which the target has no point.
        points_percentile: Percentile of the number of points at the upper end of the colors.
        ring_distances_m: Distances of the dashed lines from the vehicle.
    """

    undetected_color: str = "#d55e00"
    points_percentile: float = 98.0
    ring_distances_m: tuple[float, ...] = (1.0, 2.0, 3.0)


PARAMS = TargetPlotParams()


def plot_target_visibility(
    point_counts: Float64,
    detected: Bools,
    grid: BevGrid,
    *,
    vehicle_outline_m: Float64,
    vehicle_box_m: Float64,
    sensors_m: Float64,
    min_points: int,
    title: str,
    subtitle: str = "",
) -> Figure:
    """Plot the number of points on a test target by its position, with lines between detected and undetected cells.

    Args:
        point_counts: (Y, X) number of points; NaN where the target overlaps the vehicle or another object.
        detected: (Y, X) whether the target is detected.
        grid: Grid of the positions.
        vehicle_outline_m: (K, 2) outline of the vehicle from above.
        vehicle_box_m: (4, 2) corners of its bounding box, the origin of the distances of the dashed lines.
        sensors_m: (S, 2) positions of sensors.
        min_points: Number of points that a detection needs, for the legend.
        title: First line.
        subtitle: Second line, smaller.

    Returns:
        A new figure outside pyplot.

    Raises:
        ValueError: An array has another shape than the grid.
    """
    for name, array in (("point_counts", point_counts), ("detected", detected)):
        if array.shape != grid.shape[1:]:
            raise ValueError(f"{name}: got shape {array.shape}; give that of the grid, {grid.shape[1:]}")
    (sheet,) = create_sheets(grid)
    entries = _plot_point_counts(sheet, point_counts)
    entries.append(_plot_rings(sheet.axes, vehicle_box_m))
    entries.append(_plot_boundary(sheet.axes, detected, ~np.isnan(point_counts), grid, min_points))
    entries += plot_ego(sheet.axes, vehicle_outline_m)
    sheet.axes.plot(*sensors_m.T, linestyle="none", marker="o", markersize=3.5, color="black", zorder=4)
    entries.append(Line2D([], [], linestyle="none", marker="o", markersize=3.5, color="black", label="sensors"))
    write_title(sheet.axes, title, subtitle)
    write_legend(sheet.axes, entries, sheet.legend_columns)
    fit_paper(sheet.figure)
    return sheet.figure


def _plot_point_counts(sheet: Sheet, point_counts: Float64) -> list[Artist]:
    """Plot cells by the logarithm of their points; cells without a point have a color of their own."""
    positive = point_counts[point_counts > 0]
    high = max(float(np.percentile(positive, PARAMS.points_percentile)), 10.0) if len(positive) else 10.0
    scale = ColorScale("points on the target", "mean of the frames", "viridis", 1.0, high, logarithmic=True)
    # Means below 1 have the color of 1.
    values = np.where(point_counts > 0, np.maximum(point_counts, 1.0), np.nan)
    plot_color_bar(sheet, plot_cells(sheet.axes, values, scale), values, scale)
    sheet.axes.imshow(
        np.ma.masked_where(point_counts != 0, np.ones_like(point_counts)),
        extent=(*sheet.axes.get_xlim(), *sheet.axes.get_ylim()),
        origin="lower",
        interpolation="nearest",
        cmap=ListedColormap([PARAMS.undetected_color]),
    )
    entries: list[Artist] = []
    if (point_counts == 0).any():
        entries.append(Patch(facecolor=PARAMS.undetected_color, label="no points"))
    if np.isnan(point_counts).any():
        entries.append(Patch(label="no room for the target", **UNOBSERVED_STYLE))
    return entries


def _plot_boundary(axes: Axes, detected: Bools, is_free: Bools, grid: BevGrid, min_points: int) -> Artist:
    """Plot lines along the edges between detected and undetected free cells."""
    x, y = np.linspace(*grid.x_m, detected.shape[1] + 1), np.linspace(*grid.y_m, detected.shape[0] + 1)
    segments = []
    is_edge = (detected[:, 1:] != detected[:, :-1]) & is_free[:, 1:] & is_free[:, :-1]
    for row, column in np.argwhere(is_edge):
        segments.append(((x[column + 1], y[row]), (x[column + 1], y[row + 1])))
    is_edge = (detected[1:] != detected[:-1]) & is_free[1:] & is_free[:-1]
    for row, column in np.argwhere(is_edge):
        segments.append(((x[column], y[row + 1]), (x[column + 1], y[row + 1])))
    axes.add_collection(LineCollection(segments, colors="black", linewidths=1.4, zorder=2, path_effects=HALO))
    return Line2D([], [], color="black", linewidth=1.4, label=f"limit of {min_points} points")


def _plot_rings(axes: Axes, box_m: Float64) -> Artist:
    """Plot dashed lines at some distances from the vehicle: rectangles with rounded corners."""
    low, high = box_m.min(axis=0), box_m.max(axis=0)
    num_corner_points = 25
    angles = np.linspace(0.0, 2 * np.pi, 4 * num_corner_points, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = np.array([high, (low[0], high[1]), low, (high[0], low[1])]).repeat(num_corner_points, axis=0)
    dashes = (0, (4, 4))
    for distance_m in PARAMS.ring_distances_m:
        ring = corners + distance_m * directions
        axes.plot(*np.vstack([ring, ring[:1]]).T, color="white", linewidth=0.9, linestyle=dashes, zorder=1.5)
    distances = ", ".join(f"{distance_m:g}" for distance_m in PARAMS.ring_distances_m)
    label = f"{distances} m from the vehicle"
    return Line2D([], [], color="#808080", linewidth=0.9, linestyle=dashes, label=label)
