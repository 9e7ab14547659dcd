"""Metrics and published detectors rank the same placements, each truth with its own."""

import csv
import json

import numpy as np
import pytest

from torchcover import Region, evaluate
from torchcover.data import RegionsOfInterest
from torchcover.evaluation import agree, score_placements
from torchcover.evaluation.agreeing import NOTES, READINGS, TRUTHS
from torchcover.evaluation.placement_scores import circle
from torchcover.published import agreement_of
from torchcover.simulation import Rig

RIGS = {name: f"place3d2024_{name}" for name in ("center", "line", "pyramid")}


@pytest.fixture(scope="module")
def study():
    return agree(scenario="courtyard", metrics=["point_density"], steps=2)


def test_each_truth_ranks_its_own_eight_placements_in_both_readings_of_the_rolls(study):
    assert set(study.found) == {(truth, reading) for truth in TRUTHS.values() for reading in READINGS}
    for (truth, _), found in study.found.items():
        own = "segmentation" if truth == "mIoU" else "detection"
        assert len(found.judged.placements) == 8
        assert f"optimised_{own}" in found.judged.placements
        height = next(row for row in found.ranked if row.metric == "mean mounting height")
        assert np.isnan(next(row for row in found.ranked if row.metric == "rays").spearman.value)
        if truth in ("car mAP", "mIoU"):
            assert height.spearman.value == pytest.approx(0.93, abs=0.005)
    names = [row.metric for row in study.found["car mAP", "radians"].ranked]
    assert len(names) == len(set(names))
    assert sum(name.startswith("detection 0.4 m") for name in names) == 6


def test_a_reading_takes_its_own_rigs(study):
    scores = {one.name: one.gains for one in study.scores.rankings}["points"]
    rigs = study.scores.rigs
    # Where a LiDAR leans by 17 degrees, other points are missing than where it leans by a third of one.
    pyramid, radians, degrees = (
        scores[rigs.index(f"place3d2024_pyramid{ending}")] for ending in ("", "_roll", "_roll_degrees")
    )
    assert abs(pyramid - degrees) < abs(pyramid - radians)
    assert len(rigs) == 13
    found = study.found["car mAP", "degrees"]
    tilted = ("line_roll", "pyramid_roll", "optimised_detection")
    named = [f"place3d2024_{each}{'_degrees' * (each in tilted)}" for each in found.judged.placements]
    assert str(agreement_of(study.scores.of(named), found.judged).ranked) == str(found.ranked)
    assert str(study.found["car mAP", "radians"].ranked) != str(found.ranked)


def test_the_notes_say_what_the_data_say(study):
    heights, _, rolls = NOTES  # that another paper contradicts is held with its table: tests/test_place3d_example.py
    cars = study.found["car mAP", "radians"].judged
    mounts = [[sensor.mount.z_m for sensor in Rig.load(f"place3d2024_{name}").sensors] for name in cars.placements]
    means = np.round(np.mean(mounts, axis=1), 6)
    _, counts = np.unique(means, return_counts=True)
    start = f"{len(means)} placements, {counts.max()} of which have the same mean height and which have {len(counts)} "
    assert heights.startswith(start)
    assert "({:.2f} and {:.2f})".format(*cars.of(["pyramid_roll", "pyramid"]).mean) in rolls


def test_the_files_hold_every_number(study, tmp_path):
    files = study.save(tmp_path / "out")
    assert [path.name for path in files] == ["agreement.csv", "scores.csv", "agreement.json"]
    with files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == sum(len(found.ranked) for found in study.found.values())
    record = json.loads(files[2].read_text())
    assert [row["spearman"] for row in record["rows"]] == [
        float(row["spearman"]) if row["spearman"] else None for row in rows
    ]
    cars = record["truths"][0]
    assert (cars["truth"], cars["noise_ceiling"]) == ("car mAP", pytest.approx(0.85, abs=0.01))
    assert cars["placements"]["center"] == study.found["car mAP", "radians"].judged.mean[0]


def test_own_numbers_are_those_of_compare_over_both_measures():
    region = Region("front", (0.0, 20.0), (-10.0, 10.0))
    scores = score_placements(RIGS, "courtyard", region=region, metrics=[], steps=8, seed=3)
    asked = {
        "regions": {"front": {"x_m": (0, 20), "y_m": (-10, 10)}},
        "grid": {"x_m": (0, 20), "y_m": (-10, 10), "cell_m": 1.0},
    }
    result = evaluate(list(RIGS.values()), "courtyard", ask=RegionsOfInterest.model_validate(asked), steps=8, seed=3)
    found = {one.name: one for one in scores.rankings}
    for measure, words in (("area", "visible surface"), ("known", "known cells")):
        each = [
            [float(coverage.estimate(region, band, measure).value[1]) for coverage in result.coverages.values()]
            for band in ("ground", "obstacle")
        ]
        for name, expected in zip(("ground", "obstacle", "both bands"), (*each, np.mean(each, axis=0)), strict=True):
            one = found[f"detection 0.4 m, {name}, front, {words}"]
            np.testing.assert_array_equal(one.gains, expected)  # one number, not two of one name
            # Draws of worlds are around the number that all of them give.
            assert one.draws.shape[1] == 3
            np.testing.assert_allclose(one.draws.mean(axis=0), expected, atol=4 * one.draws.std(axis=0).max() + 1e-3)


def test_the_region_is_a_circle():
    area_m2 = sum(
        x * next_y - y * next_x
        for (x, y), (next_x, next_y) in zip(
            circle().corners_m, (*circle().corners_m[1:], circle().corners_m[0]), strict=True
        )
    )
    assert area_m2 / 2 == pytest.approx(np.pi * 50**2, rel=1e-3)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: agree("place3d2025"), "no published placements of this name; there is place3d2024"),
        (lambda: agree(metrics=["s_mag"]), "s_mag"),
        (lambda: score_placements({"a": "kitti", "b": "waymo"}), "three or more"),
    ],
)
def test_what_makes_no_sense_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()
