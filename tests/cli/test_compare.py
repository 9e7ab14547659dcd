"""Command `compare`: paired differences, complete files, and reports of interrupted runs."""

import csv
import json

import numpy as np
import pytest

from torchcover import Coverage
from torchcover.evaluation import compare as compare_saved
from torchcover.evaluation.result_page import describe_rendering_cost, estimate_rendering_cost
from torchcover.evaluation.settings import FILES
from torchcover.simulation import REFERENCE_SENSORS

QUICK = ("--set", "cell_m=4", "--set", "test_targets=none")


def compare(torchcover, scenes, *rigs, num_frames=1, out="out", options=()):
    """Run the command in the scene `yard`; returns exit code, stdout, stderr, and the folder."""
    paths = [scenes / f"{rig}.yaml" for rig in rigs]
    folder = scenes / out
    arguments = [
        "--scenario",
        scenes / "yard.yaml",
        "--num-frames",
        num_frames,
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--out",
        folder,
    ]
    arguments += ["--num-rays", 4096, "--set", "test_targets=none", *options]
    return *torchcover("compare", *paths, *arguments), folder


def test_files_agree_with_each_other_and_with_evaluate(torchcover, scenes):
    code, printed, _, out = compare(torchcover, scenes, "low", "both", num_frames=2)
    assert code == 0
    assert str(out) in printed.replace("\n", "")
    coverages = {name: Coverage.load(out / "coverage" / f"{name}.npz") for name in ("low", "both")}
    np.testing.assert_array_equal(coverages["low"].point_counts, coverages["both"].point_counts)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["rigs"] == {"low": str(scenes / "low.yaml"), "both": str(scenes / "both.yaml")}
    assert summary["complete"] is True
    assert summary["counts"]["both"]["num_frames"] == 2
    with (out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(summary["rows"]) == 18
    for row, same in zip(rows, summary["rows"], strict=True):
        assert row["rig"] == same["rig"]
        assert row["radius_m"] == ("" if same["radius_m"] is None else str(same["radius_m"]))
        assert row["radius_m_best"] == str(same["radius_m_best"])
    alone = scenes / "alone"
    options = [
        "--scenario",
        scenes / "yard.yaml",
        "--num-frames",
        2,
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--out",
        alone,
    ]
    assert torchcover("evaluate", scenes / "both.yaml", *options, "--num-rays", 4096, *QUICK)[0] == 0
    np.testing.assert_array_equal(Coverage.load(alone / "coverage.npz").radius, coverages["both"].radius)


def test_fog_never_increases_coverage(torchcover, scenes):
    path = scenes / "both.yaml"
    path.write_text(path.read_text().replace("max_range_m: 60", "max_range_m: 60, range_at_10_percent_m: 30"))
    *_, out = compare(torchcover, scenes, "both", options=["--weather", "clear", "--weather", "fog_50m"])
    rows = json.loads((out / "summary.json").read_text())["rows"]
    in_fog = {(row["region"], row["band"]): row for row in rows if row["rig"] == "both, fog_50m"}
    pairs = [(row, in_fog[row["region"], row["band"]]) for row in rows if row["rig"] == "both, clear"]
    known = [(clear, fog) for clear, fog in pairs if clear["observed_cells"]]
    assert known
    assert all(fog["radius_m"] >= clear["radius_m"] for clear, fog in known)
    lost = [clear["detection_2m"] - fog["detection_2m"] for clear, fog in known]
    assert min(lost) >= 0
    assert max(lost) > 0.05


def test_one_more_sensor_never_reduces_coverage(torchcover, scenes):
    *_, out = compare(torchcover, scenes, "low", "both")
    rows = [row for row in json.loads((out / "summary.json").read_text())["rows"] if row["rig"] == "both"]
    known = [row for row in rows if row["observed_cells"]]
    assert known
    for row in known:
        assert row["radius_m_difference"] <= 0 <= row["detection_2m_difference"]
    low, both = (Coverage.load(out / "coverage" / f"{name}.npz") for name in ("low", "both"))
    assert (both.radius < low.radius - 1.0).any()


def test_rigs_with_equal_names_get_separate_files(torchcover, scenes):
    code, printed, _, out = compare(torchcover, scenes, "low", "other/low", "low")
    assert code == 0
    assert sorted(path.name for path in (out / "coverage").iterdir()) == ["low.npz", "low_2.npz", "low_3.npz"]
    assert "low_3" in printed
    first, different, repeated = (Coverage.load(out / "coverage" / f"low{n}.npz") for n in ("", "_2", "_3"))
    np.testing.assert_array_equal(first.radius, repeated.radius)
    assert not np.array_equal(first.radius, different.radius, equal_nan=True)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["rigs"]["low_2"] == str(scenes / "other" / "low.yaml")
    for row in summary["rows"]:
        if row["rig"] == "low_3" and row["observed_cells"]:
            assert row["radius_m_difference"] == 0.0


def test_maps_and_their_differences_are_plotted(torchcover, scenes):
    *_, out = compare(torchcover, scenes, "low", "both")
    metrics = "radius_area_m", "detection_area_2m"
    band_maps = [
        f"{prefix}{metric}_{band}{suffix}.png"
        for metric in metrics
        for band in ("ground", "obstacle")
        for prefix, suffix in (("", ""), ("difference_", "_both_minus_low"))
    ]
    near = [f"near_field_{metric}.png" for metric in metrics]
    assert sorted(path.name for path in (out / "maps").iterdir()) == sorted([*band_maps, *near])


def test_differences_have_standard_errors(torchcover, scenes):
    *_, out = compare(torchcover, scenes, "low", "both", num_frames=9)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["blocks"], summary["frames_per_block"]) == (9, 1)
    known = [row for row in summary["rows"] if row["rig"] == "both" and row["band"] == "ground"][:3]
    assert len(known) == 3
    for row in known:
        assert row["radius_m_error"] > 0
        assert row["radius_m_difference_error"] >= 0
        assert isinstance(row["radius_m_difference_significant"], bool)
    first = [row for row in summary["rows"] if row["rig"] == "low" and row["band"] == "ground"][:3]
    assert [row["radius_m_difference_error"] for row in first] == [0.0, 0.0, 0.0]


