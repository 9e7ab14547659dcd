"""Content of a page: tables, maps, rigs and facts with their names and units."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import Coverage, Layer, TargetSums
from torchcover.estimation import Number
from torchcover.report.colors import UNOBSERVED, ColorScale, build_color_scale, build_difference_scale, to_array
from torchcover.report.map_layers import (
    NO_SURFACE,
    compute_difference,
    compute_square_sides,
    downsample_coverage,
    list_map_quantities,
)
from torchcover.report.number_format import format_height_band, get_display_unit
from torchcover.report.overlay import SensorView
from torchcover.report.table_layout import PageTable

Bounds = tuple[float, float]
Array = NDArray[np.floating]
Sides = NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class MapLine:
    """Line on a map.

    Args:
        name: Name in the legend.
        points_m: (K, 2) x, y in the vehicle frame in meters; NaN between two parts.
    """

    name: str
    points_m: Array


@dataclass(frozen=True, eq=False)
class PageMap:
    """Map of one quantity of one rig in one band.

    Args:
        quantity: Name of the quantity, without unit.
        band: Height band or test target.
        rig: Name of the rig.
        x: Bounds of the raster forward in meters.
        y: Bounds of the raster to the left in meters.
        cell_m: Side of a cell in meters.
        values: (Y, X) values in the unit of the scale; NaN is unobserved.
        scale: Color scale, the same for all bands and rigs.
        unobserved_label: Label of unobserved cells.
        errors: (Y, X) standard errors.
        weights: (Y, X) weight of each cell when cells are merged.
        weight_name: Name of the weights, with unit.
        opaque_weight: Weight of an opaque cell; cells with less are paler. 0 makes all cells opaque.
        sides: (Y, X) side of the square of each cell in cells; a power of 2.
        difference_scale: Color scale of the difference to the first rig; None for the first rig.
        lines: Lines on the map.
        num_bits: Bits of each number and weight in the file, 16 or 8.
    """

    quantity: str
    band: str
    rig: str
    x: Bounds
    y: Bounds
    cell_m: float
    values: Array
    scale: ColorScale
    unobserved_label: str = UNOBSERVED
    errors: Array | None = None
    weights: Array | None = None
    weight_name: str = ""
    opaque_weight: float = 0.0
    sides: Sides | None = None
    difference_scale: ColorScale | None = None
    lines: Sequence[MapLine] = ()
    num_bits: int = 16


@dataclass(frozen=True, eq=False)
class TargetVisibilityMap:
    """Map of the positions near a vehicle at which a test target is detected.

    Args:
        rig: Name of the rig.
        title: Line above the map.
        x: Bounds of the cells forward in meters.
        y: Bounds of the cells to the left in meters.
        cell_m: Side of a cell in meters.
        sensor_counts: (Y, X) number of detecting sensors; -1 where the position is not free.
        vehicle_box_m: (4, 2) corners x, y of the box from which distances are measured.
        vehicle_outline_m: (K, 2) outline of the vehicle.
        max_distance_m: Maximum distance of counted positions in meters.
        failure_effects_m2: Sensor -> additional undetected area within this distance when it fails.
    """

    rig: str
    title: str
    x: Bounds
    y: Bounds
    cell_m: float
    sensor_counts: Sides
    vehicle_box_m: Array
    vehicle_outline_m: Array
    max_distance_m: float
    failure_effects_m2: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class DetectionShares:
    """Detection shares of one region and band, for one or several rigs.

    Args:
        name: Description of the region and band.
        shares: Name of the rig -> its share, with its interval if there is one.
    """

    name: str
    shares: Mapping[str, Number]


@dataclass(frozen=True, eq=False)
class PageRig:
    """Rig on a page.

    Args:
        name: Name of the rig in tables and maps.
        sensors: Sensors; empty if unknown.
        document: The rig as YAML; empty if unknown.
    """

    name: str
    sensors: Sequence[SensorView] = ()
    document: str = ""


@dataclass(frozen=True, eq=False)
class PagePicture:
    """Picture on a page.

    Args:
        title: Description, also for screen readers.
        png: Content of the PNG file.
    """

    title: str
    png: bytes


@dataclass(frozen=True, eq=False)
class Page:
    """Content of a page.

    Args:
        title: Title.
        lead: Line below the title.
        findings: Findings in sentences, the most important first.
        target_maps: Maps of test targets, at the top.
        detection_shares: Detection shares, below them.
        tables: Tables of numbers.
        pictures: Pictures above the tables.
        maps: Maps in the order of the menus; differences are to the first rig.
        rigs: Rigs, plotted on the ego vehicle and as YAML.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in meters.
        outlines: Outlines of the regions on the maps.
        facts: Heading -> name -> value, such as settings.
        more_tables: Tables below the facts, such as omissions.
    """

    title: str
    lead: str
    findings: Sequence[str] = ()
    target_maps: Sequence[TargetVisibilityMap] = ()
    detection_shares: Sequence[DetectionShares] = ()
    tables: Sequence[PageTable] = ()
    pictures: Sequence[PagePicture] = ()
    maps: Sequence[PageMap] = ()
    rigs: Sequence[PageRig] = ()
    ego_outline_m: Array | None = None
    outlines: Sequence[MapLine] = ()
    facts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    more_tables: Sequence[PageTable] = ()


def build_page_maps(
    coverages: Mapping[str, Coverage], target_sums: Mapping[str, TargetSums] | None = None
) -> Iterator[PageMap]:
    """Yield a map for each quantity, height band and rig; maps of test targets come first.

    Args:
        coverages: Name of the rig -> its coverage; several must be paired.
        target_sums: Name of the rig -> its visibility of test targets; by default there are none.
    """
    coverages = {name: downsample_coverage(coverage) for name, coverage in coverages.items()}
    first = next(iter(coverages.values()))
    for rig, targets in (target_sums or {}).items():
        quantity = targets.quantities[0]
        for target, counts in zip(targets.target_names, targets.position_counts, strict=True):
            share = counts[..., 1] / counts[..., 0]
            yield PageMap(
                quantity=quantity.title,
                band=target,
                rig=rig,
                x=targets.grid.x_m,
                y=targets.grid.y_m,
                cell_m=targets.grid.cell_m,
                values=get_display_unit(quantity.unit).factor * to_array(share),
                scale=build_color_scale(quantity, share),
                unobserved_label="no free position",
                weights=_replace_zeros(counts[..., 0]),
                weight_name="free positions",
            )
    area_weights = _build_area_weights(first) if first.average == "area" else None
    frame_weights = CellWeights([_replace_zeros(counts) for counts in first.observed_frames], "observing frames")
    for quantity, is_area_average in list_map_quantities(first):
        layers = {rig: coverage.sparse_layers[quantity.key] for rig, coverage in coverages.items()}
        errors = {rig: coverage.sparse_errors.get(quantity.key) for rig, coverage in coverages.items()}
        weights = area_weights if is_area_average and area_weights else frame_weights
        yield from _build_quantity_maps(layers, errors, weights, first)
    redundancy_layers: dict[str, dict[str, Layer]] = {}
    for rig, coverage in coverages.items():
        if coverage.redundancy is not None:
            for key, layer in coverage.redundancy.sparse_layers.items():
                redundancy_layers.setdefault(key, {})[rig] = layer
    for layers in redundancy_layers.values():
        yield from _build_quantity_maps(layers, dict.fromkeys(layers), area_weights or frame_weights, first)


class CellWeights(NamedTuple):
    """Weights of cells, see `PageMap`.

    Args:
        values: (Y, X) weights of each band.
        name: Name of the weights, with unit.
        opaque_weight: Weight of an opaque cell; 0 makes all cells opaque.
        sides: (Y, X) sides of squares of each band; None without squares.
    """

    values: list[Array]
    name: str
    opaque_weight: float = 0.0
    sides: list[Sides] | None = None


def _build_quantity_maps(
    layers: Mapping[str, Layer], errors: Mapping[str, Tensor | None], weights: CellWeights, first: Coverage
) -> Iterator[PageMap]:
    """Build maps from numbers of the observed cells, which are the same for all rigs, as in `first`."""
    grid, quantity = first.grid, next(iter(layers.values())).quantity
    factor = get_display_unit(quantity.unit).factor
    values = {rig: factor * layer.values for rig, layer in layers.items()}
    scale = build_color_scale(quantity, torch.stack(list(values.values())))
    baseline, *compared = values.values()
    differences = [compute_difference(rig_values, baseline) for rig_values in compared]
    difference_scale = build_difference_scale(quantity, torch.stack(differences)) if differences else None
    value_maps = {}
    error_maps: dict[str, Array | None] = {}
    for rig, rig_values in values.items():
        rig_errors = errors[rig]
        value_maps[rig] = to_array(first.observed_cells.expand_to_grid(rig_values))
        error_maps[rig] = None
        if rig_errors is not None:
            error_maps[rig] = factor * to_array(first.observed_cells.expand_to_grid(rig_errors))
    for index, band in enumerate(grid.heights):
        for rig_index, rig in enumerate(values):
            error_map = error_maps[rig]
            yield PageMap(
                quantity=quantity.title,
                band=f"{band}, {format_height_band(grid, band)}",
                rig=rig,
                x=grid.x_m,
                y=grid.y_m,
                cell_m=grid.cell_m,
                values=value_maps[rig][index],
                scale=scale,
                unobserved_label=UNOBSERVED if weights.sides is None else NO_SURFACE,
                errors=None if error_map is None else error_map[index],
                weights=weights.values[index],
                weight_name=weights.name,
                opaque_weight=weights.opaque_weight,
                sides=None if weights.sides is None else weights.sides[index],
                difference_scale=difference_scale if rig_index else None,
            )


def _build_area_weights(first: Coverage) -> CellWeights | None:
    """Build weights by visible area, which all rigs share since they share the reference points."""
    if first.area_sums is None:
        return None
    areas_m2 = [_replace_zeros(band_area_m2) for band_area_m2 in first.area_sums.sum_blocks()[0]]
    sides = [band_sides.cpu().numpy() for band_sides in compute_square_sides(first.point_counts, first.grid.cell_m)]
    opaque_weight_m2 = first.counts["num_frames"] * first.grid.cell_m**2
    return CellWeights(areas_m2, "m² of visible surface in all frames", opaque_weight_m2, sides)


def _replace_zeros(counts: Tensor) -> Array:
    """Replace 0 by NaN."""
    array = to_array(counts)
    return np.where(array > 0, array, np.nan)
