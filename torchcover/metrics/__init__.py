"""What every metric of torchcover promises, once: sums with a meaning that merge exactly."""

from torchcover.metrics.mergeable import MergeableMetric

__all__ = ["MergeableMetric"]
