"""Maps of several rigs: side by side on one colour scale, and as differences to the first."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Coverage
from torchcover.report.cells import NEVER_PROBED, cell_entries, draw_cells, draw_colour_bar
from torchcover.report.file_names import file_stems
from torchcover.report.maps import draw_map
from torchcover.report.metrics import Metric, error_metrics_of, metrics_of
from torchcover.report.overlay import SensorMark, draw_ego, draw_sensors
from torchcover.report.paired import check_paired
from torchcover.report.scale import ColourScale, difference_scale
from torchcover.report.sheet import (
    HEADING_POINTS,
    fit_paper,
    lay_out,
    lower_left,
    write_heading,
    write_legend,
    write_title,
)
from torchcover.report.wording import span, steps_and_cell

Outline = NDArray[np.floating]


def draw_comparison(
    coverages: Mapping[str, Coverage],
    folder: str | Path,
    *,
    ego_outline_m: Outline | None = None,
    sensors: Mapping[str, Sequence[SensorMark]] | None = None,
    errors: bool = False,
) -> list[Path]:
    """Draw every metric of several rigs in every height band.

    Each has a picture of all rigs on one colour scale, `radius_ground.png`, and for every rig but the first a picture
    of its difference to the first, `difference_radius_ground_RIG_minus_FIRST.png`. The differences of a metric share
    their colours too.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig, from the same frames.
        folder: Where to write; made if it does not exist.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the name of the rig.
        errors: Whether to draw the standard errors of the rigs too, side by side.

    Returns:
        The PNG files.

    Raises:
        ValueError: As `check_paired`, or an outline of another shape.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for stem, figure in comparison_maps(coverages, ego_outline_m=ego_outline_m, sensors=sensors, errors=errors):
        paths.append(folder / f"{stem}.png")
        figure.savefig(paths[-1], dpi=figure.dpi)
    return paths


def comparison_maps(
    coverages: Mapping[str, Coverage],
    *,
    ego_outline_m: Outline | None = None,
    sensors: Mapping[str, Sequence[SensorMark]] | None = None,
    errors: bool = False,
) -> Iterator[tuple[str, Figure]]:
    """The maps of `draw_comparison`, one by one: stem of the file name, and figure."""
    check_paired(coverages)
    rigs, grid = list(coverages), next(iter(coverages.values())).grid
    conditions = steps_and_cell(next(iter(coverages.values())).counts["steps"], grid)
    for metric in metrics_of(list(coverages.values())):
        yield from _side_by_side(metric, rigs, grid, conditions, ego_outline_m, sensors or {})
        yield from _differences(metric, rigs, grid, conditions, ego_outline_m)
    for metric in error_metrics_of(list(coverages.values())) if errors else ():
        yield from _side_by_side(metric, rigs, grid, conditions, ego_outline_m, sensors or {})


def draw_side_by_side(
    values: Mapping[str, Tensor],
    grid: BevGrid,
    scale: ColourScale,
    *,
    title: str,
    subtitle: str = "",
    ego_outline_m: Outline | None = None,
    sensors: Mapping[str, Sequence[SensorMark]] | None = None,
    unknown: str = NEVER_PROBED,
) -> Figure:
    """Draw several arrays over one grid, with one colour bar.

    Args:
        values: (Y, X) numbers in the unit of `scale`, by their headings; as in `draw_map`.
        grid: The cells.
        scale: What the colours of all of them mean.
        title: First line.
        subtitle: Second line, smaller.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the headings.
        unknown: Why a cell is, for the legend.

    Returns:
        A figure of its own, outside pyplot.

    Raises:
        ValueError: An outline of another shape.
    """
    arrays = [value.detach().cpu().double().numpy() for value in values.values()]
    sheets = lay_out(grid, len(arrays))
    images = [draw_cells(sheet.axes, array, scale) for sheet, array in zip(sheets, arrays, strict=True)]
    together = np.stack(arrays)
    draw_colour_bar(sheets[0], images[0], together, scale)
    entries = cell_entries(together, unknown)
    for sheet, name in zip(sheets, values, strict=True):
        write_heading(sheet.axes, name)
        if ego_outline_m is not None:
            entries += draw_ego(sheet.axes, ego_outline_m)
        entries += draw_sensors(sheet, (sensors or {}).get(name, ()), named=False)
    write_title(sheets[0].axes, title, subtitle, lift_points=HEADING_POINTS)
    write_legend(lower_left(sheets), entries, sheets[0].legend_columns)
    fit_paper(sheets[0].figure)
    return sheets[0].figure


def _side_by_side(
    metric: Metric,
    rigs: Sequence[str],
    grid: BevGrid,
    conditions: str,
    ego_outline_m: Outline | None,
    sensors: Mapping[str, Sequence[SensorMark]],
) -> Iterator[tuple[str, Figure]]:
    for at, (stem, (name, band)) in enumerate(zip(file_stems(list(grid.heights)), grid.heights.items(), strict=True)):
        yield (
            f"{metric.stem}_{stem}",
            draw_side_by_side(
                {rig: values[at] for rig, values in zip(rigs, metric.values, strict=True)},
                grid,
                metric.scale,
                title=f"{metric.title}, {name}",
                subtitle=f"z {span(band)}; {conditions}",
                ego_outline_m=ego_outline_m,
                sensors=sensors,
                unknown=metric.unknown,
            ),
        )


def _differences(
    metric: Metric, rigs: Sequence[str], grid: BevGrid, conditions: str, ego_outline_m: Outline | None
) -> Iterator[tuple[str, Figure]]:
    first, *others = metric.values
    # Where both are infinite there is no difference, rather than NaN, which means unknown.
    differences = [(values - first).where(values != first, 0.0) for values in others]
    scale = difference_scale(metric.scale, torch.stack(differences), lower_is_better=metric.lower_is_better)
    rig_stems = file_stems(rigs)
    for rig, rig_stem, difference in zip(rigs[1:], rig_stems[1:], differences, strict=True):
        bands = zip(file_stems(list(grid.heights)), grid.heights.items(), strict=True)
        for at, (stem, (name, band)) in enumerate(bands):
            figure = draw_map(
                # What is infinite takes the last colour: it is better or worse, not a step without a point.
                difference[at].clamp(2 * scale.low, 2 * scale.high),
                grid,
                scale,
                title=f"{rig} minus {rigs[0]}: {metric.title[0].lower()}{metric.title[1:]}, {name}",
                subtitle=f"blue: {rig} is better, red: {rigs[0]} is better; z {span(band)}; {conditions}",
                ego_outline_m=ego_outline_m,
            )
            yield f"difference_{metric.stem}_{stem}_{rig_stem}_minus_{rig_stems[0]}", figure
