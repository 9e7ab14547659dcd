"""Lists of what is known: the cells that were probed, and those of each block of contiguous steps, for errors."""

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
    """The K cells that a reference point has probed, as lists: of small cells they are few.

    `cell_indices` (K,) int64 is which of all cells, (H, Y, X), each is, ascending; `observed_frames` and `point_counts` (K,) int64 how
    many steps had a reference point in it, and how many points there were.
    """

    shape: tuple[int, ...]
    cell_indices: Tensor
    observed_frames: Tensor
    point_counts: Tensor

    def expand_to_grid(self, values: Tensor, fill_value: float = math.nan) -> Tensor:
        """(H, Y, X) with (K,) values in these cells."""
        spread = values.new_full((math.prod(self.shape),), fill_value)
        return spread.index_copy_(0, self.cell_indices, values).view(self.shape)

    def mask_cells(self, cell_mask: Tensor, band_index: int) -> Tensor:
        """(K,) bool: which of them are some cells, (Y, X) bool, in a band."""
        return _is_in(self.cell_indices, cell_mask, band_index)


def _is_in(at: Tensor, cells: Tensor, band: int) -> Tensor:
    return (at // cells.numel() == band) & cells.flatten()[at % cells.numel()]


class LazyMaps(Mapping[str, MapT], Generic[ListedT, MapT]):
    """Maps by key, each made of its list when it is asked for: those of all cells are large."""

    def __init__(self, sparse_maps: Mapping[str, ListedT], expand: Callable[[ListedT], MapT]) -> None:
        self.sparse_maps = sparse_maps
        self._make = expand

    def __getitem__(self, key: str) -> MapT:
        return self._make(self.sparse_maps[key])

    def __iter__(self) -> Iterator[str]:
        return iter(self.sparse_maps)

    def __len__(self) -> int:
        return len(self.sparse_maps)


@dataclass(frozen=True)
class BlockSums:
    """Sums over cells in blocks of contiguous steps, as lists: most cells no step of a block has probed.

    They are of the radius in metres, then of the share of points within each threshold: the means of each step in the
    cell, which are divided by the steps; or these times the square metres of each point, divided by square metres.

    `frame_counts` (B,) int64 are those of each block, 0 in blocks that are not in use; `shape` (B, H, Y, X). Ascending `cell_indices`
    (N,) int64 is which cell of which block, `denominators` (N,) what is divided by, above 0, `sums` (Q, N) float64 the sums.
    """

    frame_counts: Tensor
    shape: tuple[int, ...]
    cell_indices: Tensor
    denominators: Tensor
    sums: Tensor

    def sum_blocks(self) -> Tensor:
        """(1 + Q, H, Y, X) float64 over all blocks: what is divided by, then the sums."""
        totals = self.sums.new_zeros((1 + len(self.sums), self._cells), dtype=torch.float64)
        for cell, each in self._each_block():
            totals[:, cell] += each  # a cell is in a block once
        return totals.view(-1, *self.shape[1:])

    def remap_cells(
        self, map_cells: Callable[[Tensor], Tensor], num_cells: int, shape: tuple[int, ...] | None = None
    ) -> Self:
        """What lies in a cell added to that of another one, by (N,) cells -> the others, `num_cells` of which there are."""
        at = self.cell_indices // self._cells * num_cells + map_cells(self.cell_indices % self._cells)
        at, base, *listed = sum_rows(torch.stack([at, self.denominators, *self.sums], dim=1).double()).T
        return type(self)(
            self.frame_counts,
            (len(self.frame_counts), *(shape or self.shape[1:])),
            at.long(),
            base,
            torch.stack(listed),
        )

    def sum_cells(self, cell_mask: Tensor, band_index: int) -> Tensor:
        """(B, 1 + Q) float64 what is divided by, then the sums, of each block over some cells of a band, (Y, X)."""
        return torch.stack(
            [each[:, _is_in(cell, cell_mask, band_index)].sum(dim=1) for cell, each in self._each_block()]
        )

    def extract_cells(self, cell_mask: Tensor, band_index: int) -> tuple[Tensor, Tensor]:
        """Arrays over the K known ones of such cells: (B, K) what is divided by, and (Q, B, K) the sums."""
        return self._spread_of(_is_in(self.cell_indices % self._cells, cell_mask, band_index))[1:]

    def extract_common_cells(self, min_blocks: int) -> tuple[Tensor, Tensor, Tensor]:
        """(K,) the cells that so many blocks list at least; then as `extract_cells`."""
        _, place, count = torch.unique(self.cell_indices % self._cells, return_inverse=True, return_counts=True)
        return self._spread_of(count[place] >= min_blocks)

    def _spread_of(self, kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        cells, cell = torch.unique(self.cell_indices[kept] % self._cells, return_inverse=True)
        place = self.cell_indices[kept] // self._cells, cell
        base = self.denominators.new_zeros((self.shape[0], len(cells)))
        sums = self.sums.new_zeros((len(self.sums), *base.shape))
        base[place] = self.denominators[kept]
        sums[(slice(None), *place)] = self.sums[:, kept]
        return cells, base, sums

    @property
    def _cells(self) -> int:
        return math.prod(self.shape[1:])

    def _each_block(self) -> Iterator[tuple[Tensor, Tensor]]:
        """(n,) the cells that each block lists, and (1 + Q, n) float64 what is divided by there, then the sums."""
        ends = torch.arange(1, self.shape[0] + 1, device=self.cell_indices.device) * self._cells
        lengths = torch.searchsorted(self.cell_indices, ends).diff(prepend=ends.new_zeros(1)).tolist()
        lists = (self.cell_indices % self._cells, self.denominators, self.sums)
        for cell, base, sums in zip(*(torch.split(one, lengths, dim=-1) for one in lists), strict=True):
            yield cell, torch.cat([base[None].double(), sums.double()])
