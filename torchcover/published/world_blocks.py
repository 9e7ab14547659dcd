"""Metrics whose sums are kept in blocks of contiguous worlds, for errors over them."""

from collections.abc import Mapping
from typing import Any

from torchcover.metrics import SumsInBlocks
from torchcover.published.frame_metric import FrameMetric

# As many as `evaluate` keeps of the coverage, so that both can be drawn again together.
BLOCKS = 16


class WorldBlocks(SumsInBlocks, FrameMetric):
    """Sums over frames in 16 blocks of contiguous worlds (`Frame.place_in_time`).

    Args:
        meaning: What the sums depend on.
        rig: Whose clouds; those of the only rig if not given.
        kwargs: For `torchmetrics.Metric`.
    """

    def __init__(self, meaning: Mapping[str, object], rig: str | None = None, **kwargs: Any) -> None:  # noqa: ANN401
        super().__init__(BLOCKS, meaning, rig, **kwargs)
