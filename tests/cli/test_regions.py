"""Regions, height bands, the grid and redundancy on the command line."""

import csv
import json
import re

import numpy as np
import pytest

import torchcover as package
from torchcover import Coverage, Region, RegionsOfInterest

SMALL = ["--num-frames", 9, "--set", "cell_m=0.5", "--thresholds-m", 2, "--num-rays", 1024]
REGIONS = "{behind: {x_m: [-6, -2], y_m: [-2, 2]}, ahead: {x_m: [2, 6], y_m: [-2, 2]}}"
HEIGHTS = "{dog: [-0.1, 0.5], child: [-0.1, 1.1]}"
GRID = "{x_m: [-10, 10], y_m: [-10, 10]}"


def write_regions(folder, regions=REGIONS, heights=HEIGHTS, grid=GRID):
    path = folder / "regions.yaml"
    path.write_text(f"regions: {regions}\nheights: {heights}\ngrid: {grid}\n")
    return ["--regions", path]


@pytest.fixture
def evaluate(torchcover, scenes):
    def run(*options, rig="both", out="out"):
        scenario = ["--scenario", scenes / "yard.yaml", "--out", scenes / out]
        return torchcover("evaluate", scenes / f"{rig}.yaml", *scenario, *SMALL, *options)

    return run


def rows_of(folder):
    with (folder / "summary.csv").open() as file:
        return list(csv.DictReader(file))


def test_regions_agree_between_options_file_and_python(evaluate, scenes):
    code, printed, _ = evaluate(*write_regions(scenes))
    assert code == 0
    assert "dog -0.1 to 0.5 m above ground, child -0.1 to 1.1 m above ground" in " ".join(printed.split())
    rows = rows_of(scenes / "out")
    assert [(row["region"], row["band"]) for row in rows] == [
        (region, height) for region in ("behind", "ahead") for height in ("dog", "child")
    ]
    assert float(rows[0]["observed_share"]) == 1.0  # the reference is aimed at it
    regions = write_regions(scenes, regions="{road_user: {x_m: [2, 6], y_m: [-2, 2]}}")
    options = ("--region", "behind:-6,-2,-2,2", "--region", "ahead:2,6,-2,2")
    assert evaluate(*regions, *options, out="file")[0] == 0
    assert (scenes / "file" / "summary.csv").read_text() == (scenes / "out" / "summary.csv").read_text()
    interest = RegionsOfInterest(
        regions={"behind": {"x_m": (-6.0, -2.0), "y_m": (-2.0, 2.0)}, "ahead": {"x_m": (2.0, 6.0), "y_m": (-2.0, 2.0)}},
        heights={"dog": (-0.1, 0.5), "child": (-0.1, 1.1)},
        grid={"x_m": (-10.0, 10.0), "y_m": (-10.0, 10.0)},
    )
    settings = {"num_frames": 9, "cell_m": 0.5, "thresholds_m": 2.0, "num_rays": 1024}
    result = package.evaluate(scenes / "both.yaml", scenes / "yard.yaml", regions=interest, **settings)
    loaded = Coverage.load(scenes / "out" / "coverage.npz")
    np.testing.assert_array_equal(result.coverage.radius, loaded.radius)
    assert loaded.regions[0] == Region("behind", (-6.0, -2.0), (-2.0, 2.0))
    assert str(loaded.summary()) == str(result.coverage.summary())
    record = json.loads((scenes / "out" / "summary.json").read_text())
    assert record["regions"]["behind"] == {"x_m": [-6.0, -2.0], "y_m": [-2.0, 2.0], "corners_m": []}


