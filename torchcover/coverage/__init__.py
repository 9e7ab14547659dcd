"""Grid, aggregations, metric, result, regions and paired differences: from clouds to coverage numbers."""

from torchcover.coverage.aggregations import (
    AGGREGATIONS,
    Aggregation,
    BinnedStep,
    Maximum,
    MeanOfMeans,
    PooledMean,
    Quantiles,
    State,
    StepQuantiles,
)
from torchcover.coverage.estimate import Measure
from torchcover.coverage.grid import BevGrid
from torchcover.coverage.layer import Layer
from torchcover.coverage.metric import CoverageMetric
from torchcover.coverage.paired import Difference, check_paired, differences
from torchcover.coverage.quantity import Quantity
from torchcover.coverage.regions import Region, check_regions, forward_regions, regions_within
from torchcover.coverage.result import Coverage
from torchcover.coverage.summary import Number, RegionSummary

__all__ = [
    "AGGREGATIONS",
    "Aggregation",
    "BevGrid",
    "BinnedStep",
    "Coverage",
    "CoverageMetric",
    "Difference",
    "Layer",
    "Maximum",
    "MeanOfMeans",
    "Measure",
    "Number",
    "PooledMean",
    "Quantiles",
    "Quantity",
    "Region",
    "RegionSummary",
    "State",
    "StepQuantiles",
    "check_paired",
    "check_regions",
    "differences",
    "forward_regions",
    "regions_within",
]
