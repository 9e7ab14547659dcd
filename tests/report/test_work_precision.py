"""The diagram of error against run time."""

from itertools import pairwise

from torchcover.report import plot_work_precision

POINTS = [(1.0, 3.0), (2.0, 1.0)]


def panel(names):
    return {"error (%)": dict.fromkeys(names, POINTS)}


def lines(figure, at: int = 0):
    return {line.get_label(): line for line in figure.axes[at].get_lines()}


def test_it_has_a_line_for_each_setting():
    panels = {label: dict.fromkeys("ab", POINTS) for label in ("error (%)", "error (m)")}
    figure = plot_work_precision(panels, title="rig in $scene$", legend_title="rays")
    first, second = lines(figure, 0), lines(figure, 1)
    assert list(first) == list(second) == ["a", "b"]
    assert first["a"].get_xydata().tolist() == [list(one) for one in POINTS]
    assert [axes.get_ylabel() for axes in figure.axes] == list(panels)
    assert {(axes.get_xscale(), axes.get_yscale()) for axes in figure.axes} == {("log", "log")}
    assert figure.legends[0].get_title().get_text() == "rays"


def test_lines_differ_beyond_the_number_of_markers():
    drawn = lines(plot_work_precision(panel("abcdefghij"), title=""))
    assert len({(line.get_color(), line.get_marker()) for line in drawn.values()}) == 10


def test_no_number_of_an_axis_lies_on_another():
    figure = plot_work_precision({"error (%)": {"a": [(3.0, 0.9), (60.0, 0.3)]}}, title="")
    figure.canvas.draw()
    (axes,) = figure.axes
    for axis, side in ((axes.xaxis, 0), (axes.yaxis, 1)):
        labels = [label for label in axis.get_ticklabels(which="both") if label.get_text()]
        inside = [
            label
            for label in labels
            if axis.get_view_interval()[0] <= label.get_position()[side] <= axis.get_view_interval()[1]
        ]
        assert len(inside) >= 2
        spans = sorted(label.get_window_extent().get_points()[:, side].tolist() for label in inside)
        assert all(before[1] < after[0] for before, after in pairwise(spans))
