"""Command `targets`: visibility of a test target."""

import json

import pytest

RASTER = "--raster=-6,6,-5,5,1"


RIG = """name: dome
sensors:
  - {name: top, mount: {z_m: 1.5}, channels: 30, vertical_fov_deg: [-60, 10], horizontal_fov_deg: 360, columns: 300,
     max_range_m: 50}
"""


@pytest.fixture
def call(torchcover, scenes):
    (scenes / "dome.yaml").write_text(RIG)

    def run(*arguments):
        return torchcover("targets", scenes / "dome.yaml", RASTER, "--out", scenes / "out", *arguments)

    return run


def test_target_map_is_printed_and_written(call, scenes):
    ended, printed, error = call("--target", "adult", "--scenario", scenes / "yard.yaml")
    assert (ended, error) == (0, "")
    assert "dome: visibility of adult" in " ".join(printed.split())
    record = json.loads((scenes / "out" / "summary.json").read_text())
    assert list(record["files"]) == ["targets.csv", "targets.npz", "report.html", "targets.png"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "moon"], "'moon' is neither"),
        (["--raster", "1,2,3"], "--raster: x0,x1,y0,y1,spacing in meters"),
        (["--raster", "-1000,1000,-1000,1000,0.5"], "16,000,000 cells"),
        (["--heading", "up"], "--heading: narrow, wide or degrees"),
        (["--detection-points", "0"], "--detection-points"),
    ],
)
def test_user_error_is_one_line_with_code_2(call, scenes, monkeypatch, arguments, message):
    monkeypatch.chdir(scenes)
    code, printed, error = call(*arguments)
    assert (code, printed) == (2, "")
    assert message in error
    assert error.count("\n") == 1
    assert not (scenes / "out").exists()
