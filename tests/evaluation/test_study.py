"""A study of error against run time."""

import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric
from torchcover.evaluation import CoverageObserver, StudyPlan, Truth, error_against_time
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
    assert truth.squared_errors(true).abs().max() == 0
    radius, detection, *_ = truth.squared_errors(coverage(0.25)).tolist()
    assert radius == pytest.approx(0.25**2, rel=1e-5)
    assert detection == 0
    assert truth.squared_errors(coverage(0.5))[1].item() == 1.0


def test_more_steps_cost_more_time_and_every_setting_is_timed():
    plan = StudyPlan("front_roof_32", rays=(64,), steps=2, runs=1, long_run_steps=8, long_run_rays=1024, cell_m=4.0)
    study = error_against_time(plan)
    assert [(point.reference, point.rays, point.steps) for point in study.points] == [
        (name, 64, steps) for name in sorted(plan.references) for steps in (1, 2)
    ]
    for one, two in (study.points[:2], study.points[2:]):
        assert 0 < one.seconds < two.seconds
    assert all(stage["rays_s"] > 0 and stage["cdist_s"] > 0 for stage in study.stages)
    assert study.record["long_run"]["rays"] == 1024
    assert set(study.recommended) == {0.05, 0.02, 0.01, 0.005}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rays": ()}, "rays: at least one is needed"),
        ({"references": ()}, "references: at least one is needed"),
        ({"steps": 0}, "steps: at least 1 is needed; got 0"),
        ({"runs": 0}, "runs: at least 1 is needed; got 0"),
        ({"long_run_steps": 0}, "long_run_steps: at least 1"),
        ({"rays": (64, 2048), "long_run_rays": 1024}, "long_run_rays: no fewer .* 2048; got 1024"),
        ({"references": ("best",)}, "reference best: "),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused_at_once(changes, message):
    with pytest.raises(ValueError, match=message):
        StudyPlan("front_roof_32", **changes)


@pytest.mark.parametrize("name", REFERENCE_SENSORS)
def test_only_reference_sensors_of_one_measure_are_studied(name):
    if REFERENCE_SENSORS[name].weight_kind == "m2":
        with pytest.raises(ValueError, match=f"references: {name} measures by area"):
            StudyPlan("front_roof_32", references=(name,))
    else:
        plan = StudyPlan("front_roof_32", references=(name,), long_run_steps=1)
        assert plan.long_frames().reference_sensor.name == name


def test_a_long_run_that_was_cut_short_is_no_truth(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    plan = StudyPlan("front_roof_32", rays=(64,), steps=1, runs=1, long_run_steps=2, long_run_rays=64, cell_m=8.0)
    update, calls = CoverageObserver.update, []
    monkeypatch.setattr(
        CoverageObserver,
        "update",
        lambda self, frame: interrupted() if calls else calls.append(frame) or update(self, frame),
    )
    with pytest.raises(KeyboardInterrupt):
        error_against_time(plan)
