"""`torchcover study`: error against run time."""

import json

import pytest

from torchcover.cli.printing import advice
from torchcover.evaluation import Settings, StudyPlan, WorkPoint


def test_a_small_study_writes_a_table_a_diagram_and_an_advice(torchcover, worlds, tmp_path):
    out = tmp_path / "out"
    rays = ["--rays", "256", "--rays", "64", "--rays", "64"]
    options = [*rays, "--steps", "2", "--runs", "1", "--long-run-steps", "8", "--cell-m", "4"]
    code, text, complaints = torchcover(
        "study", worlds / "low.yaml", "--scenario", worlds / "yard.yaml", *options, "--out", out
    )
    assert code == 0, complaints
    assert "percentage points" in text
    assert "…" not in text
    assert (out / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    assert (out / "long_run.npz").is_file()
    study = json.loads((out / "summary.json").read_text())
    assert [(row["rays"], row["steps"]) for row in study["points"]] == [(64, 1), (64, 2), (256, 1), (256, 2)]
    # A real command was timed, which has to import all this.
    assert all(row["seconds"] > study["start_s"] > 0.5 for row in study["points"])
    best = [row["errors"]["detection_0.4m"] for row in study["points"] if "detection_0.4m" in row["best"]]
    assert min(row["errors"]["detection_0.4m"] for row in study["points"]) in best
    assert [stage["rays"] for stage in study["seconds_a_step"]] == [64, 256]
    assert study["long_run"]["steps"] == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rays", "0"], "rays"),
        (["--cell-m", "0.3"], "multiple of the cell"),
        (["--every-s", "0.15"], "every_s: a positive multiple of the time step"),
        (["--scenario", "nowhere"], "nowhere"),
        (["--long-run", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_what_makes_no_sense_ends_in_one_line(torchcover, tmp_path, options, message):
    code, _, complaints = torchcover("study", "front_roof_32", *options, "--steps", "1", "--out", tmp_path / "out")
    assert code == 2
    assert message in complaints
    assert len(complaints.strip().splitlines()) == 1


def test_the_advice_has_every_option_that_decides_about_the_error():
    plan = StudyPlan(Settings("rig", "urban", steps=8, every_s=2.0))
    point = WorkPoint(1024, 4, 2, 7, {})
    expected = "For 2 percentage points of detection: --rays 1024 --steps 4 --every-s 2 (7 s)."
    assert advice(0.02, point, plan) == expected
    assert advice(0.02, None, plan).endswith("not reached within 8 steps.")


def test_run_times_are_not_measured_beside_other_ranks(torchcover, monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    code, _, said = torchcover("study", "front_roof_32", "--out", tmp_path / "out")
    assert (code, "run it without torchrun" in said) == (2, True)
