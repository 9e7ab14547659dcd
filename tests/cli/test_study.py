"""Command `study`: error against run time."""

import json
import os
import sys

import pytest

from torchcover.cli import app


def test_study_prints_tables_and_recommendations(torchcover, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # wide enough for every heading on one line

    class Timed:
        """Timed command, run in this process because its imports are loaded."""

        pid = os.getpid()

        def __init__(self, words, role, **_):
            self.returncode = run(words)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def communicate(self):
            return None, ""

    def run(words):
        assert words[:2] == [sys.executable, "-c"]
        monkeypatch.setattr(sys, "argv", words[2:])
        with pytest.raises(SystemExit) as stop:
            app.main()
        codes.append(stop.value.code)
        return stop.value.code

    codes = []
    monkeypatch.setattr("torchcover.evaluation.study.start_program", Timed)
    out = tmp_path / "out"
    options = ["--num-rays", "256", "--set", "cell_m=4", "--num-frames", "8"]
    code, text, stderr = torchcover("study", "front_roof_32", "--scenario", "courtyard", *options, "--out", out)
    assert code == 0, stderr
    assert "…" not in text
    for words in ("as given", "error after 8", "Standard error of 1 percentage point for every detection rate"):
        assert words in text
    assert (out / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    study = json.loads((out / "summary.json").read_text())
    assert [trial["options"] for trial in study["trials"]] == [""]
    assert codes == [0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--num-rays", "0"], "rays"),
        (["--set", "cell_m=0.3"], "multiple of the cell"),
        (["--set", "frame_interval_s=0.15"], "frame_interval_s: a positive multiple of the time step"),
        (["--scenario", "nowhere"], "nowhere"),
    ],
)
def test_user_error_is_one_line(torchcover, tmp_path, options, message):
    code, _, stderr = torchcover("study", "front_roof_32", *options, "--num-frames", "8", "--out", tmp_path / "out")
    assert code == 2
    assert message in stderr
    assert len(stderr.strip().splitlines()) == 1


def test_study_rejects_distributed_runs(torchcover, monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    code, _, stderr = torchcover("study", "front_roof_32", "--out", tmp_path / "out")
    assert (code, "run it without torchrun" in stderr) == (2, True)
