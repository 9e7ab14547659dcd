"""Layers of maps: quantities of a coverage on a grid, and the part of the grid that is worth showing.

Maps of the visible surface have single cells where points are many and larger squares where they are few. The value of
a square is the ratio of the sums over its cells, so that the squares of a region together give its number.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcover.coverage import BevGrid, Coverage, Layer
from torchcover.coverage.quantities import make_area_quantity
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import Quantity
from torchcover.metrics import sum_rows
from torchcover.report.colors import UNOBSERVED, ColorScale, build_color_scale
from torchcover.report.number_format import format_resolution, get_display_unit

Outline = NDArray[np.floating]
Bounds = tuple[float, float]
NO_SURFACE = "no visible surface"


@dataclass(frozen=True)
class MapParams:
    """Parameters of maps.

    Args:
        min_points: Minimum number of points of a square; the error of a detection rate from 8 points is at most
            1 / sqrt(4 * 8) = 18 percentage points.
        max_square_m: Maximum side of a square in meters.
        min_cell_m: Smaller cells are merged into squares of up to this side in meters.
        min_opacity: Opacity of an observed square with the least surface.
        near_lengths: Distance from the ego vehicle that the map of its surroundings shows, in vehicle lengths.
        margin_m: Distance between the ego vehicle and the edge of a map in meters.
    """

    min_points: int = 8
    max_square_m: float = 2.0
    min_cell_m: float = 0.25
    min_opacity: float = 0.3
    near_lengths: float = 2.0
    margin_m: float = 1.0


def compute_square_sides(points: Tensor, cell_m: float, params: MapParams = MapParams()) -> Tensor:
    """Divide a grid into squares: a square is split in four if each quarter has at least 8 points or none.

    Args:
        points: (H, Y, X) number of points of each cell.
        cell_m: Side of a cell in meters.
        params: Minimum number of points and maximum side.

    Returns:
        (H, Y, X) int64 side of the square of each cell in cells, a power of 2. Squares begin at the lower corner of the
        grid; those at the upper ends may be cropped.
    """
    side = 2 ** max(0, math.floor(math.log2(params.max_square_m / cell_m)))
    sides = torch.full_like(points, side)
    is_split = torch.ones_like(points, dtype=torch.bool)
    while side > 1:
        side //= 2
        quarter_points = _sum_squares(points, side)
        has_too_few = (quarter_points > 0) & (quarter_points < params.min_points)
        is_split &= _expand_squares(_sum_squares(has_too_few, 2) == 0, 2 * side, points.shape)
        sides[is_split] = side
    return sides


def sum_over_squares(values: Tensor, sides: Tensor) -> Tensor:
    """Sum values over the square of each cell.

    Args:
        values: (..., H, Y, X) values.
        sides: (H, Y, X) result of `compute_square_sides`.

    Returns:
        (..., H, Y, X) float64.
    """
    sums, side = values.double(), 2
    while side <= int(sides.max()):
        sums = _expand_squares(_sum_squares(values, side), side, values.shape).where(sides == side, sums)
        side *= 2
    return sums


def compute_ratios(area: BlockSums, sides: Tensor) -> Tensor:
    """Compute the numbers of squares as ratios of sums.

    Args:
        area: Sums weighted by area.
        sides: (H, Y, X) result of `compute_square_sides`.

    Returns:
        (Q, H, Y, X) radius in meters, then the detection rate at each threshold; NaN where nothing is observed.
    """
    area_m2, *sums = area.sum_blocks()
    return sum_over_squares(torch.stack(sums), sides) / sum_over_squares(area_m2, sides)


def downsample_coverage(coverage: Coverage, params: MapParams = MapParams()) -> Coverage:
    """Merge cells that are smaller than maps show into squares of up to 0.25 m.

    Args:
        coverage: The coverage.
        params: Minimum side of cells.

    Returns:
        The coverage of squares; the same object if cells are large enough, or if it has layers that are no ratios of
        sums.
    """
    grid, observed, quantities = coverage.grid, coverage.observed_cells, coverage.quantities
    side = 2 ** max(0, math.floor(math.log2(params.min_cell_m / grid.cell_m)))
    area_quantities = [make_area_quantity(quantity) for quantity in quantities] if coverage.area_sums else []
    if side == 1 or coverage.redundancy or len(coverage.sparse_layers) > len(quantities) + len(area_quantities):
        return coverage
    rows, columns = (-(-count // side) for count in grid.shape[1:])
    cell_m = side * grid.cell_m
    coarse = replace(
        grid,
        x_m=(grid.x_m[0], grid.x_m[0] + columns * cell_m),
        y_m=(grid.y_m[0], grid.y_m[0] + rows * cell_m),
        cell_m=cell_m,
    )

    def find_square(cell: Tensor) -> Tensor:
        """Return the index of the coarse cell that contains each fine cell."""
        y, x = cell // grid.shape[2], cell % grid.shape[2]
        square: Tensor = (y // grid.shape[1] * rows + y % grid.shape[1] // side) * columns + x // side
        return square

    def merge(sums: BlockSums | None) -> BlockSums | None:
        """Add up the sums of the fine cells of each coarse cell."""
        return None if sums is None else sums.remap_cells(find_square, coarse.num_cells, coarse.shape)

    area_sums = merge(coverage.area_sums)
    table = [find_square(observed.cell_indices), observed.point_counts]
    table += [observed.observed_frames * coverage.sparse_layers[quantity.key].values for quantity in quantities]
    table.append(observed.observed_frames)
    squares, point_counts, *sums, observed_frames = sum_rows(torch.stack(table, dim=1).double()).T
    layers = [Layer(quantity, total / observed_frames) for quantity, total in zip(quantities, sums, strict=True)]
    if area_sums is not None:
        area_m2, *weighted_sums = area_sums.sum_blocks().flatten(1)[:, squares.long()]
        for quantity, total in zip(area_quantities, weighted_sums, strict=True):
            layers.append(Layer(quantity, total / area_m2))
    return Coverage(
        grid=coarse,
        thresholds_m=coverage.thresholds_m,
        max_radius_m=coverage.max_radius_m,
        observed_cells=ObservedCells(coarse.shape, squares.long(), observed_frames.long(), point_counts.long()),
        layers=layers,
        counts=coverage.counts,
        block_sums=merge(coverage.block_sums),
        area_sums=area_sums,
        regions=coverage.regions,
    )


def compute_opacity(
    area: BlockSums, num_frames: int, sides: Tensor, cell_m: float, params: MapParams = MapParams()
) -> Tensor:
    """Compute the opacity of squares from the surface that is visible per frame.

    Args:
        area: Sums weighted by area.
        num_frames: Number of frames.
        sides: (H, Y, X) result of `compute_square_sides`.
        cell_m: Side of a cell in meters.
        params: Minimum opacity.

    Returns:
        (H, Y, X) opacity: 0 without visible surface, 1 where it is at least the footprint of the square, as on open
        ground; between them proportional to the square root of the share, from 0.3.
    """
    area_m2 = sum_over_squares(area.sum_blocks()[0], sides)
    footprint_m2 = sum_over_squares(torch.full_like(area_m2, cell_m**2), sides)
    share = (area_m2 / (max(num_frames, 1) * footprint_m2)).clamp(max=1)
    return (params.min_opacity + (1 - params.min_opacity) * share.sqrt()).where(area_m2 > 0, 0.0)


def _sum_squares(values: Tensor, side: int) -> Tensor:
    """Return (..., ceil(Y / side), ceil(X / side)) float64 sums over squares."""
    flat = values.double().reshape(1, -1, *values.shape[-2:])
    pooled = avg_pool2d(flat, side, ceil_mode=True, divisor_override=1)
    return pooled.view(*values.shape[:-2], *pooled.shape[-2:])


def _expand_squares(sums: Tensor, side: int, shape: torch.Size) -> Tensor:
    """Repeat the number of each square for all its cells."""
    return sums.repeat_interleave(side, -2).repeat_interleave(side, -1)[..., : shape[-2], : shape[-1]]


class Window(NamedTuple):
    """Part of a grid.

    Args:
        grid: Grid of the part.
        rows: Its rows in the whole grid.
        columns: Its columns in the whole grid.
    """

    grid: BevGrid
    rows: slice
    columns: slice

    def crop(self, values: Tensor) -> Tensor:
        """Crop values of the whole grid to the window.

        Args:
            values: (..., Y, X).
        """
        return values[..., self.rows, self.columns]


def find_observed_window(
    coverage: Coverage, ego_outline_m: Outline | None = None, params: MapParams = MapParams()
) -> Window:
    """Find the window with the observed cells in the bounds of the regions, and the ego vehicle.

    Args:
        coverage: The coverage; the window is the whole grid if it has no observed cells.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in meters.
        params: Margin around the vehicle.
    """
    grid, observed = coverage.grid, coverage.observed_cells
    is_observed = observed.expand_to_grid(observed.point_counts > 0, False).any(dim=0)
    x_m = _find_bounds(is_observed.any(dim=0), grid.x_edges_m, grid.x_m)
    y_m = _find_bounds(is_observed.any(dim=1), grid.y_edges_m, grid.y_m)
    if coverage.regions:
        regions = coverage.regions
        regions_x_m = min(region.x_m[0] for region in regions), max(region.x_m[1] for region in regions)
        regions_y_m = min(region.y_m[0] for region in regions), max(region.y_m[1] for region in regions)
        common_x_m, common_y_m = _intersect(x_m, regions_x_m), _intersect(y_m, regions_y_m)
        if common_x_m and common_y_m:
            x_m, y_m = common_x_m, common_y_m
    if ego_outline_m is not None:
        low_m, high_m = ego_outline_m.min(axis=0).tolist(), ego_outline_m.max(axis=0).tolist()
        x_m = min(x_m[0], low_m[0] - params.margin_m), max(x_m[1], high_m[0] + params.margin_m)
        y_m = min(y_m[0], low_m[1] - params.margin_m), max(y_m[1], high_m[1] + params.margin_m)
    return crop_grid(grid, x_m, y_m)


def find_near_field_window(grid: BevGrid, ego_outline_m: Outline, params: MapParams = MapParams()) -> Window | None:
    """Find the window with the ego vehicle and two of its lengths around it.

    Args:
        grid: The grid.
        ego_outline_m: (K, 2) corners x, y of the ego vehicle in meters.
        params: Distance in vehicle lengths.

    Returns:
        The window; None if it lies outside the grid.
    """
    low_m, high_m = ego_outline_m.min(axis=0), ego_outline_m.max(axis=0)
    distance_m = params.near_lengths * float(high_m[0] - low_m[0])
    x_m, y_m = ((float(low_m[axis]) - distance_m, float(high_m[axis]) + distance_m) for axis in (0, 1))
    return crop_grid(grid, x_m, y_m) if _intersect(x_m, grid.x_m) and _intersect(y_m, grid.y_m) else None


def crop_grid(grid: BevGrid, x: Bounds, y: Bounds) -> Window:
    """Crop a grid to the cells that lie within bounds, at least in part; at least one cell remains.

    Args:
        grid: The grid.
        x: Bounds of x in meters.
        y: Bounds of y in meters.
    """
    columns, x_m = _find_cells(x, grid.x_m, grid.cell_m, grid.shape[2])
    rows, y_m = _find_cells(y, grid.y_m, grid.cell_m, grid.shape[1])
    return Window(replace(grid, x_m=x_m, y_m=y_m), rows, columns)


def _find_cells(bounds: Bounds, grid_bounds: Bounds, cell_m: float, count: int) -> tuple[slice, Bounds]:
    """Find the cells of an axis that contain the bounds, and the bounds of these cells."""
    first = min(max(math.floor((bounds[0] - grid_bounds[0]) / cell_m + 1e-6), 0), count - 1)
    last = min(max(math.ceil((bounds[1] - grid_bounds[0]) / cell_m - 1e-6), first + 1), count)
    return slice(first, last), (grid_bounds[0] + first * cell_m, grid_bounds[0] + last * cell_m)


def _find_bounds(is_observed: Tensor, edges_m: Tensor, grid_bounds: Bounds) -> Bounds:
    """Find the outer edges of observed rows or columns; the bounds of the grid if there are none."""
    indices = is_observed.nonzero().flatten()
    return (float(edges_m[indices[0]]), float(edges_m[indices[-1] + 1])) if len(indices) else grid_bounds


def _intersect(first: Bounds, second: Bounds) -> Bounds | None:
    """Intersect two intervals; None if they do not overlap."""
    low, high = max(first[0], second[0]), min(first[1], second[1])
    return (low, high) if low < high else None


@dataclass(frozen=True)
class MapLayer:
    """Quantity of all rigs on the grid, with one color scale for all bands.

    Args:
        quantity: The quantity.
        values: Name of the rig -> (H, Y, X) values in the shown unit.
        scale: Color scale.
        unobserved_label: Label of cells without a value.
        conditions: Number of frames and cell size.
        opacity: (H, Y, X) opacity in [0, 1]; None for opaque cells.
    """

    quantity: Quantity
    values: Mapping[str, Tensor]
    scale: ColorScale
    unobserved_label: str
    conditions: str
    opacity: Tensor | None = None


def build_map_layers(coverages: Mapping[str, Coverage]) -> Iterator[MapLayer]:
    """Yield a map layer of all rigs for each quantity: means first, then other aggregations such as the maximum.

    Args:
        coverages: Name of the rig -> its coverage; several must be paired.
    """
    first = next(iter(coverages.values()))
    conditions = format_resolution(first.counts["num_frames"], first.grid)
    if first.average == "area":
        yield from _build_area_layers(coverages, f"{conditions}, larger where points are few")
    for quantity, is_area_average in list_map_quantities(first):
        if not is_area_average:
            values = {name: coverage.layers[quantity.key].values for name, coverage in coverages.items()}
            yield _build_layer(quantity, values, UNOBSERVED, conditions)


def list_map_quantities(coverage: Coverage) -> list[tuple[Quantity, bool]]:
    """List the quantities of maps.

    Args:
        coverage: The coverage.

    Returns:
        Each quantity, and whether it is an average over the visible surface.
    """
    area_quantities = [make_area_quantity(quantity) for quantity in coverage.quantities]
    mean_keys = {quantity.key for quantity in (*coverage.quantities, *area_quantities)}
    is_area_average = coverage.average == "area"
    quantities = [
        (quantity, is_area_average) for quantity in (area_quantities if is_area_average else coverage.quantities)
    ]
    for key, layer in coverage.layers.items():
        if key not in mean_keys:
            quantities.append((layer.quantity, False))
    return quantities


def compute_difference(values: Tensor, baseline: Tensor) -> Tensor:
    """Compute a difference that is 0 where both values are infinite, instead of NaN.

    Args:
        values: Values of a rig.
        baseline: Values of the rig that it is compared with, of the same shape.
    """
    return (values - baseline).where(values != baseline, 0.0)


def _build_area_layers(coverages: Mapping[str, Coverage], conditions: str) -> Iterator[MapLayer]:
    """Yield the layers of averages over area, merged to squares where points are few."""
    first = next(iter(coverages.values()))
    if first.area_sums is None:
        return
    sides = compute_square_sides(first.point_counts, first.grid.cell_m)
    # The rigs share the reference points and so the visible area.
    opacity = compute_opacity(first.area_sums, first.counts["num_frames"], sides, first.grid.cell_m)
    ratios = {}
    for name, coverage in coverages.items():
        if coverage.area_sums is not None:
            ratios[name] = compute_ratios(coverage.area_sums, sides)
    for index, quantity in enumerate(first.quantities):
        values = {name: rig_ratios[index] for name, rig_ratios in ratios.items()}
        yield _build_layer(make_area_quantity(quantity), values, NO_SURFACE, conditions, opacity)


def _build_layer(
    quantity: Quantity,
    values: Mapping[str, Tensor],
    unobserved_label: str,
    conditions: str,
    opacity: Tensor | None = None,
) -> MapLayer:
    """Build a layer with values in the shown unit and one scale for all rigs."""
    factor = get_display_unit(quantity.unit).factor
    shown_values = {name: factor * rig_values for name, rig_values in values.items()}
    scale = build_color_scale(quantity, torch.stack(list(shown_values.values())))
    return MapLayer(quantity, shown_values, scale, unobserved_label, conditions, opacity)
