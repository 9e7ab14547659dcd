"""Option `--target-error`: a run stops at a standard error."""

import json
import re

import numpy as np
import pytest

from torchcover import Coverage


@pytest.fixture
def long_recording(tmp_path):
    """Recording of 200 frames with two reference points and random radii."""
    folder = tmp_path / "recording"
    random = np.random.default_rng(0)
    for source in ("sensor", "reference"):
        (folder / source).mkdir(parents=True)
    reference = np.array([[2.0, 0.1, 0.0], [30.0, 0.1, 0.0]], dtype=np.float32)
    for frame in range(200):
        below = np.array([0.0, 0.0, random.random()], dtype=np.float32)
        np.save(folder / "sensor" / f"f{frame:03}.npy", reference - below)
        np.save(folder / "reference" / f"f{frame:03}.npy", reference)
    return folder


@pytest.mark.parametrize("workers", [0, 2])
def test_evaluate_stops_at_the_target_error(torchcover, long_recording, tmp_path, workers):
    arguments = ["--frames", long_recording, "--set", "cell_m=4", "--out", tmp_path / "out", "--num-workers", workers]
    code, printed, _ = torchcover("evaluate", *arguments, "--target-error", "0.05m", "--target-error", "20%")
    assert code == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    num_frames = summary["counts"]["num_frames"]
    assert 32 <= num_frames < 150
    assert f"Target error reached after {num_frames} frames." in printed
    assert (summary["complete"], summary["target_error"]["reached"]) == (True, True)
    assert all(row["radius_m_error"] <= 0.05 for row in summary["rows"] if row["observed_cells"])
    assert re.search(r"0\.\d+  \[0\.\d+, 0\.\d+\]", printed)


def test_unreached_target_error_reports_the_needed_frames(torchcover, long_recording, tmp_path):
    arguments = ["--frames", long_recording, "--set", "cell_m=4", "--out", tmp_path / "out", "--num-frames", 40]
    code, printed, _ = torchcover("evaluate", *arguments, "--target-error", "1e-3m")
    assert code == 0
    assert "Target error not reached in 40 frames" in printed
    assert "20m ground, radius_m of" in printed
    target = json.loads((tmp_path / "out" / "summary.json").read_text())["target_error"]
    assert target["reached"] is False
    assert 1_000 < target["frames_needed"] < 1_000_000
    assert Coverage.load(tmp_path / "out" / "coverage.npz").counts["num_frames"] == 40


def test_compare_stops_when_differences_reach_the_target(torchcover, scenes):
    options = [
        "--scenario",
        scenes / "yard.yaml",
        "--set",
        "cell_m=4",
        "--thresholds-m",
        2,
        "--num-rays",
        512,
        "--out",
        scenes / "out",
    ]
    rigs = [scenes / "low.yaml", scenes / "both.yaml"]
    code, printed, _ = torchcover("compare", *rigs, *options, "--target-error", "50m")
    assert code == 0
    assert "Target error reached after 67 frames." in printed
    assert "Difference to low: mean blind spot radius (m)" in printed
    target = json.loads((scenes / "out" / "summary.json").read_text())["target_error"]
    assert {number["rig"] for number in target["numbers"]} == {"low", "both", "both minus low"}
