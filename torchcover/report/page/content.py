"""What a page is made of: tables, maps, rigs and facts with their names and units, whoever measured them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import Coverage, Layer
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
    """A line over a map, in metres in the vehicle frame.

    Args:
        name: What it is, for the legend.
        points_m: (K, 2) x, y; NaN between two parts.
    """

    name: str
    points_m: Array


@dataclass(frozen=True, eq=False)
class PageMap:
    """One quantity of one rig in one band over the cells of a raster.

    Args:
        quantity: What the values are, without the unit.
        band: Where: a height band, or a target.
        rig: Whose.
        x: Bounds of the raster forward in metres.
        y: Bounds to the left.
        cell_m: Side of a cell.
        values: (Y, X) in the unit of the scale; NaN is unknown.
        scale: What the colours mean: the same for all bands and rigs.
        unobserved_label: Why a cell is.
        errors: (Y, X) standard errors.
        weights: (Y, X) what each cell weighs where several are taken together.
        weight_name: What the weights are, with the unit.
        opaque_weight: That of an opaque cell; less is paler. 0 if all are alike.
        sides: (Y, X) how many cells wide the square is that each cell is drawn in; a power of 2.
        difference_scale: Colours of the difference to the first rig; None for the first, and where nothing is compared.
        lines: What is drawn over it.
        num_bits: Of each number and weight in the file, 16 or 8.
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
    """Where a body is seen beside a vehicle, from above and true to scale.

    Args:
        rig: Who sees it.
        title: A line above it.
        x: Bounds of the cells forward in metres.
        y: Bounds to the left.
        cell_m: Side of a cell.
        sensor_counts: (Y, X) by how many sensors; 0 where it is not seen, -1 where it has no room.
        vehicle_box_m: (4, 2) corners x, y of what distances are from.
        vehicle_outline_m: (K, 2) what the vehicle looks like.
        max_distance_m: Up to which distance places count.
        failure_effects_m2: Sensor -> how much more is not seen within it when this one fails.
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
    """Shares of one kind, of one rig or of several below each other.

    Args:
        name: What they are of.
        shares: Name of the rig -> its share, with its interval if there is one.
    """

    name: str
    shares: Mapping[str, Number]


@dataclass(frozen=True, eq=False)
class PageRig:
    """A rig as a page shows it.

    Args:
        name: What tables and maps call it.
        sensors: Its sensors, if they are known.
        document: It as YAML; empty if it is unknown.
    """

    name: str
    sensors: Sequence[SensorView] = ()
    document: str = ""


@dataclass(frozen=True, eq=False)
class PagePicture:
    """A diagram.

    Args:
        title: What it shows, for those too who do not see it.
        png: The file.
    """

    title: str
    png: bytes


@dataclass(frozen=True, eq=False)
class Page:
    """All that a page shows.

    Args:
        title: Its name.
        lead: One line below.
        findings: The answer in sentences, the first of which says most.
        target_maps: What shows it, at the top.
        detection_shares: How far it is seen, below.
        tables: The numbers.
        pictures: Above them.
        maps: In the order of the menus; differences are to the first rig.
        rigs: Drawn on the ego, and as YAML.
        ego_outline_m: (K, 2) corners x, y of the ego in metres.
        outlines: Regions that the maps show, by name: (K, 2) corners x, y.
        facts: Heading -> name -> what holds, such as settings.
        more_tables: Below the facts, such as what was left out.
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


