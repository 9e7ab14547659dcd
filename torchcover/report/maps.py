"""Maps of a run: a figure for each quantity and height band, and differences between rigs."""

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

NamedFigure = tuple[str, Figure]


def plot_maps(
    coverages: Mapping[str, Coverage],
    *,
    ego_outline_m: NDArray[np.floating] | None = None,
    sensors: Mapping[str, Sequence[SensorView]] | None = None,
    vehicle: str | None = None,
    quantity_key: str | None = None,
) -> Iterator[NamedFigure]:
    """Plot all quantities in all height bands, for one rig or for several side by side.

    Averages over the visible surface are plotted for each cell, or for a larger square where points are few; cells with
    little visible surface are paler. All bands and rigs of a quantity share a color scale. Each rig but the first has
    figures of its difference to the first, which share a color scale too. Maps are cropped to the observed part of the
    regions; the surroundings of the ego vehicle have figures of their own without sensor directions.

    Args:
        coverages: Name of the rig -> result of `CoverageMetric.compute`; several must be paired.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in the vehicle frame in meters.
        sensors: Name of the rig -> sensors to plot.
        vehicle: Name of the ego vehicle for the titles.
        quantity_key: Key of the only quantity to plot; None plots all.

    Returns:
        Iterator over file stems and figures, plotted one by one: `radius_m_ground`, `detection_area_0.4m_obstacle`,
        `difference_radius_m_ground_RIG_minus_FIRST`, `near_field_radius_m`.

    Raises:
        ValueError: Coverages are not paired (`check_paired`), or the outline has another shape.

    Example:
        >>> from torchcover.coverage import CoverageMetric
        >>> metric = CoverageMetric(BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)}))
        >>> metric.update(torch.zeros(1, 3), torch.tensor([[0.3, 0.0, 0.0]]))
        >>> [name for name, _ in plot_maps({"my rig": metric.compute()})]
        ['radius_m_all', 'detection_0.4m_all']
    """
    if len(coverages) > 1:
        check_paired(coverages)
    coverages = {name: downsample_coverage(coverage) for name, coverage in coverages.items()}
    return _plot_layers(coverages, _MapContext(ego_outline_m, sensors or {}, vehicle), quantity_key)


def plot_band_maps(coverage: Coverage) -> Iterator[NamedFigure]:
    """Plot the bands of each quantity side by side: `radius_m`, `detection_0.4m`, ...

    Args:
        coverage: Result of `CoverageMetric.compute`.

    Returns:
        Iterator over keys of quantities and figures.
    """
    headings = [f"{name}, {format_height_band(coverage.grid, name)}" for name in coverage.grid.heights]
    window = find_observed_window(coverage)
    for grid_layer in build_map_layers({"": coverage}):
        layer = _crop_layer(grid_layer, window)
        figure = plot_side_by_side(
            dict(zip(headings, layer.values[""], strict=True)),
            window.grid,
            layer.scale,
            title=capitalize(layer.quantity.title),
            subtitle=layer.conditions,
            unobserved_label=layer.unobserved_label,
            opacity=None if layer.opacity is None else dict(zip(headings, layer.opacity, strict=True)),
        )
        yield layer.quantity.key, figure


def write_figures(figures: Iterable[NamedFigure], folder: str | Path) -> list[Path]:
    """Write figures as PNG files, one after the other.

    Args:
        figures: File stems and figures, as from `plot_maps`.
        folder: Folder of the files; it is created if it does not exist.

    Returns:
        Paths of the files.
    """
    paths = []
    for name, figure in figures:
        paths.append(Path(folder, f"{name}.png"))
        write_atomically(paths[-1], partial(figure.savefig, dpi=figure.dpi))
    return paths


def build_file_stems(names: Sequence[str]) -> list[str]:
    """Build distinct file names that every file system accepts, of at most 48 characters without suffix.

    Args:
        names: Names of rigs, bands or objectives.

    Example:
        >>> build_file_stems(["low/high", "low high", "ground"])
        ['low_high', 'low_high_1', 'ground']
    """
    stems: list[str] = []
    for number, name in enumerate(names):
        stem = re.sub(r"[^\w.-]+", "_", name)[:48]
        while stem.lower() in [earlier.lower() for earlier in stems]:
            stem += f"_{number}"
        stems.append(stem)
    return stems


@dataclass(frozen=True)
class _MapContext:
    """Ego vehicle and sensors of all maps of a run."""

    ego_outline_m: NDArray[np.floating] | None
    sensors: Mapping[str, Sequence[SensorView]]
    vehicle: str | None

    def add_vehicle(self, layer: MapLayer) -> MapLayer:
        """Add the name of the vehicle to the conditions of a layer."""
        if self.vehicle is None:
            return layer
        return replace(layer, conditions=f"on {self.vehicle}, {layer.conditions}")


@dataclass(frozen=True)
class _Band:
    """Height band: index in the grid, name, file stem and description of its bounds."""

    index: int
    name: str
    stem: str
    bounds: str

    def format_subtitle(self, layer: MapLayer) -> str:
        """Format the bounds of the band and the conditions of a layer."""
        return f"{self.bounds}; {layer.conditions}"

    def get_opacity(self, layer: MapLayer) -> Tensor | None:
        """Return the (Y, X) opacity of a layer in this band."""
        return None if layer.opacity is None else layer.opacity[self.index]


