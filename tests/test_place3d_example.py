"""`python -m examples.place3d`: boards whose values were worked out before, the page, and what contradicts it."""

import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.contrib.voxel_frames import beam, place3d
from torchcover.contrib import correlate_rankings, read_results
from torchcover.contrib.ranks import compute_spearman
from torchcover.simulation import Lidar, Pose, Rig, get_builtin_folder

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        names = {"boards": "boards", "study": "study", "main": "__main__"}
        yield SimpleNamespace(**{key: import_module(f"examples.place3d.{name}") for key, name in names.items()})


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("center", [0.7962, 0.3981, 0.2389, 0.1392, 0.0637]),
        ("line", [0.9083, 0.3143, 0.1295, 0.0489, 0.0482]),
    ],
)
def test_the_published_rigs_have_the_shares_that_were_worked_out_before(example, name, expected):
    hit = [example.boards.cells_hit(place3d(name), distance_m) for distance_m in example.boards.DISTANCES_M]
    # The distance decides which rig is better.
    assert [round(one.mean(), 4) for one in hit] == expected
    assert hit[0].shape == (10, 314)


def test_level_rays_hit_a_cell_each_and_the_same_ray_no_other(example):
    around = beam(columns=16, z_m=1.1)
    assert example.boards.cells_hit([around], 10.0).mean() == pytest.approx(16 / 3140)
    again = around.model_copy(update={"name": "again"})
    assert example.boards.cells_hit([around, again], 10.0).sum() == 16
    assert not example.boards.cells_hit([beam(columns=16, z_m=2.1)], 10.0).any()
    assert not example.boards.cells_hit([beam(columns=16, z_m=1.1, range_m=9.0)], 10.0).any()


def test_the_bottom_is_in_the_board_and_the_top_is_not(example):
    for z_m, hit in ((0.0, 1), (2.0, 0)):
        assert example.boards.cells_hit([beam(z_m=z_m)], 10.0).sum() == hit


def test_a_sensor_off_the_middle_hits_the_cylinder_where_it_is(example):
    # Ahead from y = 6 m, the cylinder of 10 m is met at x = 8 m.
    hit = example.boards.cells_hit([beam(y_m=6.0, z_m=1.1)], 10.0)
    ((row, column),) = np.argwhere(hit)
    assert row == 5
    assert column == int((np.arctan2(6.0, 8.0) / (2 * np.pi) + 0.5) * 314)
    assert not example.boards.cells_hit([beam(y_m=6.0, z_m=1.1, range_m=7.9)], 10.0).any()


def test_a_flat_board_is_hit_ahead_only(example):
    fan = Lidar(
        name="fan",
        mount=Pose(z_m=1.1),
        elevations_deg=(0.0,),
        horizontal_fov_deg=360.0,
        columns=360,
        max_range_m=100.0,
    )
    hit = example.boards.cells_hit([fan], 10.0, width_m=4.0)
    # Cells are 1.15 degrees wide in the middle, the rays a degree: none is missed in the one row.
    assert (hit.mean(), hit.size) == (pytest.approx(1 / 10), 20 * 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance_m": -1.0}, "distance_m: a positive length"),
        ({"cell_m": 0.0}, "cell_m: a positive length"),
        ({"cell_m": 0.3}, "height_m: 2 m is not a multiple of the cell of 0.3 m"),
        ({"height_m": (2.0, 0.0)}, "height_m: a lower and a higher bound"),
        ({"width_m": 0.3}, "width_m: 0.3 m is not a multiple"),
        ({"sensors": [beam(x_m=12.0)]}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
        ({"sensors": [beam(x_m=12.0)], "width_m": 4.0}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
    ],
)
def test_boards_that_cannot_be_are_refused(example, options, message):
    with pytest.raises(ValueError, match=message):
        example.boards.cells_hit(**{"sensors": [beam()], "distance_m": 10.0, **options})


# Tables I and II of Li et al., ICRA 2024, arXiv:2310.05245: `s_mig_1e3` is S-MIG of the LiDARs in thousands of nats,
# `map` the mAP in per cent of each fusion network and set of cameras, on the rigs `hu2022_NAME`.
def test_two_papers_contradict_each_other_on_the_placements_that_both_have(example):
    li = read_results(ROOT / "examples" / "place3d" / "li_2024.csv")
    cars = li["map", "car"]
    place3d = read_results(get_builtin_folder("published") / "place3d_2024.csv")["map", "car"]
    both = [name for name in place3d.placements if name in cars.placements]
    assert len(both) == 4
    rho = float(compute_spearman(place3d.select(both).mean, cars.select(both).mean))
    assert (
        f"the same four placements ({', '.join(both)}) with a Spearman correlation of {rho:.2f}"
        in example.study.NOTES[1]
    )
    # The metric of Li et al. ranks as their own detectors do, and every placement is a rig.
    for category in ("car", "bicycle", "pedestrian"):
        assert compute_spearman(li["s_mig_1e3", category].mean, li["map", category].mean) == pytest.approx(1.0)
    for judged in li.values():
        assert all(Rig.load(f"hu2022_{placement}").sensors for placement in judged.placements)


@pytest.fixture(scope="module")
def study(example):
    return example.study.agree(scenario="courtyard", metrics=["point_density"], steps=2)


def test_each_truth_ranks_its_own_eight_placements_in_both_readings_of_the_rolls(example, study):
    assert set(study.found) == {
        (truth, reading) for truth in example.study.TRUTHS.values() for reading in example.study.READINGS
    }
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
    assert str(correlate_rankings(study.scores.of(named), found.judged).correlations) == str(found.ranked)
    assert str(study.found["car mAP", "radians"].ranked) != str(found.ranked)


def test_the_notes_say_what_the_data_say(example, study):
    heights, _, rolls = example.study.NOTES
    cars = study.found["car mAP", "radians"].judged
    mounts = [[sensor.mount.z_m for sensor in Rig.load(f"place3d2024_{name}").sensors] for name in cars.placements]
    means = np.round(np.mean(mounts, axis=1), 6)
    _, counts = np.unique(means, return_counts=True)
    start = f"{len(means)} placements, {counts.max()} of which have the same mean height and which have {len(counts)} "
    assert heights.startswith(start)
    assert "({:.2f} and {:.2f})".format(*cars.of(["pyramid_roll", "pyramid"]).mean) in rolls


def test_a_small_run_is_a_page_with_boards_among_the_metrics(example, tmp_path, monkeypatch, capsys):
    arguments = ["place3d", "--scenario", "courtyard", "--metrics", "point_density", "--num-frames", "1"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--out", str(tmp_path)])
    example.main.main()
    page = (tmp_path / "agreement.md").read_text()
    assert page in capsys.readouterr().out
    for words in ("## car mAP", "## mIoU", "agree with each other by 0.85", "as the best of so many", "| points *"):
        assert words in page
    # Boards depend on no world: these are the ranks that the example prints, other signs at 10 m and at 50 m.
    assert "| lob_10m * | -0.64 [" in page
    assert "| lob_50m * | +0.90 [" in page
    assert [path.name for path in tmp_path.iterdir()] == ["agreement.md"]