def test_reference_sensor_is_used_and_named(torchcover, scenes):
    _, printed, _, out = compare(torchcover, scenes, "low", "both", num_frames=2, options=["--reference", "paper"])
    summary = json.loads((out / "summary.json").read_text())
    (ground,) = summary["reference"].pop("notes")
    assert ground.startswith("Ground: level faces under the ego")
    assert summary["reference"] == {"sensor": "paper", "rays_per_frame": 64 * 64, "frame_interval_s": 0.1}
    assert summary["frame_counts"]["reference_rays"] == 2 * 64 * 64
    assert "Reference sensor: paper, 4,096 rays per frame; frame interval 0.1 s." in " ".join(printed.split())


@pytest.fixture
def recording(tmp_path):
    """Recording of three frames with the rigs `far`, `kitti` and `near` and one reference point."""
    folder = tmp_path / "recording"
    for source, x in (("rigs/near", 5.0), ("rigs/kitti", 3.0), ("rigs/far", 1.0), ("reference", 6.0)):
        (folder / source).mkdir(parents=True)
        for frame in range(3):
            np.save(folder / source / f"f{frame}.npy", np.array([[x, 0.1, 0.0]], dtype=np.float32))
    return folder


@pytest.mark.parametrize(
    ("rigs", "radii"),
    [
        ([], {"far": 5.0, "kitti": 3.0, "near": 1.0}),
        (["near", "far"], {"near": 1.0, "far": 5.0}),
        (["kitti", "near"], {"kitti": 3.0, "near": 1.0}),
    ],
)
def test_rigs_of_a_recording_are_compared(torchcover, recording, tmp_path, rigs, radii):
    out = tmp_path / "out"
    arguments = ["--frames", recording, "--set", "recording.format=folder", "--set", "cell_m=4", "--out", out]
    code, _, stderr = torchcover("compare", *rigs, *arguments)
    assert code == 0, stderr
    summary = json.loads((out / "summary.json").read_text())
    assert list(summary["rigs"]) == list(radii)
    assert (summary["frames"], summary["reference"]["sensor"], summary["complete"]) == (
        str(recording),
        "recorded",
        True,
    )
    rows = [row for row in summary["rows"] if row["region"] == "20m" and row["observed_cells"]]
    assert {row["rig"]: row["radius_m"] for row in rows} == pytest.approx(radii)


