"""`torchcover compare a/coverage.npz b/coverage.npz`: what was measured apart, compared as if it had been together."""

import json

import pytest

from torchcover.evaluation import compare, evaluate


@pytest.fixture(scope="module")
def measured():
    """What was measured by a test before, by its settings."""
    return {}


@pytest.fixture
def saved(worlds, measured):
    """Evaluate a rig of the yard, and give its coverage file."""

    def run(rig, **changes):
        settings = {"num_frames": 16, "cell_m": 4.0, "thresholds_m": (2.0,), "num_rays": 1024, **changes}
        key = rig, *settings.items()
        if key not in measured:
            measured[key] = evaluate(worlds / f"{rig}.yaml", worlds / "yard.yaml", **settings).coverage
        file = worlds / rig / "coverage.npz"
        file.parent.mkdir()
        measured[key].save(file)
        return file

    return run


def test_coverage_files_compare_like_a_joint_evaluation(torchcover, worlds, saved):
    """To the last bit: differences, their errors, marks."""
    code, printed, _ = torchcover("compare", saved("low"), saved("both"), "--explain", "--out", worlds / "out")
    assert code == 0
    assert "Difference to low" in printed
    summary = json.loads((worlds / "out" / "summary.json").read_text())
    unknown = ("complete", "duration_s", "device", "frame_counts", "skipped_frames", "omissions", "reference", "scenario")
    assert [summary[name] for name in unknown] == [None] * len(unknown)
    rigs, settings = [worlds / "low.yaml", worlds / "both.yaml"], {"cell_m": 4.0, "thresholds_m": (2.0,), "num_rays": 1024}
    together = evaluate(rigs, worlds / "yard.yaml", num_frames=16, **settings)
    rows = json.loads((worlds / "out" / "summary.json").read_text())["rows"]
    # Of a file of coverage nobody knows what carried the rig, and how its sensors measured.
    assert rows == [{**row, "vehicle": None, "sensor_model": None} for row in together.summary]
    assert {row["rig"] for row in rows} == {"low", "both"}
    assert (worlds / "out" / "maps" / "difference_radius_area_m_ground_both_minus_low.png").is_file()
    # And what a comparison wrote can be compared again.
    assert compare([worlds / "out" / "coverage" / f"{name}.npz" for name in ("low", "both")]).summary == rows


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
def test_unpaired_coverage_files_are_rejected(torchcover, worlds, saved, change, message):
    code, _, complaint = torchcover("compare", saved("low"), saved("both", **change), "--out", worlds / "out")
    assert code == 2
    assert message in complaint
    assert not (worlds / "out" / "summary.json").exists()


@pytest.mark.parametrize("out", ["low", "low/.", "both"])
def test_folder_of_an_input_is_not_overwritten(torchcover, worlds, saved, out):
    """Its files would be those of an earlier run, and be deleted."""
    files = saved("low"), saved("both")
    code, _, complaint = torchcover("compare", *files, "--out", worlds / out)
    assert (code, complaint.count("\n")) == (2, 1)
    assert "which is compared, and would lose it; choose another folder" in complaint
    assert all(file.is_file() for file in files)


def test_invalid_coverage_files_are_one_line(torchcover, worlds, saved):
    file = saved("low")
    (worlds / "rubbish.npz").write_bytes(b"PK")
    for arguments, message in (
        ([file], "at least two measured rigs"),
        ([file, worlds / "missing.npz"], "no such file; a saved coverage is needed"),
        ([file, worlds / "rubbish.npz"], "not a coverage file"),
        ([file, file, "--num-frames", 3], "measured already"),
        ([file, worlds / "both.yaml"], "compare coverage files with each other, without rigs"),
    ):
        code, _, complaint = torchcover("compare", *arguments, "--out", worlds / "out")
        assert (code, complaint.count("\n")) == (2, 1)
        assert message in complaint


def test_evaluate_rejects_coverage_files(torchcover, saved):
    file = saved("low")
    code, _, complaint = torchcover("evaluate", file)
    assert (code, complaint.count("\n")) == (2, 1), complaint
    assert "is measured already: read it by Coverage.load, or compare it" in complaint
