"""The maps of a page from what was measured: the cells themselves, as in `coverage.npz`, or squares of small ones."""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import Coverage, Layer
from torchcover.report.maps.arrays import as_array
from torchcover.report.maps.colours import NEVER_PROBED, difference_scale, scale_of
from torchcover.report.maps.subjects import NOTHING_FOUND, difference, quantities_shown
from torchcover.report.maps.surface import as_drawn, square_sides
from torchcover.report.page.content import Array, PageMap, Sides
from torchcover.report.wording import shown_unit, span


def maps_of(coverages: Mapping[str, Coverage]) -> Iterator[PageMap]:
    """A map for each quantity, height band and rig; first those of bodies, if there are any: the answer tells of them.

    Args:
        coverages: By the name of the rig; one, or several that are paired.
    """
    coverages = {name: as_drawn(coverage) for name, coverage in coverages.items()}
    first = next(iter(coverages.values()))
    for rig, bodies in ((rig, coverage.bodies) for rig, coverage in coverages.items() if coverage.bodies):
        for body, cells in zip(bodies.bodies, bodies.cells, strict=True):
            free, share, quantity = _known(cells[..., 0]), cells[..., 1] / cells[..., 0], bodies.quantities[0]
            yield PageMap(
                quantity=quantity.title,
                band=body,
                rig=rig,
                x=bodies.grid.x,
                y=bodies.grid.y,
                cell_m=bodies.grid.cell,
                values=shown_unit(quantity.unit).factor * as_array(share),
                scale=scale_of(quantity, share),
                unknown="no place was free",
                weights=free,
                weight_name="free places",
            )
    shown = quantities_shown(first)
    surface = _weights(first) if first.measure == "area" else None
    steps = Weights([_known(one) for one in first.probed_steps], "steps that probed it")
    for quantity, by_surface in shown:
        layers = {rig: coverage.listed[quantity.key] for rig, coverage in coverages.items()}
        errors = {rig: one.listed_errors.get(quantity.key) for rig, one in coverages.items()}
        yield from _of_quantity(layers, errors, (surface if by_surface else None) or steps, first)
    of_sensors = {rig: one.redundancy.listed for rig, one in coverages.items() if one.redundancy is not None}
    for key in dict.fromkeys(key for layers in of_sensors.values() for key in layers):
        having = {rig: layers[key] for rig, layers in of_sensors.items() if key in layers}
        yield from _of_quantity(having, dict.fromkeys(having), surface or steps, first)


class Weights(NamedTuple):
    """What a cell weighs, in each band; see `PageMap`."""

    values: list[Array]
    name: str
    full: float = 0.0
    sides: list[Sides] | None = None


def _of_quantity(
    layers: Mapping[str, Layer], errors: Mapping[str, Tensor | None], weights: Weights, first: Coverage
) -> Iterator[PageMap]:
    """Maps from numbers of the known cells, which are the same of all rigs; so are those of `first`."""
    grid, quantity = first.grid, next(iter(layers.values())).quantity
    factor = shown_unit(quantity.unit).factor
    values = {rig: factor * layer.values for rig, layer in layers.items()}
    scale = scale_of(quantity, torch.stack(list(values.values())))
    expected, *others = values.values()
    differences = [difference(one, expected) for one in others]
    against = difference_scale(quantity, torch.stack(differences)) if differences else None
    spread = {rig: as_array(first.known.spread(one)) for rig, one in values.items()}
    of_errors = {
        rig: None if one is None else factor * as_array(first.known.spread(one)) for rig, one in errors.items()
    }
    for band, height in enumerate(grid.heights):
        for at, rig in enumerate(values):
            error = of_errors[rig]
            yield PageMap(
                quantity=quantity.title,
                band=f"{height}, {span(grid, height)}",
                rig=rig,
                x=grid.x,
                y=grid.y,
                cell_m=grid.cell,
                values=spread[rig][band],
                scale=scale,
                unknown=NEVER_PROBED if weights.sides is None else NOTHING_FOUND,
                errors=None if error is None else error[band],
                weights=weights.values[band],
                weight_name=weights.name,
                full_weight=weights.full,
                sides=None if weights.sides is None else weights.sides[band],
                difference=against if at else None,
            )


def _weights(first: Coverage) -> Weights | None:
    """Square metres; the rigs share the reference points, and so the square metres."""
    if first.area is None:
        return None
    m2 = [_known(one) for one in first.area.totals()[0]]
    sides = [one.cpu().numpy() for one in square_sides(first.points, first.grid.cell)]
    return Weights(m2, "m² of surface seen in all steps", first.counts["steps"] * first.grid.cell**2, sides)


def _known(counts: Tensor) -> Array:
    array = as_array(counts)
    return np.where(array > 0, array, np.nan)
