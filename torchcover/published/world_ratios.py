"""Metrics that are ratios of sums over frames, with errors from blocks of worlds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchcover.estimation import MIN_BLOCKS, ROUND_OFF, jackknife_error
from torchcover.frames import Frame
from torchcover.published.number import PublishedNumber
from torchcover.published.world_blocks import WorldBlocks


@dataclass(frozen=True)
class Ratio:
    """What one ratio of a metric is; see `PublishedNumber`."""

    name: str
    unit: str
    higher_is_better: bool
    count_of: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


class WorldRatios(WorldBlocks):
    """Ratios S / A of sums over frames, kept in blocks of contiguous worlds (`Frame.place_in_time`).

    A metric gives its `ratios`, and in `_of_frame` what a frame adds to each: a_j, s_j, and how many these are. Errors
    are the block jackknife's, as those of regions in `Coverage`; a ratio that fewer than 8 blocks know has none, nor
    has one of which all blocks say the same.

    Args:
        ratios: What they are.
        meaning: What the sums depend on.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.
    """

    base: Tensor
    sums: Tensor
    counts: Tensor

    def __init__(
        self,
        ratios: Sequence[Ratio],
        meaning: Mapping[str, object],
        rig: str | None = None,
        **kwargs: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(meaning, rig, **kwargs)
        self.ratios = tuple(ratios)
        self.add_block_sum("base", (len(self.ratios),))
        self.add_block_sum("sums", (len(self.ratios),))
        self.add_sum("counts", (len(self.ratios),), torch.int64)

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        """(V,) what a frame adds to what is divided by, to the sums, and to the int64 counts of each ratio."""
        raise NotImplementedError

    def _add_frame(self, frame: Frame) -> None:
        base, sums, counts = self._of_frame(frame)  # before anything is added
        block = self._block_of(frame.place_in_time)
        self.base[block] += base.to(self.base)
        self.sums[block] += sums.to(self.sums)
        self.counts += counts.to(self.counts)

    def compute(self) -> tuple[PublishedNumber, ...]:
        """The ratios so far."""
        value, error = self._value(self.base.sum(dim=0), self.sums.sum(dim=0)), self._errors()
        return tuple(
            PublishedNumber(
                ratio.name, one, ratio.unit, ratio.higher_is_better, ratio.parameters, count, ratio.count_of, own_error
            )
            for ratio, one, count, own_error in zip(
                self.ratios, value.tolist(), self.counts.tolist(), error.tolist(), strict=True
            )
        )

    def resampled(self, weights: Tensor) -> Tensor:
        """(R, V) the ratios if each block of worlds had come as often as it is weighted.

        Args:
            weights: (R, 16) how often.
        """
        weights = weights.to(self.base)
        return self._value(weights @ self.base, weights @ self.sums)

    def _value(self, base: Tensor, sums: Tensor) -> Tensor:
        return (sums / base).where(base > 0, math.nan)

    def _errors(self) -> Tensor:
        used = self.block_steps > 0
        base, sums, steps = self.base[used], self.sums[used], self.block_steps[used]
        whole, whole_base, whole_sums = self._value(base.sum(0), sums.sum(0)), base.sum(0), sums.sum(0)
        error = jackknife_error(self._value(whole_base - base, whole_sums - sums), whole, steps)
        # Blocks that all say the same do not prove that others would.
        return error.where(((base > 0).sum(dim=0) >= MIN_BLOCKS) & (error > ROUND_OFF), math.nan)
