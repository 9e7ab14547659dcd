"""Numbers of regions over observed cells."""

import math

import numpy as np
import pytest
import torch

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.coverage.averages import compute_cell_average

GRID = BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 4.0), cell_m=1.0, heights={"low": (0.0, 1.0), "high": (1.0, 2.0)})
PART = Region("part", x_m=(1.0, 7.0), y_m=(0.0, 3.0))


def steps_of(count, seed=0, points=12):
    """Sample clouds that observe some cells never and others once or twice."""
    random = np.random.default_rng(seed)
    return [
        (
            torch.from_numpy(random.uniform(0, 8, (20, 3)) / [1, 2, 4]),
            torch.from_numpy(random.beta(1, 2, (points, 3)) * [8, 4, 2]),
        )
        for _ in range(count)
    ]


def metric_over(steps, index=None, **options):
    metric = CoverageMetric(GRID, (0.4, 0.8), **options)
    for number, (sensor, reference) in zip(index or range(len(steps)), steps, strict=True):
        metric.update(sensor, reference, block_index=number)
    return metric


def test_jackknife_values_equal_runs_without_the_block():
    steps = steps_of(40)  # blocks of 4 steps, ten of them in use
    coverage = metric_over(steps, num_blocks=16).compute()
    for height in GRID.heights:
        estimate = coverage.estimate(PART, height)
        assert estimate.frame_counts.tolist() == [4] * 10
        for block in range(10):
            kept = [number for number in range(40) if number // 4 != block]
            without = metric_over([steps[number] for number in kept], kept).compute()
            expected = without.estimate(PART, height).value
            torch.testing.assert_close(estimate.jackknife_values[block], expected, rtol=1e-10, atol=1e-12)


def test_differences_are_taken_block_by_block():
    steps = steps_of(40)
    nearer = [(torch.cat([sensor, sensor + 0.2]), reference) for sensor, reference in steps]
    one, other = (metric_over(run, num_blocks=16).compute().estimate(PART, "low") for run in (steps, nearer))
    difference = other.subtract(one)
    torch.testing.assert_close(difference.value, other.value - one.value)
    assert (difference.error < one.error + other.error).all()
    assert (one.subtract(one).error == 0).all()


def test_without_blocks_values_have_no_error():
    estimate = metric_over(steps_of(40)).compute().estimate(PART, "low")
    assert estimate.value.isfinite().all()
    assert estimate.error.isnan().all()


def test_cell_average_equals_the_mean_of_the_map():
    coverage = metric_over(steps_of(9)).compute()
    for band, height in enumerate(GRID.heights):
        cells = coverage.radius[band][PART.mask_cells(GRID)]
        assert coverage.estimate(PART, height).value[0].item() == pytest.approx(cells.nanmean().item(), rel=1e-12)


def test_nothing_known_is_unknown():
    assert compute_cell_average(torch.zeros(5, dtype=torch.int64), torch.zeros(2, 5, dtype=torch.float64)).isnan().all()


def test_the_summary_has_the_numbers_with_their_errors():
    coverage = metric_over(steps_of(64, points=6), num_blocks=16).compute()
    row, estimate = coverage.summary([PART])[0], coverage.estimate(PART, "low")
    assert list(row.numbers) == ["radius_m", "detection_0.4m", "detection_0.8m"]
    assert [number.value for number in row.numbers.values()] == estimate.value.tolist()
    assert [number.error for number in row.numbers.values()] == estimate.error.tolist()
    assert not math.isnan(row.numbers["radius_m"].error)


def test_no_such_band_is_said():
    with pytest.raises(ValueError, match="height 'middle': the grid has low, high"):
        metric_over(steps_of(2)).compute().estimate(PART, "middle")


@pytest.mark.parametrize("average", ["cells", "area"])
def test_resampled_numbers_equal_runs_over_resampled_scenes(average):
    random = np.random.default_rng(1)
    steps = [(sensor, reference, torch.from_numpy(random.uniform(0.1, 2, 12))) for sensor, reference in steps_of(10)]

    def over(numbers):
        metric = CoverageMetric(GRID, (0.4, 0.8), num_blocks=16, has_area_weights=True)
        for number in numbers:
            sensor, reference, m2 = steps[number]
            metric.update(sensor, reference, weights=m2, block_index=number)
        coverage = metric.compute()
        return (coverage.estimate if average == "area" else coverage.paper_mean)(PART, "low")

    drawn = [0, 0, 3, 3, 3, 4, 5, 7, 8, 9]
    weights = torch.tensor(np.bincount(drawn, minlength=10), dtype=torch.float64)
    whole = over(range(10))
    once = torch.ones_like(weights)
    torch.testing.assert_close(whole.resample(torch.stack([weights, once]))[0], over(drawn).value)
    torch.testing.assert_close(whole.resample(once[None])[0], whole.value)
    torch.testing.assert_close(whole[1:].resample(1 - torch.eye(10)), whole.jackknife_values[:, 1:])


@pytest.mark.parametrize("has_area_weights", [True, False])
@pytest.mark.filterwarnings("ignore:.*this metric averages over cells")
def test_numbers_without_maps_equal_those_with_maps(has_area_weights):
    metric = CoverageMetric(GRID, (0.4, 0.8), num_blocks=16, has_area_weights=has_area_weights)
    for number, (sensor, reference) in enumerate(steps_of(40)):
        metric.update(sensor, reference, weights=reference[:, 0] + 0.1, block_index=number)
    places = [(PART, height) for height in GRID.heights]
    for place, result in zip(places, metric.estimate_regions(places), strict=True):
        expected = metric.compute().estimate(*place)
        assert result.quantities == expected.quantities
        for name in ("value", "jackknife_values", "frame_counts"):
            torch.testing.assert_close(getattr(result, name), getattr(expected, name), rtol=0, atol=0)
