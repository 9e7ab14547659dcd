"""Metrics whose sums are kept in blocks of contiguous steps: what standard errors are estimated from."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchcover.estimation import MIN_BLOCKS
from torchcover.metrics.sums import MergeableSums

# What takes little room is kept in so many times as many blocks.
FINER = 16
# Rows that wait at least before they are added up.
MIN_WAITING = 4096


class SparseSumsLayout(NamedTuple):
    """What the rows of a `SparseSums` are.

    `num_cells`: how many cells there are; a row is of the cell `key % cells` in the block `key // cells`; `num_maxima`: how
    many of the last columns are not added up, but keep the largest; `is_fine`: whether its blocks are the fine ones.
    """

    num_cells: int
    num_maxima: int
    is_fine: bool


class SparseSums:
    """A state of `BlockedSums`: a table of sums over those cells of those blocks that a step has touched.

    It is an attribute of the class, and `define_sparse_sums` makes the state. Rows that come wait until it is read or as
    many wait as it has, so that a step costs what it touches. They are added up in the order in which they came: when
    that is done changes no bit.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.name, self._table, self._waiting = name, f"_{name}_table", f"_{name}_waiting"

    def __get__(self, metric: "BlockedSums | None", owner: type) -> Tensor:
        if metric is None:
            raise AttributeError(f"{owner.__name__} has the state {self.name} once it is made")
        own = metric.__dict__
        if own[self._waiting]:
            rows = torch.cat([own[self._table], *own[self._waiting]])
            own[self._table], own[self._waiting] = sum_rows(rows, metric.sparse_layouts[self.name].num_maxima), []
        table: Tensor = own[self._table]
        return table

    def __set__(self, metric: "BlockedSums", table: Tensor) -> None:
        metric.__dict__.update({self._table: table, self._waiting: []})


def sum_rows(rows: Tensor, num_maxima: int = 0) -> Tensor:
    """One row for each key, in their order, of (N, 1 + C) float64 keys and what is added up in the order of the rows.

    So many of the last columns as `num_maxima` says keep the largest instead.

    Example:
        >>> sum_rows(torch.tensor([[7.0, 1.0, 3.0], [2.0, 5.0, 4.0], [7.0, 2.0, 9.0]]).double(), num_maxima=1).tolist()
        [[2.0, 5.0, 4.0], [7.0, 3.0, 9.0]]
    """
    keys, of_row = torch.unique(rows[:, 0].long(), return_inverse=True)
    first = rows.shape[1] - num_maxima
    added = rows.new_zeros((len(keys), rows.shape[1]))
    added[:, 0] = keys
    added[:, 1:first] = added[:, 1:first].index_add(0, of_row, rows[:, 1:first])
    if num_maxima:
        lowest = rows.new_full((len(keys), num_maxima), -math.inf)
        added[:, first:] = lowest.scatter_reduce_(0, of_row[:, None].expand(-1, num_maxima), rows[:, first:], "amax")
    return added


def merge_tables(first_table: Tensor, second_table: Tensor, num_maxima: int = 0) -> Tensor:
    """What `sum_rows` makes of the rows of two tables that it has made, sooner: their keys are in order."""
    if not len(first_table) or not len(second_table):
        return first_table if len(first_table) else second_table
    before = torch.searchsorted(first_table[:, 0].contiguous(), second_table[:, 0].contiguous())
    new = first_table[:, 0][before.clamp(max=len(first_table) - 1)] != second_table[:, 0]
    # Where the rows of either go: behind those of the other one with lower keys.
    ahead = torch.bincount(before[new], minlength=len(first_table) + 1).cumsum(0)[: len(first_table)]
    to, first = before + new.cumsum(0) - new.long(), first_table.shape[1] - num_maxima
    rows = first_table.new_zeros((len(first_table) + int(new.sum()), first_table.shape[1]))
    rows[:, first:] = -math.inf
    rows.index_copy_(0, ahead + torch.arange(len(first_table), device=first_table.device), first_table)
    more = second_table[:, :first].clone()
    more[:, 0] *= new
    rows[:, :first].index_add_(0, to, more)
    if num_maxima:
        rows[to, first:] = torch.maximum(rows[to, first:], second_table[:, first:])
    return rows


def _of_parts(tables: Sequence[Tensor], maxima: int) -> Tensor:
    """The sums of several parts, halves first: no row is moved often."""
    if len(tables) == 1:
        return tables[0]
    half = len(tables) // 2
    return merge_tables(_of_parts(tables[:half], maxima), _of_parts(tables[half:], maxima), maxima)


