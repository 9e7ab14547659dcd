"""What every metric of torchcover promises, once: sums with a meaning that merge exactly."""

from torchcover.metrics.blocks import SumsInBlocks
from torchcover.metrics.mergeable import MergeableMetric, figure_of, with_rows

__all__ = ["MergeableMetric", "SumsInBlocks", "figure_of", "with_rows"]