def test_error_lists_the_rigs_of_a_recording(torchcover, recording, tmp_path):
    arguments = ["--frames", recording, "--out", tmp_path / "out"]
    for command, rigs, message in (
        ("compare", ["near", "middle"], "no clouds of the rig middle; the frames have far, kitti, near"),
        (
            "compare",
            ["near", "far", "--set", "recording.format=bag"],
            "format 'bag': no such format of recordings; there",
        ),
        ("compare", ["near", "far", "--scenario", "urban"], "exclude each other"),
    ):
        code, _, error = torchcover(command, *rigs, *arguments)
        assert (code, message in error, error.count("\n")) == (2, True, 1), error
    assert torchcover("evaluate", "near", *arguments)[0] == 0
    assert torchcover("evaluate", *arguments)[0] == 0
    assert list(json.loads((tmp_path / "out" / "summary.json").read_text())["rigs"]) == ["far", "kitti", "near"]
    code, _, error = torchcover("evaluate", "kitti", "--set", "recording.format=folder")
    assert (code, "recording.format: only for a recording" in error) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "which rig?"),
        (["front_roof_128"], "at least two rigs are needed; got only front_roof_128"),
        (["front_roof_128", "no_such_rig"], "neither a .yaml file nor one of the built-in rigs; is "),
        (["front_roof_128", "none.yaml"], "none.yaml: no such file"),
        (["front_roof_128", "front_roof_64", "--scenario", "moon"], "one of the built-in scenarios; is "),
        (["front_roof_128", "front_roof_64", "--set", "cell_m=0.3"], "not a multiple of the cell"),
        (["front_roof_128", "front_roof_64", "--thresholds-m", "-1"], "thresholds_m: finite distances >= 0"),
        (["front_roof_128", "front_roof_64", "--device", "abacus"], "device abacus: cannot be used here"),
        (["front_roof_128", "front_roof_64", "--num-frames", "0"], "--num-frames"),
        (
            ["front_roof_128", "front_roof_64", "--target-error", "10cm"],
            "target error 10cm: a positive number with its unit",
        ),
        (
            ["front_roof_128", "front_roof_64", "--reference", "best"],
            f"reference best: {' or '.join(f'`{name}`' for name in REFERENCE_SENSORS)} is needed",
        ),
    ],
)
def test_user_error_is_one_line_with_code_2(torchcover, arguments, message, tmp_path):
    code, _, error = torchcover("compare", *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert message in error
    assert error.startswith("torchcover: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_pages_of_many_rigs_are_announced_or_rejected(torchcover, scenes, monkeypatch):
    code, _, error, out = compare(torchcover, scenes, "low", "both", out="few")
    assert (code, "page and maps" in error) == (0, False)
    few = compare_saved(sorted((out / "coverage").glob("*.npz")))
    many = {str(number): few.coverages["low"] for number in range(200)}
    expected_cost = 100 * np.array(estimate_rendering_cost(few.coverages, FILES))
    assert estimate_rendering_cost(many, FILES) == pytest.approx(expected_cost)
    assert estimate_rendering_cost(many, ["numbers"]) == (0.0, 0.0)
    assert "page and maps of 200 rigs take about" in describe_rendering_cost(many, "maps,page")
    assert describe_rendering_cost(many, "numbers") == ""
    for needed_bytes, expected in ((3e9, 0), (1e18, 2)):
        cost = (needed_bytes, 120.0)
        for module in ("result", "result_page"):
            name = f"torchcover.evaluation.{module}.estimate_rendering_cost"
            monkeypatch.setattr(name, lambda *_, cost=cost: cost)
        code, _, error, out = compare(torchcover, scenes, "low", "both", out=str(expected))
        assert code == expected
        assert f"page and maps of 2 rigs take about {needed_bytes / 1e9:.2g} GB of memory and 2 min" in error
        assert (out / "coverage" / "low.npz").exists()
        assert (out / "report.html").exists() == (expected == 0)
    assert "omit page and maps with `--files numbers`" in error
