"""Figure 2: a rig in four views: its fields of view, a histogram of its points, and its radius maps."""

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
    create_sheets,
    find_lower_left,
    fit_paper,
    write_heading,
    write_legend,
    write_title,
)


def plot_four_views(radius_m, point_counts, grid, *, num_frames, title, ego_outline_m, sensors):
    """Plot fields of view, points and blind spot radii of a rig.

    Args:
        radius_m: (2, Y, X) mean blind spot radius in meters, NaN in unobserved cells.
        point_counts: (Y, X) number of points of the rig in each cell, at any height, in all frames.
        grid: Square grid with two height bands.
        num_frames: Number of frames.
        title: First line.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in the vehicle frame, in meters.
        sensors: `SensorView` of each sensor of the rig.
    """
    field_of_view, histogram, *maps = _split_color_bar(create_sheets(grid, 2 + len(grid.heights)))
    entries = _plot_fields_of_view(field_of_view, sensors)
    write_heading(field_of_view.axes, "fields of view without occlusion")
    entries += _plot_histogram(histogram, point_counts.double().cpu().numpy() / num_frames)
    write_heading(histogram.axes, "points of the rig in each cell")
    scale = build_color_scale(RADIUS, radius_m)
    radius_by_band = radius_m.cpu().double().numpy()
    for sheet, values, name in zip(maps, radius_by_band, grid.heights, strict=True):
        plot_color_bar(sheet, plot_cells(sheet.axes, values, scale), radius_by_band, scale)
        write_heading(sheet.axes, f"blind spot radius, {name}: {format_height_band(grid, name)}")
    entries += build_cell_legend(radius_by_band, UNOBSERVED)
    for sheet in (histogram, *maps):
        entries += plot_sensors(sheet, sensors, show_names=False)
    for sheet in (field_of_view, histogram, *maps):
        entries += plot_ego(sheet.axes, ego_outline_m)
    write_title(field_of_view.axes, title, format_resolution(num_frames, grid), has_heading=True)
    write_legend(find_lower_left(sheet.axes for sheet in maps), entries, field_of_view.legend_columns)
    fit_paper(field_of_view.figure)
    return field_of_view.figure


def _split_color_bar(sheets):
    """Replace the common color bar by one for each row: points in the upper row, radii in the lower row."""
    figure, box = sheets[0].figure, sheets[0].color_bar_axes.get_position()
    sheets[0].color_bar_axes.remove()
    split_sheets = []
    for first in (0, 2):
        row = sheets[first].axes.get_position()
        color_bar_axes = figure.add_axes((box.x0, row.y0, box.width, row.height))
        split_sheets += [replace(sheet, color_bar_axes=color_bar_axes) for sheet in sheets[first : first + 2]]
    return split_sheets


def _plot_fields_of_view(sheet, sensors):
    """Fill the horizontal field of view of each sensor."""
    entries = []
    for index, sensor in enumerate(sensors):
        style = {"facecolor": (get_sensor_color(index), 0.3), "edgecolor": get_sensor_color(index)}
        # An infinite range cannot be plotted; four map diagonals look the same.
        range_m = min(sensor.range_m, 4 * math.hypot(*sheet.axes.get_xlim(), *sheet.axes.get_ylim()))
        half_fov_deg = sensor.horizontal_fov_deg / 2
        azimuths_deg = (sensor.yaw_deg - half_fov_deg, sensor.yaw_deg + half_fov_deg)
        sheet.axes.add_patch(Wedge((sensor.x_m, sensor.y_m), range_m, *azimuths_deg, linewidth=1.0, **style))
        entries.append(Patch(**style, label=f"field of view: {sensor.name}"))
    return entries


def _plot_histogram(sheet, points_per_frame):
    is_empty = points_per_frame == 0
    # A few cells in front of the bumper have most of the points: the scale ends at percentiles.
    low, high = (1.0, 10.0) if is_empty.all() else np.percentile(points_per_frame[~is_empty], (1, 99.5))
    high = max(float(high), 1.01 * float(low))
    scale = ColorScale("points in a cell", "mean of the frames", "viridis", float(low), high, logarithmic=True)
    values = np.where(is_empty, np.nan, points_per_frame)
    plot_color_bar(sheet, plot_cells(sheet.axes, values, scale), values, scale)
    # Empty cells are white, not hatched as unobserved cells of the other maps: their number of points is 0.
    sheet.axes.patch.set(facecolor="white", hatch="")
    label = "no point of the rig in any frame"
    return [Patch(facecolor="white", edgecolor="#b2b2b2", label=label)] if is_empty.any() else []
