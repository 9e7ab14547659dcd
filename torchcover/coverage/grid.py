"""Bird's-eye-view grid of square cells in height bands; cells and bands are half-open, [lo, hi), on every axis."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchcover.coverage.binning import count_borders_below, count_edges_below, pad_ends
from torchcover.devices import run_with_float64

# Heights are measured above the local ground, or from z = 0 of the vehicle frame, which pitches and rolls.
BandFrame = Literal["ground", "vehicle"]

# Height bands of Uecker & Zöllner 2024.
PAPER_HEIGHTS: Mapping[str, tuple[float, float]] = MappingProxyType({"ground": (-0.5, 0.5), "obstacle": (0.5, 2.0)})

# An int64 count and three float64 sums for every cell take 3 GB.
MAX_CELLS = 100_000_000
# Points processed at once on a CPU, so that all intermediate arrays stay in its cache.
CHUNK_POINTS = 32_768
# Term of a cell index that makes the sum negative, whatever the other terms are.
OUTSIDE = -(2**40)


class CellAssignment(NamedTuple):
    """Cells that contain points, as K pairs of a point and a cell.

    Args:
        point_indices: (M,) int64 indices of the points that are in any cell, ascending.
        point_positions: (K,) int64 position of the point of each pair in `point_indices`.
        cell_indices: (K,) int64 index of the cell of each pair.
    """

    point_indices: Tensor
    point_positions: Tensor
    cell_indices: Tensor


@dataclass(frozen=True)
class BevGrid:
    """Square cells over x and y in the vehicle frame, in height bands above ground or over z of the vehicle frame.

    The index of a cell is `(h * Y + y) * X + x`; arrays over the grid have the shape (H, Y, X).

    Args:
        x_m: Lower and upper bound along x (forward) in meters.
        y_m: Lower and upper bound along y (left) in meters.
        cell_m: Side length of a cell in meters. The extents must be multiples of it.
        heights: Lower and upper bound in meters by name of the height band. Bands may overlap and leave gaps. The
            default is that of the paper: ground [-0.5, 0.5) and obstacle [0.5, 2.0).
        band_frame: Zero of these bounds: "vehicle" for z of the vehicle frame, or "ground" for the height above the
            local ground, which is then required for every point.

    Raises:
        ValueError: Bounds are inverted or infinite, `cell_m` is not positive, an extent is not a multiple of `cell_m`,
            there is no band, the band frame does not exist, or there are more than 1e8 cells.

    Example:
        >>> grid = BevGrid(x_m=(0.0, 20.0), y_m=(-5.0, 5.0), cell_m=0.5)
        >>> grid.shape
        (2, 20, 40)
        >>> grid.find_cells(torch.tensor([[0.0, -5.0, 0.0], [0.0, -5.0, 0.5], [20.0, 0.0, 0.0]]))
        tensor([  0, 800,  -1])
    """

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    cell_m: float = 0.25
    heights: Mapping[str, tuple[float, float]] = field(default_factory=partial(dict, PAPER_HEIGHTS))
    band_frame: BandFrame = "vehicle"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ValueError(f"cell_m: a positive length in meters is needed; got {self.cell_m}")
        for axis, bounds in (("x_m", self.x_m), ("y_m", self.y_m)):
            _check_bounds(axis, bounds)
            _check_multiple(axis, bounds, self.cell_m)
        if not self.heights:
            raise ValueError("heights: at least one height band is needed, for example {'ground': (-0.5, 0.5)}")
        for name, band in self.heights.items():
            _check_bounds(f"heights[{name!r}]", band)
        if self.band_frame not in get_args(BandFrame):
            raise ValueError(f"band_frame: ground or vehicle is needed; got {self.band_frame!r}")
        if math.prod(self.shape) > MAX_CELLS:
            raise ValueError(f"the grid has {math.prod(self.shape):,} cells, over {MAX_CELLS:,}: use larger cells")
        # Copies with plain floats, so that lists, integers and later changes of the dict do not affect equality.
        object.__setattr__(self, "x_m", (float(self.x_m[0]), float(self.x_m[1])))
        object.__setattr__(self, "y_m", (float(self.y_m[0]), float(self.y_m[1])))
        object.__setattr__(self, "cell_m", float(self.cell_m))
        heights = {name: (float(low), float(high)) for name, (low, high) in self.heights.items()}
        object.__setattr__(self, "heights", heights)

    # The order of the bands determines cell indices, but equal dicts may differ in it.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, BevGrid) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        return self.x_m, self.y_m, self.cell_m, tuple(self.heights.items()), self.band_frame

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of bands, cells along y and cells along x: (H, Y, X)."""
        return len(self.heights), _count_cells(self.y_m, self.cell_m), _count_cells(self.x_m, self.cell_m)

    @property
    def num_cells(self) -> int:
        """Number of cells in all bands."""
        return math.prod(self.shape)

    @property
    def diagonal_m(self) -> float:
        """Longest distance between two points of the grid, heights included, in meters."""
        lowest = min(low for low, _ in self.heights.values())
        highest = max(high for _, high in self.heights.values())
        return math.hypot(self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0], highest - lowest)

    @property
    def x_edges_m(self) -> Tensor:
        """(X + 1,) float64 cell edges along x."""
        return _compute_edges(self.x_m, self.cell_m)

    @property
    def y_edges_m(self) -> Tensor:
        """(Y + 1,) float64 cell edges along y."""
        return _compute_edges(self.y_m, self.cell_m)

    @property
    def x_centers_m(self) -> Tensor:
        """(X,) float64 cell centers along x."""
        return _compute_centers(self.x_m, self.cell_m)

    @property
    def y_centers_m(self) -> Tensor:
        """(Y,) float64 cell centers along y."""
        return _compute_centers(self.y_m, self.cell_m)

    def get_band_index(self, band: str) -> int:
        """Return the index of a height band; ValueError if it does not exist."""
        if band not in self.heights:
            raise ValueError(f"height {band!r}: the grid has {', '.join(self.heights)}")
        return list(self.heights).index(band)

    def find_cells(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """Find the cell of each point, in a grid whose bands do not overlap.

        Args:
            points: (N, 3) coordinates in meters, any floating-point type.
            heights_m: (N,) height above the local ground in meters; required if `band_frame` is "ground", refused
                otherwise. A point with NaN, without ground at or below it, is in no band.

        Returns:
            (N,) int64 cell indices; -1 for a point outside every cell or band.

        Raises:
            ValueError: Another shape, heights that are missing or not used, or bands that overlap, so that a point may
                be in several cells: see `assign_cells`.
        """
        if len(self._group_disjoint_bands()) > 1:
            raise ValueError("the height bands overlap, so that a point may be in several cells: use `assign_cells`")
        return self._compute_cell_indices(points, heights_m)[0]

    def assign_cells(self, points: Tensor, heights_m: Tensor | None = None) -> CellAssignment:
        """Find all cells of each point, several where bands overlap.

        Args:
            points: As in `find_cells`.
            heights_m: As in `find_cells`.

        Raises:
            ValueError: Another shape, heights that are missing or not used.

        Example:
            >>> bands = {"dog": (0.05, 0.5), "child": (0.1, 1.1)}
            >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights=bands)
            >>> assignment = grid.assign_cells(torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.3], [1.5, 0.5, 0.9]]))
            >>> assignment.point_indices, assignment.point_positions, assignment.cell_indices
            (tensor([1, 2]), tensor([0, 0, 1]), tensor([0, 2, 3]))
        """
        cells = self._compute_cell_indices(points, heights_m)
        is_in_cell = cells >= 0
        point_indices = is_in_cell.any(dim=0).nonzero().squeeze(1)
        if len(cells) == 1:
            positions = torch.arange(len(point_indices), device=point_indices.device)
            return CellAssignment(point_indices, positions, cells[0, point_indices])
        groups, positions = is_in_cell[:, point_indices].nonzero(as_tuple=True)
        return CellAssignment(point_indices, positions, cells[groups, point_indices[positions]])

    @run_with_float64
    def count_points_by_column(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """Count the points above each ground square, once per band; faster than counting `assign_cells`.

        Args:
            points: As in `find_cells`.
            heights_m: As in `find_cells`.

        Returns:
            (Y, X) float64 counts.

        Raises:
            ValueError: Another shape, heights that are missing or not used.

        Example:
            >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0)
            >>> grid.count_points_by_column(torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.9], [1.5, 0.5, 9.0]]))
            tensor([[2., 0.]], dtype=torch.float64)
        """
        chunks = self._split_coordinates(points, heights_m)
        _, y_count, x_count = self.shape
        rows, columns = y_count + 2, x_count + 2  # with a border for points outside
        x_bounds, y_bounds = self._get_padded_edges(points.device)
        count = torch.zeros(rows * columns, dtype=torch.float64, device=points.device)
        for x, y, height in chunks:
            row = count_edges_below(y, y_bounds, *self.y_m)
            square = row.mul_(columns).add_(count_edges_below(x, x_bounds, *self.x_m))
            band_count = torch.zeros_like(height)
            for low, high in self.heights.values():
                band_count += (height >= low) & (height < high)
            count += torch.bincount(square, weights=band_count, minlength=len(count))
        return count.view(rows, columns)[1:-1, 1:-1]

    def _group_disjoint_bands(self) -> list[list[int]]:
        """Group the band indices, from below, so that the bands of a group do not overlap."""
        bounds = list(self.heights.values())
        groups: list[list[int]] = []
        for band in sorted(range(len(bounds)), key=bounds.__getitem__):
            for group in groups:
                if bounds[group[-1]][1] <= bounds[band][0]:
                    group.append(band)
                    break
            else:
                groups.append([band])
        return groups

    @run_with_float64
    def _compute_cell_indices(self, points: Tensor, heights_m: Tensor | None) -> Tensor:
        """Compute the (groups of disjoint bands, N) int64 cell indices, -1 outside."""
        chunks = self._split_coordinates(points, heights_m)
        _, rows, columns = self.shape
        x_bounds, y_bounds = self._get_padded_edges(points.device)
        x_terms = pad_ends(torch.arange(columns, device="cpu"), OUTSIDE).to(points.device)
        y_terms = pad_ends(torch.arange(rows, device="cpu") * columns, OUTSIDE).to(points.device)
        # Between the borders of the bands of a group lie, in turn, a band and a gap (which may be empty).
        bounds = list(self.heights.values())
        band_groups = []
        for group in self._group_disjoint_bands():
            borders: list[float] = []
            terms: list[int] = []
            for band in group:
                borders += bounds[band]
                terms += [band * rows * columns, OUTSIDE]
            band_terms = torch.tensor(terms[:-1], device="cpu")
            band_groups.append((borders, pad_ends(band_terms, OUTSIDE).to(points.device)))
        cells = []
        for x, y, height in chunks:
            square = x_terms.index_select(0, count_edges_below(x, x_bounds, *self.x_m))
            square += y_terms.index_select(0, count_edges_below(y, y_bounds, *self.y_m))
            group_cells = []
            for borders, band_terms in band_groups:
                group_cells.append(square + band_terms.index_select(0, count_borders_below(height, borders)))
            cells.append(torch.stack(group_cells).clamp_(min=-1))
        return torch.cat(cells, dim=1)

    def _get_padded_edges(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return the edges along x and y in the form that `count_edges_below` takes."""
        return pad_ends(self.x_edges_m, math.nan).to(device), pad_ends(self.y_edges_m, math.nan).to(device)

    def _split_coordinates(self, points: Tensor, heights_m: Tensor | None) -> Iterator[tuple[Tensor, ...]]:
        """Yield float64 x, y and height in chunks; heights default to z."""
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points: shape (N, 3) is needed; got {tuple(points.shape)}")
        self.check_heights(points, heights_m)
        height = points[:, 2] if heights_m is None else heights_m.to(points.device)
        chunk_size = CHUNK_POINTS if points.device.type == "cpu" else max(len(points), 1)
        axes = [torch.split(values.detach(), chunk_size) for values in (points[:, 0], points[:, 1], height)]
        return (tuple(values.double() for values in chunk) for chunk in zip(*axes, strict=True))

    def check_heights(self, points: Tensor, heights_m: Tensor | None, name: str = "heights_m") -> None:
        """Check that heights above ground are given if and only if the bands need them.

        Args:
            points: (N, 3) points.
            heights_m: (N,) height of each point above the local ground in meters, or None.
            name: Name of the heights in messages.

        Raises:
            ValueError: Heights are missing for bands above ground, given for bands over z, or of another shape.
        """
        if heights_m is None:
            if self.band_frame == "ground" and len(points):
                raise ValueError(f"{name}: bands over the ground need the heights of points above it; got none")
        elif self.band_frame == "vehicle":
            raise ValueError(f"{name}: of no use for bands over z of the vehicle; use BevGrid(band_frame='ground')")
        elif heights_m.shape != points.shape[:1]:
            expected = f"({len(points)},), one for each point,"
            raise ValueError(f"{name}: shape {expected} is needed; got {tuple(heights_m.shape)}")


def _check_bounds(name: str, bounds: tuple[float, float]) -> None:
    """Check that bounds are two finite ascending numbers."""
    if len(bounds) != 2 or not all(math.isfinite(bound) for bound in bounds):
        raise ValueError(f"{name}: two finite bounds in meters are needed; got {bounds}")
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name}: the lower bound must be below the upper one; got {bounds}")


def _check_multiple(name: str, bounds: tuple[float, float], cell_m: float) -> None:
    """Check that an extent is a multiple of the cell, up to rounding of decimals."""
    extent_m = bounds[1] - bounds[0]
    cell_count = extent_m / cell_m
    if not cell_count <= MAX_CELLS:
        raise ValueError(f"{name}: {cell_count:.6g} cells of {cell_m:.10g} m, over {MAX_CELLS:,}: use larger cells")
    # Extents are written in decimals: a multiple is exact up to rounding, 1e-6 of the extent and 1e-3 of a cell.
    tolerance_cells = min(1e-6 * max(1.0, cell_count), 1e-3)
    if cell_count < 0.5 or abs(cell_count - round(cell_count)) > tolerance_cells:
        fitting_cell_m = extent_m / max(1, round(cell_count))
        raise ValueError(
            f"{name}: its extent of {extent_m:.10g} m is not a multiple of the cell of {cell_m:.10g} m "
            f"({cell_count:.10g} cells); a cell of {fitting_cell_m:.10g} m would fit"
        )


def _count_cells(bounds: tuple[float, float], cell_m: float) -> int:
    return round((bounds[1] - bounds[0]) / cell_m)


def _compute_edges(bounds: tuple[float, float], cell_m: float) -> Tensor:
    count = _count_cells(bounds, cell_m)
    edges = _interpolate(bounds, torch.arange(count + 1, dtype=torch.float64, device="cpu"), count)
    edges[0], edges[-1] = bounds
    return edges


def _compute_centers(bounds: tuple[float, float], cell_m: float) -> Tensor:
    count = _count_cells(bounds, cell_m)
    return _interpolate(bounds, 2 * torch.arange(count, dtype=torch.float64, device="cpu") + 1, 2 * count)


def _interpolate(bounds: tuple[float, float], numerators: Tensor, denominator: int) -> Tensor:
    """Interpolate between bounds at fractions `numerators / denominator`."""
    # (lo (n - i) + hi i) / n rounds once if lo and hi are integers: the edge at 0.3 is 0.3, not 3 * 0.1.
    return (bounds[0] * (denominator - numerators) + bounds[1] * numerators) / denominator


# Allows `torch.load` with weights_only=True, its default.
torch.serialization.add_safe_globals([BevGrid])
