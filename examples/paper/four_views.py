"""Figure 2: a rig seen in four ways, in one frame: its sectors, a histogram of its points, and its radius maps."""

import math
from dataclasses import replace

import numpy as np
from matplotlib.patches import Patch, Wedge

from torchcover.coverage.quantities import RADIUS
from torchcover.report.colors import (
    UNOBSERVED,
    ColorScale,
    build_cell_legend,
    build_color_scale,
    plot_cells,
    plot_color_bar,
)
from torchcover.report.number_format import format_height_band, format_resolution
from torchcover.report.overlay import get_sensor_color, plot_ego, plot_sensors
from torchcover.report.plot_layout import (
    HEADING_POINTS,
    create_sheets,
    find_lower_left,
    fit_paper,
    write_heading,
    write_legend,
    write_title,
)

# A few cells beside the bumper hold most of the points.
ROBUST_PERCENTILES = (1, 99.5)
NO_POINT = "white"


def draw_four_views(radius, points, grid, *, steps, title, ego_outline_m, sensors):
    """Draw what geometry alone says of a rig, what its points alone say, and what it sees of what there is to be seen.

    Args:
        radius: (2, Y, X) mean blind spot radius in metres, NaN where unknown.
        points: (Y, X) how many points of the rig fell into each cell, at any height, in all steps.
        grid: The cells: as wide as long, with two bands.
        steps: How many steps.
        title: First line.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: The rig.
    """
    sectors, histogram, *maps = _with_a_bar_for_each_row(create_sheets(grid, 2 + len(grid.heights)))
    entries = _draw_sectors(sectors, sensors)
    write_heading(sectors.axes, "fields of view, as if nothing were in the way")
    entries += _draw_histogram(histogram, points.double().cpu().numpy() / steps)
    write_heading(histogram.axes, "points of the rig in each cell")
    scale = build_color_scale(RADIUS, radius)
    together = radius.cpu().double().numpy()
    for sheet, values, name in zip(maps, together, grid.heights, strict=True):
        plot_color_bar(sheet, plot_cells(sheet.axes, values, scale), together, scale)
        write_heading(sheet.axes, f"blind spot radius, {name}: {format_height_band(grid, name)}")
    entries += build_cell_legend(together, UNOBSERVED)
    for sheet in (histogram, *maps):
        entries += plot_sensors(sheet, sensors, show_names=False)
    for sheet in (sectors, histogram, *maps):
        entries += plot_ego(sheet.axes, ego_outline_m)
    write_title(sectors.axes, title, format_resolution(steps, grid), lift_points=HEADING_POINTS)
    write_legend(find_lower_left(sheet.axes for sheet in maps), entries, sectors.legend_columns)
    fit_paper(sectors.figure)
    return sectors.figure


def _with_a_bar_for_each_row(sheets):
    """The upper maps show points, the lower ones radii: a colour bar as high as its row, instead of one for all."""
    figure, whole = sheets[0].figure, sheets[0].bar.get_position()
    rows = [sheet.axes.get_position() for sheet in sheets[::2]]
    sheets[0].bar.remove()
    bars = [figure.add_axes((whole.x0, row.y0, whole.width, row.height)) for row in rows]
    return [replace(sheet, bar=bars[at // 2]) for at, sheet in enumerate(sheets)]


def _draw_sectors(sheet, sensors):
    """Fill the horizontal field of view of each sensor: all that geometry alone says."""
    entries = []
    for at, sensor in enumerate(sensors):
        style = {"facecolor": (get_sensor_color(at), 0.3), "edgecolor": get_sensor_color(at)}
        # Infinity cannot be drawn; so far beyond the map all ranges look the same.
        reach_m = min(sensor.range_m, 4 * math.hypot(*sheet.axes.get_xlim(), *sheet.axes.get_ylim()))
        ends_deg = (sensor.yaw_deg + side * sensor.horizontal_fov_deg / 2 for side in (-1, 1))
        sheet.axes.add_patch(Wedge((sensor.x_m, sensor.y_m), reach_m, *ends_deg, linewidth=1.0, **style))
        entries.append(Patch(**style, label=f"field of view: {sensor.name}"))
    return entries


def _draw_histogram(sheet, per_step):
    empty = per_step == 0
    low, high = np.percentile(per_step[~empty], ROBUST_PERCENTILES) if not empty.all() else (1.0, 10.0)
    high = max(float(high), 1.01 * float(low))
    scale = ColorScale("points in a cell", "mean of the steps", "viridis", float(low), high, logarithmic=True)
    shown = np.where(empty, np.nan, per_step)
    plot_color_bar(sheet, plot_cells(sheet.axes, shown, scale), shown, scale)
    # Known, unlike a cell of the other maps that is not coloured: no point, for whatever reason.
    sheet.axes.patch.set(facecolor=NO_POINT, hatch="")
    return (
        [Patch(facecolor=NO_POINT, edgecolor="#b2b2b2", label="no point of the rig in any step")] if empty.any() else []
    )
