"""A rig seen in four ways, in one frame: its sectors, a histogram of its points, and its radius maps."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.coverage.quantity import RADIUS
from torchcover.report.maps.colours import (
    NEVER_PROBED,
    ColourScale,
    cell_entries,
    draw_cells,
    draw_colour_bar,
    paler_entry,
    scale_of,
)
from torchcover.report.maps.overlay import SensorView, draw_ego, draw_sectors, draw_sensors
from torchcover.report.maps.sheet import (
    HEADING_POINTS,
    Sheet,
    fit_paper,
    lay_out,
    lower_left,
    write_heading,
    write_legend,
    write_title,
)
from torchcover.report.wording import span, steps_and_cell

# A few cells beside the bumper hold most of the points.
ROBUST_PERCENTILES = (1, 99.5)
NO_POINT = "white"


def draw_four_views(
    radius: Tensor,
    points: Tensor,
    grid: BevGrid,
    *,
    steps: int,
    title: str,
    ego_outline_m: NDArray[np.floating],
    sensors: Sequence[SensorView],
    unknown: str = NEVER_PROBED,
    opacity: Tensor | None = None,
) -> Figure:
    """Draw what geometry alone says of a rig, what its points alone say, and what it sees of what there is to be seen.

    Args:
        radius: (H, Y, X) mean blind spot radius in metres, NaN where unknown.
        points: (Y, X) how many points of the rig fell into each cell, at any height, in all steps.
        grid: The cells.
        steps: How many steps.
        title: First line.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: The rig.
        unknown: Why a cell has no radius, for the legend.
        opacity: (H, Y, X) that of the radius, as in `draw_map`.

    Returns:
        A figure of its own, outside pyplot: sectors and histogram, and below them the blind spot radius in every band;
        four panels for two bands. All have the same frame, extent and axes.

    Raises:
        ValueError: `radius`, `points`, the opacity or the outline have another shape.
    """
    expected = ("radius", radius, grid.shape), ("points", points, grid.shape[1:]), ("opacity", opacity, grid.shape)
    for name, array, shape in expected:
        if array is not None and tuple(array.shape) != shape:
            raise ValueError(f"{name}: shape {shape} is needed, as of the grid; got {tuple(array.shape)}")
    sectors, histogram, *maps = lay_out(grid, 2 + len(grid.heights), across=2)
    entries = draw_sectors(sectors, sensors)
    write_heading(sectors.axes, "fields of view, as if nothing were in the way")
    entries += _draw_histogram(histogram, points.double().cpu().numpy() / steps)
    write_heading(histogram.axes, "points of the rig in each cell")
    scale = scale_of(RADIUS, radius)
    together = radius.cpu().double().numpy()
    opaque = [None] * len(maps) if opacity is None else list(opacity.cpu().double().numpy())
    for sheet, values, shown, name in zip(maps, together, opaque, grid.heights, strict=True):
        draw_colour_bar(sheet, draw_cells(sheet.axes, values, scale, opacity=shown), together, scale)
        write_heading(sheet.axes, f"blind spot radius, {name}: {span(grid, name)}")
    entries += cell_entries(together, unknown)
    if opacity is not None:
        entries.append(paler_entry())
    for sheet in (histogram, *maps):
        entries += draw_sensors(sheet, sensors, named=False)
    for sheet in (sectors, histogram, *maps):
        entries += draw_ego(sheet.axes, ego_outline_m)
    write_title(sectors.axes, title, steps_and_cell(steps, grid), lift_points=HEADING_POINTS)
    write_legend(lower_left(maps), entries, sectors.legend_columns)
    fit_paper(sectors.figure)
    return sectors.figure


def _draw_histogram(sheet: Sheet, per_step: NDArray[np.float64]) -> list[Artist]:
    empty = per_step == 0
    low, high = np.percentile(per_step[~empty], ROBUST_PERCENTILES) if not empty.all() else (1.0, 10.0)
    high = max(float(high), 1.01 * float(low))
    scale = ColourScale("points in a cell", "mean of the steps", "viridis", float(low), high, logarithmic=True)
    shown = np.where(empty, np.nan, per_step)
    draw_colour_bar(sheet, draw_cells(sheet.axes, shown, scale), shown, scale)
    # Known, unlike a cell of the other maps that is not coloured: no point, for whatever reason.
    sheet.axes.patch.set(facecolor=NO_POINT, hatch="")
    return (
        [Patch(facecolor=NO_POINT, edgecolor="#b2b2b2", label="no point of the rig in any step")] if empty.any() else []
    )
