"""Arrays over a grid as maps: one, or several side by side."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.report.maps.colours import (
    NEVER_PROBED,
    PALER,
    ColourScale,
    cell_entries,
    draw_cells,
    draw_colour_bar,
)
from torchcover.report.maps.overlay import SensorView, draw_ego, draw_places, draw_sensors
from torchcover.report.maps.sheet import (
    HEADING_POINTS,
    fit_paper,
    lay_out,
    lower_left,
    write_heading,
    write_legend,
    write_title,
)


def draw_side_by_side(
    values: Mapping[str, Tensor],
    grid: BevGrid,
    scale: ColourScale,
    *,
    title: str,
    subtitle: str = "",
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Mapping[str, Sequence[SensorView]] | None = None,
    directions: bool = True,
    unknown: str = NEVER_PROBED,
    opacity: Mapping[str, Tensor] | None = None,
) -> Figure:
    """Draw arrays over one grid, seen from above, with one colour bar: x forward to the right, y left upwards.

    Args:
        values: (Y, X) numbers in the unit of `scale`, by their headings, which may be empty. NaN is unknown and drawn
            hatched grey; infinity has a colour of its own.
        grid: The cells.
        scale: What the colours of all of them mean.
        title: First line.
        subtitle: Second line, smaller.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the headings.
        directions: Whether to draw directions and fields of view; else the places of the sensors only.
        unknown: Why a cell is, for the legend.
        opacity: (Y, X) in [0, 1] by the headings, less where less of the surface is seen in a step; all cells alike if
            not given.

    Returns:
        A figure of its own, outside pyplot: `figure.savefig(path)`, or hand it to a logger.

    Raises:
        ValueError: An array or the outline has another shape.

    Example:
        >>> import torch
        >>> grid = BevGrid(x=(0.0, 2.0), y=(-1.0, 1.0), cell=1.0)
        >>> change = torch.tensor([[0.5, -0.5], [float("nan"), 0.0]])
        >>> scale = ColourScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0)
        >>> draw_side_by_side({"": change}, grid, scale, title="Rig B against rig A").axes[0].get_xlabel()
        'x forward (m)'
    """
    for name, given in (("values", values), ("opacity", opacity or {})):
        for one in given.values():
            if tuple(one.shape) != grid.shape[1:]:
                wanted = f"shape {grid.shape[1:]} is needed, as of a band of the grid"
                raise ValueError(f"{name}: {wanted}; got {tuple(one.shape)}")
    arrays = {name: as_array(value) for name, value in values.items()}
    opaque = {name: as_array(value) for name, value in (opacity or {}).items()}
    sheets = lay_out(grid, len(arrays))
    images = [
        draw_cells(sheet.axes, array, scale, opacity=opaque.get(name))
        for sheet, (name, array) in zip(sheets, arrays.items(), strict=True)
    ]
    together = np.stack(list(arrays.values()))
    draw_colour_bar(sheets[0], images[0], together, scale)
    entries = cell_entries(together, unknown)
    if opacity:
        entries.append(Line2D([], [], linestyle="none", label=PALER))  # words only, as it is about every colour
    for sheet, name in zip(sheets, values, strict=True):
        if name:
            write_heading(sheet.axes, name)
        if ego_outline_m is not None:
            entries += draw_ego(sheet.axes, ego_outline_m)
        own = (sensors or {}).get(name, ())
        entries += draw_sensors(sheet, own, named=not name) if directions else draw_places(sheet, own)
    write_title(sheets[0].axes, title, subtitle, lift_points=HEADING_POINTS if any(arrays) else 0.0)
    write_legend(lower_left(sheet.axes for sheet in sheets), entries, sheets[0].legend_columns)
    fit_paper(sheets[0].figure)
    return sheets[0].figure


def as_array(values: Tensor) -> NDArray[np.float64]:
    """Numbers of cells as matplotlib takes them."""
    return values.detach().cpu().double().numpy()
