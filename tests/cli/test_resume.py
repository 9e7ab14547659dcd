"""`--resume`: a run goes on in the folder of its results."""

import json

import pytest

SMALL = ("--set", "cell_m=8", "--num-rays", 256)


def files_of(folder):
    """What was measured, by file; the time that it took aside."""
    summary = json.loads((folder / "summary.json").read_text())
    assert summary.pop("duration_s") >= 0
    summary["files"] = list(summary["files"])
    arrays = {path.name: path.read_bytes() for path in folder.rglob("coverage/*.npz")}
    arrays |= {path.name: path.read_bytes() for path in folder.glob("coverage.npz")}
    return summary, arrays


@pytest.mark.parametrize("command", [("evaluate", "low.yaml"), ("compare", "low.yaml", "both.yaml")])
def test_resumed_run_writes_the_same_files(torchcover, worlds, monkeypatch, command):
    monkeypatch.chdir(worlds)
    arguments = [*command, "--scenario", "yard.yaml", *SMALL]
    assert torchcover(*arguments, "--num-frames", 5, "--out", "whole")[0] == 0
    code, _, said = torchcover(*arguments, "--num-frames", 2, "--out", "parts", "--resume")
    assert (code, "parts/checkpoint.npz does not exist: the run starts with its first frame" in said) == (0, True)
    code, _, said = torchcover(*arguments, "--num-frames", 5, "--out", "parts", "--resume")
    assert (code, "is not there" in said, "replaced" in said) == (0, False, False)
    assert files_of(worlds / "parts") == files_of(worlds / "whole")
    assert [path.parent.name for path in worlds.glob("*/checkpoint.npz")] == ["parts"]
    code, _, said = torchcover(*arguments, "--num-frames", 5, "--out", "parts", "--resume", "--seed", 1)
    assert code == 2
    assert "parts/checkpoint.npz: a checkpoint of another run: seed (0 there, 1 here); resume with the" in said
    (worlds / "parts" / "summary.json").unlink()  # as if it had been killed
    code, _, said = torchcover(*arguments, "--num-frames", 1, "--out", "parts")  # anew
    assert (code, "parts/checkpoint.npz will be replaced; to continue from it, stop now" in said) == (0, True)
    code, _, said = torchcover(*arguments, "--num-frames", 1, "--out", "parts")
    assert (code, "will be replaced" in said) == (0, False)  # the one before was complete
    assert files_of(worlds / "parts") != files_of(worlds / "whole")
    # A run that has come to its end keeps none, unless going on was asked for.
    assert not list(worlds.glob("*/checkpoint.npz"))
