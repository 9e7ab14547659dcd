"""Sums in blocks of contiguous frames, from which standard errors are estimated."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchcover.estimation import MIN_BLOCKS
from torchcover.metrics.sums import MergeableSums

# Fine blocks per block; small states are stored in fine blocks.
FINE_BLOCKS_PER_BLOCK = 16


class SparseSumsLayout(NamedTuple):
    """Layout of the rows of a `SparseSums`.

    Args:
        num_cells: Number of cells; a row belongs to the cell `key % num_cells` in the block `key // num_cells`.
        num_maxima: Number of last columns that keep the largest value instead of the sum.
        is_fine: Rows are stored per fine block.
    """

    num_cells: int
    num_maxima: int
    is_fine: bool


class SparseSums:
    """State of `BlockedSums`: a table of sums over the cells of each block that frames touched.

    A class attribute; `define_sparse_sums` creates its state. New rows are queued until the state is read or the queue
    is as long as the table, so that a frame costs only what it touches. Rows are added in the order of their arrival:
    the time of the addition changes no bit.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name
        self._table_name = f"_{name}_table"
        self._queue_name = f"_{name}_queue"

    def __get__(self, metric: "BlockedSums | None", owner: type) -> Tensor:
        if metric is None:
            raise AttributeError(f"instances of {owner.__name__} have the state {self.name}, the class has not")
        attributes = metric.__dict__
        if attributes[self._queue_name]:
            rows = torch.cat([attributes[self._table_name], *attributes[self._queue_name]])
            attributes[self._table_name] = sum_rows(rows, metric.sparse_layouts[self.name].num_maxima)
            attributes[self._queue_name] = []
        table: Tensor = attributes[self._table_name]
        return table

    def __set__(self, metric: "BlockedSums", table: Tensor) -> None:
        metric.__dict__.update({self._table_name: table, self._queue_name: []})


def sum_rows(rows: Tensor, num_maxima: int = 0) -> Tensor:
    """Add up the rows of each key in the order of the rows.

    Args:
        rows: (N, 1 + C) float64 keys and values.
        num_maxima: Number of last columns that keep the largest value instead of the sum.

    Returns:
        (K, 1 + C) one row per key, in ascending order of the keys.

    Example:
        >>> rows = torch.tensor([[7.0, 1.0, 3.0], [2.0, 5.0, 4.0], [7.0, 2.0, 9.0]], dtype=torch.float64)
        >>> sum_rows(rows, num_maxima=1).tolist()
        [[2.0, 5.0, 4.0], [7.0, 3.0, 9.0]]
    """
    keys, key_indices = torch.unique(rows[:, 0].long(), return_inverse=True)
    first_maximum = rows.shape[1] - num_maxima
    result = rows.new_zeros((len(keys), rows.shape[1]))
    result[:, 0] = keys
    result[:, 1:first_maximum] = result[:, 1:first_maximum].index_add(0, key_indices, rows[:, 1:first_maximum])
    if num_maxima:
        lowest = rows.new_full((len(keys), num_maxima), -math.inf)
        row_indices = key_indices[:, None].expand(-1, num_maxima)
        result[:, first_maximum:] = lowest.scatter_reduce_(0, row_indices, rows[:, first_maximum:], "amax")
    return result


def merge_tables(first_table: Tensor, second_table: Tensor, num_maxima: int = 0) -> Tensor:
    """Add up two results of `sum_rows`, faster than `sum_rows` of all rows since both are sorted.

    Args:
        first_table: (K, 1 + C) rows in ascending order of their keys.
        second_table: (L, 1 + C) rows in ascending order of their keys.
        num_maxima: Number of last columns that keep the largest value instead of the sum.

    Returns:
        (M, 1 + C) one row per key, in ascending order of the keys.
    """
    if not len(first_table) or not len(second_table):
        return first_table if len(first_table) else second_table
    insertions = torch.searchsorted(first_table[:, 0].contiguous(), second_table[:, 0].contiguous())
    is_new = first_table[:, 0][insertions.clamp(max=len(first_table) - 1)] != second_table[:, 0]
    # A row of either table moves behind the rows of the other table with lower keys.
    offsets = torch.bincount(insertions[is_new], minlength=len(first_table) + 1).cumsum(0)[: len(first_table)]
    second_positions = insertions + is_new.cumsum(0) - is_new.long()
    first_maximum = first_table.shape[1] - num_maxima
    rows = first_table.new_zeros((len(first_table) + int(is_new.sum()), first_table.shape[1]))
    rows[:, first_maximum:] = -math.inf
    rows.index_copy_(0, offsets + torch.arange(len(first_table), device=first_table.device), first_table)
    increments = second_table[:, :first_maximum].clone()
    increments[:, 0] *= is_new
    rows[:, :first_maximum].index_add_(0, second_positions, increments)
    if num_maxima:
        maxima = torch.maximum(rows[second_positions, first_maximum:], second_table[:, first_maximum:])
        rows[second_positions, first_maximum:] = maxima
    return rows


