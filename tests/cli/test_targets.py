"""`torchcover targets`: it says what is seen, and its exit code whether that is enough."""

import json

import pytest

RASTER = "--raster=-6,6,-5,5,1"


@pytest.fixture
def call(torchcover, worlds):
    def run(*arguments):
        return torchcover("targets", worlds / "low.yaml", RASTER, "--out", worlds / "out", *arguments)

    return run


@pytest.mark.parametrize(
    ("requirement", "code", "words"),
    [
        ("{within_m: 3, sides: [front], points: 1}", 0, "PASS any target within 3 m front: points >= 1: at all of "),
        ("{target: dog, within_m: 3, points: 5}", 1, "FAIL dog within 3 m: points >= 5: not at "),
    ],
)
def test_the_exit_code_is_the_verdict(call, worlds, requirement, code, words):
    (worlds / "need.yaml").write_text(f"requirements: [{requirement}, {{target: adult, within_m: 1, points: 1}}]\n")
    arguments = ("--target", "dog", "--scenario", worlds / "yard.yaml", "--require", worlds / "need.yaml")
    ended, printed, error = call(*arguments)
    assert (ended, error) == (code, "")
    assert words in printed
    assert "not checked, as it is not about dog_57cm: adult within 1 m: points >= 1" in printed
    assert "low sees dog_57cm" in " ".join(printed.split())
    record = json.loads((worlds / "out" / "summary.json").read_text())
    assert record["files"] == ["targets.csv", "targets.npz", "targets.png", "summary.json"]
    assert [one["passed"] for one in record["requirements"]] == [code == 0]


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
        (["--vehicle", "suv", "--scenario", "courtyard"], "a scenario has its own ego"),
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