def _plot_layers(
    coverages: Mapping[str, Coverage], context: _MapContext, quantity_key: str | None
) -> Iterator[NamedFigure]:
    """Yield maps, near-field maps and difference maps, quantity by quantity."""
    grid, ego_outline_m = next(iter(coverages.values())).grid, context.ego_outline_m
    window = find_observed_window(next(iter(coverages.values())), ego_outline_m)
    near_window = None if ego_outline_m is None else find_near_field_window(grid, ego_outline_m)
    bands = []
    for index, (name, stem) in enumerate(zip(grid.heights, build_file_stems(list(grid.heights)), strict=True)):
        bands.append(_Band(index, name, stem, format_height_band(grid, name)))
    for grid_layer in build_map_layers(coverages):
        if quantity_key not in (None, grid_layer.quantity.key):
            continue
        described_layer = context.add_vehicle(grid_layer)
        layer = _crop_layer(described_layer, window)
        yield from _plot_rigs(layer, window.grid, bands, context)
        yield from _plot_differences(layer, window.grid, bands, context)
        if near_window is not None:
            near_layer = _crop_layer(described_layer, near_window)
            scale = build_color_scale(near_layer.quantity, torch.stack(list(near_layer.values.values())))
            yield _plot_near_field(replace(near_layer, scale=scale), near_window.grid, bands, context)


def _crop_layer(layer: MapLayer, window: Window) -> MapLayer:
    """Crop the values and opacities of all rigs to a window."""
    values = {rig: window.crop(rig_values) for rig, rig_values in layer.values.items()}
    return replace(layer, values=values, opacity=None if layer.opacity is None else window.crop(layer.opacity))


def _plot_rigs(layer: MapLayer, grid: BevGrid, bands: Sequence[_Band], context: _MapContext) -> Iterator[NamedFigure]:
    """Yield a figure for each band with all rigs side by side."""
    headings = {rig: rig if len(layer.values) > 1 else "" for rig in layer.values}
    for band in bands:
        opacity = band.get_opacity(layer)
        figure = plot_side_by_side(
            {headings[rig]: values[band.index] for rig, values in layer.values.items()},
            grid,
            layer.scale,
            title=f"{capitalize(layer.quantity.title)}, {band.name}",
            subtitle=band.format_subtitle(layer),
            ego_outline_m=context.ego_outline_m,
            sensors={heading: context.sensors.get(rig, ()) for rig, heading in headings.items()},
            unobserved_label=layer.unobserved_label,
            opacity=None if opacity is None else dict.fromkeys(headings.values(), opacity),
        )
        yield f"{layer.quantity.key}_{band.stem}", figure


def _plot_near_field(layer: MapLayer, grid: BevGrid, bands: Sequence[_Band], context: _MapContext) -> NamedFigure:
    """Plot the near field of all rigs and bands side by side, without directions of sensors."""
    values, sensors, opacity = {}, {}, {}
    for rig, rig_values in layer.values.items():
        for band in bands:
            heading = f"{band.name}, {band.bounds}"
            if len(layer.values) > 1:
                heading = f"{rig}, {heading}"
            values[heading] = rig_values[band.index]
            sensors[heading] = context.sensors.get(rig, ())
            band_opacity = band.get_opacity(layer)
            if band_opacity is not None:
                opacity[heading] = band_opacity
    figure = plot_side_by_side(
        values,
        grid,
        layer.scale,
        title=f"{capitalize(layer.quantity.title)}, two vehicle lengths around the ego vehicle",
        subtitle=layer.conditions,
        ego_outline_m=context.ego_outline_m,
        sensors=sensors,
        show_directions=False,
        unobserved_label=layer.unobserved_label,
        opacity=opacity,
    )
    return f"near_field_{layer.quantity.key}", figure


def _plot_differences(
    layer: MapLayer, grid: BevGrid, bands: Sequence[_Band], context: _MapContext
) -> Iterator[NamedFigure]:
    """Yield the differences of each rig to the first in all bands, on one scale."""
    (first, baseline), *compared = layer.values.items()
    if not compared:
        return
    differences = [compute_difference(values, baseline) for _, values in compared]
    scale = build_difference_scale(layer.quantity, torch.stack(differences))
    first_stem, *stems = build_file_stems(list(layer.values))
    for (rig, _), stem, difference in zip(compared, stems, differences, strict=True):
        for band in bands:
            opacity = band.get_opacity(layer)
            figure = plot_side_by_side(
                # An infinite difference gets the last color; the infinite color is for frames without points.
                {"": difference[band.index].clamp(2 * scale.low, 2 * scale.high)},
                grid,
                scale,
                title=f"{rig} minus {first}: {layer.quantity.title}, {band.name}",
                subtitle=f"blue: {rig} is better, red: {first} is better; {band.format_subtitle(layer)}",
                ego_outline_m=context.ego_outline_m,
                unobserved_label=layer.unobserved_label,
                opacity=None if opacity is None else {"": opacity},
            )
            yield f"difference_{layer.quantity.key}_{band.stem}_{stem}_minus_{first_stem}", figure
