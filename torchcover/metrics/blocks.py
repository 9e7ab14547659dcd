"""Metrics whose sums are kept in blocks of contiguous steps: what standard errors are estimated from."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchcover.estimation import MIN_BLOCKS
from torchcover.metrics.lean import gather_all_tensors
from torchcover.metrics.mergeable import MergeableMetric

# What takes little room is kept in so many times as many blocks.
FINER = 16


class SumsInBlocks(MergeableMetric):
    """Sums in as many blocks of contiguous steps, or worlds.

    Blocks start with one step each; whenever a step comes that is past the last one, neighbours are added up in pairs
    and blocks become twice as long. The state has a fixed size, and parts merge exactly, whatever the lengths of their
    blocks. A metric adds its sums with `add_block_sum`, and asks `_block_of` where those of a step belong. What is
    `fine` is in 16 times as many blocks, so that up to 256 worlds are known one by one: `_fine_block_of`.

    Args:
        blocks: 1 for no errors, or an even number from 8 on: at least half as many are in use at the end of a long run.
        args: For the next base, `MergeableMetric` or another.
        kwargs: Likewise.

    Raises:
        ValueError: Another number of blocks.
    """

    block_steps: Tensor
    fine_steps: Tensor
    block_length: Tensor

    def __init__(self, blocks: int, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        if blocks != 1 and (blocks < MIN_BLOCKS or blocks % 2):
            raise ValueError(f"blocks: 1, or an even number from {MIN_BLOCKS} on, is needed; got {blocks}")
        super().__init__(*args, **kwargs)
        self.blocks = blocks
        self.fine_blocks = blocks * FINER if blocks > 1 else 1
        self._in_blocks: tuple[str, ...] = ()
        self._in_fine_blocks: tuple[str, ...] = ()
        self.add_block_sum("block_steps", (), torch.int64)
        self.add_block_sum("fine_steps", (), torch.int64, fine=True)
        self.add_state("block_length", torch.tensor(1), dist_reduce_fx="max", persistent=True)

    def add_block_sum(
        self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64, *, fine: bool = False
    ) -> None:
        """Add a state (B, *shape) that starts at zero and adds up."""
        self.add_sum(name, (self.fine_blocks if fine else self.blocks, *shape), dtype)
        if fine:
            self._in_fine_blocks = (*self._in_fine_blocks, name)
        else:
            self._in_blocks = (*self._in_blocks, name)

    def _block_of(self, place: int) -> int:
        """The block of a step at a place in time, which is counted there; makes room for it."""
        if self.blocks > 1:
            while place >= self.blocks * int(self.block_length):
                self._pair_up(self.metric_state)
        block = place // int(self.block_length) if self.blocks > 1 else 0
        self.block_steps[block] += 1
        self.fine_steps[self._fine_block_of(place)] += 1
        return block

    def _fine_block_of(self, place: int) -> int:
        """Likewise, once there is room for it."""
        return place // max(1, int(self.block_length) // FINER) if self.blocks > 1 else 0

    def _pair_up(self, state: dict[str, Any]) -> None:
        """Add up neighbouring blocks in place: half as many of twice the length, and room for as many again."""
        fine_too = int(state["block_length"]) >= FINER  # else those of one length fit in
        for name in (*self._in_blocks, *self._in_fine_blocks * fine_too):
            sums = state[name]
            half = len(sums) // 2
            sums[:half] = sums[0::2] + sums[1::2]
            sums[half:] = 0
        state["block_length"] *= 2

    def _align_with(self, incoming: dict[str, Any]) -> None:
        # Blocks of the same length only can be added up.
        longest = max(int(self.block_length), int(incoming["block_length"]))
        states: tuple[dict[str, Any], ...] = (self.metric_state, incoming)
        for state in states:
            while int(state["block_length"]) < longest:
                self._pair_up(state)

    def _align_ranks(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        lengths = dist_sync_fn(self.block_length, group=process_group or self.process_group)
        while int(self.block_length) < max(map(int, lengths)):
            self._pair_up(self.metric_state)
