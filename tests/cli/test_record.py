"""`torchcover record`: what it writes measures as the simulation does."""

import json
import signal

import numpy as np

from torchcover import Coverage
from torchcover.simulation import writing


def test_recording_has_the_numbers_of_the_simulation(torchcover, worlds, tmp_path):
    options = ("--scenario", worlds / "yard.yaml", "--num-frames", 3, "--seed", 2, "--num-rays", 1024)
    measured, read, recording = (tmp_path / name for name in ("simulated", "read", "recording"))
    code, printed, told = torchcover("record", worlds / "both.yaml", *options, "--out", recording)
    assert "record" in told
    assert "3/3" in told  # the bar
    assert (code, len(printed.splitlines())) == (0, 1)
    assert printed.startswith(f"Wrote 3 frames to {recording}; ")
    cell = ("--set", "cell_m=1", "--thresholds-m", 0.4, "--thresholds-m", 1)
    assert (
        torchcover("evaluate", worlds / "both.yaml", *options, *cell, "--set", "test_targets=none", "--out", measured)[0] == 0
    )
    code, printed, _ = torchcover("evaluate", "--frames", recording, *cell, "--out", read)
    assert code == 0
    assert "No test targets in the near field: a recording" in " ".join(printed.split())
    code, _, told = torchcover("evaluate", "--frames", recording, "--set", "test_targets=child", "--out", read)
    assert (code, "test_targets are for simulations" in told) == (2, True)
    first, second = (Coverage.load(folder / "coverage.npz") for folder in (measured, read))
    assert first.average == second.average == "area"
    for name in ("radius", "detection", "observed_frames", "point_counts"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    np.testing.assert_array_equal(first.errors["radius_m"], second.errors["radius_m"])
    rows = [json.loads((folder / "summary.json").read_text())["rows"] for folder in (measured, read)]
    unknown = dict.fromkeys(("rig", "vehicle", "sensor_model"))  # to a recording
    assert [row | unknown for row in rows[0]] == [row | unknown for row in rows[1]]
    assert any(row["radius_m"] for row in rows[0])


def test_record_rejects_invalid_options(torchcover, worlds, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").write_text("")
    low, both, yard = worlds / "low.yaml", worlds / "both.yaml", ("--scenario", worlds / "yard.yaml", "--num-frames", 1)
    code, _, error = torchcover("record", low, *yard, "--out", tmp_path / "out")
    assert (code, len(error.splitlines())) == (2, 1)
    assert "not empty; a new or empty folder is needed" in error
    code, _, error = torchcover("record", both, *yard, "--out", tmp_path / "new", "--format", "kitti")
    assert code == 2
    assert "format kitti: a rig of one LiDAR is needed; both has front, rear; use the format folder" in error


def test_interrupted_recording_is_resumed_but_not_evaluated(torchcover, worlds, monkeypatch):
    out, step = worlds / "drive", writing.build_frame_record
    command = ("record", worlds / "low.yaml", "--scenario", worlds / "yard.yaml", "--num-frames", 3, "--num-rays", 64)
    monkeypatch.setattr(writing, "build_frame_record", lambda *given: (given[1] == 1 and signal.raise_signal(2)) or step(*given))
    code, _, said = torchcover(*command, "--out", out)
    assert code == 130
    assert said.endswith("torchcover: 1 of 3 frames are kept; continue with --resume\ntorchcover: interrupted\n")
    code, _, said = torchcover("evaluate", "--frames", out, "--set", "cell_m=8", "--out", worlds / "out")
    assert code == 2
    assert f"{out}: an incomplete recording with 1 frames; continue it with `torchcover record" in said
    monkeypatch.setattr(writing, "build_frame_record", step)
    code, printed, _ = torchcover(*command, "--out", out, "--resume")
    assert (code, printed.startswith("Wrote 3 frames to ")) == (0, True)
    assert torchcover("evaluate", "--frames", out, "--set", "cell_m=8", "--out", worlds / "out")[0] == 0
