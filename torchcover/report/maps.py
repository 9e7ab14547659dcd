"""All maps of a run: a figure for each quantity and height band, whatever was measured."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Coverage, check_paired
from torchcover.files import write_atomically
from torchcover.report.colors import build_color_scale, build_difference_scale, plot_side_by_side
from torchcover.report.map_layers import (
    MapLayer,
    Window,
    build_map_layers,
    compute_difference,
    downsample_coverage,
    find_near_field_window,
    find_observed_window,
)
from torchcover.report.number_format import capitalize, format_height_band
from torchcover.report.overlay import SensorView

MAX_FILE_NAME = 48
NamedFigure = tuple[str, Figure]


def plot_maps(
    coverages: Mapping[str, Coverage],
    *,
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Mapping[str, Sequence[SensorView]] | None = None,
    vehicle: str | None = None,
    quantity_key: str | None = None,
) -> Iterator[NamedFigure]:
    """Draw what was measured in every height band, for one rig or for several.

    Results over the visible surface are drawn as the ratio of each cell, or of a larger square where points are few;
    paler where little surface is seen in a step. The bands of a quantity share their colours, so that they can be
    compared by eye, and so do the rigs, which lie side by side. For every rig but the first there is a figure of its
    difference to the first too; the differences of a quantity share their colours. Maps show what was asked for and is
    known; what is near the ego has figures of its own, on which nothing but the sensors' places lies over the cells.

    Args:
        coverages: What `CoverageMetric.compute` returned, by the name of the rig; several from the same frames.
        ego_outline_m: (K, 2) corners x, y of the ego in the vehicle frame in metres.
        sensors: What to mark, by the name of the rig.
        vehicle: What the ego is called, for the titles.
        quantity_key: Key of the only quantity to draw; all if not given.

    Returns:
        Pairs, drawn one by one, of a name that is fit for a file and a figure: `radius_m_ground`,
        `detection_area_0.4m_obstacle`, `difference_radius_m_ground_RIG_minus_FIRST`, `near_radius_m`.

    Raises:
        ValueError: Several coverages that are not paired, as in `check_paired`; while drawing, an outline of another
            shape.

    Example:
        >>> from torchcover.coverage import CoverageMetric
        >>> metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(torch.zeros(1, 3), torch.tensor([[0.3, 0.0, 0.0]]))
        >>> [name for name, _ in plot_maps({"my rig": metric.compute()})]
        ['radius_m_all', 'detection_0.4m_all']
    """
    if len(coverages) > 1:
        check_paired(coverages)
    coverages = {name: downsample_coverage(coverage) for name, coverage in coverages.items()}
    return _figures(coverages, _Setting(ego_outline_m, sensors or {}, vehicle), quantity_key)


def plot_band_maps(coverage: Coverage) -> Iterator[NamedFigure]:
    """Draw what was measured, the bands of a quantity side by side: `radius_m`, `detection_0.4m`, ...

    Args:
        coverage: What `CoverageMetric.compute` returned.
    """
    headings = [f"{name}, {format_height_band(coverage.grid, name)}" for name in coverage.grid.heights]
    shown = find_observed_window(coverage)
    for whole in build_map_layers({"": coverage}):
        subject = _within(whole, shown)
        figure = plot_side_by_side(
            dict(zip(headings, subject.values[""], strict=True)),
            shown.grid,
            subject.scale,
            title=capitalize(subject.quantity.title),
            subtitle=subject.conditions,
            unobserved_label=subject.unobserved_label,
            opacity=None if subject.opacity is None else dict(zip(headings, subject.opacity, strict=True)),
        )
        yield subject.quantity.key, figure


def write_figures(figures: Iterable[NamedFigure], folder: str | Path) -> list[Path]:
    """Write figures as PNG files, one after the other.

    Args:
        figures: Their names without suffix, and they: what `plot_maps` gives.
        folder: Where to write; made if it does not exist.
    """
    paths = []
    for name, figure in figures:
        paths.append(Path(folder, f"{name}.png"))
        write_atomically(paths[-1], partial(figure.savefig, dpi=figure.dpi))
    return paths


def build_file_stems(names: Sequence[str]) -> list[str]:
    """A name for each that every file system takes and that no other has.

    Example:
        >>> build_file_stems(["low/high", "low high", "ground"])
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
    ego_outline_m: NDArray[np.floating] | None
    sensors: Mapping[str, Sequence[SensorView]]
    vehicle: str | None

    def told(self, subject: MapLayer) -> MapLayer:
        """With what carried the rigs."""
        if self.vehicle is None:
            return subject
        return replace(subject, conditions=f"on {self.vehicle}, {subject.conditions}")


