"""Regions in height bands, and all of the grid: what numbers about places are given for."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcover.coverage import BevGrid, Region, check_regions


def coarse_grid(grid: BevGrid, cell_m: float) -> BevGrid:
    """A grid of other cells, as large as the given one, or by a part of a cell larger.

    Example:
        >>> coarse_grid(BevGrid(x=(-0.5, 2.0), y=(0.0, 1.0), cell=0.25), 1.0).x
        (-1.0, 2.0)
    """
    x, y = ((math.floor(low / cell_m) * cell_m, math.ceil(high / cell_m) * cell_m) for low, high in (grid.x, grid.y))
    return BevGrid(x, y, cell_m, grid.heights)


class Places:
    """All cells of a grid, and those of each region, in each height band.

    Args:
        grid: Cells and height bands.
        regions: Those that have numbers of their own.

    Raises:
        ValueError: A region beyond the grid, or without a cell centre; two of one name.

    Example:
        >>> Places(BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0), [Region("near", (0.0, 1.0), (0.0, 1.0))]).names
        ('', ':near_ground', ':near_obstacle')
    """

    def __init__(self, grid: BevGrid, regions: Sequence[Region]) -> None:
        check_regions(regions, grid)
        self.grid = grid
        self.regions = tuple(regions)
        flat = [region.mask(grid).flatten() for region in self.regions]
        self._masks = torch.stack(flat) if flat else torch.zeros((0, grid.shape[1] * grid.shape[2]), dtype=torch.bool)

    @property
    def meaning(self) -> dict[str, object]:
        """What sums over them depend on."""
        return {"grid": self.grid, "regions": self.regions}

    @property
    def names(self) -> tuple[str, ...]:
        """What is appended to the name of a number; nothing for all cells."""
        return ("", *(f":{region.name}_{band}" for region in self.regions for band in self.grid.heights))

    def sums(self, cell: Tensor, values: Tensor) -> Tensor:
        """(V, places) float64: sums over what is in each place.

        Args:
            cell: (N,) int64 numbers of cells.
            values: (V, N) float64 what is there.
        """
        bands, rows, columns = self.grid.shape
        column, band = cell % (rows * columns), cell // (rows * columns)
        everywhere = values.sum(dim=1, keepdim=True)
        masks = self._masks.to(cell.device)
        parts = []
        for mask in masks:
            inside = mask[column]
            part = values.new_zeros(len(values), bands)
            parts.append(part.index_add_(1, band[inside], values[:, inside]))
        return torch.cat([everywhere, *parts], dim=1)
