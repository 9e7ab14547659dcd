"""Blocks of contiguous steps: what standard errors are estimated from."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self, TypeVar

import torch
from torch import Tensor


@dataclass(frozen=True)
class BlockSums:
    """Sums over cells in blocks of contiguous steps, as lists: most cells no step of a block has probed.

    Args:
        steps: (B,) int64 steps in each block; 0 in the blocks that are not in use.
        shape: (B, H, Y, X) blocks and cells.
        at: (N,) int64 which cell of which block, as an index into all of them, ascending.
        base: (N,) what is divided by: steps, or square metres; above 0.
        listed: (Q, N) float64 sums of each quantity.
    """

    steps: Tensor
    shape: tuple[int, ...]
    at: Tensor
    base: Tensor
    listed: Tensor

    @classmethod
    def of(cls, steps: Tensor, base: Tensor, sums: Tensor) -> Self:
        """Those of arrays, which are copied.

        Args:
            steps: (B,) steps in each block.
            base: (B, H, Y, X) what is divided by.
            sums: (B, Q, H, Y, X) sums; 0 wherever `base` is.

        Example:
            >>> few = AreaSums.of(torch.tensor([1]), torch.tensor([[[[0.0, 2.0]]]]), torch.tensor([[[[[0.0, 3.0]]]]]))
            >>> few.at, few.listed, few.sums
            (tensor([1]), tensor([[3.]]), tensor([[[[[0., 3.]]]]]))
        """
        where = base.nonzero(as_tuple=True)
        at = torch.zeros_like(where[0])
        for index, length in zip(where, base.shape, strict=True):
            at = at * length + index
        listed = torch.stack([quantity[where] for quantity in sums.unbind(dim=1)])
        return cls(steps.clone(), tuple(base.shape), at, base[where], listed)

    @property
    def sums(self) -> Tensor:
        """(B, Q, H, Y, X) float64 sums of each quantity."""
        return self._spread(self.listed).movedim(0, 1)

    def totals(self) -> Tensor:
        """(1 + Q, H, Y, X) float64 over all blocks: what is divided by, then the sums."""
        totals = self.listed.new_zeros((1 + len(self.listed), self._cells), dtype=torch.float64)
        for cell, each in self._each_block():
            totals[:, cell] += each  # a cell is in a block once
        return totals.view(-1, *self.shape[1:])

    def over(self, cells: Tensor) -> Tensor:
        """(B, 1 + Q) float64 over some cells, (H, Y, X) bool, in each block: what is divided by, then the sums."""
        chosen = cells.flatten()
        return torch.stack([each[:, chosen[cell]].sum(dim=1) for cell, each in self._each_block()])

    def known_in(self) -> Tensor:
        """(H, Y, X) int64 how many blocks list each cell."""
        return torch.bincount(self.at % self._cells, minlength=self._cells).view(self.shape[1:])

    def spread_over(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Arrays over the K of some cells, (H, Y, X) bool: (B, K) what is divided by, and (Q, B, K) the sums."""
        chosen, cell, block = cells.flatten(), self.at % self._cells, self.at // self._cells
        kept = chosen[cell]
        place = block[kept], (chosen.cumsum(dim=0) - 1)[cell[kept]]
        base = self.base.new_zeros((self.shape[0], int(chosen.sum())))
        sums = self.listed.new_zeros((len(self.listed), *base.shape))
        base[place] = self.base[kept]
        sums[(slice(None), *place)] = self.listed[:, kept]
        return base, sums

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

    def _spread(self, listed: Tensor) -> Tensor:
        """(..., B, H, Y, X) zeros but for (..., N) what is listed."""
        spread = listed.new_zeros((*listed.shape[:-1], math.prod(self.shape)))
        spread[..., self.at] = listed
        return spread.view(*listed.shape[:-1], *self.shape)


BlockSumsT = TypeVar("BlockSumsT", bound=BlockSums)


class Blocks(BlockSums):
    """The sums of a run: over the steps of a block, of the means in a cell.

    They are of the radius in metres, then of the share of points within each threshold; and are divided by the steps of
    the block that had a reference point in the cell.
    """

    @property
    def probed_steps(self) -> Tensor:
        """(B, H, Y, X) int64 steps of the block that had a reference point in the cell."""
        return self._spread(self.base)


class AreaSums(BlockSums):
    """The sums over the visible surface; one block if errors were not asked for.

    They are of square metres times the radius in metres, then of the square metres of points within each threshold; and
    are divided by the square metres of all points in the cell.
    """

    @property
    def m2(self) -> Tensor:
        """(B, H, Y, X) float64 square metres of the points in the cell."""
        return self._spread(self.base)
