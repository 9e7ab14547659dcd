"""Averages over area: ratios of sums that depend neither on cells nor on the number of points."""

import math

import numpy as np
import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.data import SimulatedFrames
from torchcover.simulation import SurfaceReference

REGION = Region("all", x_m=(0.0, 8.0), y_m=(0.0, 4.0))
HEIGHTS = {"low": (0.0, 1.0), "high": (1.0, 2.0)}


def grid(cell_m=1.0):
    return BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 4.0), cell_m=cell_m, heights=HEIGHTS)


def steps_of(count, seed=0, points=40):
    """Sample sensor clouds, reference clouds and area weights over ten decades for some frames."""
    random = torch.Generator().manual_seed(seed)
    size = torch.tensor([8.0, 4.0, 2.0])
    return [
        (
            torch.rand(20, 3, generator=random) * size,
            torch.rand(points, 3, generator=random) * size,
            10 ** (10 * torch.rand(points, generator=random) - 5),
        )
        for _ in range(count)
    ]


def metric_over(steps, index=None, cell_m=1.0, **options):
    metric = CoverageMetric(grid(cell_m), (0.4, 0.8), has_area_weights=True, **options)
    for number, (sensor, reference, m2) in zip(index or range(len(steps)), steps, strict=True):
        metric.update(sensor, reference, weights=m2, block_index=number)
    return metric


def by_hand(steps, low, high):
    """Compute the radius and the detections over all points in a band, weighted by area."""
    sums, whole = torch.zeros(3, dtype=torch.float64), 0.0
    for sensor, reference, m2 in steps:
        radius = torch.cdist(reference.double(), sensor.double()).amin(dim=1)
        inside = m2.double() * ((reference[:, 2] >= low) & (reference[:, 2] < high))
        sums += torch.stack([(inside * part).sum() for part in (radius, radius <= 0.4, radius <= 0.8)])
        whole += inside.sum()
    return sums / whole


@pytest.mark.parametrize("cell", [0.25, 1.0, 4.0])
def test_area_average_is_independent_of_the_cells(cell):
    steps = steps_of(9)
    coverage = metric_over(steps, cell_m=cell).compute()
    for height, band in HEIGHTS.items():
        estimate = coverage.estimate(REGION, height)
        torch.testing.assert_close(estimate.value, by_hand(steps, *band), rtol=1e-6, atol=1e-9)
        assert estimate.error.isnan().all()


def test_jackknife_values_equal_runs_without_the_block():
    steps = steps_of(40)
    coverage = metric_over(steps, num_blocks=16).compute()
    estimate = coverage.estimate(REGION, "low")
    assert estimate.frame_counts.tolist() == [4] * 10
    for block in range(10):
        kept = [number for number in range(40) if number // 4 != block]
        without = by_hand([steps[number] for number in kept], *HEIGHTS["low"])
        torch.testing.assert_close(estimate.jackknife_values[block], without, rtol=1e-6, atol=1e-9)
    assert (estimate.error > 0).all()


def test_points_that_are_split_up_change_nothing():
    whole = steps_of(8)
    halves = [(sensor, reference.repeat(4, 1), m2.repeat(4) / 4) for sensor, reference, m2 in whole]
    values = [metric_over(steps).compute().estimate(REGION, "low").value for steps in (whole, halves)]
    torch.testing.assert_close(*values, rtol=1e-9, atol=0)


@pytest.mark.parametrize("blocks", [1, 8])
def test_area_sums_merge_and_load_exactly(tmp_path, blocks):
    steps = steps_of(20)
    whole = metric_over(steps, num_blocks=blocks)
    first, second = (
        metric_over(steps[:7], num_blocks=blocks),
        metric_over(steps[7:], list(range(7, 20)), num_blocks=blocks),
    )
    first.merge_state(second)
    coverage = whole.compute()
    coverage.save(tmp_path / "coverage.npz")
    loaded = Coverage.load(tmp_path / "coverage.npz")
    for other, exact in ((first.compute(), 1e-12), (loaded, 0.0)):
        one, two = (each.estimate(REGION, "high") for each in (coverage, other))
        torch.testing.assert_close(one.value, two.value, rtol=exact, atol=0)
        torch.testing.assert_close(one.jackknife_values, two.jackknife_values, rtol=exact, atol=0)
    assert torch.equal(loaded.layers["radius_area_m"].values, coverage.layers["radius_area_m"].values)


# Overlapping regions whose bounds are no edges of 0.32 m cells; the last is the rest of the first.
ODD = (
    Region("near", x_m=(0.4, 3.3), y_m=(0.5, 2.1)),
    Region("far", x_m=(2.9, 7.77), y_m=(0.0, 4.0)),
    Region.from_corners("corner", [(0.5, 0.5), (6.0, 0.5), (0.5, 3.7)]),
    Region.from_corners("rest", [(6.0, 0.5), (7.0, 3.7), (0.5, 3.7)]),
)


def of_odd(steps, index=None, regions=ODD):
    odd = BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 6.4), cell_m=0.32, heights=HEIGHTS)
    metric = CoverageMetric(odd, (0.4, 0.8), has_area_weights=True, num_blocks=8, regions=regions)
    for number, (sensor, reference, m2) in zip(index or range(len(steps)), steps, strict=True):
        metric.update(sensor, reference, weights=m2, block_index=number)
    return metric


