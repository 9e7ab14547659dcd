"""Maps of the visible surface: cells where points are many, larger squares where they are few; paler the less is seen.

The measure is a ratio of sums, so that a square of several cells has the ratio of their sums, and the squares of a
region together have its number.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcover.coverage import Coverage, Layer
from torchcover.coverage.blocks import BlockSums, KnownCells
from torchcover.coverage.quantity import by_area
from torchcover.metrics import added_up

# A detection from 8 points is off by 18 percentage points at most: 1 / sqrt(4 * 8).
MIN_POINTS = 8
LARGEST_M = 2.0
SMALLEST_M = 0.25
# Of what is seen at all.
FAINTEST = 0.3


def square_sides(points: Tensor, cell_m: float) -> Tensor:
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


def over_squares(values: Tensor, sides: Tensor) -> Tensor:
    """The sum over the square that each cell lies in.

    `values`: (..., H, Y, X) what is added up; `sides`: (H, Y, X) as from `square_sides`. Returns (..., H, Y, X)
    float64.
    """
    sums, side = values.double(), 2
    while side <= int(sides.max()):
        sums = _spread(_pooled(values, side), side, values.shape).where(sides == side, sums)
        side *= 2
    return sums


def ratios(area: BlockSums, sides: Tensor) -> Tensor:
    """(Q, H, Y, X) the radius in metres, then the detection at each threshold; NaN where nothing was seen."""
    m2, *sums = area.totals()
    return over_squares(torch.stack(sums), sides) / over_squares(m2, sides)


def as_drawn(coverage: Coverage) -> Coverage:
    """The same over squares of cells that are smaller than pictures show: of the largest up to 0.25 m.

    Itself where cells are as large, and where there are layers that are no ratios of sums.
    """
    grid, known, means = coverage.grid, coverage.known, coverage.quantities
    side = 2 ** max(0, math.floor(math.log2(SMALLEST_M / grid.cell)))
    by_surface = tuple(map(by_area, means)) if coverage.area else ()
    if side == 1 or coverage.redundancy or len(coverage.listed) > len(means) + len(by_surface):
        return coverage
    rows, columns = (-(-count // side) for count in grid.shape[1:])
    cell_m = side * grid.cell
    coarse = replace(
        grid, x=(grid.x[0], grid.x[0] + columns * cell_m), y=(grid.y[0], grid.y[0] + rows * cell_m), cell=cell_m
    )

    def square(cell: Tensor) -> Tensor:
        y, x = cell // grid.shape[2], cell % grid.shape[2]
        own: Tensor = (y // grid.shape[1] * rows + y % grid.shape[1] // side) * columns + x // side
        return own

    def moved(sums: BlockSums | None) -> BlockSums | None:
        return None if sums is None else sums.moved(square, coarse.cells, coarse.shape)

    area, own = moved(coverage.area), [known.probed_steps * coverage.listed[one.key].values for one in means]
    columns_of = [square(known.at), known.points, *own, known.probed_steps]
    summed = added_up(torch.stack(columns_of, dim=1).double()).T
    layers = list(map(Layer, means, summed[2:-1] / summed[-1]))
    if area is not None:
        m2, *sums = area.totals().flatten(1)[:, summed[0].long()]
        layers += [Layer(quantity, own / m2) for quantity, own in zip(by_surface, sums, strict=True)]
    return Coverage(
        grid=coarse,
        thresholds=coverage.thresholds,
        max_radius=coverage.max_radius,
        known=KnownCells(coarse.shape, summed[0].long(), summed[-1].long(), summed[1].long()),
        layers=layers,
        counts=coverage.counts,
        blocks=moved(coverage.blocks),
        area=area,
        regions=coverage.regions,
    )


def opacity_of(area: BlockSums, steps: int, sides: Tensor, cell_m: float) -> Tensor:
    """How opaque a place is drawn, by how much surface is seen there in a step.

    Returns (H, Y, X): 0 where nothing was seen, 1 where as much as open ground has, which is the footprint of the
    square, or more; between them the root of the share, from 0.3 on.
    """
    m2 = over_squares(area.totals()[0], sides)
    footprint_m2 = over_squares(torch.full_like(m2, cell_m**2), sides)
    share = (m2 / (max(steps, 1) * footprint_m2)).clamp(max=1)
    return (FAINTEST + (1 - FAINTEST) * share.sqrt()).where(m2 > 0, 0.0)


def _pooled(values: Tensor, side: int) -> Tensor:
    """(..., ceil(Y / side), ceil(X / side)) float64 sums over squares."""
    flat = values.double().reshape(1, -1, *values.shape[-2:])
    pooled = avg_pool2d(flat, side, ceil_mode=True, divisor_override=1)
    return pooled.view(*values.shape[:-2], *pooled.shape[-2:])


def _spread(pooled: Tensor, side: int, shape: torch.Size) -> Tensor:
    """Each number to all cells of its square."""
    return pooled.repeat_interleave(side, -2).repeat_interleave(side, -1)[..., : shape[-2], : shape[-1]]
