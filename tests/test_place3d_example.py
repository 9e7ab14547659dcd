"""Tests of `python -m examples.place3d`: occupancy boards, agreement with published results, and the page."""

import sys
from importlib import import_module
from itertools import product
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
def test_boards_of_published_rigs_have_known_shares(example, name, expected):
    boards = [example.boards.find_hit_cells(place3d(name), distance_m) for distance_m in example.boards.DISTANCES_M]
    # Which rig is better depends on the distance.
    assert [round(board.mean(), 4) for board in boards] == expected
    assert boards[0].shape == (10, 314)


def test_level_rays_hit_one_cell_each(example):
    around = beam(columns=16, z_m=1.1)
    assert example.boards.find_hit_cells([around], 10.0).mean() == pytest.approx(16 / 3140)
    again = around.model_copy(update={"name": "again"})
    assert example.boards.find_hit_cells([around, again], 10.0).sum() == 16
    assert not example.boards.find_hit_cells([beam(columns=16, z_m=2.1)], 10.0).any()
    assert not example.boards.find_hit_cells([beam(columns=16, z_m=1.1, range_m=9.0)], 10.0).any()


def test_board_includes_its_bottom_but_not_its_top(example):
    for z_m, hit in ((0.0, 1), (2.0, 0)):
        assert example.boards.find_hit_cells([beam(z_m=z_m)], 10.0).sum() == hit


def test_offset_sensor_hits_the_cylinder_ahead_of_it(example):
    # A ray ahead from y = 6 m hits the cylinder of 10 m at x = 8 m.
    hit = example.boards.find_hit_cells([beam(y_m=6.0, z_m=1.1)], 10.0)
    ((row, column),) = np.argwhere(hit)
    assert row == 5
    assert column == int((np.arctan2(6.0, 8.0) / (2 * np.pi) + 0.5) * 314)
    assert not example.boards.find_hit_cells([beam(y_m=6.0, z_m=1.1, range_m=7.9)], 10.0).any()


def test_flat_board_is_only_ahead(example):
    fan = Lidar(
        name="fan",
        mount=Pose(z_m=1.1),
        elevations_deg=(0.0,),
        horizontal_fov_deg=360.0,
        columns=360,
        max_range_m=100.0,
    )
    hit = example.boards.find_hit_cells([fan], 10.0, width_m=4.0)
    # Cells are at most 1.15 degrees wide and rays are 1 degree apart, so that each cell of the row is hit.
    assert (hit.mean(), hit.size) == (pytest.approx(1 / 10), 20 * 10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance_m": -1.0}, "distance_m: got -1.0; give a positive length"),
        ({"cell_m": 0.0}, "cell_m: got 0.0; give a positive length"),
        ({"cell_m": 0.3}, "height_m: 2 m is no multiple of the cell of 0.3 m"),
        ({"height_m": (2.0, 0.0)}, r"height_m: got \(2.0, 0.0\); give a lower and a higher bound"),
        ({"width_m": 0.3}, "width_m: 0.3 m is no multiple"),
        ({"sensors": [beam(x_m=12.0)]}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
        ({"sensors": [beam(x_m=12.0)], "width_m": 4.0}, "sensor 'beam' is 12 m away, behind the board at 10 m"),
    ],
)
def test_invalid_boards_are_refused(example, options, message):
    with pytest.raises(ValueError, match=message):
        example.boards.find_hit_cells(**{"sensors": [beam()], "distance_m": 10.0, **options})


# Tables I and II of Li et al., ICRA 2024, arXiv:2310.05245: `s_mig_1e3` is S-MIG of the LiDARs in thousands of nats,
# `map` the mAP in per cent of each fusion network and set of cameras, on the rigs `hu2022_NAME`.
def test_two_papers_contradict_each_other(example):
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
    # The metric of Li et al. ranks as their own detectors do, and each placement is a built-in rig.
    for category in ("car", "bicycle", "pedestrian"):
        assert compute_spearman(li["s_mig_1e3", category].mean, li["map", category].mean) == pytest.approx(1.0)
    for ratings in li.values():
        assert all(Rig.load(f"hu2022_{placement}").sensors for placement in ratings.placements)


