"""Aggregations beside the mean of means, each by its definition; and one that nobody here has heard of."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric
from torchcover.coverage import AGGREGATIONS, Aggregation, Layer, Quantiles, State, StepQuantiles
from torchcover.estimation import Quantity

ONE_CELL = BevGrid(x=(0.0, 1.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)})
NOTHING = torch.zeros(0, 3)
ORIGIN = torch.zeros(1, 3)


def points_at(*distances):
    """Reference points in the one cell, at these distances from a sensor point in the origin."""
    return torch.tensor([[0.0, distance, 0.0] for distance in distances]).reshape(-1, 3)


def coverage(steps, grid=ONE_CELL, **options):
    metric = CoverageMetric(grid, **options)
    for sensor, reference in steps:
        metric.update(sensor, reference)
    return metric.compute()


def quantile(steps, level, grid=ONE_CELL, kind=Quantiles, **options):
    result = coverage(steps, grid, aggregations=[kind((level,))], **options)
    return list(result.layers.values())[-1].values.item()


# Quantiles over points


@pytest.mark.parametrize("level", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_quantiles_are_right_within_a_bin(level):
    """A bin is 12 % wide, or 1 cm."""
    grid = BevGrid(x=(0.0, 64.0), y=(0.0, 64.0), cell=64.0, heights={"all": (-1.0, 1.0)})
    random = np.random.default_rng(0)
    distances = np.concatenate([10 ** random.uniform(-4, 1.7, 801)])
    expected = np.quantile(distances, level, method="inverted_cdf")
    assert abs(quantile([(ORIGIN, points_at(*distances))], level, grid) - expected) <= max(0.123 * expected, 0.01)


def test_steps_weigh_the_same_in_a_quantile():
    steps = [(ORIGIN, points_at(*[0.1] * 500)), (ORIGIN, points_at(0.8)), (ORIGIN, points_at(0.8))]
    assert quantile(steps, 0.5) == pytest.approx(0.8, rel=0.13)


def test_quantiles_beyond_the_histogram_are_max_radius():
    grid = BevGrid(x=(0.0, 512.0), y=(0.0, 512.0), cell=512.0, heights={"all": (-1.0, 1.0)})
    steps = [(ORIGIN, points_at(1.0, 200.0, 300.0))]
    assert quantile(steps, 0.9, grid, max_radius=250.0) == 250.0
    assert quantile(steps, 0.9, grid) == math.inf
    assert quantile([(NOTHING, points_at(0.5))], 0.5) == math.inf


def test_the_least_value_is_not_zero_unless_a_value_is():
    least = quantile([(ORIGIN, points_at(0.5, 0.75))], 0.0)
    assert least == pytest.approx(0.5, rel=0.13)
    assert quantile([(ORIGIN, points_at(0.0, 0.75))], 0.0) == 0


# Quantiles over steps


@pytest.mark.parametrize("level", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_a_quantile_over_steps_is_that_of_the_means(level):
    random = np.random.default_rng(3)
    steps = [random.uniform(0.02, 0.9, random.integers(1, 9)) for _ in range(101)]
    means = [np.float32(step).astype(float).mean() for step in steps]
    found = quantile([(ORIGIN, points_at(*step)) for step in steps], level, kind=StepQuantiles)
    expected = np.quantile(means, level, method="inverted_cdf")
    assert abs(found - expected) <= max(0.123 * expected, 0.01)


def test_a_bad_moment_is_no_bad_point():
    """One point in a hundred is blind in every step: no step is bad. One step in ten is blind: it is."""
    spread = [(ORIGIN, points_at(*[0.02] * 99, 0.9))] * 10
    assert quantile(spread, 0.95, kind=StepQuantiles) < 0.04
    moment = [(ORIGIN, points_at(*[0.02] * 10))] * 9 + [(ORIGIN, points_at(*[0.9] * 10))]
    assert quantile(moment, 0.95, kind=StepQuantiles) == pytest.approx(0.9, rel=0.13)


def test_blind_steps_saturate_and_unprobed_ones_do_not_count():
    steps = [(ORIGIN, points_at(0.1)), (ORIGIN, NOTHING), (NOTHING, points_at(0.1))]
    assert quantile(steps, 1.0, kind=StepQuantiles) == math.inf
    assert quantile(steps, 1.0, kind=StepQuantiles, max_radius=2.0) == 2.0
    assert quantile(steps, 0.4, kind=StepQuantiles) == pytest.approx(0.1, rel=0.13)


# Any other


@dataclass(frozen=True)
class Minimum(Aggregation):
    """The smallest radius: all that an aggregation has to be."""

    name: ClassVar[str] = "minimum"
    words: ClassVar[str] = "minima"

    def states(self, cells):
        return {"negative": State(torch.full((cells,), -math.inf, dtype=torch.float64), reduction="max")}

    def update(self, sums, step):
        sums["negative"].scatter_reduce_(0, step.cell, -step.radius, "amax")

    def layers(self, sums, probed_steps, max_radius):
        quantity = Quantity("radius_minimum_m", "smallest blind spot radius", "m", lower_is_better=True)
        return [Layer(quantity, (-sums["negative"]).where(probed_steps > 0, math.nan))]


def test_an_aggregation_of_ones_own_is_measured_merged_saved_and_loaded(tmp_path):
    grid = BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=1.0, heights={"all": (-1.0, 1.0)})
    one, other = (CoverageMetric(grid, aggregations=[Minimum()], blocks=8) for _ in range(2))
    one.update(ORIGIN, points_at(0.5, 0.25))
    other.update(ORIGIN, points_at(0.75, 0.125), index=1)
    one.merge_state(other)
    one.compute().save(tmp_path / "coverage.npz")
    layer = Coverage.load(tmp_path / "coverage.npz").layers["radius_minimum_m"]
    assert layer.quantity.title == "smallest blind spot radius"
    assert layer.values.flatten().tolist() == pytest.approx([0.125, math.nan], nan_ok=True)
    with pytest.raises(ValueError, match="cannot merge metrics with different aggregations"):
        one.merge_state(CoverageMetric(grid, blocks=8))


def test_aggregations_have_names_of_their_own():
    assert len({kind.name for kind in AGGREGATIONS}) == len({kind.words for kind in AGGREGATIONS}) == len(AGGREGATIONS)
