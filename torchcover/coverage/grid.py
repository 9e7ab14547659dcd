"""The bird's-eye-view grid: which cell a point belongs to. Bins are half-open, [lo, hi), on every axis."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchcover.coverage.binning import count_borders_below, count_edges_below, pad_ends
from torchcover.devices import run_with_float64

# What heights are measured from: the local ground, or z = 0 of the vehicle frame, which pitches and rolls.
BandFrame = Literal["ground", "vehicle"]

# Height bands of Uecker & Zöllner 2024.
PAPER_HEIGHTS: Mapping[str, tuple[float, float]] = MappingProxyType({"ground": (-0.5, 0.5), "obstacle": (0.5, 2.0)})

# The extents of a grid are written in decimals; a multiple of the cell is one up to their rounding.
MULTIPLE_TOLERANCE = 1e-6  # of the extent,
MULTIPLE_TOLERANCE_CELLS = 1e-3  # and never more than this share of a cell
# An int64 count and three float64 sums for every cell: 3 GB.
MAX_CELLS = 100_000_000

# Points that are looked at together on a CPU.
PART = 32_768
# A sum with it is negative, whatever the other terms.
OUTSIDE = -(2**40)


class CellAssignment(NamedTuple):
    """Where points are in a grid.

    `point_indices` (M,) int64 numbers of the points that are in any cell, ascending. For each of K pairs of a point and a cell
    that it is in: `point_positions` (K,) which of these points, `cell_indices` (K,) int64 the number of the cell.
    """

    point_indices: Tensor
    point_positions: Tensor
    cell_indices: Tensor


@dataclass(frozen=True)
class BevGrid:
    """Square cells over x and y in the vehicle frame, in height bands over the ground or over its z.

    A cell's number is `(h * Y + y) * X + x`; arrays over the grid have the shape (H, Y, X).

    Args:
        x_m: Lower and upper bound forward, in metres.
        y_m: Lower and upper bound to the left, in metres.
        cell_m: Side of a cell in metres. The extents must be multiples of it.
        heights: Name of each height band -> lower and upper bound in metres. Bands may overlap, and leave gaps. The
            default is the paper's: ground [-0.5, 0.5) and obstacle [0.5, 2.0).
        band_frame: What these are bounds of: "vehicle", z of the vehicle frame, or "ground", the height above the local
            ground, which every point is then to come with.

    Raises:
        ValueError: Inverted or infinite bounds, a cell that is not positive, an extent that is not a multiple of the
            cell_m, no band, another band frame, or more than 1e8 cells.

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
    heights: Mapping[str, tuple[float, float]] = field(default_factory=lambda: dict(PAPER_HEIGHTS))
    band_frame: BandFrame = "vehicle"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.cell_m) and self.cell_m > 0):
            raise ValueError(f"cell_m: a positive length in metres is needed; got {self.cell_m}")
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
        # Plain floats in copies: lists, whole numbers and a dict that its owner changes later make no difference.
        heights = {name: (float(low), float(high)) for name, (low, high) in self.heights.items()}
        own = {"x_m": tuple(map(float, self.x_m)), "y_m": tuple(map(float, self.y_m)), "cell_m": float(self.cell_m)}
        for name, value in {**own, "heights": heights}.items():
            object.__setattr__(self, name, value)

    # The order of the bands is part of a cell's number; equal dicts may differ in it.
    def __eq__(self, other: object) -> bool:
        return isinstance(other, BevGrid) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        return self.x_m, self.y_m, self.cell_m, tuple(self.heights.items()), self.band_frame

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of bands, cells along y, cells along x: (H, Y, X)."""
        return len(self.heights), _count(self.y_m, self.cell_m), _count(self.x_m, self.cell_m)

    @property
    def num_cells(self) -> int:
        """Number of cells in all bands."""
        return math.prod(self.shape)

    @property
    def diagonal_m(self) -> float:
        """Longest distance between two points of the grid, heights included, in metres."""
        lowest = min(low for low, _ in self.heights.values())
        highest = max(high for _, high in self.heights.values())
        return math.hypot(self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0], highest - lowest)

    @property
    def x_edges_m(self) -> Tensor:
        """(X + 1,) float64 cell borders along x."""
        return _edges(self.x_m, self.cell_m)

    @property
    def y_edges_m(self) -> Tensor:
        """(Y + 1,) float64 cell borders along y."""
        return _edges(self.y_m, self.cell_m)

    @property
    def x_centers_m(self) -> Tensor:
        """(X,) float64 cell centres along x."""
        return _centres(self.x_m, self.cell_m)

    @property
    def y_centers_m(self) -> Tensor:
        """(Y,) float64 cell centres along y."""
        return _centres(self.y_m, self.cell_m)

    def find_cells(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """Number of the cell of each point, in a grid whose bands do not overlap.

        Args:
            points: (N, 3) coordinates in metres, any floating-point type.
            heights_m: (N,) metres above the local ground, of a grid whose band frame it is, and of no other; NaN, where
                there is no ground at or below a point, is in no band.

        Returns:
            (N,) int64 cell numbers; -1 for a point outside every cell or band.

        Raises:
            ValueError: Another shape, heights that are missing or of no use, or bands that overlap, so that a point has
                several cells: see `bins`.
        """
        if len(self._tiers) > 1:
            raise ValueError("the height bands overlap, so that a point may be in several cells: use `bins`")
        return self._cells_of(points, heights_m)[0]

    def assign_cells(self, points: Tensor, heights_m: Tensor | None = None) -> CellAssignment:
        """The cells that points are in, several where bands overlap; it takes what `find_cells` takes.

        Raises:
            ValueError: Another shape, heights that are missing or of no use.

        Example:
            >>> bands = {"dog": (0.05, 0.5), "child": (0.1, 1.1)}
            >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights=bands)
            >>> grid.assign_cells(torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.3], [1.5, 0.5, 0.9]]))
            CellAssignment(point_indices=tensor([1, 2]), point_positions=tensor([0, 0, 1]), cell_indices=tensor([0, 2, 3]))
        """
        cells = self._cells_of(points, heights_m)
        within = cells >= 0
        inside = within.any(dim=0).nonzero().squeeze(1)
        if len(cells) == 1:
            return CellAssignment(inside, torch.arange(len(inside), device=inside.device), cells[0, inside])
        tier, of = within[:, inside].nonzero(as_tuple=True)
        return CellAssignment(inside, of, cells[tier, inside[of]])

    @run_with_float64
    def count_points_by_column(self, points: Tensor, heights_m: Tensor | None = None) -> Tensor:
        """(Y, X) float64: how many points lie above each square of ground in each band, as by counting `bins`, sooner.

        Raises:
            ValueError: Another shape, heights that are missing or of no use.

        Example:
            >>> grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0)
            >>> grid.count_points_by_column(torch.tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.9], [1.5, 0.5, 9.0]]))
            tensor([[2., 0.]], dtype=torch.float64)
        """
        parts = self._parts_of(points, heights_m)
        _, rows, columns = (count + 2 for count in self.shape)  # with a border for what is beyond
        x_bounds, y_bounds = self._bounds_on(points.device)
        count = torch.zeros(rows * columns, dtype=torch.float64, device=points.device)
        for x, y, z in parts:
            place = (
                count_edges_below(y, y_bounds, *self.y_m).mul_(columns).add_(count_edges_below(x, x_bounds, *self.x_m))
            )
            bands = torch.zeros_like(z)
            for low, high in self.heights.values():
                bands += (z >= low) & (z < high)
            count += torch.bincount(place, weights=bands, minlength=len(count))
        return count.view(rows, columns)[1:-1, 1:-1]

    @property
    def _tiers(self) -> list[list[int]]:
        """The numbers of the bands, from below, shared out so that those of a tier do not overlap."""
        bounds, tiers = list(self.heights.values()), list[list[int]]()
        for band in sorted(range(len(bounds)), key=bounds.__getitem__):
            free = [tier for tier in tiers if bounds[tier[-1]][1] <= bounds[band][0]]
            if free:
                free[0].append(band)
            else:
                tiers.append([band])
        return tiers

    @run_with_float64
    def _cells_of(self, points: Tensor, height: Tensor | None) -> Tensor:
        """(tiers, N) int64 cell numbers, -1 for none."""
        parts = self._parts_of(points, height)
        _, rows, columns = self.shape
        x_bounds, y_bounds = self._bounds_on(points.device)
        steps = torch.arange(columns, device="cpu"), torch.arange(rows, device="cpu") * columns
        x_terms, y_terms = (pad_ends(terms, OUTSIDE).to(points.device) for terms in steps)
        # Between the borders of the bands of a tier lie, in turn, a band and a gap (which may be empty).
        bounds, tiers = list(self.heights.values()), []
        for bands in self._tiers:
            terms = torch.tensor(
                [term for band in bands for term in (band * rows * columns, OUTSIDE)][:-1], device="cpu"
            )
            borders = [border for band in bands for border in bounds[band]]
            tiers.append((borders, pad_ends(terms, OUTSIDE).to(points.device)))

        def cells_of(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
            place = x_terms.index_select(0, count_edges_below(x, x_bounds, *self.x_m))
            place += y_terms.index_select(0, count_edges_below(y, y_bounds, *self.y_m))
            in_tiers = [place + z_terms.index_select(0, count_borders_below(z, borders)) for borders, z_terms in tiers]
            return torch.stack(in_tiers).clamp_(min=-1)

        return torch.cat([cells_of(*part) for part in parts], dim=1)

    def _bounds_on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """The borders along x and along y as `count_edges_below` takes them."""
        x, y = (pad_ends(edges, math.nan).to(device) for edges in (self.x_edges_m, self.y_edges_m))
        return x, y

    def _parts_of(self, points: Tensor, height: Tensor | None) -> Iterator[tuple[Tensor, ...]]:
        """Float64 x, y and what bands are of, in parts that stay in the processor's cache; a GPU takes all at once."""
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points: shape (N, 3) is needed; got {tuple(points.shape)}")
        self.check_heights(points, height)
        each = (points[:, 0], points[:, 1], points[:, 2] if height is None else height.to(points.device))
        size = PART if points.device.type == "cpu" else max(len(points), 1)
        parts = zip(*(torch.split(values.detach(), size) for values in each), strict=True)
        return (tuple(values.double() for values in part) for part in parts)

    def check_heights(self, points: Tensor, heights_m: Tensor | None, name: str = "heights_m") -> None:
        """Refuse heights that do not go with the bands.

        Args:
            points: (N, 3) points.
            heights_m: Their heights above the local ground, if there are any.
            name: What messages call them.

        Raises:
            ValueError: None where bands are over the ground, any where they are over z; other than one for each point.
        """
        if heights_m is None:
            if self.band_frame == "ground" and len(points):
                raise ValueError(f"{name}: bands over the ground need the heights of points above it; got none")
        elif self.band_frame == "vehicle":
            raise ValueError(f"{name}: of no use for bands over z of the vehicle; use BevGrid(band_frame='ground')")
        elif heights_m.shape != points.shape[:1]:
            needed = f"({len(points)},), one for each point,"
            raise ValueError(f"{name}: shape {needed} is needed; got {tuple(heights_m.shape)}")