def twin(steps, region, low, high):
    """Test points in NumPy one by one; for polygons by the side of each edge."""
    sums, whole = np.zeros(3), 0.0
    for sensor, reference, m2 in steps:
        points = reference.double().numpy()
        radius = np.linalg.norm(points[:, None] - sensor.double().numpy(), axis=2).min(axis=1)
        x, y, z = points.T
        inside = (z >= low) & (z < high) & (x >= region.x_m[0]) & (x < region.x_m[1])
        inside &= (y >= region.y_m[0]) & (y < region.y_m[1])
        for (ax, ay), (bx, by) in zip(region.corners_m, region.corners_m[1:] + region.corners_m[:1], strict=True):
            inside &= (bx - ax) * (y - ay) > (by - ay) * (x - ax)
        weight = m2.double().numpy() * inside
        sums += [(weight * each).sum() for each in (radius, radius <= 0.4, radius <= 0.8)]
        whole += weight.sum()
    return sums / whole


def test_points_belong_to_regions_by_position():
    steps = steps_of(20, points=150)
    coverage = of_odd(steps).compute()
    for region in ODD:
        for height, band in HEIGHTS.items():
            result = coverage.estimate(region, height)
            np.testing.assert_allclose(result.value, twin(steps, region, *band), rtol=1e-6)
            np.testing.assert_allclose(result.jackknife_values[0], twin(steps[1:], region, *band), rtol=1e-6)
            (row,) = (row for row in coverage.summary([region]) if row.band == height)
            assert row.visible_m2 > 0
    # Assignment by cell centers gives another number.
    cells = coverage.area_sums.sum_cells(ODD[0].mask_cells(coverage.grid), 0).sum(dim=0)
    assert abs(cells[1] / cells[0] / coverage.estimate(ODD[0], "low").value[0] - 1) > 1e-3


def test_area_average_is_independent_of_any_order():
    steps = steps_of(16, points=60)
    random = torch.Generator().manual_seed(1)
    orders = [torch.randperm(60, generator=random) for _ in steps]
    shuffled = [(sensor, points[at], m2[at]) for (sensor, points, m2), at in zip(steps, orders, strict=True)]
    split = [(sensor, points.repeat(2, 1), m2.repeat(2) / 2) for sensor, points, m2 in steps]
    parts = of_odd(steps[9:], range(9, 16))
    parts.merge_state(of_odd(steps[:9]))
    others = [of_odd(shuffled), of_odd(split), of_odd(steps[::-1], range(15, -1, -1)), parts]
    whole = of_odd(steps).compute()
    for coverage in (other.compute() for other in others):
        for region in ODD:
            one, two = (each.estimate(region, "high") for each in (whole, coverage))
            torch.testing.assert_close(one.value, two.value, rtol=1e-12, atol=0)
            torch.testing.assert_close(one.jackknife_values, two.jackknife_values, rtol=1e-12, atol=0)
    with pytest.raises(ValueError, match="cannot merge metrics with different regions"):
        parts.merge_state(of_odd(steps[:1], regions=ODD[:1]))


