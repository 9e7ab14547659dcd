"""Command `check`: all requirements of a file in one run, with the verdict as exit code."""

import json
from xml.etree import ElementTree

import pytest

AHEAD = "{target: adult, positions: {points_m: [[5, 0]]}, points: 5, name: '<a> & b'}"
TOO_MANY = "{target: adult, positions: {points_m: [[5, 0]]}, points: 99999}"
INSIDE = "{target: dog, positions: {points_m: [[0, 0]]}, points: 5}"


@pytest.mark.parametrize(
    ("requirements", "code", "states"),
    [
        ([AHEAD], 0, ["met"]),
        ([AHEAD, INSIDE], 1, ["met", "not decided"]),
        ([AHEAD, INSIDE, TOO_MANY], 1, ["met", "not decided", "not met"]),
    ],
)
def test_exit_code_states_the_verdict_on_all_requirements(torchcover, scenes, requirements, code, states):
    (scenes / "need.yaml").write_text(f"name: needs\nscenario: yard.yaml\nrequirements: [{', '.join(requirements)}]\n")
    ended, printed, error = torchcover("check", scenes / "low.yaml", "--requirements", scenes / "need.yaml")
    assert (ended, error) == (code, "")
    assert all(state in printed for state in states)
    out = scenes / "out" / "check"
    record = json.loads((out / "summary.json").read_text())
    assert (record["met"], list(record["files"])) == (not code, ["junit.xml"])
    assert [verdict["state"] for verdict in record["rigs"]["low"]] == states
    assert record["rigs"]["low"][0]["margin"] == record["rigs"]["low"][0]["value"] - 5
    (suite,) = ElementTree.parse(out / "junit.xml").getroot()
    tags = {"met": [], "not met": ["failure"], "not decided": ["error"]}
    assert [[child.tag for child in case] for case in suite] == [tags[state] for state in states]
    assert suite[0].get("name") == "<a> & b: adult, points_m [[5.0, 0.0]]: points >= 5"
    messages = {case[0].get("message"): case[0].text for case in suite if len(case)}
    unknown = "worst value: -; margin: -; not met: 0; not decided: 1; total: 1; occupied: 0; worst location: {}"
    where = "x = 0.00, y = 0.00 m, occupied"
    assert (messages.get(unknown.format(where)) == where) == ("not decided" in states)
    assert record["scenarios"] == {"target": str(scenes / "yard.yaml")}
    assert suite.get("failures") == str(states.count("not met"))
    assert "no homologation" in " ".join(printed.split())


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("requirements: [{target: moon, positions: {within_m: 1}, points: 5}]", [], "no target is called 'moon'"),
        ("requirements: [{target: dog, positions: {within_m: 1}, pionts: 5}]", [], "pionts: unknown key"),
        (
            "requirements: [{target: dog, positions: {within_m: 1}, points: 5, counted_sensors: rof}]",
            [],
            "no sensor is called 'rof'",
        ),
        ("{}", [], "requirements: a value is needed; the key is missing"),
        (f"requirements: [{AHEAD}]", ["--requirements", "crosing_like"], "is 'crossing_like' meant?"),
        (f"requirements: [{AHEAD}]", ["--requirements", "none.yaml"], "none.yaml: no such file"),
    ],
)
def test_user_error_is_one_line_with_code_2(torchcover, scenes, text, arguments, message):
    (scenes / "need.yaml").write_text(text)
    ended, printed, error = torchcover("check", scenes / "low.yaml", "--requirements", scenes / "need.yaml", *arguments)
    assert (ended, printed) == (2, "")
    assert message in error
    assert error.count("\n") == 1
    assert not (scenes / "out" / "check").exists()
