"""What every metric of torchcover promises, once: sums with a meaning that merge exactly."""

from torchcover.metrics.blocks import SumsInBlocks, TouchedSums, added_up
from torchcover.metrics.mergeable import MergeableMetric, figure_of, with_rows

__all__ = ["MergeableMetric", "SumsInBlocks", "TouchedSums", "added_up", "figure_of", "with_rows"]
