"""Command `compare` with coverage files: equal to a joint evaluation of the rigs."""

import json

import pytest

from torchcover.evaluation import compare, evaluate


@pytest.fixture(scope="module")
def measured():
    """Cache of coverages by their settings, shared by all tests."""
    return {}


@pytest.fixture
def saved(scenes, measured):
    """Evaluate a rig in the scene `yard` and return its coverage file."""

    def run(rig, **changes):
        settings = {"num_frames": 16, "cell_m": 4.0, "thresholds_m": (2.0,), "num_rays": 1024, **changes}
        key = rig, *settings.items()
        if key not in measured:
            measured[key] = evaluate(scenes / f"{rig}.yaml", scenes / "yard.yaml", **settings)
        measured[key].save(scenes / rig, file_kinds="numbers")
        return scenes / rig / "coverage.npz"

    return run


def test_coverage_files_compare_like_a_joint_evaluation(torchcover, scenes, saved):
    """Differences, errors and marks are equal to the last bit."""
    code, printed, _ = torchcover("compare", saved("low"), saved("both"), "--explain", "--out", scenes / "out")
    assert code == 0
    assert "Difference to low" in printed
    summary = json.loads((scenes / "out" / "summary.json").read_text())
    for name in ("complete", "duration_s", "device", "frame_counts", "skipped_frames", "omissions", "reference"):
        assert summary[name] is None
    assert summary["scenario"] is None
    rigs = [scenes / "low.yaml", scenes / "both.yaml"]
    settings = {"cell_m": 4.0, "thresholds_m": (2.0,), "num_rays": 1024}
    together = evaluate(rigs, scenes / "yard.yaml", num_frames=16, **settings)
    rows = json.loads((scenes / "out" / "summary.json").read_text())["rows"]
    # A coverage file contains neither the vehicle nor the sensor model.
    assert rows == [{**row, "vehicle": None, "sensor_model": None} for row in together.summary]
    assert {row["rig"] for row in rows} == {"low", "both"}
    assert (scenes / "out" / "maps" / "difference_radius_area_m_ground_both_minus_low.png").is_file()
    # The coverage files of a comparison can be compared again.
    assert compare([scenes / "out" / "coverage" / f"{name}.npz" for name in ("low", "both")]).summary == rows


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 5}, "different reference points"),
        ({"num_frames": 15}, "different reference points"),
        ({"thresholds_m": (1.0,)}, "differ in their thresholds"),
        ({"cell_m": 8.0}, "differ in their grid"),
        ({"band_frame": "vehicle"}, "differ in their band_frame"),
    ],
)
def test_unpaired_coverage_files_are_rejected(torchcover, scenes, saved, change, message):
    code, _, stderr = torchcover("compare", saved("low"), saved("both", **change), "--out", scenes / "out")
    assert code == 2
    assert message in stderr
    assert not (scenes / "out" / "summary.json").exists()


@pytest.mark.parametrize("out", ["low", "low/.", "both"])
def test_folder_of_an_input_is_not_overwritten(torchcover, scenes, saved, out):
    """A run deletes the files of an earlier run in its folder, which would include the input."""
    files = saved("low"), saved("both")
    code, _, stderr = torchcover("compare", *files, "--out", scenes / out)
    assert (code, stderr.count("\n")) == (2, 1)
    assert "which is compared; choose another folder" in stderr
    assert all(file.is_file() for file in files)


def test_invalid_coverage_files_are_one_line(torchcover, scenes, saved):
    file = saved("low")
    (scenes / "rubbish.npz").write_bytes(b"PK")
    for arguments, message in (
        ([file], "at least two measured rigs"),
        ([file, scenes / "missing.npz"], "no such file; a saved coverage is needed"),
        ([file, scenes / "rubbish.npz"], "not a coverage file"),
        ([file, file, "--num-frames", 3], "measured already"),
        ([file, scenes / "both.yaml"], "compare coverage files with each other, without rigs"),
    ):
        code, _, stderr = torchcover("compare", *arguments, "--out", scenes / "out")
        assert (code, stderr.count("\n")) == (2, 1)
        assert message in stderr


def test_evaluate_rejects_coverage_files(torchcover, saved):
    file = saved("low")
    code, _, stderr = torchcover("evaluate", file)
    assert (code, stderr.count("\n")) == (2, 1), stderr
    assert "is measured already: read it by Coverage.load, or compare it" in stderr
