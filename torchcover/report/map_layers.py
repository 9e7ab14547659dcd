"""What the maps of a run show: the quantities of its measure and of other aggregations, and which part of a grid.

Maps of the visible surface have cells where points are many and larger squares where they are few, paler the less is
seen. The measure is a ratio of sums, so that a square of several cells has the ratio of their sums, and the squares of
a region together have its number.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcover.coverage import BevGrid, Coverage, Layer
from torchcover.coverage.blocks import BlockSums, ObservedCells
from torchcover.coverage.quantity import make_area_quantity
from torchcover.estimation import Quantity
from torchcover.metrics import sum_rows
from torchcover.report.colors import NEVER_PROBED, ColorScale, build_color_scale
from torchcover.report.number_format import format_resolution, get_display_unit

# A detection from 8 points is off by 18 percentage points at most: 1 / sqrt(4 * 8).
MIN_POINTS = 8
LARGEST_M = 2.0
SMALLEST_M = 0.25
# Of what is seen at all.
FAINTEST = 0.3


def compute_square_sides(points: Tensor, cell_m: float) -> Tensor:
    """Cut a grid into squares of cells: a square is cut in four if each quarter has 8 points at least, or none at all.

    Of (H, Y, X) points in each cell, gives (H, Y, X) int64 how many cells wide the square is that it lies in: a power
    of 2, at most 2 m. Squares begin at the lower corner of the grid; those at the upper ends may be cut off.
    """
    side = 2 ** max(0, math.floor(math.log2(LARGEST_M / cell_m)))
    sides = torch.full_like(points, side)
    is_cut = torch.ones_like(points, dtype=torch.bool)
    while side > 1:
        side //= 2
        inside = _pooled(points, side)
        too_few = (inside > 0) & (inside < MIN_POINTS)
        is_cut &= _spread(_pooled(too_few, 2) == 0, 2 * side, points.shape)
        sides[is_cut] = side
    return sides


def sum_over_squares(values: Tensor, sides: Tensor) -> Tensor:
    """The sum over the square that each cell lies in.

    `values`: (..., H, Y, X) what is added up; `sides`: (H, Y, X) as from `compute_square_sides`. Returns (..., H, Y, X)
    float64.
    """
    sums, side = values.double(), 2
    while side <= int(sides.max()):
        sums = _spread(_pooled(values, side), side, values.shape).where(sides == side, sums)
        side *= 2
    return sums


def compute_ratios(area: BlockSums, sides: Tensor) -> Tensor:
    """(Q, H, Y, X) the radius in metres, then the detection at each threshold; NaN where nothing was seen."""
    m2, *sums = area.sum_blocks()
    return sum_over_squares(torch.stack(sums), sides) / sum_over_squares(m2, sides)


def downsample_coverage(coverage: Coverage) -> Coverage:
    """The same over squares of cells that are smaller than pictures show: of the largest up to 0.25 m.

    Itself where cells are as large, and where there are layers that are no ratios of sums.
    """
    grid, known, means = coverage.grid, coverage.observed_cells, coverage.quantities
    side = 2 ** max(0, math.floor(math.log2(SMALLEST_M / grid.cell_m)))
    by_surface = tuple(map(make_area_quantity, means)) if coverage.area_sums else ()
    if side == 1 or coverage.redundancy or len(coverage.sparse_layers) > len(means) + len(by_surface):
        return coverage
    rows, columns = (-(-count // side) for count in grid.shape[1:])
    cell_m = side * grid.cell_m
    coarse = replace(
        grid,
        x_m=(grid.x_m[0], grid.x_m[0] + columns * cell_m),
        y_m=(grid.y_m[0], grid.y_m[0] + rows * cell_m),
        cell_m=cell_m,
    )

    def square(cell: Tensor) -> Tensor:
        y, x = cell // grid.shape[2], cell % grid.shape[2]
        own: Tensor = (y // grid.shape[1] * rows + y % grid.shape[1] // side) * columns + x // side
        return own

    def moved(sums: BlockSums | None) -> BlockSums | None:
        return None if sums is None else sums.remap_cells(square, coarse.num_cells, coarse.shape)

    area, own = (
        moved(coverage.area_sums),
        [known.observed_frames * coverage.sparse_layers[one.key].values for one in means],
    )
    columns_of = [square(known.cell_indices), known.point_counts, *own, known.observed_frames]
    summed = sum_rows(torch.stack(columns_of, dim=1).double()).T
    layers = list(map(Layer, means, summed[2:-1] / summed[-1]))
    if area is not None:
        m2, *sums = area.sum_blocks().flatten(1)[:, summed[0].long()]
        layers += [Layer(quantity, own / m2) for quantity, own in zip(by_surface, sums, strict=True)]
    return Coverage(
        grid=coarse,
        thresholds_m=coverage.thresholds_m,
        max_radius_m=coverage.max_radius_m,
        observed_cells=ObservedCells(coarse.shape, summed[0].long(), summed[-1].long(), summed[1].long()),
        layers=layers,
        counts=coverage.counts,
        block_sums=moved(coverage.block_sums),
        area_sums=area,
        regions=coverage.regions,
    )


def compute_opacity(area: BlockSums, num_frames: int, sides: Tensor, cell_m: float) -> Tensor:
    """How opaque a place is drawn, by how much surface is seen there in a step.

    Returns (H, Y, X): 0 where nothing was seen, 1 where as much as open ground has, which is the footprint of the
    square, or more; between them the root of the share, from 0.3 on.
    """
    m2 = sum_over_squares(area.sum_blocks()[0], sides)
    footprint_m2 = sum_over_squares(torch.full_like(m2, cell_m**2), sides)
    share = (m2 / (max(num_frames, 1) * footprint_m2)).clamp(max=1)
    return (FAINTEST + (1 - FAINTEST) * share.sqrt()).where(m2 > 0, 0.0)


def _pooled(values: Tensor, side: int) -> Tensor:
    """(..., ceil(Y / side), ceil(X / side)) float64 sums over squares."""
    flat = values.double().reshape(1, -1, *values.shape[-2:])
    pooled = avg_pool2d(flat, side, ceil_mode=True, divisor_override=1)
    return pooled.view(*values.shape[:-2], *pooled.shape[-2:])


def _spread(pooled: Tensor, side: int, shape: torch.Size) -> Tensor:
    """Each number to all cells of its square."""
    return pooled.repeat_interleave(side, -2).repeat_interleave(side, -1)[..., : shape[-2], : shape[-1]]


Outline = NDArray[np.floating]
Bounds = tuple[float, float]

# The near field, in lengths of the ego, to all its sides.
NEAR_LENGTHS = 2.0
MARGIN_M = 1.0


class Window(NamedTuple):
    """Some rows and columns of a grid, and the grid that they are."""

    grid: BevGrid
    rows: slice
    columns: slice

    def crop(self, values: Tensor) -> Tensor:
        """(..., Y, X) values in it."""
        return values[..., self.rows, self.columns]


def find_observed_window(coverage: Coverage, ego_outline_m: Outline | None = None) -> Window:
    """What of a result is worth paper: where it knows cells within the regions' bounds, and the ego.

    `coverage`: the result; the whole grid if it knows nothing; `ego_outline_m`: (K, 2) corners x, y of the ego in
    metres.
    """
    grid = coverage.grid
    known = coverage.observed_cells.expand_to_grid(coverage.observed_cells.point_counts > 0, False).any(dim=0)
    x, y = _held(known.any(dim=0), grid.x_edges_m, grid.x_m), _held(known.any(dim=1), grid.y_edges_m, grid.y_m)
    if coverage.regions:
        in_x = _both(x, (min(one.x_m[0] for one in coverage.regions), max(one.x_m[1] for one in coverage.regions)))
        in_y = _both(y, (min(one.y_m[0] for one in coverage.regions), max(one.y_m[1] for one in coverage.regions)))
        x, y = (in_x, in_y) if in_x and in_y else (x, y)
    if ego_outline_m is not None:
        x, y = (_including(bounds, ego_outline_m[:, axis].tolist()) for axis, bounds in enumerate((x, y)))
    return crop_grid(grid, x, y)


def find_near_field_window(grid: BevGrid, ego_outline_m: Outline) -> Window | None:
    """The ego and two of its lengths around it, as far as the grid goes; None where that is nothing."""
    low, high = ego_outline_m.min(axis=0), ego_outline_m.max(axis=0)
    reach_m = NEAR_LENGTHS * float(high[0] - low[0])
    x, y = ((float(low[axis]) - reach_m, float(high[axis]) + reach_m) for axis in (0, 1))
    return crop_grid(grid, x, y) if _both(x, grid.x_m) and _both(y, grid.y_m) else None


def crop_grid(grid: BevGrid, x: Bounds, y: Bounds) -> Window:
    """The cells of a grid that lie within some bounds, or in part; at least one."""
    (columns, own_x), (rows, own_y) = (
        _cells(bounds, whole, grid.cell_m, count)
        for bounds, whole, count in ((x, grid.x_m, grid.shape[2]), (y, grid.y_m, grid.shape[1]))
    )
    return Window(replace(grid, x_m=own_x, y_m=own_y), rows, columns)


def _cells(bounds: Bounds, whole: Bounds, cell_m: float, count: int) -> tuple[slice, Bounds]:
    first = min(max(math.floor((bounds[0] - whole[0]) / cell_m + 1e-6), 0), count - 1)
    last = min(max(math.ceil((bounds[1] - whole[0]) / cell_m - 1e-6), first + 1), count)
    return slice(first, last), (whole[0] + first * cell_m, whole[0] + last * cell_m)


def _held(known: Tensor, edges_m: Tensor, whole: Bounds) -> Bounds:
    at = known.nonzero().flatten()
    return (float(edges_m[at[0]]), float(edges_m[at[-1] + 1])) if len(at) else whole


def _both(a: Bounds, b: Bounds) -> Bounds | None:
    low, high = max(a[0], b[0]), min(a[1], b[1])
    return (low, high) if low < high else None


def _including(bounds: Bounds, values: Sequence[float]) -> Bounds:
    return min(bounds[0], min(values) - MARGIN_M), max(bounds[1], max(values) + MARGIN_M)


LARGER = ", larger where points are few"
NOTHING_FOUND = "no visible surface found"


@dataclass(frozen=True)
class MapLayer:
    """What some maps show: one quantity of every rig, (H, Y, X) in the unit that is shown, by one scale in every band.

    For the legend: why a cell has no number, and how much was measured, and how finely. `opacity` (H, Y, X) is None if
    all cells are alike.
    """

    quantity: Quantity
    values: Mapping[str, Tensor]
    scale: ColorScale
    unobserved_label: str
    conditions: str
    opacity: Tensor | None = None


def build_map_layers(coverages: Mapping[str, Coverage]) -> Iterator[MapLayer]:
    """The quantities of the measure that the results have, then those of other aggregations.

    `coverages`: by the name of the rig; one, or several that are paired.
    """
    first = next(iter(coverages.values()))
    if first.average == "area":
        yield from _of_surface(coverages)
    for quantity, by_surface in list_map_quantities(first):
        if not by_surface:
            values = {name: coverage.layers[quantity.key].values for name, coverage in coverages.items()}
            yield _subject(quantity, values, NEVER_PROBED, _conditions(first))


def list_map_quantities(coverage: Coverage) -> list[tuple[Quantity, bool]]:
    """The quantities of the measure, then those of other aggregations, and whether each is over the visible surface."""
    of_surface = [make_area_quantity(quantity) for quantity in coverage.quantities]
    of_both = {quantity.key for quantity in (*coverage.quantities, *of_surface)}
    of_measure = of_surface if coverage.average == "area" else coverage.quantities
    others = [layer.quantity for key, layer in coverage.layers.items() if key not in of_both]
    return [*((one, coverage.average == "area") for one in of_measure), *((one, False) for one in others)]


def compute_difference(values: Tensor, baseline: Tensor) -> Tensor:
    """Where both are infinite there is no difference, rather than NaN, which means unknown."""
    return (values - baseline).where(values != baseline, 0.0)


def _of_surface(coverages: Mapping[str, Coverage]) -> Iterator[MapLayer]:
    first = next(iter(coverages.values()))
    areas = {name: coverage.area_sums for name, coverage in coverages.items() if coverage.area_sums is not None}
    sides = compute_square_sides(first.point_counts, first.grid.cell_m)
    # The rigs share the reference points, and so the square metres.
    opacity = compute_opacity(next(iter(areas.values())), first.counts["num_frames"], sides, first.grid.cell_m)
    each = {name: compute_ratios(area, sides) for name, area in areas.items()}
    for at, quantity in enumerate(map(make_area_quantity, first.quantities)):
        values = {name: values[at] for name, values in each.items()}
        yield _subject(quantity, values, NOTHING_FOUND, _conditions(first) + LARGER, opacity)


def _conditions(coverage: Coverage) -> str:
    return format_resolution(coverage.counts["num_frames"], coverage.grid)


def _subject(
    quantity: Quantity, values: Mapping[str, Tensor], unknown: str, conditions: str, opacity: Tensor | None = None
) -> MapLayer:
    """With the values in the unit that is shown, and one scale for all."""
    shown = {name: get_display_unit(quantity.unit).factor * each for name, each in values.items()}
    return MapLayer(
        quantity, shown, build_color_scale(quantity, torch.stack(list(shown.values()))), unknown, conditions, opacity
    )
