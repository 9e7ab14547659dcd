"""Test targets in the near field of a run: rows, files, comparisons, mixtures and workers."""

import csv
import json

import pytest

from torchcover import Coverage, Rig, compare, evaluate
from torchcover.evaluation import Checkpoint, MixedResult
from torchcover.report import RENDERERS
from torchcover.simulation import RegionsOfInterest, Scenario

YARD = {
    "ego": {"shape": {"type": "box", "size_m": [4, 2, 1]}},
    "bodies": [{"name": "floor", "shape": {"type": "plane", "size_m": [400, 400]}}],
}
SMALL = {"num_frames": 32, "cell_m": 4.0, "num_rays": 128, "test_targets": "pole", "num_workers": 0}
SIDES = ["front_3m", "rear_3m", "left_3m", "right_3m"]


def yard(name):
    return Scenario.model_validate({"name": name, **YARD})


def rig(name, z_m=1.4, fov_deg=360):
    mount = {"x_m": 0.0 if z_m > 1 else 2.1, "z_m": z_m}
    sensor = {
        "name": "top",
        "mount": mount,
        "channels": 16,
        "vertical_fov_deg": [-30, 5],
        "horizontal_fov_deg": fov_deg,
    }
    return Rig.model_validate({"name": name, "sensors": [{**sensor, "columns": 240, "max_range_m": 60}]})


RIGS = [rig("roof"), rig("grille", 0.6, 120)]


@pytest.fixture(scope="module")
def both():
    return evaluate(RIGS, yard("yard"), **SMALL)


def select_target_rows(result, **values):
    rows = [row for row in result.summary if row["average"] == "target_positions"]
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def test_near_field_rows_are_about_test_targets(both):
    near = [(row["region"], row["band"]) for row in both.summary if row["rig"] == "roof" and row["region"] in SIDES]
    bands = [(region, "ground") for region in SIDES if (region, "ground") in near]
    assert near == [*bands, *((region, "pole_100cm") for region in SIDES)]
    for row in select_target_rows(both):
        assert 0 < row["observed_cells"] <= row["cells"] == 8 * 3
        assert 0 <= row["target_surface_0.4m"] <= 1
        assert (row["radius_m"], row["z_min_m"]) == (None, None)
    (roof,), (grille,) = (select_target_rows(both, rig=name, region="front_3m") for name in ("roof", "grille"))
    assert grille["target_positions_5_points_difference"] == pytest.approx(
        grille["target_positions_5_points"] - roof["target_positions_5_points"]
    )
    (front,) = select_target_rows(both, rig="grille", region="front_3m")
    assert (
        0
        <= front["target_positions_5_points_low"]
        < front["target_positions_5_points"]
        < front["target_positions_5_points_high"]
        <= 1
    )
    text = RENDERERS["text"](both.table)
    assert "Free positions with 5 points or more (%)" in text
    assert "Test targets: in 8 frames" in " ".join(text.split())
    assert "free positions" in evaluate(RIGS[0], yard("yard"), **{**SMALL, "num_frames": 1}).tables[1].headings


def test_files_contain_test_targets_for_comparisons(both, tmp_path):
    both.save(tmp_path)
    compared = compare([tmp_path / "coverage" / "roof.npz", tmp_path / "coverage" / "grille.npz"])
    assert select_target_rows(compared) == [
        {**row, "vehicle": None, "sensor_model": None} for row in select_target_rows(both)
    ]
    loaded = Coverage.load(tmp_path / "coverage" / "roof.npz")
    assert loaded.scalars() == pytest.approx(both.coverages["roof"].scalars(), rel=0, abs=0, nan_ok=True)
    rows = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    assert [row["region"] for row in rows if row["band"] == "pole_100cm"] == SIDES * 2
    assert json.loads((tmp_path / "summary.json").read_text())["rows"] == both.summary
    assert [page_map.band for page_map in both.page.maps].count("pole_100cm") == 2
    without = evaluate(RIGS[1], yard("yard"), **{**SMALL, "num_frames": 1, "test_targets": "none"})
    assert select_target_rows(without) == []
    with pytest.raises(ValueError, match="they were measured with different test targets"):
        _ = compare([both, without]).table


def test_workers_and_checkpoints_change_no_number(both, tmp_path):
    path = tmp_path / "run.npz"
    evaluate(RIGS, yard("yard"), checkpoint=Checkpoint(path, keep=True), **{**SMALL, "num_frames": 14})
    resumed = evaluate(RIGS, yard("yard"), checkpoint=Checkpoint(path), **SMALL)
    assert select_target_rows(resumed) == select_target_rows(both)
    assert select_target_rows(evaluate(RIGS, yard("yard"), **{**SMALL, "num_workers": 2})) == select_target_rows(both)


def test_a_mixture_is_the_weighted_mean(both):
    other = evaluate(RIGS, yard("other"), **{**SMALL, "seed": 1})
    mixed = MixedResult.from_results({"yard": both, "road_user": other}, {"yard": 0.75, "road_user": 0.25})
    for row, first, second in zip(
        select_target_rows(mixed), select_target_rows(both), select_target_rows(other), strict=True
    ):
        value = 0.75 * first["target_positions_5_points"] + 0.25 * second["target_positions_5_points"]
        assert row["target_positions_5_points"] == pytest.approx(value)
        assert row["observed_cells"] == first["observed_cells"] + second["observed_cells"]
    without = evaluate(RIGS, yard("other"), **{**SMALL, "num_frames": 1, "test_targets": "none"})
    with pytest.raises(ValueError, match="differ in their test targets"):
        _ = MixedResult.from_results({"yard": both, "road_user": without}, {"yard": 0.75, "road_user": 0.25})


def test_own_regions_need_named_test_targets():
    regions = RegionsOfInterest(regions={"ahead": {"x_m": (2.0, 22.0), "y_m": (-8.0, 8.0)}})
    settings = {**SMALL, "num_frames": 1, "regions": regions}
    assert {row["region"] for row in select_target_rows(evaluate(RIGS[0], yard("yard"), **settings))} == set(SIDES)
    assert select_target_rows(evaluate(RIGS[0], yard("yard"), **{**settings, "test_targets": None})) == []


@pytest.mark.parametrize(
    ("test_targets", "message"), [(["none", "child"], "none, or targets"), (["child", "child_110cm"], "twice")]
)
def test_invalid_test_targets_are_rejected(test_targets, message):
    with pytest.raises(ValueError, match=message):
        evaluate(RIGS[0], yard("yard"), **{**SMALL, "test_targets": test_targets})
