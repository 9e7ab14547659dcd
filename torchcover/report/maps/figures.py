"""All maps of a run: a figure for each quantity and height band, whatever was measured."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Coverage, Quantity, check_paired
from torchcover.coverage.blocks import MIN_BLOCKS
from torchcover.report.maps.arrays import draw_map, draw_side_by_side
from torchcover.report.maps.colours import NEVER_PROBED, ColourScale, difference_scale, error_scale, scale_of
from torchcover.report.maps.overlay import SensorView
from torchcover.report.wording import UNITS, capitalised, span, steps_and_cell

MAX_FILE_NAME = 48
Named = tuple[str, Figure]


@dataclass(frozen=True)
class Subject:
    """What some maps show: one quantity of every rig in every band.

    Args:
        quantity: What the values are.
        values: Name of the rig -> (H, Y, X) in the unit that is shown.
        scale: What the colours mean: the same for all bands and rigs.
        unknown: Why a cell has no number, for the legend.
    """

    quantity: Quantity
    values: Mapping[str, Tensor]
    scale: ColourScale
    unknown: str


def subjects_of(coverages: Mapping[str, Coverage]) -> Iterator[Subject]:
    """All that was measured.

    Args:
        coverages: By the name of the rig; one, or several that are paired.
    """
    for key, layer in _first(coverages).layers.items():
        values = _shown(layer.quantity, [coverage.layers[key].values for coverage in coverages.values()])
        named = dict(zip(coverages, values, strict=True))
        yield Subject(layer.quantity, named, scale_of(layer.quantity, torch.stack(values)), NEVER_PROBED)


def error_subjects_of(coverages: Mapping[str, Coverage]) -> Iterator[Subject]:
    """The standard errors of what has any.

    Args:
        coverages: As in `subjects_of`.
    """
    unknown = f"probed in fewer than {MIN_BLOCKS} blocks of steps"
    first = _first(coverages)
    for key in first.errors:
        of = first.layers[key].quantity
        quantity = Quantity(of.error_key, f"standard error of the {of.title}", of.unit, lower_is_better=True)
        values = _shown(quantity, [coverage.errors[key] for coverage in coverages.values()])
        named = dict(zip(coverages, values, strict=True))
        yield Subject(quantity, named, error_scale(quantity, torch.stack(values)), unknown)


def _first(coverages: Mapping[str, Coverage]) -> Coverage:
    return next(iter(coverages.values()))


def _shown(quantity: Quantity, values: Sequence[Tensor]) -> list[Tensor]:
    return [UNITS[quantity.unit].factor * each for each in values]


def map_figures(
    coverages: Mapping[str, Coverage],
    *,
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Mapping[str, Sequence[SensorView]] | None = None,
    errors: bool = False,
) -> Iterator[Named]:
    """Draw everything that was measured in every height band, for one rig or for several.

    The bands of a quantity share their colours, so that they can be compared by eye, and so do the rigs, which lie
    side by side. For every rig but the first there is a figure of its difference to the first too; the differences of
    a quantity share their colours.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig; several from the same frames.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the name of the rig.
        errors: Whether to draw the standard errors too, if there are any.

    Returns:
        Pairs, drawn one by one, of a name that is fit for a file and a figure: `radius_m_ground`,
        `detection_0.4m_obstacle`, `radius_m_error_ground`, `difference_radius_m_ground_RIG_minus_FIRST`.

    Raises:
        ValueError: Several coverages that are not paired, as in `check_paired`; while drawing, an outline of another
            shape.

    Example:
        >>> from torchcover.coverage import CoverageMetric
        >>> metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(torch.zeros(1, 3), torch.tensor([[0.3, 0.0, 0.0]]))
        >>> [name for name, _ in map_figures({"my rig": metric.compute()})]
        ['radius_m_all', 'detection_0.4m_all']
    """
    if len(coverages) > 1:
        check_paired(coverages)
    return _figures(coverages, _Setting(ego_outline_m, sensors or {}), errors=errors)


def band_figures(coverage: Coverage) -> Iterator[Named]:
    """Draw everything that was measured, the bands of a quantity side by side: `radius_m`, `detection_0.4m`, ...

    Args:
        coverage: What `CoverageMetric.compute` returned.
    """
    grid, conditions = coverage.grid, steps_and_cell(coverage.counts["steps"], coverage.grid)
    headings = [f"{name}, z {span(band)}" for name, band in grid.heights.items()]
    for subject in subjects_of({"": coverage}):
        bands = dict(zip(headings, subject.values[""], strict=True))
        title = capitalised(subject.quantity.title)
        yield subject.quantity.key, draw_side_by_side(bands, grid, subject.scale, title=title, subtitle=conditions)


def write_figures(figures: Iterable[Named], folder: str | Path) -> list[Path]:
    """Write figures as PNG files, one after the other.

    Args:
        figures: Their names without suffix, and they: what `map_figures` gives.
        folder: Where to write; made if it does not exist.

    Returns:
        The files.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in figures:
        paths.append(folder / f"{name}.png")
        figure.savefig(paths[-1], dpi=figure.dpi)
    return paths