@pytest.fixture(scope="module")
def study(example):
    return example.study.run_study(scenario="courtyard", metrics=["point_density"], num_frames=2)


def test_each_rating_has_both_readings_of_the_rolls(example, study):
    ratings, readings = example.study.RATINGS.values(), example.study.READINGS
    assert set(study.agreements) == set(product(ratings, readings))


def test_each_rating_ranks_its_own_eight_placements(study):
    for (rating, _), agreement in study.agreements.items():
        task = "segmentation" if rating == "mIoU" else "detection"
        assert len(agreement.ratings.placements) == 8
        assert f"optimised_{task}" in agreement.ratings.placements
        spearman = {row.metric: row.spearman.value for row in agreement.correlations}
        assert np.isnan(spearman["rays"])
        if rating in ("car mAP", "mIoU"):
            assert spearman["mean mounting height"] == pytest.approx(0.93, abs=0.005)
    names = [row.metric for row in study.agreements["car mAP", "radians"].correlations]
    assert len(names) == len(set(names))
    assert sum(name.startswith("detection 0.4 m") for name in names) == 6


def test_each_reading_uses_its_own_rigs(study):
    scores = {ranking.name: ranking.scores for ranking in study.scores.rankings}["points"]
    rigs = study.scores.rigs
    assert len(rigs) == 13
    # A roll of 17 degrees changes the number of points more than a roll of 0.3 degrees.
    pyramid, radians, degrees = (
        scores[rigs.index(f"place3d2024_pyramid{ending}")] for ending in ("", "_roll", "_roll_degrees")
    )
    assert abs(pyramid - degrees) < abs(pyramid - radians)
    agreement = study.agreements["car mAP", "degrees"]
    tilted = ("line_roll", "pyramid_roll", "optimised_detection")
    names = [f"place3d2024_{name}{'_degrees' * (name in tilted)}" for name in agreement.ratings.placements]
    expected = correlate_rankings(study.scores.select(names), agreement.ratings)
    assert str(expected.correlations) == str(agreement.correlations)
    assert str(study.agreements["car mAP", "radians"].correlations) != str(agreement.correlations)


def test_notes_agree_with_the_data(example, study):
    heights, _, rolls = example.study.NOTES
    cars = study.agreements["car mAP", "radians"].ratings
    mounts_m = []
    for name in cars.placements:
        mounts_m.append([sensor.mount.z_m for sensor in Rig.load(f"place3d2024_{name}").sensors])
    means_m = np.round(np.mean(mounts_m, axis=1), 6)
    _, counts = np.unique(means_m, return_counts=True)
    start = (
        f"{len(means_m)} placements, {counts.max()} of which have the same mean height and which have {len(counts)} "
    )
    assert heights.startswith(start)
    assert "({:.2f} and {:.2f})".format(*cars.select(["pyramid_roll", "pyramid"]).mean) in rolls


def test_small_run_writes_a_page_with_boards(example, tmp_path, monkeypatch, capsys):
    arguments = ["place3d", "--scenario", "courtyard", "--metrics", "point_density", "--num-frames", "1"]
    monkeypatch.setattr(sys, "argv", [*arguments, "--out", str(tmp_path)])
    example.main.main()
    page = (tmp_path / "agreement.md").read_text()
    assert page in capsys.readouterr().out
    for text in ("## car mAP", "## mIoU", "agree with each other by 0.85", "choice of the best", "| points *"):
        assert text in page
    # Boards do not depend on scenes: their correlations are known, with opposite signs at 10 m and at 50 m.
    assert "| lob_10m * | -0.64 [" in page
    assert "| lob_50m * | +0.90 [" in page
    assert [path.name for path in tmp_path.iterdir()] == ["agreement.md"]
