"""Grid, binning, metric, result and regions: from clouds to coverage numbers."""

from torchcover.coverage.grid import BevGrid
from torchcover.coverage.metric import CoverageMetric
from torchcover.coverage.regions import Region, forward_regions
from torchcover.coverage.result import Coverage
from torchcover.coverage.summary import RegionNumbers, RegionSummary

__all__ = ["BevGrid", "Coverage", "CoverageMetric", "Region", "RegionNumbers", "RegionSummary", "forward_regions"]
