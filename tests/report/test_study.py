"""The table of a study: its errors read as everywhere."""

import io
import json
import math

from rich.console import Console

from torchcover.report import WorkPoint, study_records, study_table


def point(seconds: float, error: float) -> WorkPoint:
    return WorkPoint("even", 1024, 8, seconds, error, error, error, error, error, error, 0.9996)


def test_errors_have_two_digits_and_the_fastest_of_their_error_are_marked():
    console = Console(file=io.StringIO(), width=200)
    console.print(study_table([point(1.0, 0.0123), point(2.0, 0.0234), point(3.0, math.nan)]))
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]] for line in console.file.getvalue().splitlines() if "│" in line
    ]
    assert rows[0] == ["even *", "1,024", "8", "1.0", "1.2", "1.2", "0.012", "0.012", "1.2", "0.012", ">99.9"]
    assert rows[1][0] == "even"
    assert rows[2][4:10] == ["unknown"] * 6


def test_records_are_json_without_nan():
    best, unknown = json.loads(json.dumps(study_records([point(1.0, 0.1), point(2.0, math.nan)]), allow_nan=False))
    assert (best["best_detection_error"], best["best_radius_error_m"]) == (True, True)
    assert (unknown["detection_error"], unknown["best_detection_error"]) == (None, False)
