"""What the maps of a run show: the quantities of its measure, and those of other aggregations."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcover.coverage import Coverage
from torchcover.coverage.quantity import by_area
from torchcover.estimation import Quantity
from torchcover.report.maps.colours import NEVER_PROBED, ColourScale, scale_of
from torchcover.report.maps.surface import opacity_of, ratios, square_sides
from torchcover.report.wording import shown_unit, steps_and_cell

LARGER = ", larger where points are few"
NOTHING_FOUND = "no visible surface found"


@dataclass(frozen=True)
class Subject:
    """What some maps show: one quantity of every rig, (H, Y, X) in the unit that is shown, by one scale in every band.

    For the legend: why a cell has no number, and how much was measured, and how finely. `opacity` (H, Y, X) is None if
    all cells are alike.
    """

    quantity: Quantity
    values: Mapping[str, Tensor]
    scale: ColourScale
    unknown: str
    conditions: str
    opacity: Tensor | None = None


def subjects_of(coverages: Mapping[str, Coverage]) -> Iterator[Subject]:
    """The quantities of the measure that the results have, then those of other aggregations.

    `coverages`: by the name of the rig; one, or several that are paired.
    """
    first = next(iter(coverages.values()))
    if first.measure == "area":
        yield from _of_surface(coverages)
    for quantity, by_surface in quantities_shown(first):
        if not by_surface:
            values = {name: coverage.layers[quantity.key].values for name, coverage in coverages.items()}
            yield _subject(quantity, values, NEVER_PROBED, _conditions(first))


def quantities_shown(coverage: Coverage) -> list[tuple[Quantity, bool]]:
    """The quantities of the measure, then those of other aggregations, and whether each is over the visible surface."""
    of_surface = [by_area(quantity) for quantity in coverage.quantities]
    of_both = {quantity.key for quantity in (*coverage.quantities, *of_surface)}
    of_measure = of_surface if coverage.measure == "area" else coverage.quantities
    others = [layer.quantity for key, layer in coverage.layers.items() if key not in of_both]
    return [*((one, coverage.measure == "area") for one in of_measure), *((one, False) for one in others)]


def difference(values: Tensor, expected: Tensor) -> Tensor:
    """Where both are infinite there is no difference, rather than NaN, which means unknown."""
    return (values - expected).where(values != expected, 0.0)


def _of_surface(coverages: Mapping[str, Coverage]) -> Iterator[Subject]:
    first = next(iter(coverages.values()))
    areas = {name: coverage.area for name, coverage in coverages.items() if coverage.area is not None}
    sides = square_sides(first.points, first.grid.cell)
    # The rigs share the reference points, and so the square metres.
    opacity = opacity_of(next(iter(areas.values())), first.counts["steps"], sides, first.grid.cell)
    each = {name: ratios(area, sides) for name, area in areas.items()}
    for at, quantity in enumerate(map(by_area, first.quantities)):
        values = {name: values[at] for name, values in each.items()}
        yield _subject(quantity, values, NOTHING_FOUND, _conditions(first) + LARGER, opacity)


def _conditions(coverage: Coverage) -> str:
    return steps_and_cell(coverage.counts["steps"], coverage.grid)


def _subject(
    quantity: Quantity, values: Mapping[str, Tensor], unknown: str, conditions: str, opacity: Tensor | None = None
) -> Subject:
    """With the values in the unit that is shown, and one scale for all."""
    shown = {name: shown_unit(quantity.unit).factor * each for name, each in values.items()}
    return Subject(quantity, shown, scale_of(quantity, torch.stack(list(shown.values()))), unknown, conditions, opacity)
