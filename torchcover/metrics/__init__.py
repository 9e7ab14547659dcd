"""What every metric of torchcover promises, once: sums with a meaning that merge exactly."""

from torchcover.metrics.mergeable import MergeableMetric
from torchcover.metrics.plotting import figure_of

__all__ = ["MergeableMetric", "figure_of"]
