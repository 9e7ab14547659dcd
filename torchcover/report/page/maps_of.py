"""The maps of a page from what was measured: the cells themselves, as in `coverage.npz`."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import Coverage
from torchcover.report.maps.colours import NEVER_PROBED, difference_scale, scale_of
from torchcover.report.maps.subjects import NOTHING_FOUND, quantities_shown
from torchcover.report.maps.surface import square_sides
from torchcover.report.page.content import Array, PageMap, Sides
from torchcover.report.wording import UNITS, span


def maps_of(coverages: Mapping[str, Coverage]) -> Iterator[PageMap]:
    """A map for each quantity, height band and rig.

    Args:
        coverages: By the name of the rig; one, or several that are paired.
    """
    first = next(iter(coverages.values()))
    weighed = {by_surface: _weights(first, by_surface=by_surface) for _, by_surface in quantities_shown(first)}
    for quantity, by_surface in quantities_shown(first):
        factor = UNITS[quantity.unit].factor
        values = {rig: factor * coverage.layers[quantity.key].values for rig, coverage in coverages.items()}
        errors = {rig: coverage.errors.get(quantity.key) for rig, coverage in coverages.items()}
        scale = scale_of(quantity, torch.stack(list(values.values())))
        expected, *others = values.values()
        differences = [_difference(one, expected) for one in others]
        against = difference_scale(quantity, torch.stack(differences)) if differences else None
        weights, name, full, sides = weighed[by_surface]
        for band, (height, z) in enumerate(first.grid.heights.items()):
            for at, rig in enumerate(coverages):
                error = errors[rig]
                yield PageMap(
                    quantity=quantity.title,
                    band=f"{height}, z {span(z)}",
                    rig=rig,
                    x=first.grid.x,
                    y=first.grid.y,
                    cell_m=first.grid.cell,
                    values=_array(values[rig][band]),
                    scale=scale,
                    unknown=NOTHING_FOUND if by_surface else NEVER_PROBED,
                    errors=None if error is None else factor * _array(error[band]),
                    weights=weights[band],
                    weight_name=name,
                    full_weight=full,
                    sides=None if sides is None else sides[band],
                    difference=against if at else None,
                )


def _difference(values: Tensor, expected: Tensor) -> Tensor:
    """Where both are infinite there is no difference, rather than NaN, which means unknown."""
    return (values - expected).where(values != expected, 0.0)


def _weights(first: Coverage, *, by_surface: bool) -> tuple[list[Array], str, float, list[Sides] | None]:
    """What a cell weighs, in each band; the rigs share the reference points, and so the square metres."""
    if not by_surface or first.area is None:
        return [_known(one) for one in first.probed_steps], "steps that probed it", 0.0, None
    m2 = [_known(one) for one in first.area.totals()[0]]
    sides = [one.cpu().numpy() for one in square_sides(first.points, first.grid.cell)]
    return m2, "m² of surface seen in all steps", first.counts["steps"] * first.grid.cell**2, sides


def _known(counts: Tensor) -> Array:
    array = _array(counts)
    return np.where(array > 0, array, np.nan)


def _array(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()
