"""A report says what its parts say, and no more."""

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

NASTY = "<b>&amp;roof</b>"
MAX_DISTANCE_M = TargetPageParams().max_distance_m


def lidar(name, x_m, z_m=0.8):
    mount = {"x_m": x_m, "z_m": z_m}
    return {"type": "lidar", "name": name, "model": "velodyne_vlp16", "mount": mount}


ONE = Rig.model_validate({"name": "one", "sensors": [lidar("front", 2.6)]})
TWO = Rig.model_validate({"name": NASTY, "sensors": [lidar("front", 2.6), lidar("rear", -2.6)]})
CROSSING = {
    "name": "a",
    "ego": {"speed_kmh": 30},
    "road_user": {"body": "adult", "speed_kmh": 5, "approach_distance_m": 2},
}
NEEDS = {"name": "needs", "requirements": [{"target": "child", "positions": {"points_m": [[5.0, 0.0]]}, "points": 5}]}


@pytest.fixture(scope="module")
def found():
    crossing = EncounterSet.model_validate({"name": "one", "encounters": [CROSSING]})
    needs = Requirements.model_validate(NEEDS)
    return report([ONE, TWO], "courtyard", num_frames=8, encounters=crossing, requirements=needs, num_workers=0)


def test_first_finding_is_the_detected_share_of_positions(found):
    words = found.verdict[0]
    assert words.startswith("A child of 1.10 m is detected (5 points or more) at ")
    for rig, seen in found.targets.items():
        near = seen.free_mask & (seen.distance_m <= MAX_DISTANCE_M)
        share = (near & (seen.min_points >= seen.detection_points)).sum() / near.sum()
        assert f"at {100 * share:.0f} % " in words.partition(rig)[0]
    assert words.index(NASTY) < words.index("one")  # who sees most comes first


def test_failure_loses_positions_of_one_sensor_only(found):
    seen = found.targets[NASTY]
    for k, (sensor, lost_m2) in enumerate(seen.compute_failure_effects_m2(MAX_DISTANCE_M).items()):
        others = np.delete(seen.sensor_points, k, axis=0).sum(axis=0)
        lost = seen.free_mask & (seen.distance_m <= MAX_DISTANCE_M) & (seen.points >= seen.detection_points) & (others < seen.detection_points)
        assert seen.sensor_names[k] == sensor
        assert lost_m2 == pytest.approx(lost.sum() * 0.04)
    worst = max(seen.compute_failure_effects_m2(MAX_DISTANCE_M).values())
    (words,) = [one for one in found.verdict if one.startswith(f"{NASTY} loses most without ")]
    assert f"{worst:.1f} m² more" in words
    assert "one has one sensor, so it detects nothing if this sensor fails." in found.verdict


def test_different_sensor_models_are_reported(found):
    source = {**found.result.source, "sensor_model": {"one": "real", "two": "ideal"}}
    mixed = replace(found, result=replace(found.result, source=source))
    assert "Sensor models differ: one real, two ideal; differences between rigs include their effect." in mixed.verdict
    assert not any("Sensor model" in sentence for sentence in found.verdict)


def test_sensors_with_similar_losses_are_named_together():
    rig = Rig.model_validate({"name": "sides", "sensors": [
        {**lidar(side, 0.0), "mount": {"y_m": y_m, "z_m": 1.0}} for side, y_m in (("left", 1.1), ("right", -1.1))
    ]})  # fmt: skip
    words = report(rig, "courtyard", num_frames=8, num_workers=0).verdict[-1]
    assert "loses most without left or right: up to" in words


def test_map_contains_detecting_sensors_per_position(found):
    for seen in found.targets.values():
        plan = build_target_plan(seen)
        assert ((plan.sensor_counts == -1) == ~seen.free_mask).all()
        assert ((plan.sensor_counts > 0) == seen.detected_mask).all()
        assert ((plan.sensor_counts > 1) == (seen.detected_mask & (seen.min_sensors >= 2))).all()
        near = seen.free_mask & (seen.distance_m <= MAX_DISTANCE_M)
        assert f"{(near & (plan.sensor_counts == 0)).sum():,} of {near.sum():,} positions" in plan.title


def test_encounters_and_requirements_are_reported(found):
    assert "Always detected in time: " in " ".join(found.verdict)
    assert found.verdict[-1].startswith("Of the 1 bounds of needs: one meets 1; ")


def test_page_starts_with_findings_and_escapes_names(found, tmp_path):
    text = render_page(found.page)
    assert NASTY not in text
    assert text.index("A child of 1.10 m is detected") < text.index("<svg") < text.index('id="maps"')
    assert text.count('class="plan"') == 2
    assert len(text) < 500_000
    written = {path.relative_to(tmp_path).as_posix() for path in found.save(tmp_path)}
    assert {"report.html", "report.md", "summary.json", "junit.xml", "encounters.csv", "targets/one.npz"} <= written
    record = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert record["verdict"] == list(found.verdict)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").startswith("**A child of 1.10 m is detected")


def test_rectangles_of_the_map_cover_its_cells(found):
    """Rectangles of a colour have the area of its cells."""
    seen = found.targets["one"]
    text = render_page(found.page)
    for number in range(2):
        drawn = re.search(rf'<path class="seen{number}" d="([^"]*)"', text)[1]
        m2 = sum(float(w) * float(h) for w, h in re.findall(r"h(-?[\d.]+)v([\d.]+)", drawn))
        assert m2 == pytest.approx((build_target_plan(seen).sensor_counts == number).sum() * 0.04)


def test_budget_ends_the_traffic_after_8_blocks():
    found = report(ONE, "courtyard", num_frames=64, budget_s=0.01, num_workers=0)
    assert found.result.table.first_conditions.counts["num_frames"] == 8
    assert found.verdict[-1] == "The time budget ended after 8 of 64 frames of traffic."
    assert not found.record["complete"]


def test_too_few_frames_report_the_needed_number():
    words = "4 frames form 4 blocks, 11 are needed (about 11 frames; `--num-frames`)."
    assert f"Not enough frames for ranges: {words}" in report(ONE, "courtyard", num_frames=4, num_workers=0).verdict


def test_no_free_position_gives_an_unknown_share(found):

    seen = found.targets["one"]
    nowhere = replace(seen, state=np.full_like(seen.state, 2))
    assert math.isnan(nowhere.compute_detected_share(MAX_DISTANCE_M))
    assert summarize_target_maps({"one": nowhere}) == ("No position within 2 m is free, so detection there is unknown.",)
    assert "Not detected at 0 of 0 positions" in build_target_plan(nowhere).title


@pytest.mark.parametrize(("given", "words"), [
    ({"rigs": []}, "1 to 8 rigs fit on a page; got 0"),
    ({"rigs": [ONE] * 1000}, "1 to 8 rigs fit on a page; got 1000"),
    ({"rigs": ONE, "budget_s": 0.0}, "seconds above 0 are needed; got 0.0"),
    ({"rigs": ONE, "scenario": "urban,highway"}, "a single scenario is needed"),
])  # fmt: skip
def test_report_rejects_invalid_arguments(given, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        report(**given)


def test_rig_far_above_detects_no_position():
    high = Rig.model_validate({"name": "high", "sensors": [lidar("mast", 0.0, 10.0)]})
    assert (
        report(high, "courtyard", num_frames=8, num_workers=0)
        .verdict[0]
        .endswith("detected (5 points or more) at 0 % of the positions within 2 m by high.")
    )
