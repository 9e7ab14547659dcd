"""Sparse arrays over observed cells, and over the observed cells of each block of contiguous frames."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from torchcover.metrics import sum_rows

ListedT = TypeVar("ListedT")
MapT = TypeVar("MapT")


@dataclass(frozen=True)
class ObservedCells:
    """The K cells that contained a reference point in any frame.

    Args:
        shape: (H, Y, X) of the grid.
        cell_indices: (K,) int64 indices into the flattened grid, ascending.
        observed_frames: (K,) int64 number of frames with a reference point in the cell.
        point_counts: (K,) int64 number of reference points in the cell.
    """

    shape: tuple[int, ...]
    cell_indices: Tensor
    observed_frames: Tensor
    point_counts: Tensor

    def expand_to_grid(self, values: Tensor, fill_value: float = math.nan) -> Tensor:
        """Write values of the observed cells to an array over the grid.

        Args:
            values: (K,) values.
            fill_value: Value of all other cells.

        Returns:
            (H, Y, X) array.
        """
        spread = values.new_full((math.prod(self.shape),), fill_value)
        return spread.index_copy_(0, self.cell_indices, values).view(self.shape)

    def mask_cells(self, cell_mask: Tensor, band_index: int) -> Tensor:
        """Select observed cells.

        Args:
            cell_mask: (Y, X) bool cells.
            band_index: Index of the height band.

        Returns:
            (K,) bool.
        """
        return _is_in_mask(self.cell_indices, cell_mask, band_index)


def _is_in_mask(cell_indices: Tensor, cell_mask: Tensor, band_index: int) -> Tensor:
    is_in_band = cell_indices // cell_mask.numel() == band_index
    return is_in_band & cell_mask.flatten()[cell_indices % cell_mask.numel()]


class LazyMaps(Mapping[str, MapT], Generic[ListedT, MapT]):
    """Maps by key that are expanded to the full grid on access, since full maps are large.

    Args:
        sparse_maps: Sparse map by key.
        expand: Function that expands one sparse map.
    """

    def __init__(self, sparse_maps: Mapping[str, ListedT], expand: Callable[[ListedT], MapT]) -> None:
        self.sparse_maps = sparse_maps
        self._expand = expand

    def __getitem__(self, key: str) -> MapT:
        return self._expand(self.sparse_maps[key])

    def __iter__(self) -> Iterator[str]:
        return iter(self.sparse_maps)

    def __len__(self) -> int:
        return len(self.sparse_maps)


@dataclass(frozen=True)
class BlockSums:
    """Sparse sums over the cells of each block of contiguous frames.

    The sums are those of the radius in meters, then of the share of points within each threshold: either the mean of
    each frame, with the number of frames as denominator, or values times area, with the area as denominator.

    Args:
        frame_counts: (B,) int64 frames per block; 0 in unused blocks.
        shape: (B, H, Y, X).
        cell_indices: (N,) int64 indices into the flattened shape, ascending.
        denominators: (N,) denominators, above 0.
        sums: (Q, N) float64 sums.
    """

    frame_counts: Tensor
    shape: tuple[int, ...]
    cell_indices: Tensor
    denominators: Tensor
    sums: Tensor

    def sum_blocks(self) -> Tensor:
        """Compute (1 + Q, H, Y, X) float64 denominators and sums over all blocks."""
        totals = self.sums.new_zeros((1 + len(self.sums), self._cells), dtype=torch.float64)
        for cells, values in self._iterate_blocks():
            totals[:, cells] += values  # a cell occurs once per block
        return totals.view(-1, *self.shape[1:])

    def remap_cells(
        self, map_cells: Callable[[Tensor], Tensor], num_cells: int, shape: tuple[int, ...] | None = None
    ) -> Self:
        """Add the sums of cells to other cells, for example of a coarser grid.

        Args:
            map_cells: Function from (N,) cell indices to (N,) indices of the target cells.
            num_cells: Number of target cells.
            shape: (H, Y, X) of the target cells; by default unchanged.
        """
        targets = self.cell_indices // self._cells * num_cells + map_cells(self.cell_indices % self._cells)
        targets, denominators, *sums = sum_rows(torch.stack([targets, self.denominators, *self.sums], dim=1).double()).T
        return type(self)(
            self.frame_counts,
            (len(self.frame_counts), *(shape or self.shape[1:])),
            targets.long(),
            denominators,
            torch.stack(sums),
        )

    def sum_cells(self, cell_mask: Tensor, band_index: int) -> Tensor:
        """Sum over cells of a band in each block.

        Args:
            cell_mask: (Y, X) bool cells.
            band_index: Index of the height band.

        Returns:
            (B, 1 + Q) float64 denominators and sums.
        """
        totals = []
        for cells, values in self._iterate_blocks():
            totals.append(values[:, _is_in_mask(cells, cell_mask, band_index)].sum(dim=1))
        return torch.stack(totals)

    def extract_cells(self, cell_mask: Tensor, band_index: int) -> tuple[Tensor, Tensor]:
        """Extract dense arrays over the K observed cells of a selection.

        Args:
            cell_mask: (Y, X) bool cells.
            band_index: Index of the height band.

        Returns:
            (B, K) denominators and (Q, B, K) sums.
        """
        return self._expand_entries(_is_in_mask(self.cell_indices % self._cells, cell_mask, band_index))[1:]

    def extract_common_cells(self, min_blocks: int) -> tuple[Tensor, Tensor, Tensor]:
        """Extract dense arrays over the cells that occur in enough blocks.

        Args:
            min_blocks: Smallest number of blocks.

        Returns:
            (K,) cell indices, (B, K) denominators and (Q, B, K) sums.
        """
        cells = self.cell_indices % self._cells
        _, positions, block_counts = torch.unique(cells, return_inverse=True, return_counts=True)
        return self._expand_entries(block_counts[positions] >= min_blocks)

    def _expand_entries(self, selection: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Expand selected entries to dense arrays over blocks and their distinct cells."""
        cells, positions = torch.unique(self.cell_indices[selection] % self._cells, return_inverse=True)
        entries = self.cell_indices[selection] // self._cells, positions
        denominators = self.denominators.new_zeros((self.shape[0], len(cells)))
        sums = self.sums.new_zeros((len(self.sums), *denominators.shape))
        denominators[entries] = self.denominators[selection]
        sums[(slice(None), *entries)] = self.sums[:, selection]
        return cells, denominators, sums

    @property
    def _cells(self) -> int:
        return math.prod(self.shape[1:])

    def _iterate_blocks(self) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield (n,) cells of each block, and their (1 + Q, n) float64 denominators and sums."""
        ends = torch.arange(1, self.shape[0] + 1, device=self.cell_indices.device) * self._cells
        lengths = torch.searchsorted(self.cell_indices, ends).diff(prepend=ends.new_zeros(1)).tolist()
        lists = (self.cell_indices % self._cells, self.denominators, self.sums)
        blocks = [torch.split(values, lengths, dim=-1) for values in lists]
        for cells, denominators, sums in zip(*blocks, strict=True):
            yield cells, torch.cat([denominators[None].double(), sums.double()])
