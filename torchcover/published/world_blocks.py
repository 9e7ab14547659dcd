"""Metrics whose sums are kept in blocks of contiguous worlds, for errors over them."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torchmetrics.utilities.distributed import gather_all_tensors

from torchcover.coverage.blocks import pair_up
from torchcover.frames import Frame
from torchcover.published.frame_metric import FrameMetric

# As many as `evaluate` keeps of the coverage, so that both can be drawn again together.
BLOCKS = 16


class WorldBlocks(FrameMetric):
    """Sums over frames in 16 blocks of contiguous worlds (`Frame.place_in_time`).

    Blocks double as in `CoverageMetric`, so that the state has a fixed size and parts merge exactly. A metric adds its
    sums with `add_block_sum`, and asks `_block_of` where those of a frame belong.

    Args:
        meaning: What the sums depend on.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.
    """

    block_steps: Tensor
    block_length: Tensor

    def __init__(self, meaning: Mapping[str, object], rig: str | None = None, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(meaning, rig, **kwargs)
        self._in_blocks: tuple[str, ...] = ()
        self.add_block_sum("block_steps", (), torch.int64)
        self.add_state("block_length", torch.tensor(1), dist_reduce_fx="max", persistent=True)

    def add_block_sum(self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> None:
        """Add a state (16, *shape) that starts at zero and adds up."""
        self._in_blocks = (*self._in_blocks, name)
        self.add_sum(name, (BLOCKS, *shape), dtype)

    def _block_of(self, frame: Frame) -> int:
        """The block of a frame, which is counted there; makes room for it."""
        while frame.place_in_time >= BLOCKS * int(self.block_length):
            pair_up(self.metric_state, self._in_blocks)
        block = frame.place_in_time // int(self.block_length)
        self.block_steps[block] += 1
        return block

    def _align_with(self, incoming: dict[str, Any]) -> None:
        # Blocks of the same length only can be added up.
        longest = max(int(self.block_length), int(incoming["block_length"]))
        states: tuple[dict[str, Any], ...] = (self.metric_state, incoming)
        for state in states:
            while int(state["block_length"]) < longest:
                pair_up(state, self._in_blocks)

    def _align_ranks(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:  # noqa: ANN401
        lengths = dist_sync_fn(self.block_length, group=process_group or self.process_group)
        while int(self.block_length) < max(map(int, lengths)):
            pair_up(self.metric_state, self._in_blocks)
