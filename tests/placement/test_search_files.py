"""What a search writes: a rig that can be evaluated, tables that agree, a page and pictures."""

import csv
import json
import re

import numpy as np
import pytest

from tests.placement.surfaces import plan, space
from torchcover.coverage.quantities import RADIUS, make_detection_quantity
from torchcover.estimation import Difference
from torchcover.placement import PlacementSearch, run_search
from torchcover.placement.running import JOURNAL
from torchcover.placement.validation import HeldOutImprovement, describe_improvement
from torchcover.report.page.svg import render_text_html
from torchcover.simulation import Rig


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    folder = tmp_path_factory.mktemp("one")
    result = run_search(PlacementSearch(space(), plan(num_evaluations=16)), folder)
    return result, folder, result.save(folder)


def rows(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_best_rig_can_be_loaded(one):
    result, folder, _ = one
    rig = Rig.load(folder / "best.yaml")
    assert rig == result.rig
    assert rig.sensors[0].mount.pitch_deg == result.best.evaluation.values["roof.pitch_deg"]
    assert rig.name == "roof_best"


def test_the_summary_comes_last_and_lists_all_files(one):
    result, folder, files = one
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["complete"] is True
    assert summary["summary"] == result.summary
    assert files[-1].name == "summary.json"
    assert set(summary["files"]) == {path.name for path in files[:-1]}
    assert set(summary["files"]) >= {"best.yaml", "evaluations.csv", "pareto.csv", "search.json", "report.html"}
    assert {path.name for path in folder.iterdir()} == {path.name for path in files} | {JOURNAL}


def test_evaluations_have_rows_with_their_improvement(one):
    result, folder, _ = one
    table = rows(folder / "evaluations.csv")
    assert [int(row["number"]) for row in table] == list(range(17))
    start = float(table[0]["near_value"])
    for row, evaluation in zip(table, result.search.evaluations, strict=True):
        assert row["strategy"] == evaluation.strategy
        assert (row["state"], row["reason"]) == ("complete", "")
        assert float(row["near_improvement"]) == pytest.approx(float(row["near_value"]) - start, abs=1e-8)
    best = max(table, key=lambda row: float(row["near_improvement"]))
    assert int(best["number"]) == result.best.evaluation.number


def test_notebook_has_summary_and_evaluation_rows(one):
    result, _, _ = one
    assert result.summary in repr(result)
    assert re.search(r"<strong>.*</strong>.*data:image/png;base64,", result._repr_html_())
    table = result.to_dataframe()
    assert table["number"].tolist() == [each.number for each in result.search.evaluations]


def test_the_record_has_seeds_gains_and_counts(one):
    result, folder, _ = one
    record = json.loads((folder / "search.json").read_text())
    assert record["band_frame"] == "ground"
    assert (record["seed"], record["test_seed"]) == (0, 1)
    gain = record["finalists"][0]["improvements"]["near"]["area"]
    assert gain["optimism"] == pytest.approx(gain["search_improvement"] - gain["improvement"])
    assert record["strategy_counts"] == result.strategy_counts


def test_page_shows_improvements_rigs_and_plots(one):
    result, folder, _ = one
    page = (folder / "report.html").read_text()
    first, *others = re.split(r"(?<=[.]) (?=[A-Z])", result.summary)
    assert f'<p class="verdict">{render_text_html(first)}</p>' in page
    assert all(f"<li>{render_text_html(words)}</li>" in page for words in others)
    assert page.count("data:image/png;base64,") == 1
    assert "start: front_roof_32" in page
    assert "best: roof_best" in page
    assert f"{result.best.evaluation.values['roof.pitch_deg']:.3f}" in page


def test_several_objectives_write_a_front_and_its_rigs(tmp_path):
    result = run_search(PlacementSearch(space(objectives=("near", "far")), plan(num_evaluations=16)))
    names = {path.name for path in result.save(tmp_path)}
    assert names >= {"best.yaml", "best_near.yaml", "best_far.yaml", "pareto.png"}
    assert [int(row["number"]) for row in rows(tmp_path / "pareto.csv")] == result.search.find_best()


def test_infeasible_search_still_writes_files(tmp_path):
    def nowhere(rig):
        if rig.name != "front_roof_32":
            raise ValueError("inside the wall")
        return np.array([0.5, 0.5])

    result = run_search(PlacementSearch(space(), plan(num_evaluations=3, compute_values=nowhere)))
    result.save(tmp_path)
    assert Rig.load(tmp_path / "best.yaml") == Rig.load("front_roof_32")
    assert [row["reason"] for row in rows(tmp_path / "evaluations.csv")[1:]] == ["inside the wall"] * 3
    assert json.loads((tmp_path / "search.json").read_text())["finalists"][0]["improvements"] is None


DETECTION = make_detection_quantity(0.4)


def gain(mean, error, significant, num_scenes=16, quantity=DETECTION):
    ends = mean - 2 * error, mean + 2 * error
    return HeldOutImprovement(
        "near", "area", Difference(quantity, mean, error, *ends, significant, 0.1, num_scenes, 9), 0.04
    )


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (
            gain(-0.02, 0.004, True),
            "worsened by -2.00  [-2.80, -1.20] points on 16 held-out scenes (t -5.0, better in 9)",
        ),
        (gain(0.03, 0.01, True), "improved by +3.0  [+1.0, +5.0] points on 16 held-out scenes (t 3.0, better in 9)"),
        (
            gain(0.03, 0.01, None, 3),
            "no significant improvement: +3.0  [+1.0, +5.0] points on 3 held-out scenes (t 3.0, better in 9)",
        ),
        (
            gain(0.0202, 0.01, False),
            "no significant improvement: +2.0  [0.0, +4.0] points on 16 held-out scenes (t 2.0, better in 9)",
        ),
        (
            gain(0.02, np.nan, None),
            "no significant improvement: +2.0 points on 16 held-out scenes (t unknown, better in 9)",
        ),
        (
            gain(-0.1, 0.02, True, quantity=RADIUS),
            "improved by +0.100  [+0.060, +0.140] m on 16 held-out scenes (t 5.0, better in 9)",
        ),
        (gain(np.nan, np.nan, None), "unknown on held-out scenes"),
    ],
)
def test_only_significant_changes_are_called_improvements(found, words):
    assert describe_improvement(found) == words
    if np.isfinite(found.difference.value):
        assert describe_improvement(found, optimism=True).startswith(f"{words}, optimism ")


def test_number_without_average_has_one_row(tmp_path):
    objectives = {"near": {"region": "20m"}, "largest": {"number": "radius_maximum_m", "region": "20m"}}
    result = run_search(PlacementSearch(space(objectives=objectives), plan(num_evaluations=16, average="cells")))
    result.save(tmp_path)
    found = json.loads((tmp_path / "search.json").read_text())
    assert found["average"] == "cells"
    tested = [pick for pick in found["finalists"] if pick["improvements"]]
    assert tested
    for pick in tested:
        assert {name: list(gains) for name, gains in pick["improvements"].items()} == {
            "near": ["cells"],
            "largest": ["-"],
        }
    assert result.summary.count("near: ") == result.summary.count("largest: ") == 1
    said = [tuple(cell.text for cell in row[:3]) for row in result.report.tables[0].rows]
    assert len(said) == len(set(said))
    assert {each[1:] for each in said} == {
        ("near (points)", "cells"),
        ("largest (points)", "-"),
    }
