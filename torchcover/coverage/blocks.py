"""Lists of what is known: the cells that were probed, and those of each block of contiguous steps, for errors."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import torch
from torch import Tensor

from torchcover.metrics import added_up

ListedT = TypeVar("ListedT")
MapT = TypeVar("MapT")


@dataclass(frozen=True)
class KnownCells:
    """The K cells that a reference point has probed, as lists: of small cells they are few.

    `at` (K,) int64 is which of all cells, (H, Y, X), each is, ascending; `probed_steps` and `points` (K,) int64 how
    many steps had a reference point in it, and how many points there were.
    """

    shape: tuple[int, ...]
    at: Tensor
    probed_steps: Tensor
    points: Tensor

    def spread(self, values: Tensor, nothing: float = math.nan) -> Tensor:
        """(H, Y, X) with (K,) values in these cells."""
        spread = values.new_full((math.prod(self.shape),), nothing)
        return spread.index_copy_(0, self.at, values).view(self.shape)

    def within(self, cells: Tensor, band: int) -> Tensor:
        """(K,) bool: which of them are some cells, (Y, X) bool, in a band."""
        return _is_in(self.at, cells, band)


def _is_in(at: Tensor, cells: Tensor, band: int) -> Tensor:
    return (at // cells.numel() == band) & cells.flatten()[at % cells.numel()]


class Maps(Mapping[str, MapT], Generic[ListedT, MapT]):
    """Maps by key, each made of its list when it is asked for: those of all cells are large."""

    def __init__(self, listed: Mapping[str, ListedT], make: Callable[[ListedT], MapT]) -> None:
        self.listed = listed
        self._make = make

    def __getitem__(self, key: str) -> MapT:
        return self._make(self.listed[key])

    def __iter__(self) -> Iterator[str]:
        return iter(self.listed)

    def __len__(self) -> int:
        return len(self.listed)


@dataclass(frozen=True)
class BlockSums:
    """Sums over cells in blocks of contiguous steps, as lists: most cells no step of a block has probed.

    They are of the radius in metres, then of the share of points within each threshold: the means of each step in the
    cell, which are divided by the steps; or these times the square metres of each point, divided by square metres.

    `steps` (B,) int64 are those of each block, 0 in blocks that are not in use; `shape` (B, H, Y, X). Ascending `at`
    (N,) int64 is which cell of which block, `base` (N,) what is divided by, above 0, `listed` (Q, N) float64 the sums.
    """

    steps: Tensor
    shape: tuple[int, ...]
    at: Tensor
    base: Tensor
    listed: Tensor

    def totals(self) -> Tensor:
        """(1 + Q, H, Y, X) float64 over all blocks: what is divided by, then the sums."""
        totals = self.listed.new_zeros((1 + len(self.listed), self._cells), dtype=torch.float64)
        for cell, each in self._each_block():
            totals[:, cell] += each  # a cell is in a block once
        return totals.view(-1, *self.shape[1:])

    def moved(self, to: Callable[[Tensor], Tensor], cells: int, shape: tuple[int, ...] | None = None) -> Self:
        """What lies in a cell added to that of another one, by (N,) cells -> the others, `cells` of which there are."""
        at = self.at // self._cells * cells + to(self.at % self._cells)
        at, base, *listed = added_up(torch.stack([at, self.base, *self.listed], dim=1).double()).T
        return type(self)(
            self.steps, (len(self.steps), *(shape or self.shape[1:])), at.long(), base, torch.stack(listed)
        )

    def over(self, cells: Tensor, band: int) -> Tensor:
        """(B, 1 + Q) float64 what is divided by, then the sums, of each block over some cells of a band, (Y, X)."""
        return torch.stack([each[:, _is_in(cell, cells, band)].sum(dim=1) for cell, each in self._each_block()])

    def spread_over(self, cells: Tensor, band: int) -> tuple[Tensor, Tensor]:
        """Arrays over the K known ones of such cells: (B, K) what is divided by, and (Q, B, K) the sums."""
        return self._spread_of(_is_in(self.at % self._cells, cells, band))[1:]

    def spread_where(self, blocks: int) -> tuple[Tensor, Tensor, Tensor]:
        """(K,) the cells that so many blocks list at least; then as `spread_over`."""
        _, place, count = torch.unique(self.at % self._cells, return_inverse=True, return_counts=True)
        return self._spread_of(count[place] >= blocks)

    def _spread_of(self, kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        cells, cell = torch.unique(self.at[kept] % self._cells, return_inverse=True)
        place = self.at[kept] // self._cells, cell
        base = self.base.new_zeros((self.shape[0], len(cells)))
        sums = self.listed.new_zeros((len(self.listed), *base.shape))
        base[place] = self.base[kept]
        sums[(slice(None), *place)] = self.listed[:, kept]
        return cells, base, sums

    @property
    def _cells(self) -> int:
        return math.prod(self.shape[1:])

    def _each_block(self) -> Iterator[tuple[Tensor, Tensor]]:
        """(n,) the cells that each block lists, and (1 + Q, n) float64 what is divided by there, then the sums."""
        ends = torch.arange(1, self.shape[0] + 1, device=self.at.device) * self._cells
        lengths = torch.searchsorted(self.at, ends).diff(prepend=ends.new_zeros(1)).tolist()
        lists = (self.at % self._cells, self.base, self.listed)
        for cell, base, sums in zip(*(torch.split(one, lengths, dim=-1) for one in lists), strict=True):
            yield cell, torch.cat([base[None].double(), sums.double()])
