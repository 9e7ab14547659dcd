"""Results of several scenarios, and the weighted mixture of their numbers."""

import csv
import json
import math

import pytest

from torchcover import RegionsOfInterest, Rig, compare, evaluate
from torchcover.evaluation import Checkpoint, MixedResult, Settings

REGIONS = RegionsOfInterest.model_validate(
    {
        "regions": {"ahead": {"x_m": [2, 22], "y_m": [-5, 5]}},
        "heights": {"ground": [-0.5, 0.5]},
        "grid": {"x_m": [0, 24], "y_m": [-8, 8]},
    }
)
SMALL = {"num_frames": 16, "cell_m": 1.0, "num_rays": 256, "regions": REGIONS}
RIGS = [
    Rig.model_validate({
        "name": name,
        "sensors": [{"name": "front", "mount": {"x_m": 2.5, "z_m": z_m}, "channels": 8, "vertical_fov_deg": [-30, 0],
                     "horizontal_fov_deg": 90, "columns": 30, "max_range_m": 60}],
    })
    for name, z_m in (("high", 1.8), ("low", 0.5))
]  # fmt: skip
NUMBERS = ("radius_m", "detection_0.4m", "radius_m_difference", "detection_0.4m_difference")
YARD = """name: {name}
ego: {{shape: {{type: box, size_m: [4, 2, {height_m}]}}}}
bodies:
  - {{name: floor, shape: {{type: plane, size_m: [400, 400]}}}}
  - {{name: wall, shape: {{type: box, size_m: [1, 8, 2]}}, poses: [{{x_m: {wall_m}}}]}}
"""


@pytest.fixture(scope="module")
def yards(tmp_path_factory):
    """Folder of two scenarios that differ in the position of a wall."""
    folder = tmp_path_factory.mktemp("yards")
    for name, wall_m in (("near", 8), ("far", 16)):
        (folder / f"{name}.yaml").write_text(YARD.format(name=name, wall_m=wall_m, height_m=1.5))
    return folder


@pytest.fixture(scope="module")
def mixed(yards):
    return evaluate(RIGS, {str(yards / "near.yaml"): 3, str(yards / "far.yaml"): 1.0}, **SMALL)


def test_each_scenario_has_its_own_result(mixed, yards):
    alone = evaluate(RIGS, yards / "far.yaml", **SMALL)
    assert mixed.scenario_results["far"].summary == alone.summary
    assert list(mixed.scenario_results) == ["near", "far"]
    assert mixed.weights == {"near": 0.75, "far": 0.25}


def test_a_mixture_is_the_weighted_mean(mixed):
    for index, row in enumerate(mixed.summary):
        parts = [(mixed.weights[name], result.summary[index]) for name, result in mixed.scenario_results.items()]
        assert all(part["rig"] == row["rig"] for _, part in parts)
        for key in NUMBERS:
            assert row[key] == pytest.approx(sum(weight * part[key] for weight, part in parts))
            error = math.sqrt(sum((weight * part[f"{key}_error"]) ** 2 for weight, part in parts))
            assert row[f"{key}_error"] == pytest.approx(error)
        # The mixture has more blocks than each scenario, so its interval is shorter for the same error.
        assert row["radius_m_low"] < row["radius_m"] < row["radius_m_high"]
        assert row["blocks"] == sum(part["blocks"] for _, part in parts)
        assert row["visible_m2"] == pytest.approx(sum(weight * part["visible_m2"] for weight, part in parts))


def test_marks_of_a_mixture_need_significance(mixed, yards):
    first, other = mixed.summary
    assert other["detection_0.4m_difference_significant"]
    assert first["detection_0.4m_best"] != other["detection_0.4m_best"]
    short = evaluate(RIGS, [yards / "near.yaml", yards / "far.yaml"], **{**SMALL, "num_frames": 4})
    assert not any(row["detection_0.4m_best"] for row in short.summary)
    # Eight blocks in total are too few: each scenario needs them.
    assert all(row["detection_0.4m_low"] is None for row in short.summary)
    assert "Not enough frames for confidence intervals in near: got 4 blocks" in " ".join(str(short).split())


