"""Reports: findings, page and files agree with their evaluations."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from torchcover.encounters import EncounterSet
from torchcover.evaluation import Requirements, report
from torchcover.evaluation.target_page import TargetPageParams, build_target_plan, summarize_target_maps
from torchcover.report import render_page
from torchcover.simulation import Rig

HTML_NAME = "<b>&amp;roof</b>"
MAX_DISTANCE_M = TargetPageParams().max_distance_m


def make_lidar(name, x_m, z_m=0.8):
    mount = {"x_m": x_m, "z_m": z_m}
    return {"type": "lidar", "name": name, "model": "velodyne_vlp16", "mount": mount}


ONE = Rig.model_validate({"name": "one", "sensors": [make_lidar("front", 2.6)]})
TWO = Rig.model_validate({"name": HTML_NAME, "sensors": [make_lidar("front", 2.6), make_lidar("rear", -2.6)]})
CROSSING = {
    "name": "a",
    "ego": {"speed_kmh": 30},
    "road_user": {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2},
}
REQUIREMENTS = {
    "name": "needs",
    "requirements": [{"target": "child", "positions": {"points_m": [[5.0, 0.0]]}, "points": 5}],
}


@pytest.fixture(scope="module")
def rig_report():
    crossing = EncounterSet.model_validate({"name": "one", "encounters": [CROSSING]})
    requirements = Requirements.model_validate(REQUIREMENTS)
    return report([ONE, TWO], "courtyard", num_frames=8, encounters=crossing, requirements=requirements, num_workers=0)


def test_first_finding_is_the_detected_share_of_positions(rig_report):
    words = rig_report.verdict[0]
    assert words.startswith("A child of 1.10 m is detected (5 points or more) at ")
    for rig, target_map in rig_report.targets.items():
        near = target_map.free_mask & (target_map.distance_m <= MAX_DISTANCE_M)
        share = (near & (target_map.min_points >= target_map.detection_points)).sum() / near.sum()
        assert f"at {100 * share:.0f} % " in words.partition(rig)[0]
    assert words.index(HTML_NAME) < words.index("one")  # the rig with the highest share comes first


def test_failure_loses_positions_of_one_sensor_only(rig_report):
    target_map = rig_report.targets[HTML_NAME]
    for k, (sensor, lost_m2) in enumerate(target_map.compute_failure_effects_m2(MAX_DISTANCE_M).items()):
        other_points = np.delete(target_map.sensor_points, k, axis=0).sum(axis=0)
        lost = (
            target_map.free_mask
            & (target_map.distance_m <= MAX_DISTANCE_M)
            & (target_map.points >= target_map.detection_points)
            & (other_points < target_map.detection_points)
        )
        assert target_map.sensor_names[k] == sensor
        assert lost_m2 == pytest.approx(lost.sum() * 0.04)
    worst = max(target_map.compute_failure_effects_m2(MAX_DISTANCE_M).values())
    (words,) = [sentence for sentence in rig_report.verdict if sentence.startswith(f"{HTML_NAME} loses most without ")]
    assert f"{worst:.1f} m² more" in words
    assert "one has one sensor, so it detects nothing if this sensor fails." in rig_report.verdict


def test_different_sensor_models_are_reported(rig_report):
    source = {**rig_report.result.source, "sensor_model": {"one": "real", "two": "ideal"}}
    mixed = replace(rig_report, result=replace(rig_report.result, source=source))
    assert "Sensor models differ: one real, two ideal; differences between rigs include their effect." in mixed.verdict
    assert not any("Sensor model" in sentence for sentence in rig_report.verdict)


def test_sensors_with_similar_losses_are_named_together():
    rig = Rig.model_validate({"name": "sides", "sensors": [
        {**make_lidar(side, 0.0), "mount": {"y_m": y_m, "z_m": 1.0}} for side, y_m in (("left", 1.1), ("right", -1.1))
    ]})  # fmt: skip
    words = report(rig, "courtyard", num_frames=8, num_workers=0).verdict[-1]
    assert "loses most without left or right: up to" in words


def test_map_contains_detecting_sensors_per_position(rig_report):
    for target_map in rig_report.targets.values():
        plan = build_target_plan(target_map)
        assert ((plan.sensor_counts == -1) == ~target_map.free_mask).all()
        assert ((plan.sensor_counts > 0) == target_map.detected_mask).all()
        assert ((plan.sensor_counts > 1) == (target_map.detected_mask & (target_map.min_sensors >= 2))).all()
        near = target_map.free_mask & (target_map.distance_m <= MAX_DISTANCE_M)
        assert f"{(near & (plan.sensor_counts == 0)).sum():,} of {near.sum():,} positions" in plan.title


def test_encounters_and_requirements_are_reported(rig_report):
    assert "Always detected in time: " in " ".join(rig_report.verdict)
    assert rig_report.verdict[-1].startswith("Of the 1 bounds of needs: one meets 1; ")


def test_page_starts_with_findings_and_escapes_names(rig_report, tmp_path):
    text = render_page(rig_report.page)
    assert HTML_NAME not in text
    assert text.index("A child of 1.10 m is detected") < text.index("<svg") < text.index('id="maps"')
    assert text.count('class="plan"') == 2
    assert len(text) < 500_000
    written = {path.relative_to(tmp_path).as_posix() for path in rig_report.save(tmp_path)}
    assert {"report.html", "report.md", "summary.json", "junit.xml", "encounters.csv", "targets/one.npz"} <= written
    record = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert record["verdict"] == list(rig_report.verdict)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").startswith("**A child of 1.10 m is detected")


def test_rectangles_of_the_map_cover_its_cells(rig_report):
    """Rectangles of one color have the area of its cells."""
    target_map = rig_report.targets["one"]
    text = render_page(rig_report.page)
    for number in range(2):
        path_data = re.search(rf'<path class="seen{number}" d="([^"]*)"', text)[1]
        m2 = sum(float(w) * float(h) for w, h in re.findall(r"h(-?[\d.]+)v([\d.]+)", path_data))
        assert m2 == pytest.approx((build_target_plan(target_map).sensor_counts == number).sum() * 0.04)


def test_budget_ends_the_traffic_after_8_blocks():
    rig_report = report(ONE, "courtyard", num_frames=64, budget_s=0.01, num_workers=0)
    assert rig_report.result.table.first_conditions.counts["num_frames"] == 8
    assert rig_report.verdict[-1] == "The time budget ended after 8 of 64 frames of traffic."
    assert not rig_report.record["complete"]


def test_too_few_frames_report_the_needed_number():
    words = "4 frames form 4 blocks, 11 are needed (about 11 frames; `--num-frames`)."
    assert f"Not enough frames for ranges: {words}" in report(ONE, "courtyard", num_frames=4, num_workers=0).verdict


def test_no_free_position_gives_an_unknown_share(rig_report):
    target_map = rig_report.targets["one"]
    nowhere = replace(target_map, state=np.full_like(target_map.state, 2))
    assert math.isnan(nowhere.compute_detected_share(MAX_DISTANCE_M))
    assert summarize_target_maps({"one": nowhere}) == (
        "No position within 2 m is free, so detection there is unknown.",
    )
    assert "Not detected at 0 of 0 positions" in build_target_plan(nowhere).title


@pytest.mark.parametrize(("arguments", "message"), [
    ({"rigs": []}, "1 to 8 rigs fit on a page; got 0"),
    ({"rigs": [ONE] * 1000}, "1 to 8 rigs fit on a page; got 1000"),
    ({"rigs": ONE, "budget_s": 0.0}, "seconds above 0 are needed; got 0.0"),
    ({"rigs": ONE, "scenario": "urban,highway"}, "a single scenario is needed"),
])  # fmt: skip
def test_report_rejects_invalid_arguments(arguments, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        report(**arguments)


def test_rig_far_above_detects_no_position():
    high = Rig.model_validate({"name": "high", "sensors": [make_lidar("mast", 0.0, 10.0)]})
    assert (
        report(high, "courtyard", num_frames=8, num_workers=0)
        .verdict[0]
        .endswith("detected (5 points or more) at 0 % of the positions within 2 m by high.")
    )
