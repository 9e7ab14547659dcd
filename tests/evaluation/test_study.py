"""A study of error against run time."""

import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric
from torchcover.evaluation import StudyPlan, Truth, error_against_time
from torchcover.simulation import REFERENCE_SENSORS


def test_the_long_run_itself_has_no_error_and_a_shifted_one_its_shift():
    grid = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0), cell=8.0)
    x, y = torch.meshgrid(torch.arange(-36.0, 160.0, 8.0), torch.arange(-36.0, 40.0, 8.0), indexing="ij")
    everywhere = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel())], dim=1)
    both = torch.cat([everywhere, everywhere + torch.tensor([0.0, 0.0, 1.0])])

    def coverage(shift_m):
        metric = CoverageMetric(grid, (0.4,), max_radius=grid.diagonal_m, blocks=16)
        metric.update(both + torch.tensor([0.0, 0.0, shift_m]), both)
        return metric.compute()

    true = coverage(0.0)
    truth = Truth.from_coverage(true)
    assert truth.squared_errors(true)[:6].abs().max() == 0
    radius, detection, *_, known = truth.squared_errors(coverage(0.25)).tolist()
    assert radius == pytest.approx(0.25**2, rel=1e-5)
    assert detection == 0
    assert 0 < known <= 1
    assert truth.squared_errors(coverage(0.5))[1].item() == 1.0


def test_more_steps_cost_more_time_and_every_setting_is_timed():
    plan = StudyPlan("front_roof_32", rays=(64,), steps=2, runs=1, long_run_steps=8, long_run_rays=1024, cell_m=4.0)
    study = error_against_time(plan)
    points = [(point.reference, point.rays, point.steps) for point in study.points]
    assert points == [(name, 64, steps) for name in sorted(REFERENCE_SENSORS) for steps in (1, 2)]
    for one, two in zip(study.points[::2], study.points[1::2], strict=True):
        assert 0 < one.seconds < two.seconds
        assert one.known_share <= two.known_share
    assert all(stage["rays_s"] > 0 and stage["cdist_s"] > 0 for stage in study.stages)
    assert study.record["long_run"]["rays"] == 1024
    assert set(study.recommended) == {0.05, 0.02, 0.01, 0.005}
