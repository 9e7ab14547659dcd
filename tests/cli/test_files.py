"""Option `--files`: selected files, which replace older ones atomically."""

import pytest

SMALL = ("--set", "cell_m=8", "--num-rays", 256, "--num-frames", 1)
NUMBERS = {"coverage.npz", "summary.csv"}


def written(folder):
    return {path.name for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("files", "expected"),
    [("numbers", NUMBERS), ("page", {"report.html"}), ("page, numbers", {*NUMBERS, "report.html"}), ("maps", set())],
)
def test_result_has_the_selected_files(torchcover, scenes, files, expected):
    out = scenes / "out"
    code, printed, _ = torchcover(
        "evaluate", scenes / "low.yaml", "--scenario", scenes / "yard.yaml", *SMALL, "--files", files, "--out", out
    )
    assert code == 0
    maps = {name for name in written(out) if name.endswith(".png")}
    assert written(out) - maps == {*expected, "summary.json"}
    assert bool(maps) == (files == "maps")
    assert ("maps/" in printed) == (files == "maps")


def test_target_map_has_the_selected_files(torchcover, scenes):
    raster = ["--raster", "3,5,-1,1,1", "--out", scenes / "out"]
    for files, expected in (("numbers", {"targets.csv", "targets.npz"}), ("maps", {"targets.png"})):
        assert torchcover("targets", scenes / "low.yaml", *raster, "--files", files)[0] == 0
        assert written(scenes / "out") == {*expected, "summary.json"}


@pytest.mark.parametrize("files", ["", "number", "numbers,", "numbers;maps"])
def test_unknown_file_kind_is_rejected_before_the_run(torchcover, scenes, files):
    code, _, stderr = torchcover("evaluate", scenes / "low.yaml", "--files", files, "--out", scenes / "out")
    assert code == 2
    assert stderr == f"torchcover: files: numbers, maps, page, one or more of them, are needed; got {files!r}\n"
    assert not (scenes / "out").exists()