def test_other_regions_need_bounds_on_cell_edges(tmp_path):
    of_odd(steps_of(20)).compute().save(tmp_path / "coverage.npz")
    loaded, request = Coverage.load(tmp_path / "coverage.npz"), Region("later", x_m=(0.32, 3.2), y_m=(0.64, 1.6))
    there = of_odd(steps_of(20), regions=[request]).compute()
    one, two = (each.estimate(request, "low") for each in (there, loaded))
    torch.testing.assert_close(one.value, two.value, rtol=1e-12, atol=0)
    assert (len(one.frame_counts), len(two.frame_counts)) == (20, 5)  # sums over cells are in fewer blocks
    assert str(loaded.summary(ODD)) == str(of_odd(steps_of(20)).compute().summary(ODD))
    for other in (
        Region("later", x_m=(0.3, 3.2), y_m=(0.64, 1.6)),
        Region.from_corners("later", [(0, 0), (3.2, 0), (0, 3.2)]),
    ):
        with pytest.raises(
            ValueError,
            match=r"'later': its points were not summed, and its bounds are not edges of the cells of 0\.32 m",
        ):
            loaded.estimate(other, "low")
        assert loaded.paper_mean(other, "low").value.isfinite().all()


def test_cells_have_the_ratio_of_their_sums():
    coverage = metric_over(steps_of(30), cell_m=4.0).compute()
    band = coverage.area_sums.sum_blocks()[0, 0]
    radius = coverage.layers["radius_area_m"].values[0]
    detection = coverage.layers["detection_area_0.8m"].values[0]
    value = coverage.estimate(REGION, "low").value
    assert ((radius * band).sum() / band.sum()).item() == pytest.approx(value[0].item(), rel=1e-12)
    assert ((detection * band).sum() / band.sum()).item() == pytest.approx(value[2].item(), rel=1e-12)


def test_regions_without_surface_are_unknown():
    sensor, nowhere, none = torch.zeros(1, 3), torch.zeros(0, 3), torch.zeros(0)
    assert metric_over([(sensor, nowhere, none)]).compute().estimate(REGION, "low").value.isnan().all()
    one = (torch.zeros(0, 3), torch.tensor([[1.0, 1.0, 0.5]]), torch.tensor([2.0]))
    value = metric_over([one]).compute().estimate(REGION, "low").value
    assert value.tolist() == [math.inf, 0.0, 0.0]


def test_it_needs_has_area_weights():
    sensor, reference, _ = steps_of(1)[0]
    with pytest.raises(ValueError, match="weights: the area of each reference point in m2 is needed"):
        CoverageMetric(grid(), has_area_weights=True).update(sensor, reference)
    with pytest.raises(ValueError, match="different has_area_weights"):
        metric_over(steps_of(1)).merge_state(CoverageMetric(grid(), (0.4, 0.8)))


def test_the_ray_budget_does_not_move_it():
    ahead = Region("ahead", x_m=(0.0, 40.0), y_m=(-10.0, 10.0))
    few, many = (
        simulated(ahead, SurfaceReference(((ahead.x_m, ahead.y_m),), rays), steps=steps)
        for rays, steps in ((512, 32), (4096, 32))
    )
    for height in ("ground", "obstacle"):
        for ours, theirs in zip(few[height], many[height], strict=True):
            error = math.hypot(ours[1], theirs[1])
            assert abs(ours[0] - theirs[0]) < 4 * error
            assert error < 0.12 * theirs[0]


def simulated(region, reference_sensor, steps):
    """Compute (value, error) of the radius and of the detection by band."""
    metric = CoverageMetric(
        BevGrid(x_m=region.x_m, y_m=region.y_m, cell_m=0.5), max_radius_m=50.0, num_blocks=16, has_area_weights=True
    )
    for frame in SimulatedFrames("courtyard", "front_roof_32", num_frames=steps, reference_sensor=reference_sensor):
        metric.update(frame.sensor, frame.reference, weights=frame.reference_weights, block_index=frame.index)
    coverage = metric.compute()
    estimates = {height: coverage.estimate(region, height) for height in ("ground", "obstacle")}
    return {
        height: list(zip(result.value.tolist(), result.error.tolist(), strict=True))
        for height, result in estimates.items()
    }
