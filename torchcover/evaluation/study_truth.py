"""The long run of a study, and how far others are from it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcover.coverage import Coverage, Region, forward_regions
from torchcover.evaluation.observers import CoverageObserver
from torchcover.evaluation.pipeline import observe
from torchcover.evaluation.settings import BLOCKS
from torchcover.evaluation.study_plan import StudyPlan


@dataclass(frozen=True)
class Truth:
    """The long run: its maps, and what it says about each region and band.

    Args:
        coverage: Its coverage.
        values: (regions x bands, 2) radius in metres and detection.
        errors: Their standard errors.
    """

    coverage: Coverage
    values: Tensor
    errors: Tensor

    @classmethod
    def from_coverage(cls, coverage: Coverage) -> "Truth":
        """What a coverage says."""
        estimates = [coverage.estimate(region, height) for region, height in _places(coverage)]
        values = torch.stack([estimate.value for estimate in estimates])
        return cls(coverage, values, torch.stack([estimate.error for estimate in estimates]))

    def squared_errors(self, coverage: Coverage) -> Tensor:
        """(4,) mean squares of what a coverage is off by: radius and detection of the regions, then of the cells."""
        values = torch.stack([coverage.estimate(*place).value for place in _places(coverage)])
        # A region of which nothing is known yet has no distance.
        regions = (values - self.values).square().nanmean(dim=0)
        return torch.cat([regions, self._cell_errors(coverage, forward_regions()[-1])])

    def _cell_errors(self, coverage: Coverage, region: Region) -> Tensor:
        cells, truth = region.mask(coverage.grid), self.coverage
        radius = (coverage.radius - truth.radius)[:, cells].square().nanmean()
        detection = (coverage.detection[0] - truth.detection[0])[:, cells].square().nanmean()
        return torch.stack([radius, detection])


def long_run(plan: StudyPlan, *, progress: bool) -> Truth:
    """Do it."""
    observer = CoverageObserver(plan.metric(BLOCKS))
    observe(plan.long_frames(), [observer], progress=progress, title="long run")
    return Truth.from_coverage(observer.compute())


def _places(coverage: Coverage) -> list[tuple[Region, str]]:
    return [(region, height) for region in forward_regions() for height in coverage.grid.heights]
