"""Maps: one picture for each metric and height band, seen from above."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Coverage
from torchcover.report.cells import NEVER_PROBED, cell_entries, draw_cells, draw_colour_bar
from torchcover.report.file_names import file_stems
from torchcover.report.metrics import error_metrics_of, metrics_of
from torchcover.report.overlay import SensorMark, draw_ego, draw_sensors
from torchcover.report.scale import ColourScale
from torchcover.report.sheet import fit_paper, lay_out, write_legend, write_title
from torchcover.report.wording import span, steps_and_cell


def draw_maps(
    coverage: Coverage,
    folder: str | Path,
    *,
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Sequence[SensorMark] = (),
    errors: bool = False,
) -> list[Path]:
    """Draw every metric of a coverage in every height band: `radius_ground.png`, `detection_0.4m_obstacle.png`, ...

    The bands of a metric share their colours, so that they can be compared by eye.

    Args:
        coverage: What `CoverageMetric.compute` returned.
        folder: Where to write; made if it does not exist.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark.
        errors: Whether to draw the standard errors too, `radius_error_ground.png`, `detection_0.4m_error_ground.png`.

    Returns:
        The PNG files: metric by metric, in each the bands in the order of the grid.

    Raises:
        ValueError: An outline of another shape.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for stem, figure in coverage_maps(coverage, ego_outline_m=ego_outline_m, sensors=sensors, errors=errors):
        paths.append(folder / f"{stem}.png")
        figure.savefig(paths[-1], dpi=figure.dpi)
    return paths


def coverage_maps(
    coverage: Coverage,
    *,
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Sequence[SensorMark] = (),
    errors: bool = False,
) -> Iterator[tuple[str, Figure]]:
    """The maps of `draw_maps`, one by one: stem of the file name, and figure."""
    heights = coverage.grid.heights
    stems = file_stems(list(heights))
    conditions = steps_and_cell(coverage.counts["steps"], coverage.grid)
    for metric in (*metrics_of([coverage]), *(error_metrics_of([coverage]) if errors else ())):
        for values, stem, (name, band) in zip(metric.values[0], stems, heights.items(), strict=True):
            figure = draw_map(
                values,
                coverage.grid,
                metric.scale,
                title=f"{metric.title}, {name}",
                subtitle=f"z {span(band)}; {conditions}",
                ego_outline_m=ego_outline_m,
                sensors=sensors,
                unknown=metric.unknown,
            )
            yield f"{metric.stem}_{stem}", figure


def draw_map(
    values: Tensor,
    grid: BevGrid,
    scale: ColourScale,
    *,
    title: str,
    subtitle: str = "",
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Sequence[SensorMark] = (),
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
