"""Command `search`."""

import sys
from functools import partial
from pathlib import Path

import pytest

from tests.placement.surfaces import Surface
from torchcover.cli import search_run
from torchcover.cli.commands import parse_budget_s
from torchcover.placement import SearchPlan

CHOICE = Path(__file__).parents[2] / "examples" / "placement" / "robot_corners.yaml"
SPACE = """
name: roof
start: front_roof_32
scenario: urban
free: {roof: {x_m: [-0.6, 0.8], z_m: 1.8, pitch_deg: [-10, 15]}}
objectives: {near: {region: 20m}}
"""


@pytest.fixture
def space(tmp_path, monkeypatch):
    """Search space whose frames are synthetic surfaces; the validation has one test target."""
    monkeypatch.setattr("torchcover.placement.validation.TARGETS", ("pole",))
    makes = lambda space, plan, seed, num_scenes: Surface(seed, num_scenes, plan.frames_per_scene)  # noqa: E731
    create_plan = partial(SearchPlan, make_frames=makes)
    create_plan.num_scenes = SearchPlan.num_scenes
    monkeypatch.setattr(search_run, "SearchPlan", create_plan)
    (tmp_path / "space.yaml").write_text(SPACE)
    return tmp_path / "space.yaml"


def test_search_prints_improvement_and_random_candidates(torchcover, space, tmp_path):
    out = tmp_path / "found"
    code, printed, _ = torchcover("search", space, "--num-evaluations", 12, "--out", out, "--seed", 3)
    assert code == 0
    last = printed.splitlines()[-1]
    assert last.startswith("near: ")
    assert "random candidates" in last
    assert last.endswith("Sensor model: ideal, every hit is a point.")
    assert (out / "best.yaml").exists()
    code, again, _ = torchcover("search", space, "--num-evaluations", 12, "--out", out, "--seed", 3, "--resume")
    assert again.splitlines()[-1] == last
    code, _, stderr = torchcover("search", space, "--num-evaluations", 12, "--out", out, "--resume")
    assert code == 2
    assert "the journal belongs to another search: seed (3 there, 0 here)" in stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--budget", "30"), "--budget: a time is needed, as in 90s, 30min or 2h; got '30'"),
        (("--budget", "1h", "--num-evaluations", "3"), "one of them is needed; got both"),
        (("--num-evaluations", "3", "--sensor-model", "real"), "no LiDAR of the rig 'front_roof_32' has a range_at_10"),
        (("--budget", "0s"), "budget: got 0 s; give more than 0 s"),
        (("--budget", "0.00001s"), "is too short for two evaluations"),
    ],
)
def test_user_error_is_one_line(torchcover, space, tmp_path, options, message):
    code, _, stderr = torchcover("search", space, "--out", tmp_path / "found", *options)
    assert code == 2
    assert message in stderr
    assert not (tmp_path / "found" / "summary.json").exists()


@pytest.mark.parametrize(
    ("objective", "message"),
    [
        ("number: radius, region: 20m", "objective 'near': results have no number 'radius'; did you mean 'radius_m'?"),
        ("number: radius_m", "objectives.near: region: 'radius_m' needs one"),
    ],
)
def test_unknown_objective_is_one_line(torchcover, tmp_path, objective, message):
    path = tmp_path / "space.yaml"
    path.write_text(SPACE.replace("region: 20m", objective))
    code, _, stderr = torchcover("search", path, "--out", tmp_path / "found")
    assert code == 2
    assert message in stderr
    assert stderr.count("\n") == 1


@pytest.mark.parametrize("options", [("--budget", "5s"), ("--num-evaluations", "3"), ("--resume",)])
def test_sensor_selection_rejects_a_budget(torchcover, tmp_path, options):
    code, _, stderr = torchcover("search", CHOICE, "--out", tmp_path / "found", *options)
    assert code == 2
    assert f"torchcover: {options[0]}: has no effect, because all candidates of this file are evaluated" in stderr


def test_budgets_are_parsed_to_seconds():
    assert [parse_budget_s(text) for text in ("10s", "30min", "2h", "0.5 h")] == [10, 1800, 7200, 1800]


def test_missing_optuna_is_one_line(torchcover, space, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    code, _, stderr = torchcover("search", space, "--num-evaluations", 3, "--out", tmp_path / "found")
    assert code == 2
    assert stderr == "torchcover: a placement search needs Optuna: pip install 'torchcover[search]'\n"
