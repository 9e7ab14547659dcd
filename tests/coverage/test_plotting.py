"""Maps of `CoverageMetric.plot`."""

import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib import colormaps

from torchcover import BevGrid, CoverageMetric

GRID = BevGrid(x_m=(5.0, 8.0), y_m=(-1.0, 1.0), cell_m=1.0, heights={"low": (-1.0, 0.0), "high": (0.0, 1.0)})
AHEAD = torch.tensor([[5.5, -0.5, 0.5]])  # in the first cell of the band "high"


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def metric_over(sensor, reference, **options):
    metric = CoverageMetric(GRID, **options)
    metric.update(sensor, reference, weights=torch.ones(len(reference)))
    return metric


def drawn(axes):
    return axes.collections[0]


def test_maps_show_the_layer_and_the_vehicle():
    sensor = torch.tensor([[5.5, -0.5, 0.5]])
    metric = metric_over(sensor, sensor + torch.tensor([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]), max_radius_m=9.0)
    _, axes = metric.plot(band="high", quantity_key="radius_m")
    corners = drawn(axes).get_coordinates()
    assert (corners[0, 0].tolist(), corners[-1, -1].tolist()) == ([5.0, -1.0], [8.0, 1.0])
    values = drawn(axes).get_array()
    np.testing.assert_array_equal(values.mask, [[False, True, True], [True, True, False]])
    np.testing.assert_allclose(values.compressed(), [0.0, math.sqrt(5)], rtol=1e-6)
    assert axes.lines[0].get_xydata().tolist() == [[0.0, 0.0]]
    assert (axes.get_xlim(), axes.get_ylim()) == ((0.0, 8.0), (-1.0, 1.0))
    assert axes.get_title() == "mean blind spot radius, high, 1 frames (gray: unobserved)"


@pytest.mark.parametrize(
    ("options", "title"),
    [
        ({}, "detection within 0.4 m, low, 1 frames (gray: unobserved)"),
        ({"thresholds_m": ()}, "mean blind spot radius, low, 1 frames (gray: unobserved)"),
        ({"has_area_weights": True}, "detection within 0.4 m, by area, low, 1 frames (gray: unobserved)"),
    ],
)
def test_maps_show_the_first_detection_by_default(options, title):
    _, axes = metric_over(AHEAD, AHEAD, **options).plot()
    assert axes.get_title() == title


def test_blind_cells_are_dark_and_unobserved_gray():
    metric = metric_over(torch.empty(0, 3), AHEAD)
    darkest = colormaps["viridis"](0.0)
    for layer in ("radius_m", "detection_0.4m"):
        figure, axes = metric.plot(quantity_key=layer, band="high")
        figure.canvas.draw()
        assert tuple(drawn(axes).get_facecolors()[0]) == pytest.approx(darkest)
        assert drawn(axes).get_facecolors()[1][3] == 0.0


def test_unknown_layers_and_bands_are_refused():
    metric = metric_over(AHEAD, AHEAD)
    with pytest.raises(ValueError, match=r"layer: one of radius_m, detection_0.4m is needed; got 'detection'"):
        metric.plot(quantity_key="detection")
    with pytest.raises(ValueError, match=r"height 'ground': the grid has low, high"):
        metric.plot(band="ground")
