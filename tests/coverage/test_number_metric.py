"""Coverage numbers in the tracker and in collections of torchmetrics."""

import math
import pickle

import matplotlib.pyplot as plt
import pytest
import torch
from torchmetrics import MetricCollection
from torchmetrics.wrappers import MetricTracker

from torchcover import BevGrid, CoverageMetric, Region, nearest
from torchcover.coverage import CoverageNumberMetric, sums

GRID = BevGrid(x_m=(0.0, 8.0), y_m=(-2.0, 2.0), cell_m=1.0, heights={"low": (-1.0, 0.5), "high": (0.5, 2.0)})
NEAR, FAR = Region("near", (0.0, 4.0), (-2.0, 2.0)), Region("far", (4.0, 8.0), (-2.0, 2.0))
OPTIONS = {"thresholds_m": (0.4, 1.0), "max_radius_m": 9.0}
# The order of names and of creation differs from the order of directions.
NUMBERS = {
    "d_far": ("detection_1m", FAR, "high"),
    "a_radius": ("radius_m", NEAR, "low"),
    "c_near": ("detection_0.4m", NEAR, "low"),
    "b_radius": ("radius_m", FAR, "high"),
}


def step(seed, points=60):
    generator = torch.Generator().manual_seed(seed)
    clouds = [torch.rand(n, 3, generator=generator) * torch.tensor([8.0, 4.0, 3.0]) for n in (points, 200)]
    return [cloud - torch.tensor([0.0, 2.0, 1.0]) for cloud in clouds]


def numbers(**options):
    return {name: CoverageNumberMetric(*which, GRID, **OPTIONS, **options) for name, which in NUMBERS.items()}


def scalar(coverage, name):
    quantity, region, height = NUMBERS[name]
    return coverage.scalars([NEAR, FAR])[f"{quantity}/{region.name}/{height}"]


@pytest.mark.parametrize("options", [{}, {"has_area_weights": True, "num_blocks": 8}])
def test_a_number_is_that_of_the_summary(options):
    whole, each = CoverageMetric(GRID, **OPTIONS, **options), numbers(**options)
    for seed in range(3):
        clouds, weights = step(seed), torch.rand(200, generator=torch.Generator().manual_seed(seed)) + 0.1
        for one in (whole, *each.values()):
            one.update(*clouds, weights=weights)
    for name, one in each.items():
        result = pickle.loads(pickle.dumps(one)).compute()
        assert (result.shape, result.dtype) == ((), torch.float64)
        assert result.item() == scalar(whole.compute(), name)


@pytest.mark.parametrize("name", NUMBERS)
def test_tracker_uses_the_direction_of_the_number(name):
    tracker = MetricTracker(numbers()[name])
    for seed, points in enumerate((5, 400, 40)):  # the second rig detects most
        tracker.increment()
        tracker.update(*step(seed, points))
    best, at = tracker.best_metric(return_step=True)
    assert at == 1
    assert best == tracker.compute_all()[1].item()
    assert tracker.maximize == name.endswith(("far", "near"))


def test_collections_measure_each_frame_once(monkeypatch):
    searched = []
    monkeypatch.setattr(sums, "nearest", lambda *a, **o: (searched.append(1), nearest(*a, **o))[1])
    tracker = MetricTracker(MetricCollection(numbers()))
    truths = []
    for epoch, points in enumerate((5, 400, 40)):
        tracker.increment()
        whole = CoverageMetric(GRID, **OPTIONS)
        for seed in range(epoch, epoch + 3):
            searched.clear()
            tracker.update(*step(seed, points))
            whole.update(*step(seed, points))
        assert len(searched) == 2  # the collection groups metrics with equal sums after the first frame
        truths.append(whole.compute())
        assert tracker.compute() == tracker.compute() == {name: scalar(truths[-1], name) for name in NUMBERS}
    best, at = tracker.best_metric(return_step=True)
    assert at == dict.fromkeys(NUMBERS, 1)
    assert best == {name: scalar(truths[1], name) for name in NUMBERS}


def test_unknown_numbers_are_nan_and_never_best():
    tracker = MetricTracker(CoverageNumberMetric("radius_m", NEAR, "low", GRID))
    for reference in (torch.empty(0, 3), torch.tensor([[1.0, 0.0, 0.0]])):
        tracker.increment()
        tracker.update(torch.zeros(1, 3), reference)
    assert tracker.compute_all()[1] == 1.0
    assert math.isnan(tracker.best_metric())


def test_a_plot_shows_the_values():
    number = numbers()["a_radius"]
    values = [number(*step(seed)) for seed in range(3)]
    try:
        figure, axes = number.plot(values)
        assert axes.lines[0].get_ydata().tolist() == [value.item() for value in values]
        assert number.plot(ax=axes) == (figure, axes)
    finally:
        plt.close("all")


@pytest.mark.parametrize(
    ("which", "message"),
    [
        (("detection_2m", NEAR, "low"), r"quantity: one of radius_m, detection_0.4m, detection_1m is needed; got"),
        (("observed_share", NEAR, "low"), r"quantity: one of radius_m"),
        (("radius_m", NEAR, "ground"), r"height 'ground': the grid has low, high"),
        (("radius_m", Region("wide", (0.0, 9.0), (-2.0, 2.0)), "low"), r"region 'wide' spans"),
    ],
)
def test_what_there_is_not_is_refused_at_once(which, message):
    with pytest.raises(ValueError, match=message):
        CoverageNumberMetric(*which, GRID, **OPTIONS)