class BlockedSums(MergeableSums):
    """Sums in as many blocks of contiguous steps, or worlds.

    Blocks start with one step each; whenever a step comes that is past the last one, neighbours are added up in pairs
    and blocks become twice as long. The state does not grow with the steps, but for tables until every cell of every
    block is touched, and parts merge exactly, whatever the lengths of their blocks. A metric adds its sums with
    `define_block_sum` and `define_sparse_sums`, and asks `_block_of` where those of a step belong. What is `fine` is in 16
    times as many blocks, so that up to 256 worlds are known one by one: `_fine_block_of`.

    Args:
        num_blocks: 1 for no errors, or an even number from 8 on: at least half as many are in use at the end of a long run.
        args: For the next base, `MergeableSums` or another.
        kwargs: Likewise.

    Raises:
        ValueError: Another number of blocks.
    """

    block_frame_counts: Tensor
    fine_block_frame_counts: Tensor
    frames_per_block: Tensor

    def __init__(self, num_blocks: int, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        if num_blocks != 1 and (num_blocks < MIN_BLOCKS or num_blocks % 2):
            raise ValueError(f"blocks: 1, or an even number from {MIN_BLOCKS} on, is needed; got {num_blocks}")
        super().__init__(*args, **kwargs)
        self.num_blocks = num_blocks
        self.num_fine_blocks = num_blocks * FINER if num_blocks > 1 else 1
        self._in_blocks: tuple[str, ...] = ()
        self._in_fine_blocks: tuple[str, ...] = ()
        self.sparse_layouts: dict[str, SparseSumsLayout] = {}
        self.define_block_sum("block_frame_counts", (), torch.int64)
        self.define_block_sum("fine_block_frame_counts", (), torch.int64, is_fine=True)
        self.define_state("frames_per_block", torch.tensor(1, device="cpu"), "max")

    def define_block_sum(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64, *, is_fine: bool = False
    ) -> None:
        """Add a state (B, *shape) that starts at zero and adds up."""
        self.define_sum(name, (self.num_fine_blocks if is_fine else self.num_blocks, *shape), dtype)
        if is_fine:
            self._in_fine_blocks = (*self._in_fine_blocks, name)
        else:
            self._in_blocks = (*self._in_blocks, name)

    def define_sparse_sums(
        self, name: str, num_cells: int, num_columns: int, *, num_maxima: int = 0, is_fine: bool = False
    ) -> None:
        """Make the state of a `SparseSums` of this name: a table, empty at first; see `Rows`."""
        self.sparse_layouts[name] = SparseSumsLayout(num_cells, num_maxima, is_fine)
        self.define_table(name, 1 + num_columns, partial(_of_parts, maxima=num_maxima))

    def add_to_sparse_sums(self, name: str, block_index: int, increments: Tensor) -> None:
        """Add to a `SparseSums` the (1 + C, K) columns of a block: cells, each once, then what they grow by."""
        table, waiting = self.__dict__[f"_{name}_table"], self.__dict__[f"_{name}_waiting"]
        key = increments[:1] + block_index * self.sparse_layouts[name].num_cells
        waiting.append(torch.cat([key, increments[1:]]).T.to(table.device))
        if sum(map(len, waiting)) > max(MIN_WAITING, len(table)):
            getattr(self, name)

    def _block_of(self, place: int) -> int:
        """The block of a step at a place in time, which is counted there; makes room for it."""
        if self.num_blocks > 1:
            while place >= self.num_blocks * int(self.frames_per_block):
                self._pair_up_own()
        block = place // int(self.frames_per_block) if self.num_blocks > 1 else 0
        self.block_frame_counts[block] += 1
        self.fine_block_frame_counts[self._fine_block_of(place)] += 1
        return block

    def _fine_block_of(self, place: int) -> int:
        """Likewise, once there is room for it."""
        return place // max(1, int(self.frames_per_block) // FINER) if self.num_blocks > 1 else 0

    def _pair_up(self, state: dict[str, Any]) -> None:
        """Add up neighbouring blocks in place: half as many of twice the length, and room for as many again."""
        fine_too = int(state["frames_per_block"]) >= FINER  # else those of one length fit in
        for name in (*self._in_blocks, *self._in_fine_blocks * fine_too):
            sums = state[name]
            half = len(sums) // 2
            sums[:half] = sums[0::2] + sums[1::2]
            sums[half:] = 0
        for name, (cells, maxima, fine) in self.sparse_layouts.items():
            if fine_too or not fine:
                key, sums = state[name].split([1, state[name].shape[1] - 1], dim=1)
                pair = key.div(2 * cells, rounding_mode="floor") * cells + key % cells
                state[name] = sum_rows(torch.cat([pair, sums], dim=1), maxima)
        state["frames_per_block"] *= 2

    def _pair_up_own(self) -> None:
        state = self.metric_state
        self._pair_up(state)
        for name in self.sparse_layouts:
            setattr(self, name, state[name])

    def _align_with(self, incoming: dict[str, Any]) -> None:
        # Blocks of the same length only can be added up.
        while int(incoming["frames_per_block"]) < int(self.frames_per_block):
            self._pair_up(incoming)
        while int(self.frames_per_block) < int(incoming["frames_per_block"]):
            self._pair_up_own()

    def _align_ranks(self, gather: Callable[[Tensor], Sequence[Tensor]]) -> None:
        longest = max(map(int, gather(self.frames_per_block)))
        while int(self.frames_per_block) < longest:
            self._pair_up_own()

    def _copied(self, states: Mapping[str, Tensor]) -> dict[str, Any]:
        copies = super()._copied(states)
        for name, (cells, _, fine) in self.sparse_layouts.items():
            key, end = copies[name][:, 0], cells * (self.num_fine_blocks if fine else self.num_blocks)
            if not bool(((key >= 0) & (key < end) & (key == key.floor())).all() and (key.diff() > 0).all()):
                raise ValueError(f"state {name!r}: keys in ascending order, whole numbers below {end}, are needed")
        return copies
