"""Which part of a grid a picture shows: what was asked for and is known, or what is near the ego."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import BevGrid, Coverage

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

    def of(self, values: Tensor) -> Tensor:
        """(..., Y, X) values in it."""
        return values[..., self.rows, self.columns]


def asked_and_known(coverage: Coverage, ego_outline_m: Outline | None = None) -> Window:
    """What of a result is worth paper: where it knows cells within the regions' bounds, and the ego.

    `coverage`: the result; the whole grid if it knows nothing; `ego_outline_m`: (K, 2) corners x, y of the ego in
    metres.
    """
    grid = coverage.grid
    known = coverage.known.spread(coverage.known.points > 0, False).any(dim=0)
    x, y = _held(known.any(dim=0), grid.x_edges_m, grid.x), _held(known.any(dim=1), grid.y_edges_m, grid.y)
    if coverage.regions:
        in_x = _both(x, (min(one.x[0] for one in coverage.regions), max(one.x[1] for one in coverage.regions)))
        in_y = _both(y, (min(one.y[0] for one in coverage.regions), max(one.y[1] for one in coverage.regions)))
        x, y = (in_x, in_y) if in_x and in_y else (x, y)
    if ego_outline_m is not None:
        x, y = (_with(bounds, ego_outline_m[:, axis].tolist()) for axis, bounds in enumerate((x, y)))
    return window(grid, x, y)


def near_field(grid: BevGrid, ego_outline_m: Outline) -> Window | None:
    """The ego and two of its lengths around it, as far as the grid goes; None where that is nothing."""
    low, high = ego_outline_m.min(axis=0), ego_outline_m.max(axis=0)
    reach_m = NEAR_LENGTHS * float(high[0] - low[0])
    x, y = ((float(low[axis]) - reach_m, float(high[axis]) + reach_m) for axis in (0, 1))
    return window(grid, x, y) if _both(x, grid.x) and _both(y, grid.y) else None


def window(grid: BevGrid, x: Bounds, y: Bounds) -> Window:
    """The cells of a grid that lie within some bounds, or in part; at least one."""
    (columns, own_x), (rows, own_y) = (
        _cells(bounds, whole, grid.cell, count)
        for bounds, whole, count in ((x, grid.x, grid.shape[2]), (y, grid.y, grid.shape[1]))
    )
    return Window(replace(grid, x=own_x, y=own_y), rows, columns)


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


def _with(bounds: Bounds, values: Sequence[float]) -> Bounds:
    return min(bounds[0], min(values) - MARGIN_M), max(bounds[1], max(values) + MARGIN_M)
