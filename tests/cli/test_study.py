"""`torchcover study`: error against run time."""

import json

import pytest

from torchcover.cli.printing import advice
from torchcover.evaluation import StudyPlan, WorkPoint


def test_a_small_study_writes_a_table_a_diagram_and_an_advice(torchcover, tmp_path):
    out = tmp_path / "out"
    rays = ["--rays", "64", "--rays", "256", "--rays", "64"]
    options = [*rays, "--steps", "4", "--runs", "2", "--long-run-steps", "8", "--long-run-rays", "4096", "--cell", "4"]
    code, text, complaints = torchcover("study", "front_roof_32", "--scenario", "courtyard", *options, "--out", out)
    assert code == 0, complaints
    assert "percentage points" in text
    assert "…" not in text
    assert (out / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    study = json.loads((out / "study.json").read_text())
    names = StudyPlan.references
    settings = {(row["reference"], row["rays"], row["steps"]) for row in study["points"]}
    assert settings == {(name, rays, steps) for name in names for rays in (64, 256) for steps in (1, 2, 4)}
    assert all(row["seconds"] > 0 for row in study["points"])
    best = [row for row in study["points"] if row["best_detection_error"]]
    assert min(row["detection_error"] for row in study["points"]) in {row["detection_error"] for row in best}
    assert [(stage["reference"], stage["rays"]) for stage in study["stages"]] == [
        (name, rays) for rays in (64, 256) for name in names
    ]
    assert study["long_run"]["steps"] == 8


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rays", "2"], "rays"),
        (["--cell", "0.3"], "multiple of the cell"),
        (["--every", "0.15"], "every_s: a positive multiple of the time step"),
        (["--scenario", "nowhere"], "nowhere"),
    ],
)
def test_what_makes_no_sense_ends_in_one_line(torchcover, tmp_path, options, message):
    code, _, complaints = torchcover("study", "front_roof_32", *options, "--steps", "1", "--out", tmp_path / "out")
    assert code == 2
    assert message in complaints
    assert len(complaints.strip().splitlines()) == 1


def test_the_advice_has_every_option_that_decides_about_the_error():
    plan = StudyPlan("rig", "urban", steps=8, every_s=2.0)
    point = WorkPoint("even", 1024, 1, 7, *[0.01] * 4)
    expected = (
        "For 2 percentage points of detection: --reference even --rays 1024 --steps 1 --cell 0.5 --every 2 (7 s)."
    )
    assert advice(0.02, point, plan) == expected
    assert advice(0.02, None, plan).endswith("not reached within 8 steps.")