def test_redundancy_of_a_mixture_is_the_weighted_mean(yards):
    rig = RIGS[0].model_copy(
        update={"sensors": tuple(of.sensors[0].model_copy(update={"name": of.name}) for of in RIGS)}
    )
    weights = {str(yards / "near.yaml"): 3, str(yards / "far.yaml"): 1}
    mixed = evaluate(rig, weights, redundancy=True, **SMALL)
    (row,), parts = (
        mixed.summary,
        [(mixed.weights[name], result.summary[0]) for name, result in mixed.scenario_results.items()],
    )
    assert row["most_critical_sensor"] == "high"
    for key in ("sensors_0.4m", "detection_0.4m_without_high", "detection_0.4m_without_high_change"):
        assert row[key] == pytest.approx(sum(weight * part[key] for weight, part in parts))
        error = math.sqrt(sum((weight * part[f"{key}_error"]) ** 2 for weight, part in parts))
        assert row[f"{key}_error"] == pytest.approx(error)


def test_common_notes_of_scenarios_appear_once(mixed, yards, tmp_path):
    foggy = yards / "foggy.yaml"
    foggy.write_text(YARD.format(name="foggy", wall_m=8, height_m=1.5) + "weather: {name: fog, visibility_m: 30}\n")
    other = evaluate(RIGS[0], [yards / "near.yaml", foggy], **{**SMALL, "num_frames": 2})
    assert other.source["weather"] == {"high": "near clear, foggy fog"}
    assert {"foggy: Weather: fog.", "Vehicle: box.", "Sensor model: ideal, every hit is a point."} < set(
        other.table.notes
    )
    (page,) = (
        file for file in mixed.save(tmp_path, file_kinds="page") if file.parent == tmp_path and file.suffix == ".html"
    )
    text = page.read_text()
    assert all(part in text for part in ("mixture: Mean blind spot radius", "far: Mean blind", "near 0.75, far 0.25"))
    assert len(text) < 100_000


def test_a_scenario_with_all_weight_is_the_mixture(yards):
    paths = [str(yards / f"{name}.yaml") for name in ("near", "far")]
    only = evaluate(RIGS, dict(zip(paths, (0.0, 2.0), strict=True)), **SMALL)
    for row, same in zip(only.summary, only.scenario_results["far"].summary, strict=True):
        for key in (*NUMBERS, "radius_m_low", "radius_m_difference_high", "cells_radius_m_error"):
            assert row[key] == pytest.approx(same[key])


def test_compared_mixtures_equal_one_common_run(mixed, yards):
    weights = {str(yards / "near.yaml"): 0.75, str(yards / "far.yaml"): 0.25}
    results = [evaluate(rig, weights, **SMALL) for rig in RIGS]
    assert compare(results).summary == mixed.summary
    with pytest.raises(ValueError, match="same scenarios with the same weights"):
        compare([results[0], MixedResult.from_results(results[1].scenario_results, {"near": 0.5, "far": 0.5})])
    with pytest.raises(ValueError, match="same scenarios with the same weights"):
        compare([results[0], results[1].scenario_results["far"]])


def test_files_contain_every_scenario_and_the_mixture(mixed, tmp_path):
    files = mixed.save(tmp_path, file_kinds="numbers")
    assert all(file.is_file() for file in files)
    record = json.loads((tmp_path / "summary.json").read_text())
    assert record["rows"] == mixed.summary
    assert record["sensor_model"] == {"high": "ideal", "low": "ideal"}
    assert {name: scenario["weight"] for name, scenario in record["scenarios"].items()} == mixed.weights
    for name, result in mixed.scenario_results.items():
        assert json.loads((tmp_path / name / "summary.json").read_text())["rows"] == result.summary
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["scenario"] for row in rows] == ["near"] * 2 + ["far"] * 2 + ["mixture"] * 2
    assert [float(row["radius_m"]) for row in rows[4:]] == [row["radius_m"] for row in mixed.summary]
    assert {(row["vehicle"], row["sensor_model"]) for row in rows} == {("box", "ideal")}
    assert [stem.split("/")[0] for stem, _ in mixed.plot_maps()][:: len(list(mixed.plot_maps())) - 1] == ["near", "far"]
    with pytest.raises(ValueError, match=r"scenario_results\[name\]"):
        _ = mixed.coverage


