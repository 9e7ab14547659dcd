"""`torchcover agree`: published placements, ranked by metrics and by detectors."""

import pytest


def test_a_small_run_prints_ranks_and_what_they_are_worth(torchcover, tmp_path):
    out = tmp_path / "out"
    options = ["--scenario", "courtyard", "--steps", "1", "--metrics", "point_density", "--out", out]
    code, text, complaints = torchcover("agree", "place3d2024", *options)
    assert code == 0, complaints
    for words in ("rolls in radians", "rolls in degrees", "mean mounting height", "+0.93", "as the best of so many"):
        assert words in text
    assert "No metric is validated by this" in text
    assert "cannot separate metrics" in text
    assert "Sensor model: " in text
    assert "…" not in text
    assert {path.name for path in out.iterdir()} >= {"agreement.csv", "scores.csv", "summary.json"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["place3d"], "place3d: no published placements of this name; there is place3d2024"),
        (["place3d2024", "--metrics", "s_mag"], "s_mag"),
        (["place3d2024", "--scenario", "nowhere"], "nowhere"),
    ],
)
def test_what_makes_no_sense_ends_in_one_line(torchcover, tmp_path, arguments, message):
    code, _, complaints = torchcover("agree", *arguments, "--steps", "1", "--out", tmp_path / "out")
    assert code == 2
    assert message in complaints
    assert len(complaints.strip().splitlines()) == 1
