"""What there is to draw: the maps of one coverage, or of several on one colour scale."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcover.coverage import Coverage, Quantity
from torchcover.coverage.errors import MIN_BLOCKS_OF_A_CELL
from torchcover.report.maps.cells import NEVER_PROBED
from torchcover.report.maps.scale import ColourScale, error_scale, scale_of
from torchcover.report.units import UNITS


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
    unknown = f"probed in fewer than {MIN_BLOCKS_OF_A_CELL} blocks of steps"
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
