"""Command `encounter`: tables, files, and user errors."""

import json

import pytest

SET = """name: two
encounters:
  - name: child
    ego: {speed_kmh: [10, 60]}
    road_user: {body: child_120cm, speed_kmh: 5, approach_distance_m: 2.0, yaw_deg: [90, -90]}
"""


def test_tables_and_files_contain_all_rigs(torchcover, scenes, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # wide enough for every cell on one line
    (scenes / "two.yaml").write_text(SET)
    arguments = (
        "--encounters",
        scenes / "two.yaml",
        "--num-start-offsets",
        "2",
        "--points",
        "1",
        "--consecutive-scans",
        "1",
        "--vehicle",
        "suv",
    )
    ended, printed, _ = torchcover("encounter", scenes / "low.yaml", scenes / "both.yaml", *arguments)
    assert ended == 0
    for words in (
        "child: yaw_deg 90",
        "child: yaw_deg -90",
        "too late",
        "Highest tested speed with timely",
        "most critical",
        "1 LiDAR points",
    ):
        assert words in printed
    out = scenes / "out" / "encounters"
    record = json.loads((out / "summary.json").read_text())
    assert list(record["files"]) == ["encounters.csv", "report.html", "encounters.png"]
    assert [(row["encounter"], row["speed_kmh"], row["rig"]) for row in record["rows"]][:2] == [
        ("child: yaw_deg 90", 10.0, "low"), ("child: yaw_deg 90", 10.0, "both")]  # fmt: skip
    assert len(record["rows"]) == len((out / "encounters.csv").read_text().splitlines()) - 1 == 8
    assert record["rows"][0]["interval_low"] is None
    assert {row["max_speed_kmh"] for row in record["speeds"]} == {10.0}
    assert "Detection before a collision: low, both" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        (SET.replace("child_120cm", "chidl"), [], "encounters.0: road_user.body: "),
        (SET.replace("approach_distance_m: 2.0", "form_m: 2.0"), [], "encounters.0: road_user.form_m"),
        (SET.replace("yaw_deg: [90, -90]", "yaw_deg: 0, impact_location: 4"), [], "the outlines never touch"),
        (SET.replace("name: two", "name: [two]"), [], "name: "),
        (SET, ["--points", "0"], "points: a number >= 1"),
        (SET, ["--deceleration-mps2", "0"], "deceleration_mps2: m/s2 above 0"),
        (SET, ["--latency-s", "-1"], "latency_s: 0 to 10 seconds"),
        (SET, ["--latency-s", "300"], "latency_s: 0 to 10 seconds are needed; got 300, is that milliseconds?"),
        (SET, ["--encounters", "crosing_like"], "is 'crossing_like' meant?"),
        (SET, ["--animation", "a.png"], "an animation is a .gif or .mp4 file"),
        (SET, ["--num-scenes", "16"], "--num-scenes: has no effect with a set; omit it"),
        (SET, ["--max-ttc-s", "4"], "--max-ttc-s: has no effect with a set"),
        (SET, ["--scenario", "urban"], "--encounters: has no effect with --scenario"),
    ],
)
def test_user_error_is_one_line(torchcover, scenes, text, arguments, message):
    (scenes / "two.yaml").write_text(text)
    options = ("--encounters", scenes / "two.yaml", "--num-start-offsets", "1", "--vehicle", "suv", *arguments)
    ended, _, error = torchcover("encounter", scenes / "low.yaml", *options)
    assert ended == 2
    assert message in error.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["low.yaml", "--scenario", "courtyard"], "nothing moves in it"),
        (["low.yaml", "--scenario", "urban", "--animation", "a.gif"], "--animation: has no effect with --scenario"),
        (
            ["low.yaml", "--scenario", "urban", "--num-start-offsets", "10"],
            "--num-start-offsets: has no effect with --scenario",
        ),
        (["low.yaml", "--frames", "drive"], "rigs: has no effect with --frames, which defines rigs and traffic"),
        (["--frames", "drive", "--scenario", "urban"], "--scenario: has no effect with --frames"),
        (["--frames", "drive", "--vehicle", "suv"], "--vehicle: has no effect with --frames"),
        (["--frames", "drive"], "drive"),
        ([], "rigs with different names are needed; got none"),
    ],
)
def test_option_without_effect_is_a_user_error(torchcover, scenes, arguments, message):
    ended, _, error = torchcover("encounter", *(scenes / item if item == "low.yaml" else item for item in arguments))
    assert ended == 2
    assert message in error.strip().splitlines()[-1]
