"""`torchcover targets`: it says what is seen, and its exit code whether that is enough."""

import json

import pytest

RASTER = "--raster=-6,6,-5,5,1"


RIG = """name: dome
sensors:
  - {name: top, mount: {z_m: 1.5}, channels: 30, vertical_fov_deg: [-60, 10], horizontal_fov_deg: 360, columns: 300,
     max_range_m: 50}
"""


@pytest.fixture
def call(torchcover, worlds):
    (worlds / "dome.yaml").write_text(RIG)

    def run(*arguments):
        return torchcover("targets", worlds / "dome.yaml", RASTER, "--out", worlds / "out", *arguments)

    return run


@pytest.mark.parametrize(
    ("requirement", "code", "words"),
    [
        ("{within_m: 3, sides: [front], points: 5}", 0, "PASS any target within 3 m front: points >= 5: at all of "),
        ("{target: adult, within_m: 3, points: 500}", 1, "FAIL adult within 3 m: points >= 500: not at "),
    ],
)
def test_the_exit_code_is_the_verdict(call, worlds, requirement, code, words):
    (worlds / "need.yaml").write_text(f"requirements: [{requirement}, {{target: dog, within_m: 1, points: 1}}]\n")
    arguments = ("--target", "adult", "--scenario", worlds / "yard.yaml", "--require", worlds / "need.yaml")
    ended, printed, error = call(*arguments)
    assert (ended, error) == (code, "")
    assert words in printed
    assert "not checked, as it is not about adult: dog within 1 m: points >= 1" in printed
    assert "dome sees adult" in " ".join(printed.split())
    record = json.loads((worlds / "out" / "summary.json").read_text())
    assert record["files"] == ["targets.csv", "targets.npz", "report.html", "targets.png"]
    assert [one["passed"] for one in record["requirements"]] == [code == 0]
    assert record["not_checked"] == ["dog within 1 m: points >= 1"]
    assert "Not checked, as it is not about adult: dog within 1 m" in (worlds / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--target", "moon"], "'moon' is neither"),
        (["--raster", "1,2,3"], "--raster: x0,x1,y0,y1,step in metres"),
        (["--raster", "-1000,1000,-1000,1000,0.5"], "16,000,000 cells"),
        (["--heading", "up"], "--heading: narrow, wide or degrees"),
        (["--hits", "0"], "--hits"),
        (["--require", "none.yaml"], "none.yaml: no such file"),
        (["--require", "empty.yaml"], "requirements: Field required"),
        (["--require", "wrong.yaml"], "requirements.0.pionts: Extra inputs are not permitted"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(call, worlds, monkeypatch, arguments, message):
    monkeypatch.chdir(worlds)
    (worlds / "empty.yaml").write_text("{}\n")
    (worlds / "wrong.yaml").write_text("requirements: [{within_m: 1, pionts: 5}]\n")
    code, printed, error = call(*arguments)
    assert (code, printed) == (2, "")
    assert message in error
    assert error.count("\n") == 1
    assert not (worlds / "out").exists()
