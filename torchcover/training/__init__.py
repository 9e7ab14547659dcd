"""Coverage beside the training of a detector: callbacks, loggers, adapters to other frameworks.

The names are imported when first used: this needs neither Lightning nor MMEngine, TensorBoard or matplotlib.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchcover.training.batches import frames_of_batch_dict as frames_of_batch_dict
    from torchcover.training.batches import frames_of_data_batch as frames_of_data_batch
    from torchcover.training.callback import CoverageCallback as CoverageCallback
    from torchcover.training.counting import CountOnce as CountOnce
    from torchcover.training.counting import shard_of as shard_of
    from torchcover.training.figures import log_maps as log_maps
    from torchcover.training.matching import bev_iou as bev_iou
    from torchcover.training.matching import match as match
    from torchcover.training.mmengine import MMEngineCoverage as MMEngineCoverage
    from torchcover.training.recall import RecallByVisibility as RecallByVisibility
    from torchcover.training.recall_curve import DetectionCounts as DetectionCounts
    from torchcover.training.visibility import BoxVisibility as BoxVisibility
    from torchcover.training.visibility import box_visibility as box_visibility

_HOME = {
    "BoxVisibility": "torchcover.training.visibility",
    "CountOnce": "torchcover.training.counting",
    "CoverageCallback": "torchcover.training.callback",
    "DetectionCounts": "torchcover.training.recall_curve",
    "MMEngineCoverage": "torchcover.training.mmengine",
    "RecallByVisibility": "torchcover.training.recall",
    "bev_iou": "torchcover.training.matching",
    "box_visibility": "torchcover.training.visibility",
    "frames_of_batch_dict": "torchcover.training.batches",
    "frames_of_data_batch": "torchcover.training.batches",
    "log_maps": "torchcover.training.figures",
    "match": "torchcover.training.matching",
    "shard_of": "torchcover.training.counting",
}

__all__ = [
    "BoxVisibility",
    "CountOnce",
    "CoverageCallback",
    "DetectionCounts",
    "MMEngineCoverage",
    "RecallByVisibility",
    "bev_iou",
    "box_visibility",
    "frames_of_batch_dict",
    "frames_of_data_batch",
    "log_maps",
    "match",
    "shard_of",
]


def __getattr__(name: str) -> Any:  # noqa: ANN401  (a module attribute can be anything)
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'torchcover.training' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
