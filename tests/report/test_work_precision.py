"""Error against run time: the front, the cheapest, the diagram."""

import math

from torchcover.report import WorkPoint, cheapest, draw_work_precision, pareto_front


def point(seconds, error, rays=1024, reference="even"):
    return WorkPoint(reference, rays, 1, seconds, error, error, error, error, error, error, 1.0)


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


def test_the_diagram_has_a_line_for_each_setting_and_both_panels_name_their_unit():
    points = [point(k, 1 / k, rays, name) for k in (1, 2) for rays in (64, 256) for name in ("even", "paper")]
    figure = draw_work_precision(points, {"detection_error": 0.01, "radius_error_m": math.nan}, "rig in scene")
    panels = figure.axes
    assert [axes.get_xscale() for axes in panels] == ["log", "log"]
    assert "percentage points" in panels[0].get_ylabel()
    assert "(m)" in panels[1].get_ylabel()
    labels = [line.get_label() for line in panels[0].get_lines()]
    assert [label for label in labels if label.startswith(("even", "paper"))] == [
        "even 64",
        "even 256",
        "paper 64",
        "paper 256",
    ]
    assert "standard error of the long run" in labels
    assert "standard error of the long run" not in [line.get_label() for line in panels[1].get_lines()]