def test_region_behind_depends_on_the_rear_sensor(evaluate, torchcover, scenes):
    code, printed, _ = evaluate(*write_regions(scenes), "--redundancy")
    assert code == 0
    assert "Single point of failure: " in printed
    by_place = {(row["region"], row["band"]): row for row in rows_of(scenes / "out")}
    for region, sensor, other_sensor in (("behind", "rear", "front"), ("ahead", "front", "rear")):
        row = by_place[region, "dog"]
        assert row["most_critical_sensor"] == sensor
        assert float(row[f"detection_2m_without_{sensor}_change"]) < -0.2
        assert float(row[f"detection_2m_without_{other_sensor}_change"]) == 0.0
        assert float(row["sensors_2m"]) == pytest.approx(float(row["detection_2m"]))  # never both
    # Without the sensor behind it is the rig without it, in the same frames.
    assert evaluate(*write_regions(scenes), rig="low", out="alone")[0] == 0
    for row in rows_of(scenes / "alone"):
        row_of_both = by_place[row["region"], row["band"]]
        for key in ("radius_m", "detection_2m"):
            assert float(row_of_both[f"{key}_without_rear"]) == pytest.approx(float(row[key]), rel=1e-12)
    files = [scenes / name / "coverage.npz" for name in ("out", "alone")]
    code, printed, _ = torchcover("compare", *files, "--out", scenes / "compared")
    assert code == 0
    assert "behind" in printed
    assert "out: change of detection" in " ".join(printed.split())


def test_resume_requires_the_same_regions_and_grid(evaluate, scenes):
    regions = [*write_regions(scenes), "--redundancy"]
    assert evaluate(*regions)[0] == 0
    assert evaluate(*regions, "--resume")[0] == 0
    for changed, options, what in (
        ({}, [], "redundancy"),
        ({"regions": "{ahead: {x_m: [2, 6], y_m: [-2, 2]}}"}, ["--redundancy"], "regions"),
        ({"heights": "{dog: [0, 0.5]}"}, ["--redundancy"], "heights"),
        ({"grid": "{x_m: [-9, 9], y_m: [-9, 9]}"}, ["--redundancy"], "grid"),
    ):
        code, _, stderr = evaluate(*write_regions(scenes, **changed), *options, "--resume")
        assert code == 2
        assert what in stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--region", "1,2,3,4"], "--region 1,2,3,4: NAME:x0,x1,y0,y1 is needed"),
        (["--region", "a:1,2,3"], "--region a:1,2,3: 4 numbers x0,x1,y0,y1 in meters are needed"),
        (["--region", "a:1,2,3,x"], "--region a:1,2,3,x: 4 numbers"),
        (["--region", "a:2,1,0,1"], "regions.a.x_m: the lower bound must be below the upper one; got 2 to 1 m"),
        (["--region", "a:nan,1,0,1"], "regions.a.x_m.0: a finite number"),
        (["--region", "a:0,1,0,1", "--region", "a:0,2,0,1"], "the name 'a' is repeated"),
        (["--region", "a:0,0.1,0,1"], "region 'a' holds no cell center; use smaller cells than 0.5 m"),
        (["--regions", "nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_invalid_region_is_one_line(evaluate, options, message):
    code, _, stderr = evaluate(*options)
    assert code == 2
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"regions": "{a: {x_m: [0, 50], y_m: [0, 1]}}"}, "region 'a' spans x = 0 to 50 m, beyond the grid's"),
        ({"heights": "{a: [1, 1]}"}, "heights.a: the lower bound must be below the upper one; got 1 to 1 m"),
        ({"heights": "{a: [0, 1], a: [0, 2]}"}, "'a'"),
        ({"grid": "{x_m: [-2000, 2000], y_m: [-2000, 2000]}"}, "128,000,000 cells, over 100,000,000: use larger cells"),
    ],
)
def test_invalid_regions_file_is_rejected(evaluate, scenes, changed, message):
    code, _, stderr = evaluate(*write_regions(scenes, **changed))
    assert (code, message in stderr) == (2, True)


