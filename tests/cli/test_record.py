"""Command `record`: its recording gives the numbers of the simulation."""

import json
import signal

import numpy as np

from torchcover import Coverage
from torchcover.simulation import writing


def test_recording_has_the_numbers_of_the_simulation(torchcover, scenes, tmp_path):
    options = ("--scenario", scenes / "yard.yaml", "--num-frames", 3, "--seed", 2, "--num-rays", 1024)
    measured, read, recording = (tmp_path / name for name in ("simulated", "read", "recording"))
    code, printed, stderr = torchcover("record", scenes / "both.yaml", *options, "--out", recording)
    assert "record" in stderr
    assert "3/3" in stderr  # the bar
    assert (code, len(printed.splitlines())) == (0, 1)
    assert printed.startswith(f"Wrote 3 frames to {recording}; ")
    cell = ("--set", "cell_m=1", "--thresholds-m", 0.4, "--thresholds-m", 1)
    without_targets = ("--set", "test_targets=none", "--out", measured)
    assert torchcover("evaluate", scenes / "both.yaml", *options, *cell, *without_targets)[0] == 0
    code, printed, _ = torchcover("evaluate", "--frames", recording, *cell, "--out", read)
    assert code == 0
    assert "No test targets in the near field: a recording" in " ".join(printed.split())
    code, _, stderr = torchcover("evaluate", "--frames", recording, "--set", "test_targets=child", "--out", read)
    assert (code, "test_targets are for simulations" in stderr) == (2, True)
    first, second = (Coverage.load(folder / "coverage.npz") for folder in (measured, read))
    assert first.average == second.average == "area"
    for name in ("radius", "detection", "observed_frames", "point_counts"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    np.testing.assert_array_equal(first.errors["radius_m"], second.errors["radius_m"])
    rows = [json.loads((folder / "summary.json").read_text())["rows"] for folder in (measured, read)]
    unknown = dict.fromkeys(("rig", "vehicle", "sensor_model"))  # to a recording
    assert [row | unknown for row in rows[0]] == [row | unknown for row in rows[1]]
    assert any(row["radius_m"] for row in rows[0])


def test_record_rejects_invalid_options(torchcover, scenes, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("")
    low, both, yard = scenes / "low.yaml", scenes / "both.yaml", ("--scenario", scenes / "yard.yaml", "--num-frames", 1)
    code, _, error = torchcover("record", low, *yard, "--out", tmp_path / "out")
    assert (code, len(error.splitlines())) == (2, 1)
    assert "not empty; a new or empty folder is needed" in error
    code, _, error = torchcover("record", both, *yard, "--out", tmp_path / "new", "--format", "kitti")
    assert code == 2
    assert "format kitti: a rig of one LiDAR is needed; both has front, rear; use the format folder" in error


def test_interrupted_recording_is_resumed_but_not_evaluated(torchcover, scenes, monkeypatch):
    out, build_frame_record = scenes / "drive", writing.build_frame_record
    command = ("record", scenes / "low.yaml", "--scenario", scenes / "yard.yaml", "--num-frames", 3, "--num-rays", 64)

    def interrupt_at_frame_1(*args):
        return (args[1] == 1 and signal.raise_signal(2)) or build_frame_record(*args)

    monkeypatch.setattr(writing, "build_frame_record", interrupt_at_frame_1)
    code, _, stderr = torchcover(*command, "--out", out)
    assert code == 130
    assert stderr.endswith("torchcover: 1 of 3 frames are kept; continue with --resume\ntorchcover: interrupted\n")
    code, _, stderr = torchcover("evaluate", "--frames", out, "--set", "cell_m=8", "--out", scenes / "out")
    assert code == 2
    assert f"{out}: an incomplete recording with 1 frames; continue it with `torchcover record" in stderr
    monkeypatch.setattr(writing, "build_frame_record", build_frame_record)
    code, printed, _ = torchcover(*command, "--out", out, "--resume")
    assert (code, printed.startswith("Wrote 3 frames to ")) == (0, True)
    assert torchcover("evaluate", "--frames", out, "--set", "cell_m=8", "--out", scenes / "out")[0] == 0
