"""`torchcover study`: error against run time."""

import json
import math

import pytest
import torch

from torchcover.cli.study import Request, Truth, _advice, _errors
from torchcover.coverage import BevGrid, CoverageMetric, forward_regions
from torchcover.report import WorkPoint, cheapest, draw_work_precision, pareto_front


def point(seconds, error, rays=1024, reference="even"):
    return WorkPoint(reference, rays, 1, seconds, error, error, error, error, error, error, 1.0)


def test_a_small_study_writes_a_table_a_diagram_and_an_advice(torchcover, tmp_path):
    out = tmp_path / "out"
    rays = ["--rays", "64", "--rays", "256", "--rays", "64"]
    options = [*rays, "--steps", "4", "--runs", "2", "--long-run-steps", "8", "--cell", "1"]
    code, text, complaints = torchcover("study", "front_roof_32", "--scenario", "courtyard", *options, "--out", out)
    assert code == 0, complaints
    assert "percentage points" in text
    assert "…" not in text
    assert (out / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    study = json.loads((out / "study.json").read_text())
    settings = {(row["reference"], row["rays"], row["steps"]) for row in study["points"]}
    assert settings == {(name, rays, steps) for name in ("even", "paper") for rays in (64, 256) for steps in (1, 2, 4)}
    assert all(row["seconds"] > 0 for row in study["points"])
    best = [row for row in study["points"] if row["best_detection_error"]]
    assert min(row["detection_error"] for row in study["points"]) in {row["detection_error"] for row in best}
    assert [(stage["reference"], stage["rays"]) for stage in study["stages"]] == [
        (name, rays) for rays in (64, 256) for name in ("even", "paper")
    ]
    assert study["long_run"]["steps"] == 8


def test_more_time_without_less_error_is_not_on_the_front():
    front = pareto_front([point(3, 0.3), point(1, 0.5), point(2, 0.6), point(4, 0.3), point(5, 0.1)], "detection_error")
    assert [one.seconds for one in front] == [1, 3, 5]


def test_a_point_whose_error_is_unknown_is_not_on_the_front_and_does_not_hide_the_others():
    front = pareto_front([point(1, math.nan), point(2, 0.3), point(3, math.nan), point(4, 0.1)], "detection_error")
    assert [one.seconds for one in front] == [2, 4]


def test_the_advice_has_every_option_that_decides_about_the_error(tmp_path):
    request = Request("rig", "urban", (64,), 8, 1, 8, every_s=2.0, seed=0, cell=0.5, threshold=0.4, out=tmp_path)
    expected = (
        "For 2 percentage points of detection: --reference even --rays 1024 --steps 1 --cell 0.5 --every 2 (7 s)."
    )
    assert _advice(0.02, point(7, 0.01), request) == expected
    assert _advice(0.02, None, request).endswith("not reached within 8 steps.")


def test_the_cheapest_that_is_good_enough_is_advised():
    points = [point(9, 0.01), point(4, 0.02), point(1, 0.5)]
    assert cheapest(points, "detection_error", 0.02).seconds == 4
    assert cheapest(points, "detection_error", 0.001) is None


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
    values = torch.stack(
        [true.estimate(region, height).value for region in forward_regions() for height in grid.heights]
    )
    truth = Truth(true, values, torch.full_like(values, math.nan))
    assert _errors(true, truth)[:6].abs().max() == 0
    radius, detection, *_, known = _errors(coverage(0.25), truth).tolist()
    assert radius == pytest.approx(0.25**2, rel=1e-5)
    assert detection == 0
    assert 0 < known <= 1
    assert _errors(coverage(0.5), truth)[1].item() == 1.0


def test_the_diagram_has_a_line_for_each_setting_and_both_panels_name_their_unit():
    points = [point(k, 1 / k, rays, name) for k in (1, 2) for rays in (64, 256) for name in ("even", "paper")]
    figure = draw_work_precision(points, {"detection_error": 0.01, "radius_error_m": math.nan}, "rig in scene")
    panels = figure.axes
    assert [axes.get_xscale() for axes in panels] == ["log", "log"]
    assert "percentage points" in panels[0].get_ylabel()
    assert "(m)" in panels[1].get_ylabel()
    labels = [line.get_label() for line in panels[0].get_lines()]
    assert [label for label in labels if label.startswith(("even", "paper"))] == [
        "even 64",
        "even 256",
        "paper 64",
        "paper 256",
    ]
    assert "standard error of the long run" in labels
    assert "standard error of the long run" not in [line.get_label() for line in panels[1].get_lines()]


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
