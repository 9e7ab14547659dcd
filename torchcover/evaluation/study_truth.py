"""The long run of a study, and how far others are from it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcover.coverage import Coverage, forward_regions
from torchcover.evaluation.observers import CoverageObserver
from torchcover.evaluation.pipeline import observe
from torchcover.evaluation.settings import BLOCKS
from torchcover.evaluation.study_plan import LONG_RUN_SEED, StudyPlan


@dataclass(frozen=True)
class Truth:
    """The long run: what it says about the paper's regions and bands.

    Args:
        coverage: Its coverage, by area.

    Raises:
        ValueError: It has no square metres.
    """

    coverage: Coverage

    def __post_init__(self) -> None:
        if self.coverage.measure != "area":
            raise ValueError("long run: its reference points had no square metres; make it with the surface reference")

    @property
    def errors(self) -> dict[str, float]:
        """Its own standard errors by the key of their quantity, root mean squares: no smaller error can be told."""
        places = [(region, height) for region in forward_regions() for height in self.coverage.grid.heights]
        each = torch.stack([self.coverage.estimate(*place).error for place in places])
        return self._by_key(each.square().nanmean(dim=0).sqrt())

    def distances(self, sums: Tensor) -> dict[str, float]:
        """Root mean squares of what runs are off by, over them, the regions and the bands, by the key of the quantity.

        NaN if a run has seen nothing of a region of which the long run has.

        Args:
            sums: (N, R, 1 + Q, H) what `area_sums` says of each of N runs.
        """
        truth = _ratios(area_sums(self.coverage))
        known = truth.isfinite()
        squares = (_ratios(sums) - truth).square().where(known, 0.0)
        return self._by_key((squares.sum(dim=(0, 1, 3)) / (len(sums) * known.sum(dim=(0, 2)))).sqrt())

    def _by_key(self, numbers: Tensor) -> dict[str, float]:
        keys = [quantity.key for quantity in self.coverage.quantities]
        return dict(zip(keys, numbers.tolist(), strict=True))


def area_sums(coverage: Coverage) -> Tensor:
    """(R, 1 + Q, H) sums over the visible surface of the paper's R regions in H bands; those of other steps add up.

    The square metres, then those times each of Q quantities.
    """
    assert coverage.area is not None  # no other is studied
    sums = coverage.area.totals()
    return torch.stack([sums[:, :, region.mask(coverage.grid)].sum(dim=2) for region in forward_regions()])


def long_run(plan: StudyPlan, *, progress: bool) -> Truth:
    """Do it, or read it.

    Raises:
        FileNotFoundError: No such file.
        ValueError: It is no coverage by area, or one with other thresholds.
    """
    if plan.long_run is None:
        observer = CoverageObserver(plan.metric(BLOCKS))
        frames = plan.frames(LONG_RUN_SEED + plan.seed, plan.long_run_steps)
        observe(frames, [observer], progress=progress, title="long run")
        return Truth(observer.compute())
    coverage = Coverage.load(plan.long_run)
    if coverage.thresholds != (plan.threshold_m,):
        measured = " and ".join(f"{threshold:g} m" for threshold in coverage.thresholds)
        raise ValueError(f"{plan.long_run}: measured within {measured}; wanted is {plan.threshold_m:g} m")
    return Truth(coverage)


def _ratios(sums: Tensor) -> Tensor:
    return sums[..., 1:, :] / sums[..., :1, :]
