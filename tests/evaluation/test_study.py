"""A study of error against run time."""

import math
from dataclasses import replace

import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric
from torchcover.evaluation import (
    CoverageObserver,
    Settings,
    StudyPlan,
    Truth,
    area_sums,
    error_against_time,
    evaluate,
)
from torchcover.evaluation.study_runs import tried
from torchcover.simulation import Rig

GRID = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0), cell=8.0)
SMALL = {"settings": Settings("front_roof_32", steps=2, cell_m=4.0), "rays": (64,), "runs": 2, "long_run_steps": 8}


def coverage(shift_m, steps=1, **settings):
    """All cells, seen from everywhere; the rig's points are that far above them."""
    x, y = torch.meshgrid(torch.arange(-36.0, 160.0, 8.0), torch.arange(-36.0, 40.0, 8.0), indexing="ij")
    floor = torch.stack([x.flatten(), y.flatten(), torch.zeros(x.numel())], dim=1)
    both = torch.cat([floor, floor + torch.tensor([0.0, 0.0, 1.0])])
    metric = CoverageMetric(GRID, (0.4,), max_radius=GRID.diagonal_m, **{"square_metres": True, **settings})
    for _ in range(steps):
        metric.update(both + torch.tensor([0.0, 0.0, shift_m]), both, weights=torch.ones(len(both)))
    return metric.compute()


@pytest.fixture(autouse=True)
def no_command(monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.study.command_s", lambda plan: 100.0)


def test_the_long_run_itself_has_no_distance_and_a_shifted_one_its_shift():
    true = coverage(0.0, blocks=16)
    truth = Truth(true)
    assert truth.distances(area_sums(true)[None]) == {"radius_m": 0.0, "detection_0.4m": 0.0}
    near = truth.distances(area_sums(coverage(0.25))[None])
    assert near == {"radius_m": pytest.approx(0.25, rel=1e-6), "detection_0.4m": 0.0}
    each = torch.stack([area_sums(coverage(shift)) for shift in (0.0, 0.5)])
    far = truth.distances(each)  # root mean squares of 0 and 0.5, and of 0 and 1
    assert far == {"radius_m": pytest.approx(0.5**1.5, rel=1e-6), "detection_0.4m": pytest.approx(0.5**0.5)}


def test_a_run_that_has_not_seen_a_region_has_no_distance():
    sums = area_sums(coverage(0.25))
    sums[0, :, 0] = 0.0
    assert all(map(math.isnan, Truth(coverage(0.0)).distances(sums[None]).values()))


def test_sums_of_parts_are_those_of_the_whole():
    parts = area_sums(coverage(0.25, steps=2)) + area_sums(coverage(0.5, steps=3))
    assert torch.allclose(parts[:, 0], area_sums(coverage(0.0, steps=5))[:, 0], rtol=1e-12)


def test_only_square_metres_can_be_a_long_run():
    with pytest.raises(ValueError, match="no square metres"):
        Truth(coverage(0.0, square_metres=False))


def test_a_study_says_of_the_same_steps_what_an_evaluation_says():
    plan = StudyPlan(**SMALL)
    same = evaluate("front_roof_32", steps=4, cell_m=4.0, rays=64).coverage
    (trial,) = tried(plan, 100.0, progress=False).trials
    whole, again = trial.sums(4)[0], area_sums(same)
    assert torch.allclose(whole, again, rtol=1e-12, atol=0)


def test_more_steps_cost_more_time_and_the_start_is_in_it():
    study = error_against_time(StudyPlan(**SMALL))
    assert [(point.rays, point.steps, point.runs) for point in study.points] == [(64, 1, 4), (64, 2, 2)]
    one, two = study.points
    assert study.start_s < 100 < study.start_s + 50
    assert study.start_s < one.seconds < two.seconds
    assert two.seconds - one.seconds == pytest.approx(one.seconds - study.start_s)
    (stage,) = study.stages
    assert sum(stage[part] for part in ("worlds", "casting", "measuring")) == pytest.approx(two.seconds - one.seconds)
    assert study.record["long_run"]["steps"] == 8
    assert set(study.recommended) == {0.05, 0.02, 0.01, 0.005}


def test_runs_are_looked_at_whenever_their_steps_have_doubled():
    assert StudyPlan(Settings("rig", steps=100)).lengths == [6, 12, 24, 48, 96]
    assert StudyPlan(Settings("rig", steps=5)).lengths == [1, 2, 4]


def test_the_command_that_is_timed_has_every_option_that_is_not_as_usual():
    settings = Settings("rig", "urban", cell_m=0.5, thresholds_m=(0.2, 1), every_s=5.0, steps=7)
    assert StudyPlan(settings).command == [
        "evaluate", "rig", "--scenario=urban", "--cell-m=0.5", "--thresholds-m=0.2", "--thresholds-m=1.0",
        "--every-s=5.0",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rays": ()}, "rays: at least one is needed"),
        ({"runs": 0}, "runs: at least 1 is needed; got 0"),
        ({"long_run_steps": 0}, "long_run_steps: at least 1"),
        ({"settings": Settings()}, "one rig and a scenario are needed, by names or paths"),
        ({"settings": Settings(Rig.load("front_roof_32"))}, "one rig and a scenario are needed, by names or paths"),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused_at_once(changes, message):
    with pytest.raises(ValueError, match=message):
        StudyPlan(**{**SMALL, **changes})


def test_a_saved_long_run_is_used_and_one_with_other_settings_refused(tmp_path):
    saved = tmp_path / "long_run.npz"
    coverage(0.0, blocks=16).save(saved)
    plan = StudyPlan(**SMALL | {"settings": Settings("front_roof_32", steps=2, cell_m=8.0)}, long_run=saved)
    assert torch.equal(error_against_time(plan).truth.coverage.radius, coverage(0.0).radius)
    for changes, message in (
        ({"thresholds_m": 0.2}, r"thresholds_m is \(0.4,\) there; \(0.2,\) is needed"),
        ({"cell_m": 4.0}, "cell_m is 8.0 there; 4.0 is needed"),
    ):
        with pytest.raises(ValueError, match=f"long_run.npz: {message}"):
            error_against_time(replace(plan, settings=replace(plan.settings, **changes)))


def test_a_long_run_that_was_cut_short_is_no_truth(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    update, calls = CoverageObserver.update, []
    monkeypatch.setattr(
        CoverageObserver,
        "update",
        lambda self, frame: interrupted() if calls else calls.append(frame) or update(self, frame),
    )
    with pytest.raises(KeyboardInterrupt):
        error_against_time(StudyPlan(**SMALL))
