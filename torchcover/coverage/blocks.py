"""Blocks of contiguous steps: what standard errors are estimated from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

# With fewer, the error itself is off by more than a quarter: 1 / sqrt(2 (blocks - 1)).
MIN_BLOCKS = 8


@dataclass(frozen=True)
class Blocks:
    """The sums of a run in blocks of contiguous steps.

    Args:
        steps: (B,) int64 steps in each block; 0 in the blocks that are not in use.
        probed_steps: (B, H, Y, X) int64 steps of the block that had a reference point in the cell.
        sums: (B, Q, H, Y, X) float64 sums over these steps of the cell's means: the radius in metres, then the share of
            points within each threshold.
    """

    steps: Tensor
    probed_steps: Tensor
    sums: Tensor


@dataclass(frozen=True)
class AreaSums:
    """The sums over the visible surface, in blocks of contiguous steps; one block if errors were not asked for.

    Args:
        steps: (B,) int64 steps in each block; 0 in the blocks that are not in use.
        m2: (B, H, Y, X) float64 square metres of the points in the cell.
        sums: (B, Q, H, Y, X) float64 sums of square metres times the radius in metres, then of the square metres of
            points within each threshold.
    """

    steps: Tensor
    m2: Tensor
    sums: Tensor


def check_blocks(blocks: int) -> None:
    """Refuse a number of blocks that gives no error to believe.

    Raises:
        ValueError: Neither 1 nor an even number from 8 on.
    """
    if blocks != 1 and (blocks < MIN_BLOCKS or blocks % 2):
        raise ValueError(f"blocks: 1, or an even number from {MIN_BLOCKS} on, is needed; got {blocks}")


def pair_up(state: dict[str, Any], in_blocks: Sequence[str]) -> None:
    """Add up neighbouring blocks in place: half as many of twice the length, and room for as many again.

    Args:
        state: The states of a `CoverageMetric`, `block_length` among them.
        in_blocks: Names of those whose first dimension is the blocks.
    """
    for name in in_blocks:
        sums = state[name]
        half = len(sums) // 2
        sums[:half] = sums[0::2] + sums[1::2]
        sums[half:] = 0
    state["block_length"] *= 2
