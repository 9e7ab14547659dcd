"""The points of a study: the front, the cheapest, what the diagram is given, the table and the records."""

import io
import json
import math

from rich.console import Console

from torchcover.evaluation import WorkPoint, cheapest, pareto_front, study_records, study_table, work_panels


def point(seconds: float, error: float, rays: int = 1024, reference: str = "even") -> WorkPoint:
    return WorkPoint(reference, rays, 8, seconds, error, error, error, error)


def test_more_time_without_less_error_is_not_on_the_front():
    front = pareto_front([point(3, 0.3), point(1, 0.5), point(2, 0.6), point(4, 0.3), point(5, 0.1)], "detection_error")
    assert [one.seconds for one in front] == [1, 3, 5]


def test_a_point_whose_error_is_unknown_is_not_on_the_front_and_does_not_hide_the_others():
    front = pareto_front([point(1, math.nan), point(2, 0.3), point(3, math.nan), point(4, 0.1)], "detection_error")
    assert [one.seconds for one in front] == [2, 4]


def test_the_cheapest_that_is_good_enough_is_advised():
    points = [point(9, 0.01), point(4, 0.02), point(1, 0.5)]
    assert cheapest(points, "detection_error", 0.02).seconds == 4
    assert cheapest(points, "detection_error", 0.001) is None


def test_errors_have_two_digits_and_the_fastest_of_their_error_are_marked():
    console = Console(file=io.StringIO(), width=200)
    console.print(study_table([point(1.0, 0.0123), point(2.0, 0.0234), point(3.0, math.nan)]))
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]] for line in console.file.getvalue().splitlines() if "│" in line
    ]
    assert rows[0] == ["even *", "1,024", "8", "1.0", "1.2", "0.012", "1.2", "0.012"]
    assert rows[1][0] == "even"
    assert rows[2][4:] == ["unknown"] * 4


def test_records_are_json_without_nan():
    best, unknown = json.loads(json.dumps(study_records([point(1.0, 0.1), point(2.0, math.nan)]), allow_nan=False))
    assert (best["best_detection_error"], best["best_radius_error_m"]) == (True, True)
    assert (unknown["detection_error"], unknown["best_detection_error"]) == (None, False)


def test_the_diagram_is_given_a_line_for_each_setting_in_the_unit_that_it_names():
    points = [point(k, 1 / k, rays, name) for k in (1, 2) for rays in (256, 64) for name in ("odd", "even")]
    share, length = work_panels(points, {"detection_error": 0.01, "radius_error_m": math.nan})
    assert {name: list(lines) for name, lines in share.lines.items()} == {"odd": ["64", "256"], "even": ["64", "256"]}
    assert share.lines["odd"]["64"] == share.front == [(1, 100.0), (2, 50.0)]
    assert length.lines["even"]["256"] == [(1, 1.0), (2, 0.5)]
    assert ("percentage points" in share.label, "(m)" in length.label) == (True, True)
    assert (share.floor, math.isnan(length.floor)) == (1.0, True)