def build_page_maps(coverages: Mapping[str, Coverage]) -> Iterator[PageMap]:
    """A map for each quantity, height band and rig; first those of bodies, if there are any: the answer tells of them.

    Args:
        coverages: By the name of the rig; one, or several that are paired.
    """
    coverages = {name: downsample_coverage(coverage) for name, coverage in coverages.items()}
    first = next(iter(coverages.values()))
    for rig, bodies in ((rig, coverage.target_sums) for rig, coverage in coverages.items() if coverage.target_sums):
        for body, cells in zip(bodies.target_names, bodies.position_counts, strict=True):
            free, share, quantity = _nan_where_none(cells[..., 0]), cells[..., 1] / cells[..., 0], bodies.quantities[0]
            yield PageMap(
                quantity=quantity.title,
                band=body,
                rig=rig,
                x=bodies.grid.x_m,
                y=bodies.grid.y_m,
                cell_m=bodies.grid.cell_m,
                values=get_display_unit(quantity.unit).factor * to_array(share),
                scale=build_color_scale(quantity, share),
                unobserved_label="no place was free",
                weights=free,
                weight_name="free places",
            )
    shown = list_map_quantities(first)
    surface = _weights(first) if first.average == "area" else None
    steps = CellWeights([_nan_where_none(one) for one in first.observed_frames], "steps that probed it")
    for quantity, by_surface in shown:
        layers = {rig: coverage.sparse_layers[quantity.key] for rig, coverage in coverages.items()}
        errors = {rig: one.sparse_errors.get(quantity.key) for rig, one in coverages.items()}
        yield from _of_quantity(layers, errors, (surface if by_surface else None) or steps, first)
    of_sensors = {rig: one.redundancy.sparse_layers for rig, one in coverages.items() if one.redundancy is not None}
    for key in dict.fromkeys(key for layers in of_sensors.values() for key in layers):
        having = {rig: layers[key] for rig, layers in of_sensors.items() if key in layers}
        yield from _of_quantity(having, dict.fromkeys(having), surface or steps, first)


class CellWeights(NamedTuple):
    """What a cell weighs, in each band; see `PageMap`."""

    values: list[Array]
    name: str
    opaque_weight: float = 0.0
    sides: list[Sides] | None = None


def _of_quantity(
    layers: Mapping[str, Layer], errors: Mapping[str, Tensor | None], weights: CellWeights, first: Coverage
) -> Iterator[PageMap]:
    """Maps from numbers of the known cells, which are the same of all rigs; so are those of `first`."""
    grid, quantity = first.grid, next(iter(layers.values())).quantity
    factor = get_display_unit(quantity.unit).factor
    values = {rig: factor * layer.values for rig, layer in layers.items()}
    scale = build_color_scale(quantity, torch.stack(list(values.values())))
    expected, *others = values.values()
    differences = [compute_difference(one, expected) for one in others]
    against = build_difference_scale(quantity, torch.stack(differences)) if differences else None
    spread = {rig: to_array(first.observed_cells.expand_to_grid(one)) for rig, one in values.items()}
    of_errors = {
        rig: None if one is None else factor * to_array(first.observed_cells.expand_to_grid(one))
        for rig, one in errors.items()
    }
    for band, height in enumerate(grid.heights):
        for at, rig in enumerate(values):
            error = of_errors[rig]
            yield PageMap(
                quantity=quantity.title,
                band=f"{height}, {format_height_band(grid, height)}",
                rig=rig,
                x=grid.x_m,
                y=grid.y_m,
                cell_m=grid.cell_m,
                values=spread[rig][band],
                scale=scale,
                unobserved_label=UNOBSERVED if weights.sides is None else NO_SURFACE,
                errors=None if error is None else error[band],
                weights=weights.values[band],
                weight_name=weights.name,
                opaque_weight=weights.opaque_weight,
                sides=None if weights.sides is None else weights.sides[band],
                difference_scale=against if at else None,
            )


def _weights(first: Coverage) -> CellWeights | None:
    """Square metres; the rigs share the reference points, and so the square metres."""
    if first.area_sums is None:
        return None
    m2 = [_nan_where_none(one) for one in first.area_sums.sum_blocks()[0]]
    sides = [one.cpu().numpy() for one in compute_square_sides(first.point_counts, first.grid.cell_m)]
    return CellWeights(m2, "m² of surface seen in all steps", first.counts["num_frames"] * first.grid.cell_m**2, sides)


def _nan_where_none(counts: Tensor) -> Array:
    array = to_array(counts)
    return np.where(array > 0, array, np.nan)
