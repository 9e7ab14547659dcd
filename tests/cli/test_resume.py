"""Option `--resume`: a run continues in the folder of its results."""

import json

import pytest

SMALL = ("--set", "cell_m=8", "--num-rays", 256)


def files_of(folder):
    """Content of all files without run times."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary.pop("duration_s") >= 0
    summary["files"] = list(summary["files"])
    arrays = {path.name: path.read_bytes() for path in folder.rglob("coverage/*.npz")}
    arrays |= {path.name: path.read_bytes() for path in folder.glob("coverage.npz")}
    return summary, arrays


@pytest.mark.parametrize("command", [("evaluate", "low.yaml"), ("compare", "low.yaml", "both.yaml")])
def test_resumed_run_writes_the_same_files(torchcover, scenes, monkeypatch, command):
    monkeypatch.chdir(scenes)
    arguments = [*command, "--scenario", "yard.yaml", *SMALL]
    assert torchcover(*arguments, "--num-frames", 5, "--out", "whole")[0] == 0
    code, _, stderr = torchcover(*arguments, "--num-frames", 2, "--out", "parts", "--resume")
    assert (code, "parts/checkpoint.npz does not exist: the run starts with its first frame" in stderr) == (0, True)
    code, _, stderr = torchcover(*arguments, "--num-frames", 5, "--out", "parts", "--resume")
    assert (code, "does not exist" in stderr, "replaced" in stderr) == (0, False, False)
    assert files_of(scenes / "parts") == files_of(scenes / "whole")
    assert [path.parent.name for path in scenes.glob("*/checkpoint.npz")] == ["parts"]
    code, _, stderr = torchcover(*arguments, "--num-frames", 5, "--out", "parts", "--resume", "--seed", 1)
    assert code == 2
    assert "parts/checkpoint.npz: a checkpoint of another run: seed (0 there, 1 here); resume with the" in stderr
    (scenes / "parts" / "summary.json").unlink()  # as if it had been killed
    code, _, stderr = torchcover(*arguments, "--num-frames", 1, "--out", "parts")  # starts again
    assert (code, "parts/checkpoint.npz will be replaced; to continue from it, stop now" in stderr) == (0, True)
    code, _, stderr = torchcover(*arguments, "--num-frames", 1, "--out", "parts")
    assert (code, "will be replaced" in stderr) == (0, False)  # the previous run was complete
    assert files_of(scenes / "parts") != files_of(scenes / "whole")
    # A complete run keeps its checkpoint only with --resume.
    assert not list(scenes.glob("*/checkpoint.npz"))