def _check_bounds(name: str, bounds: tuple[float, float]) -> None:
    if len(bounds) != 2 or not all(math.isfinite(bound) for bound in bounds):
        raise ValueError(f"{name}: two finite bounds in metres are needed; got {bounds}")
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name}: the lower bound must be below the upper one; got {bounds}")


def _check_multiple(name: str, bounds: tuple[float, float], cell: float) -> None:
    extent = bounds[1] - bounds[0]
    cells = extent / cell
    if not cells <= MAX_CELLS:
        raise ValueError(f"{name}: {cells:.6g} cells of {cell:.10g} m, over {MAX_CELLS:,}: use larger cells")
    if cells < 0.5 or abs(cells - round(cells)) > min(MULTIPLE_TOLERANCE * max(1.0, cells), MULTIPLE_TOLERANCE_CELLS):
        fits = extent / max(1, round(cells))
        raise ValueError(
            f"{name}: its extent of {extent:.10g} m is not a multiple of the cell of {cell:.10g} m "
            f"({cells:.10g} cells); a cell of {fits:.10g} m would fit"
        )


def _count(bounds: tuple[float, float], cell: float) -> int:
    return round((bounds[1] - bounds[0]) / cell)


def _edges(bounds: tuple[float, float], cell: float) -> Tensor:
    count = _count(bounds, cell)
    edges = _between(bounds, torch.arange(count + 1, dtype=torch.float64, device="cpu"), count)
    edges[0], edges[-1] = bounds
    return edges


def _centres(bounds: tuple[float, float], cell: float) -> Tensor:
    count = _count(bounds, cell)
    return _between(bounds, 2 * torch.arange(count, dtype=torch.float64, device="cpu") + 1, 2 * count)


def _between(bounds: tuple[float, float], step: Tensor, steps: int) -> Tensor:
    # (lo (n - i) + hi i) / n rounds once where lo and hi are whole numbers: the border at 0.3 is 0.3, not 3 * 0.1.
    return (bounds[0] * (steps - step) + bounds[1] * step) / steps


# `torch.load` gives them back with weights_only=True, its default.
torch.serialization.add_safe_globals([BevGrid])
