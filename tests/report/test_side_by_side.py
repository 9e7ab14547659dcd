"""Several maps on one paper: what they share, and that none hides another."""

import math

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchcover.coverage import BevGrid
from torchcover.coverage.quantities import RADIUS
from torchcover.report import SensorView, build_color_scale, plot_side_by_side

GRID = BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0)
AROUND = BevGrid(x_m=(-10.0, 10.0), y_m=(-10.0, 10.0), cell_m=0.25)
SQUARE = BevGrid(x_m=(0.0, 10.0), y_m=(-5.0, 5.0), cell_m=1.0)
EGO = np.array([[1.0, 0.5], [-1.0, 0.5], [-1.0, -0.5], [1.0, -0.5]])


def pixels(figure: Figure) -> np.ndarray:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3] / 255.0


def panel(figure: Figure, at: int) -> np.ndarray:
    """The pixels of one map, row 0 at the top."""
    return cut(pixels(figure), figure, at)


def cut(everything: np.ndarray, figure: Figure, at: int) -> np.ndarray:
    (left, bottom), (right, top) = figure.axes[at].get_window_extent().get_points().round().astype(int)
    return everything[len(everything) - top : len(everything) - bottom, left:right]


def side_by_side(grid: BevGrid, arrays: dict[str, torch.Tensor], **options) -> Figure:
    return plot_side_by_side(arrays, grid, build_color_scale(RADIUS, torch.ones(2)), title="Title", **options)


def test_equal_values_have_equal_colors():
    values = torch.full(GRID.shape[1:], 0.5)
    figure = side_by_side(GRID, {"a": values, "b": values * torch.linspace(0.0, 2.0, 20)})
    first, second = panel(figure, 0), panel(figure, 1)
    middle = len(first) // 2
    assert (abs(second - first[middle, middle]).max(axis=2) < 0.06).any()
    assert abs(second[middle, 10] - second[middle, -10]).max() > 0.5
    assert len(figure.axes) == 3  # two maps, one colour bar


def test_long_maps_stack_and_square_maps_align():
    long = BevGrid(x_m=(0.0, 50.0), y_m=(-10.0, 10.0), cell_m=1.0)
    for grid, stacked in ((long, True), (SQUARE, False)):
        for names in ("ab", "abc"):
            figure = side_by_side(grid, {name: torch.zeros(grid.shape[1:]) for name in names})
            a, *others = (axes.get_position() for axes in figure.axes[:-1])
            for other in others:
                assert bool(a.x0 == pytest.approx(other.x0)) is stacked
                assert bool(a.y0 == pytest.approx(other.y0)) is not stacked
                assert a.width == pytest.approx(other.width)


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("grid", [GRID, AROUND, BevGrid(x_m=(0.0, 200.0), y_m=(-40.0, 40.0), cell_m=0.5)])
def test_panels_have_whole_pixels_without_overlap(count, grid):
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(grid.shape[1:], generator=generator)
    figure = side_by_side(grid, {f"rig {k}": values for k in range(count)}, subtitle="where")
    _, rows_, columns = grid.shape
    everything = pixels(figure)
    shown = [cut(everything, figure, at) for at in range(count)]
    for one in shown:
        assert one.shape == shown[0].shape
        assert (one.shape[0] % rows_, one.shape[1] % columns) == (0, 0)
        np.testing.assert_array_equal(one[3:-3, 3:-3], shown[0][3:-3, 3:-3])
    corners = [axes.get_window_extent().get_points() for axes in figure.axes[:-1]]
    np.testing.assert_allclose(corners, np.round(corners), atol=1e-3)
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    for at, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[at + 1 :])
    for edge in (everything[:5], everything[-5:], everything[:, :5], everything[:, -5:]):
        assert (edge == 1.0).all()


def test_panels_have_headings_and_one_legend():
    sensor = SensorView("lidar", np.eye(4), 90.0, (-9.0, 9.0), 5.0)
    arrays = {"$a": torch.zeros(GRID.shape[1:]), "b": torch.full(GRID.shape[1:], math.inf)}
    figure = side_by_side(GRID, arrays, ego_outline_m=EGO, sensors={"$a": [sensor], "b": [sensor]})
    assert [axes.texts[0].get_text() for axes in figure.axes[:2]] == ["$a", "b"]
    (legend,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    entries = [text.get_text() for text in legend.get_texts()]
    assert entries == [
        "unobserved (0 % of the cells)",
        "infinite: no sensor points in some frame (50.0 % of the cells)",
        "ego vehicle",
        "sensor, with its direction",
        "field of view, up to its range",
    ]
