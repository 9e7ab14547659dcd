"""The diagram of error against run time."""

import math

import pytest

from torchcover.report import WorkPanel, draw_work_precision

POINTS = [(1.0, 3.0), (2.0, 1.0)]


def panel(groups, floor: float = math.nan) -> WorkPanel:
    return WorkPanel("error (%)", {name: dict.fromkeys(("64", "256"), POINTS) for name in groups}, POINTS, floor)


def lines(figure, at: int = 0):
    return {line.get_label(): line for line in figure.axes[at].get_lines()}


def test_it_has_a_line_for_each_setting_the_front_and_the_floor_where_there_is_one():
    figure = draw_work_precision([panel("ab", 0.5), panel("ab")], title="rig in $scene$", legend_title="rays")
    first, second = lines(figure, 0), lines(figure, 1)
    assert list(second) == ["a 64", "a 256", "b 64", "b 256", "Pareto front"]
    assert list(first) == [*second, "standard error of the long run"]
    assert first["a 64"].get_xydata().tolist() == [list(one) for one in POINTS]
    assert [(axes.get_xscale(), axes.get_yscale(), axes.get_ylabel()) for axes in figure.axes] == [
        ("log", "log", "error (%)")
    ] * 2
    assert figure.legends[0].get_title().get_text() == "rays"


@pytest.mark.parametrize("groups", [("even", "paper"), ("surface", "mine"), ("paper", "even")])
def test_colours_and_line_styles_follow_the_order_and_no_name(groups):
    def looks(names):
        drawn = lines(draw_work_precision([panel(names)], title=""))
        return [
            (drawn[f"{name} {rays}"].get_color(), drawn[f"{name} {rays}"].get_linestyle())
            for name in names
            for rays in ("64", "256")
        ]

    assert looks(groups) == looks("ab")
    assert len(set(looks(groups))) == 4


def test_more_groups_than_colours_are_drawn_too():
    assert len(lines(draw_work_precision([panel("abcdefg")], title=""))) == 15