@dataclass(frozen=True)
class _Band:
    number: int
    name: str
    stem: str
    z: str

    def subtitle(self, subject: MapLayer) -> str:
        """Where it is, and under which conditions a subject was measured."""
        return f"{self.z}; {subject.conditions}"

    def opacity(self, subject: MapLayer) -> Tensor | None:
        """(Y, X) that of a subject in this band."""
        return None if subject.opacity is None else subject.opacity[self.number]


def _figures(coverages: Mapping[str, Coverage], setting: _Setting, layer: str | None) -> Iterator[NamedFigure]:
    first, ego = next(iter(coverages.values())), setting.ego_outline_m
    named, shown = (
        zip(first.grid.heights, build_file_stems(list(first.grid.heights)), strict=True),
        find_observed_window(first, ego),
    )
    bands = [_Band(at, name, stem, format_height_band(first.grid, name)) for at, (name, stem) in enumerate(named)]
    near = None if ego is None else find_near_field_window(first.grid, ego)
    for whole in map(setting.told, build_map_layers(coverages)):
        if layer not in (None, whole.quantity.key):
            continue
        subject = _within(whole, shown)
        yield from _draw_rigs(subject, shown.grid, bands, setting)
        yield from _draw_differences(subject, shown.grid, bands, setting)
        if near is not None:
            around = _within(whole, near)
            own = build_color_scale(around.quantity, torch.stack(list(around.values.values())))
            yield _draw_near(replace(around, scale=own), near.grid, bands, setting)


def _within(subject: MapLayer, shown: Window) -> MapLayer:
    values = {rig: shown.crop(each) for rig, each in subject.values.items()}
    return replace(subject, values=values, opacity=None if subject.opacity is None else shown.crop(subject.opacity))


def _draw_rigs(subject: MapLayer, grid: BevGrid, bands: Sequence[_Band], setting: _Setting) -> Iterator[NamedFigure]:
    headings = {rig: rig if len(subject.values) > 1 else "" for rig in subject.values}
    for band in bands:
        opacity = band.opacity(subject)
        figure = plot_side_by_side(
            {headings[rig]: values[band.number] for rig, values in subject.values.items()},
            grid,
            subject.scale,
            title=f"{capitalize(subject.quantity.title)}, {band.name}",
            subtitle=band.subtitle(subject),
            ego_outline_m=setting.ego_outline_m,
            sensors={heading: setting.sensors.get(rig, ()) for rig, heading in headings.items()},
            unobserved_label=subject.unobserved_label,
            opacity=None if opacity is None else dict.fromkeys(headings.values(), opacity),
        )
        yield f"{subject.quantity.key}_{band.stem}", figure


def _draw_near(subject: MapLayer, grid: BevGrid, bands: Sequence[_Band], setting: _Setting) -> NamedFigure:
    several = len(subject.values) > 1
    panels = {
        f"{rig}, {band.name}, {band.z}" if several else f"{band.name}, {band.z}": (rig, band)
        for rig in subject.values
        for band in bands
    }
    opacity = {heading: band.opacity(subject) for heading, (_, band) in panels.items()}
    figure = plot_side_by_side(
        {heading: subject.values[rig][band.number] for heading, (rig, band) in panels.items()},
        grid,
        subject.scale,
        title=f"{capitalize(subject.quantity.title)}, near the ego",
        subtitle=subject.conditions,
        ego_outline_m=setting.ego_outline_m,
        sensors={heading: setting.sensors.get(rig, ()) for heading, (rig, _) in panels.items()},
        show_directions=False,
        unobserved_label=subject.unobserved_label,
        opacity={heading: each for heading, each in opacity.items() if each is not None},
    )
    return f"near_{subject.quantity.key}", figure


def _draw_differences(
    subject: MapLayer, grid: BevGrid, bands: Sequence[_Band], setting: _Setting
) -> Iterator[NamedFigure]:
    (first, expected), *others = subject.values.items()
    if not others:
        return
    differences = [compute_difference(values, expected) for _, values in others]
    scale = build_difference_scale(subject.quantity, torch.stack(differences))
    first_stem, *stems = build_file_stems(list(subject.values))
    for (rig, _), stem, change in zip(others, stems, differences, strict=True):
        for band in bands:
            opacity = band.opacity(subject)
            figure = plot_side_by_side(
                # What is infinite takes the last colour: it is better or worse, not a step without a point.
                {"": change[band.number].clamp(2 * scale.low, 2 * scale.high)},
                grid,
                scale,
                title=f"{rig} minus {first}: {subject.quantity.title}, {band.name}",
                subtitle=f"blue: {rig} is better, red: {first} is better; {band.subtitle(subject)}",
                ego_outline_m=setting.ego_outline_m,
                unobserved_label=subject.unobserved_label,
                opacity=None if opacity is None else {"": opacity},
            )
            yield f"difference_{subject.quantity.key}_{band.stem}_{stem}_minus_{first_stem}", figure