def _merge_all_tables(tables: Sequence[Tensor], num_maxima: int) -> Tensor:
    """Add up several tables by halves, so that each row is copied only a few times."""
    if len(tables) == 1:
        return tables[0]
    half = len(tables) // 2
    halves = _merge_all_tables(tables[:half], num_maxima), _merge_all_tables(tables[half:], num_maxima)
    return merge_tables(*halves, num_maxima)


class BlockedSums(MergeableSums):
    """Sums in blocks of contiguous frames, or of scenes.

    Blocks begin with one frame each. Whenever a frame lies beyond the last block, neighboring blocks are added up in
    pairs and all blocks become twice as long. The size of the state does not grow with the number of frames, except for
    tables until each cell of each block is touched, and parts merge exactly whatever the lengths of their blocks. A
    metric adds its states with `define_block_sum` and `define_sparse_sums`, and gets the block of a frame from
    `_assign_block`. Fine states have 16 times as many blocks, so that up to 256 scenes stay separate; see
    `_get_fine_block`.

    Args:
        num_blocks: 1 for no standard errors, or an even number from 8 on. At least half of the blocks are in use at the
            end of a long run.
        args: Positional arguments of the next base class, such as `MergeableSums`.
        kwargs: Keyword arguments of the next base class.

    Raises:
        ValueError: Another number of blocks.
    """

    block_frame_counts: Tensor
    fine_block_frame_counts: Tensor
    frames_per_block: Tensor

    def __init__(self, num_blocks: int, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        if num_blocks != 1 and (num_blocks < MIN_BLOCKS or num_blocks % 2):
            raise ValueError(f"num_blocks: 1, or an even number from {MIN_BLOCKS} on, is needed; got {num_blocks}")
        super().__init__(*args, **kwargs)
        self.num_blocks = num_blocks
        self.num_fine_blocks = num_blocks * FINE_BLOCKS_PER_BLOCK if num_blocks > 1 else 1
        self._block_states: tuple[str, ...] = ()
        self._fine_block_states: tuple[str, ...] = ()
        self.sparse_layouts: dict[str, SparseSumsLayout] = {}
        self.define_block_sum("block_frame_counts", (), torch.int64)
        self.define_block_sum("fine_block_frame_counts", (), torch.int64, is_fine=True)
        self.define_state("frames_per_block", torch.tensor(1, device="cpu"), "max")

    def define_block_sum(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64, *, is_fine: bool = False
    ) -> None:
        """Add a state with one sum per block of frames, zero at first.

        Args:
            name: Name of the state, an attribute from here on.
            shape: Shape of the sums of one block; the state is (B, *shape).
            dtype: float64 or int64.
            is_fine: Use the shorter blocks of frames, of which a block consists.
        """
        self.define_sum(name, (self.num_fine_blocks if is_fine else self.num_blocks, *shape), dtype)
        if is_fine:
            self._fine_block_states = (*self._fine_block_states, name)
        else:
            self._block_states = (*self._block_states, name)

    def define_sparse_sums(
        self, name: str, num_cells: int, num_columns: int, *, num_maxima: int = 0, is_fine: bool = False
    ) -> None:
        """Create the state of the class attribute `SparseSums` of this name: a table, empty at first.

        Args:
            name: Name of the class attribute.
            num_cells: Number of cells.
            num_columns: Number of values per cell.
            num_maxima: Number of last columns that keep the largest value instead of the sum.
            is_fine: Use fine blocks.
        """
        self.sparse_layouts[name] = SparseSumsLayout(num_cells, num_maxima, is_fine)
        self.define_table(name, 1 + num_columns, partial(_merge_all_tables, num_maxima=num_maxima))

    def add_to_sparse_sums(self, name: str, block_index: int, increments: Tensor) -> None:
        """Add the values of one frame to a `SparseSums`.

        Args:
            name: Name of the state.
            block_index: Block of the frame.
            increments: (1 + C, K) cells, each at most once, and the values to be added.
        """
        table, queue = self.__dict__[f"_{name}_table"], self.__dict__[f"_{name}_queue"]
        keys = increments[:1] + block_index * self.sparse_layouts[name].num_cells
        queue.append(torch.cat([keys, increments[1:]]).T.to(table.device))
        min_queue_length = 4096  # rows; shorter queues would be added up too often while the table is small
        if sum(map(len, queue)) > max(min_queue_length, len(table)):
            getattr(self, name)  # reading the state adds up its queue

    def _assign_block(self, frame_index: int) -> int:
        """Return the block of a frame after counting it there; blocks are merged if the frame lies beyond them."""
        if self.num_blocks > 1:
            while frame_index >= self.num_blocks * int(self.frames_per_block):
                self._merge_block_pairs()
        block = frame_index // int(self.frames_per_block) if self.num_blocks > 1 else 0
        self.block_frame_counts[block] += 1
        self.fine_block_frame_counts[self._get_fine_block(frame_index)] += 1
        return block

    def _get_fine_block(self, frame_index: int) -> int:
        """Return the fine block of a frame for which `_assign_block` made room."""
        return frame_index // max(1, int(self.frames_per_block) // FINE_BLOCKS_PER_BLOCK) if self.num_blocks > 1 else 0

    def _merge_block_pairs_of(self, state: dict[str, Any]) -> None:
        """Add up neighboring blocks of a state in place: half as many blocks of twice the length, and as many free."""
        # Fine blocks of one frame each still fit until a block has as many frames as fine blocks.
        is_fine_full = int(state["frames_per_block"]) >= FINE_BLOCKS_PER_BLOCK
        for name in (*self._block_states, *self._fine_block_states * is_fine_full):
            sums = state[name]
            half = len(sums) // 2
            sums[:half] = sums[0::2] + sums[1::2]
            sums[half:] = 0
        for name, (num_cells, num_maxima, is_fine) in self.sparse_layouts.items():
            if is_fine_full or not is_fine:
                keys, sums = state[name].split([1, state[name].shape[1] - 1], dim=1)
                merged_keys = keys.div(2 * num_cells, rounding_mode="floor") * num_cells + keys % num_cells
                state[name] = sum_rows(torch.cat([merged_keys, sums], dim=1), num_maxima)
        state["frames_per_block"] *= 2

    def _merge_block_pairs(self) -> None:
        state = self.metric_state
        self._merge_block_pairs_of(state)
        for name in self.sparse_layouts:
            setattr(self, name, state[name])

    def _align_with(self, incoming: dict[str, Any]) -> None:
        # Only blocks of the same length can be added up.
        while int(incoming["frames_per_block"]) < int(self.frames_per_block):
            self._merge_block_pairs_of(incoming)
        while int(self.frames_per_block) < int(incoming["frames_per_block"]):
            self._merge_block_pairs()

    def _align_ranks(self, gather: Callable[[Tensor], Sequence[Tensor]]) -> None:
        longest = max(map(int, gather(self.frames_per_block)))
        while int(self.frames_per_block) < longest:
            self._merge_block_pairs()

    def _copy_states(self, states: Mapping[str, Tensor]) -> dict[str, Any]:
        """Copy states that are loaded, and check the keys of sparse tables."""
        copies = super()._copy_states(states)
        for name, (num_cells, _, is_fine) in self.sparse_layouts.items():
            keys, end = copies[name][:, 0], num_cells * (self.num_fine_blocks if is_fine else self.num_blocks)
            is_index = (keys >= 0) & (keys < end) & (keys == keys.floor())
            if not bool(is_index.all() and (keys.diff() > 0).all()):
                raise ValueError(f"state {name!r}: keys in ascending order, whole numbers below {end}, are needed")
        return copies
