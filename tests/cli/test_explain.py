"""`--explain`: what a run left out."""

import json

import pytest
import torch

from torchcover.cli.explain import left_out
from torchcover.coverage import BevGrid, CoverageMetric

RAYS = ["--rays", "256", "--cell", "1"]


def whats(folder):
    return {row["what"]: row for row in json.loads((folder / "summary.json").read_text())["left_out"]}


def test_a_scene_in_which_nothing_moves_reuses_its_scan(torchcover, worlds):
    options = ["--scenario", worlds / "yard.yaml", "--steps", "3", *RAYS, "--explain", "--out", worlds / "out"]
    code, text, complaints = torchcover("evaluate", worlds / "low.yaml", *options)
    assert code == 0, complaints
    assert "Left out, for this run did not need it" in text
    reused = whats(worlds / "out")["rays of sensors where nothing moves: cast once, for all steps"]
    assert reused["count"] == reused["of"] == 3 * 8 * 30


def test_without_the_option_it_stands_in_the_summary_only(torchcover, worlds):
    options = ["--scenario", worlds / "yard.yaml", "--steps", "2", *RAYS, "--out", worlds / "out"]
    code, text, _ = torchcover("compare", worlds / "low.yaml", worlds / "both.yaml", *options)
    assert code == 0
    assert "Left out" not in text
    assert whats(worlds / "out")


def test_points_outside_the_grid_are_counted_over_all_rigs():
    grid = BevGrid(x=(0.0, 2.0), y=(0.0, 2.0), cell=1.0)
    metric = CoverageMetric(grid)
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0], [9.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]))
    records = {str(row["what"]): row for row in left_out({}, [metric.compute()] * 2)}
    outside = records["reference points outside every cell: not searched for"]
    assert (outside["count"], outside["of"]) == (4, 6)
    assert "maxima, quantiles, quantiles over steps, pooled means: not asked for, not kept" in records


@pytest.mark.parametrize("count", [0, 7])
def test_what_was_not_left_out_is_not_listed(count):
    metric = CoverageMetric(BevGrid(x=(0.0, 2.0), y=(0.0, 2.0), cell=1.0))
    metric.update(torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]]))
    counts = {"moving_bodies_out_of_range": count, "moving_bodies": 9}
    listed = [row["count"] for row in left_out(counts, [metric.compute()]) if row["of"] == 9]
    assert listed == ([7] if count else [])