def file_stems(names: Sequence[str]) -> list[str]:
    """A name for each that every file system takes and that no other has.

    Example:
        >>> file_stems(["low/high", "low high", "ground"])
        ['low_high', 'low_high_1', 'ground']
    """
    stems: list[str] = []
    for number, name in enumerate(names):
        stem = re.sub(r"[^\w.-]+", "_", name)[:MAX_FILE_NAME]
        while stem.lower() in (other.lower() for other in stems):
            stem += f"_{number}"
        stems.append(stem)
    return stems


@dataclass(frozen=True)
class _Setting:
    """What is drawn over the maps."""

    ego_outline_m: NDArray[np.floating] | None
    sensors: Mapping[str, Sequence[SensorView]]


@dataclass(frozen=True)
class _Band:
    """A height band as titles and file names have it."""

    number: int
    name: str
    stem: str
    subtitle: str


def _figures(coverages: Mapping[str, Coverage], setting: _Setting, *, errors: bool) -> Iterator[Named]:
    first = next(iter(coverages.values()))
    bands = _bands(first.grid, first.counts["steps"])
    draw_rigs = _draw_one if len(coverages) == 1 else _draw_several
    for subject in subjects_of(coverages):
        yield from draw_rigs(subject, first.grid, bands, setting)
        yield from _draw_differences(subject, first.grid, bands, setting)
    for subject in error_subjects_of(coverages) if errors else ():
        yield from draw_rigs(subject, first.grid, bands, setting)


def _bands(grid: BevGrid, steps: int) -> list[_Band]:
    conditions = steps_and_cell(steps, grid)
    named = zip(grid.heights.items(), file_stems(list(grid.heights)), strict=True)
    return [_Band(at, name, stem, f"z {span(z)}; {conditions}") for at, ((name, z), stem) in enumerate(named)]


def _draw_one(subject: Subject, grid: BevGrid, bands: Sequence[_Band], setting: _Setting) -> Iterator[Named]:
    ((rig, values),) = subject.values.items()
    for band in bands:
        figure = draw_map(
            values[band.number],
            grid,
            subject.scale,
            title=f"{capitalised(subject.quantity.title)}, {band.name}",
            subtitle=band.subtitle,
            ego_outline_m=setting.ego_outline_m,
            sensors=setting.sensors.get(rig, ()),
            unknown=subject.unknown,
        )
        yield f"{subject.quantity.key}_{band.stem}", figure


def _draw_several(subject: Subject, grid: BevGrid, bands: Sequence[_Band], setting: _Setting) -> Iterator[Named]:
    for band in bands:
        figure = draw_side_by_side(
            {rig: values[band.number] for rig, values in subject.values.items()},
            grid,
            subject.scale,
            title=f"{capitalised(subject.quantity.title)}, {band.name}",
            subtitle=band.subtitle,
            ego_outline_m=setting.ego_outline_m,
            sensors=setting.sensors,
            unknown=subject.unknown,
        )
        yield f"{subject.quantity.key}_{band.stem}", figure


def _draw_differences(subject: Subject, grid: BevGrid, bands: Sequence[_Band], setting: _Setting) -> Iterator[Named]:
    (first, expected), *others = subject.values.items()
    if not others:
        return
    # Where both are infinite there is no difference, rather than NaN, which means unknown.
    differences = [(values - expected).where(values != expected, 0.0) for _, values in others]
    scale = difference_scale(subject.quantity, torch.stack(differences))
    first_stem, *stems = file_stems(list(subject.values))
    for (rig, _), stem, difference in zip(others, stems, differences, strict=True):
        for band in bands:
            figure = draw_map(
                # What is infinite takes the last colour: it is better or worse, not a step without a point.
                difference[band.number].clamp(2 * scale.low, 2 * scale.high),
                grid,
                scale,
                title=f"{rig} minus {first}: {subject.quantity.title}, {band.name}",
                subtitle=f"blue: {rig} is better, red: {first} is better; {band.subtitle}",
                ego_outline_m=setting.ego_outline_m,
            )
            yield f"difference_{subject.quantity.key}_{band.stem}_{stem}_minus_{first_stem}", figure
