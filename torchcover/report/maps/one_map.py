"""One map: an array over a grid, seen from above."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.report.maps.cells import NEVER_PROBED, cell_entries, draw_cells, draw_colour_bar
from torchcover.report.maps.overlay import draw_ego, draw_sensors
from torchcover.report.maps.scale import ColourScale
from torchcover.report.maps.sheet import fit_paper, lay_out, write_legend, write_title
from torchcover.report.sensor_view import SensorView


def draw_map(
    values: Tensor,
    grid: BevGrid,
    scale: ColourScale,
    *,
    title: str,
    subtitle: str = "",
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Sequence[SensorView] = (),
    unknown: str = NEVER_PROBED,
) -> Figure:
    """Draw one array over a grid, seen from above: x forward to the right, y left upwards.

    Args:
        values: (Y, X) numbers in the unit of `scale`. NaN is unknown and drawn hatched grey; infinity has a colour of
            its own.
        grid: The cells.
        scale: What the colours mean.
        title: First line.
        subtitle: Second line, smaller.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark.
        unknown: Why a cell is, for the legend.

    Returns:
        A figure of its own, outside pyplot: `figure.savefig(path)`, or hand it to a logger.

    Raises:
        ValueError: `values` or the outline have another shape.

    Example:
        >>> import torch
        >>> grid = BevGrid(x=(0.0, 2.0), y=(-1.0, 1.0), cell=1.0)
        >>> change = torch.tensor([[0.5, -0.5], [float("nan"), 0.0]])
        >>> scale = ColourScale("change of the blind spot radius", "m", "PuOr", -1.0, 1.0)
        >>> draw_map(change, grid, scale, title="Rig B against rig A").axes[0].get_xlabel()
        'x forward (m)'
    """
    if tuple(values.shape) != grid.shape[1:]:
        raise ValueError(
            f"values: shape {grid.shape[1:]} is needed, as of a band of the grid; got {tuple(values.shape)}"
        )
    array = values.detach().cpu().double().numpy()
    (sheet,) = lay_out(grid)
    draw_colour_bar(sheet, draw_cells(sheet.axes, array, scale), array, scale)
    entries = cell_entries(array, unknown)
    if ego_outline_m is not None:
        entries += draw_ego(sheet.axes, ego_outline_m)
    entries += draw_sensors(sheet, sensors)
    write_title(sheet.axes, title, subtitle)
    write_legend(sheet.axes, entries, sheet.legend_columns)
    fit_paper(sheet.figure)
    return sheet.figure