def test_maps_beyond_memory_are_rejected_before_the_run(evaluate, monkeypatch):
    monkeypatch.setattr("torchcover.simulation.memory.find_memory_limit_bytes", lambda: 1e6)
    code, _, stderr = evaluate()
    assert code == 2
    assert re.search(r"maps of [\d,]+ cells: .* of memory are needed", stderr)


@pytest.mark.filterwarnings("always:region:UserWarning")
def test_region_inside_the_vehicle_warns_and_is_unknown(evaluate, scenes):
    code, _, stderr = evaluate("--region", "hold:-1,1,-0.5,0.5")
    assert code == 0
    assert "warning: region 'hold' lies within the vehicle (x = -2 to 2 m, y = -1 to 1 m)" in stderr
    assert [(row["detection_2m"], row["observed_cells"]) for row in rows_of(scenes / "out")] == [("", "0")] * 2


def test_unobserved_region_has_unknown_single_point_of_failure(evaluate, scenes):
    regions = write_regions(scenes, regions="{sky: {x_m: [2, 6], y_m: [-2, 2]}}", heights="{sky: [50, 60]}")
    code, printed, _ = evaluate(*regions, "--redundancy")
    assert code == 0
    assert "Single point of failure unknown: no surface in the regions was observed." in " ".join(printed.split())
    assert "No single point of failure" not in printed


def test_undetected_region_has_unknown_single_point_of_failure(torchcover, scenes):
    scene = ("--scenario", scenes / "yard.yaml", "--out", scenes / "out", "--num-frames", 2, "--num-rays", 1024)
    options = ("--set", "cell_m=0.5", "--region", "ahead:2,6,-2,2", "--thresholds-m", 2e-3, "--redundancy")
    code, printed, _ = torchcover("evaluate", scenes / "both.yaml", *scene, *options)
    sentence = "Single point of failure unknown: nothing in the regions is detected with all sensors."
    assert (code, sentence in " ".join(printed.split())) == (0, True)
    assert "No single point of failure" not in printed


def test_band_frames_agree_on_level_ground(torchcover, evaluate, scenes):
    rows = {}
    spans = {"ground": ("-0.5 to 0.5 m above ground",), "vehicle": ("z -0.5 to 0.5 m", "--set", "band_frame=vehicle")}
    for band_frame, (words, *options) in spans.items():
        code, printed, _ = evaluate(*options, "--num-rays", 16_384, out=band_frame)
        assert code == 0
        assert f"cells of 0.5 m; ground {words}" in " ".join(printed.split())
        assert json.loads((scenes / band_frame / "summary.json").read_text())["band_frame"] == band_frame
        assert Coverage.load(scenes / band_frame / "coverage.npz").band_frame == band_frame
        rows[band_frame] = [float(row["detection_2m"] or "nan") for row in rows_of(scenes / band_frame)]
    np.testing.assert_allclose(rows["ground"], rows["vehicle"], atol=0.03)


def test_paper_reference_has_bands_of_the_vehicle_frame(evaluate, scenes):
    assert evaluate("--reference", "paper")[0] == 0
    assert json.loads((scenes / "out" / "summary.json").read_text())["band_frame"] == "vehicle"
    code, _, errors = evaluate("--reference", "paper", "--set", "band_frame=ground")
    assert (code, len(errors.strip().splitlines())) == (2, 1)
    assert "band_frame ground: the paper reference has height bands of the vehicle frame; omit it" in errors


def test_recording_keeps_heights_above_ground(torchcover, scenes):
    recorded = scenes / "recorded"
    scenario = ["--scenario", scenes / "yard.yaml", "--out", recorded]
    assert torchcover("record", scenes / "both.yaml", *scenario, *SMALL[:2])[0] == 0
    assert package.evaluate(frames=recorded, cell_m=4.0).coverage.band_frame == "ground"
    with pytest.raises(ValueError, match=r"sampled for bands above the ground; use the band frame ground$"):
        package.evaluate(frames=recorded, cell_m=4.0, band_frame="vehicle")
