"""Aggregations: how radii become maps. One file each; a new one is a class and a line here."""

from torchcover.coverage.aggregations.aggregation import Aggregation, BinnedStep, State
from torchcover.coverage.aggregations.maximum import Maximum
from torchcover.coverage.aggregations.mean_of_means import MeanOfMeans
from torchcover.coverage.aggregations.pooled_mean import PooledMean
from torchcover.coverage.aggregations.quantiles import Quantiles
from torchcover.coverage.aggregations.step_quantiles import StepQuantiles
from torchcover.coverage.aggregations.visible_area import VisibleArea

# Those that a metric may have beside the mean of means.
AGGREGATIONS: tuple[type[Aggregation], ...] = (Maximum, Quantiles, StepQuantiles, PooledMean)

__all__ = [
    "AGGREGATIONS",
    "Aggregation",
    "BinnedStep",
    "Maximum",
    "MeanOfMeans",
    "PooledMean",
    "Quantiles",
    "State",
    "StepQuantiles",
    "VisibleArea",
]