def test_each_scenario_has_its_own_checkpoint(mixed, yards, tmp_path):
    weights = {str(yards / "near.yaml"): 0.75, str(yards / "far.yaml"): 0.25}
    checkpoint = Checkpoint(tmp_path / "checkpoint.npz", keep=False)
    evaluate(RIGS, weights, checkpoint=checkpoint, **{**SMALL, "num_frames": 8})
    assert sorted(path.parent.name for path in tmp_path.glob("*/checkpoint.npz")) == ["far", "near"]
    longer = evaluate(RIGS, weights, checkpoint=checkpoint, **SMALL)
    assert longer.summary == mixed.summary


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        ("urban,highway,urban", "different names are needed .*; got urban, highway, urban"),
        (["near.yaml", "Near.yaml"], "got near, Near"),
        ("urbn=0.5,highway", "'urbn' is neither a .yaml file nor .* is 'urban' meant"),
        ("urban=-1,highway=2", "0 or more are needed, not all 0; got urban=-1, highway=2"),
        ("urban=0,highway=0", "not all 0"),
        ("urban=nan,highway=1", "not all 0"),
        ("urban=much,highway=1", "got urban=much, highway=1"),
        ({"urban": None, "highway": 1}, "weights"),
        ("urban=1,highway", "a weight for every scenario is needed, or none"),
        ("urban,", "no name"),
        ([], "no scenario"),
        (["urban", "nowhere"], "nowhere"),
        (["urban", "."], "a folder; evaluate a recording on its own"),
    ],
)
def test_invalid_mixtures_are_rejected_before_the_run(scenario, message, monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.mixed_result.measure_coverage", None)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        evaluate(RIGS[0], scenario, **SMALL)


def test_scenarios_with_different_regions_cannot_be_mixed(yards, monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.mixed_result.measure_coverage", None)
    tall = yards / "tall.yaml"
    tall.write_text(YARD.format(name="tall", wall_m=8, height_m=1.5).replace("[4, 2, 1.5]", "[6, 2, 1.5]"))
    near = str(yards / "near.yaml")
    with pytest.raises(ValueError, match="near, tall cannot be mixed: the regions around their ego vehicles differ"):
        evaluate(RIGS[0], [near, tall], num_frames=1, cell_m=1.0, num_rays=64)
    with pytest.raises(TypeError, match="got int"):
        evaluate(RIGS[0], [near, 3], **SMALL)
    with pytest.raises(ValueError, match="observers"):
        evaluate(RIGS[0], [near, "courtyard"], observers={"any": None}, **SMALL)
    with pytest.raises(ValueError, match="exclude each other"):
        evaluate(RIGS[0], [near, "courtyard"], frames="recording", **SMALL)
    with pytest.raises(ValueError, match="a single one is needed here; got near, courtyard"):
        _ = Settings(RIGS[0], [near, "courtyard"]).single_scenario


def test_missing_packages_are_reported_before_the_run(yards, monkeypatch):
    monkeypatch.setattr("torchcover.evaluation.mixed_result.measure_coverage", None)
    monkeypatch.setattr("torchcover.simulation.sumo.simulating.find_spec", lambda _: None)
    monkeypatch.setattr("torchcover.simulation.sumo.simulating.which", lambda _: None)
    with pytest.raises(ImportError, match=r"torchcover\[sumo\]"):
        evaluate(RIGS[0], [str(yards / "near.yaml"), "sumo_random"], **SMALL)


def test_file_names_with_commas_are_one_scenario(yards, monkeypatch):
    monkeypatch.chdir(yards)
    (yards / "a,b=c.yaml").write_text((yards / "near.yaml").read_text())
    assert Settings(RIGS[0], "a,b=c.yaml").mixture is None
