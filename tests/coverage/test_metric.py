"""Coverage metric: definitions in closed form and against plain loops."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcover import BevGrid, CoverageMetric
from torchcover.coverage import FrameQuantiles, Maximum, MeanOfMeans, PooledMean, Quantiles

GRID = BevGrid(x_m=(-2.0, 3.0), y_m=(-1.5, 1.0), cell_m=0.5, heights={"high": (1.0, 2.0), "low": (-1.0, 0.5)})
ONE_CELL = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
NOTHING = torch.zeros(0, 3)
SETS_OF_THRESHOLDS = ((0.1,), (0.25,), (0.5,), (0.1, 0.25, 0.5), (0.25, 0.4, 3.0))
EVERY_AGGREGATION = (Maximum(), PooledMean(), Quantiles((0.25, 0.9)), FrameQuantiles((0.5,)))
OPTIONS = {"aggregations": EVERY_AGGREGATION}


def cloud(*rows, dtype=torch.float32):
    return torch.tensor(rows, dtype=dtype).reshape(-1, 3)


def points_at(*distances, dtype=torch.float32):
    """Create reference points in one cell at these distances from a sensor point at the origin."""
    return torch.tensor([[0.0, distance, 0.0] for distance in distances], dtype=dtype).reshape(-1, 3)


ORIGIN = cloud([0, 0, 0])


def coverage(steps, grid=ONE_CELL, *args, **kwargs):
    metric = CoverageMetric(grid, *args, **kwargs)
    for sensor, reference in steps:
        metric.update(sensor, reference)
    return metric.compute()


def map_of(result, name):
    """Return a map by its key, or by the name of an attribute."""
    return result.layers[name].values if name in result.layers else getattr(result, name)


def random_steps(seed, steps=3, dyadic=True, empty=True):
    """Sample clouds that reach beyond the grid; `dyadic` puts points on edges and at exact distances."""
    random = np.random.default_rng(seed)
    clouds = []
    for _ in range(steps):
        pair = [random.uniform(-4, 4, (random.integers(0 if empty else 1, 40), 3)) / [1, 1, 2] for _ in range(2)]
        clouds.append([torch.from_numpy(np.round(points * 4) / 4 if dyadic else points) for points in pair])
    return clouds


# Closed forms


@pytest.mark.parametrize("backend", ["cdist", "kdtree"])
def test_radius_of_one_sensor_point_above_a_plane(backend):
    """r is the distance to the sensor point; four reference points per cell, and one of two bands is empty."""
    grid = BevGrid(x_m=(-4.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0)
    x, y = torch.meshgrid(torch.arange(-4, 4, 0.5) + 0.25, torch.arange(-2, 2, 0.5) + 0.25, indexing="ij")
    plane = torch.stack([x.flatten(), y.flatten(), torch.zeros(128)], dim=1)
    result = coverage([(cloud([1, 0, 1]), plane)], grid, (1.5, 3.0), backend=backend)
    for row in range(4):
        for column in range(8):
            corners = [(column - 4 + dx, row - 2 + dy) for dx in (0.25, 0.75) for dy in (0.25, 0.75)]
            r = [math.sqrt((px - 1) ** 2 + py**2 + 1) for px, py in corners]
            assert result.radius[0, row, column].item() == pytest.approx(sum(r) / 4, rel=1e-6)
            for at, threshold in enumerate((1.5, 3.0)):
                assert result.detection[at, 0, row, column].item() == sum(d <= threshold for d in r) / 4
    assert (result.point_counts[0] == 4).all()
    assert result.radius[1].isnan().all()


def test_a_mean_of_means_not_a_pooled_mean():
    """A frame with 1 point in a cell weighs as much as a frame with 1000."""
    result = coverage([(ORIGIN, points_at(*[0.125] * 1000)), (ORIGIN, points_at(0.875))], aggregations=[PooledMean()])
    assert result.radius.item() == 0.5
    assert result.detection.item() == 0.5
    assert map_of(result, "radius_pooled_m").item() == (1000 * 0.125 + 0.875) / 1001
    assert (result.observed_frames.item(), result.point_counts.item()) == (2, 1001)


def test_frames_count_only_in_cells_with_points():
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    result = coverage([(ORIGIN, points_at(0.5)), (ORIGIN, cloud([1, 0, 0])), (ORIGIN, points_at(0.25))], grid)
    assert result.radius.flatten().tolist() == [0.375, 1.0]
    assert result.observed_frames.flatten().tolist() == [2, 1]


def test_nearest_sensor_points_may_lie_outside_the_grid():
    """The sensor cloud is never cropped."""
    outside = cloud([-0.25, 0.5, 0], [0.5, 0.5, 5.0])
    assert coverage([(outside, cloud([0.25, 0.5, 0]))]).radius.item() == 0.5


def test_reference_points_outside_the_grid_are_only_counted():
    inside = points_at(0.25, 0.75)
    outside = cloud([1, 0, 0], [-0.01, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1.01])
    alone, together = coverage([(ORIGIN, inside)]), coverage([(ORIGIN, torch.cat([outside, inside]))])
    assert torch.equal(alone.radius, together.radius)
    assert together.point_counts.item() == 2
    assert (alone.counts["outside_points"], together.counts["outside_points"]) == (0, 5)


def test_unknown_cells_are_nan_with_count_zero():
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    result = coverage([(ORIGIN, points_at(0.5))], grid, (0.4, 0.6), **OPTIONS)
    for values in (result.detection, *(layer.values for layer in result.layers.values())):
        assert values[..., 1].isnan().all()
        assert not values[..., 0].isnan().any()
    assert (result.observed_frames[..., 1].item(), result.point_counts[..., 1].item()) == (0, 0)


# Thresholds


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threshold", [0.4, 0.1, 0.7])
def test_a_point_at_exactly_the_threshold_is_detected(threshold, dtype):
    beyond = torch.nextafter(torch.tensor(threshold, dtype=dtype), torch.tensor(1.0, dtype=dtype)).item()
    origin = ORIGIN.to(dtype)
    assert coverage([(origin, points_at(threshold, dtype=dtype))], ONE_CELL, (threshold,)).detection.item() == 1
    assert coverage([(origin, points_at(beyond, dtype=dtype))], ONE_CELL, (threshold,)).detection.item() == 0


def test_several_thresholds_in_one_pass():
    result = coverage([(ORIGIN, points_at(0.0, 0.25, 0.5, 0.75))], ONE_CELL, (0.25, 0.0, 10.0, 0.5))
    assert result.detection.flatten().tolist() == [0.5, 0.25, 1.0, 0.75]
    assert result.thresholds_m == (0.25, 0.0, 10.0, 0.5)


def test_no_thresholds_give_no_detection():
    result = coverage([(ORIGIN, points_at(0.5))], ONE_CELL, ())
    assert result.detection.shape == (0, 1, 1, 1)
    assert result.radius.item() == 0.5


# Empty clouds, saturation, counts


def test_frames_without_sensor_points_are_blind():
    result = coverage(
        [(NOTHING, points_at(0.5)), (ORIGIN, points_at(0.5))], ONE_CELL, (0.75,), aggregations=[Maximum()]
    )
    assert (result.radius.item(), map_of(result, "radius_maximum_m").item()) == (math.inf, math.inf)
    assert (result.detection.item(), result.observed_frames.item()) == (0.5, 2)
    assert result.counts["empty_sensor_frames"] == 1


def test_an_empty_sensor_cloud_gives_max_radius():
    result = coverage([(NOTHING, points_at(0.5)), (ORIGIN, points_at(0.5))], max_radius_m=8.0)
    assert result.radius.item() == 4.25
    assert result.max_radius_m == 8.0


def test_blind_frames_detect_nothing_at_any_threshold():
    result = coverage([(NOTHING, points_at(0.5)), (ORIGIN, points_at(0.4, 0.5))], ONE_CELL, (0.4,), max_radius_m=0.4)
    assert result.detection.item() == 0.25
    assert result.radius.item() == pytest.approx(0.4)


def test_an_empty_reference_cloud_says_nothing():
    result = coverage([(ORIGIN, NOTHING), (ORIGIN, points_at(0.5)), (NOTHING, NOTHING)], **OPTIONS)
    assert (result.radius.item(), result.observed_frames.item()) == (0.5, 1)
    assert (result.counts["num_frames"], result.counts["empty_reference_frames"]) == (3, 2)
    assert result.counts["empty_sensor_frames"] == 1


def test_everything_that_happened_is_counted():
    steps = [
        (ORIGIN, torch.cat([points_at(0.25, 0.5, 0.75), cloud([7, 7, 7])])),
        (NOTHING, points_at(0.1, 0.2)),
        (ORIGIN, NOTHING),
        (ORIGIN, cloud([7, 7, 7])),
    ]
    assert coverage(steps, ONE_CELL, (0.4,), max_radius_m=0.5).counts == {
        "num_frames": 4,
        "empty_sensor_frames": 1,
        "empty_reference_frames": 1,
        "saturated_points": 4,
        "inside_points": 5,
        "outside_points": 2,
        "no_ground_points": 0,
    }


@pytest.mark.parametrize("max_radius", [0.5, 1e39, 1e300])
def test_max_radius_saturates_every_number(max_radius):
    steps = [(ORIGIN, points_at(0.25, 0.75))]
    result = coverage(steps, ONE_CELL, (0.4,), max_radius_m=max_radius, **OPTIONS)
    assert map_of(result, "radius_maximum_m").item() == min(0.75, max_radius)
    assert result.radius.item() == map_of(result, "radius_pooled_m").item() == (0.25 + min(0.75, max_radius)) / 2
    assert map_of(result, "radius_q0.9_m").item() <= max_radius


def test_bounded_searches_detect_exactly_the_same():
    """For detection rates alone, the search may end at the largest threshold."""
    steps = random_steps(11, steps=6)
    whole, bounded = (coverage(steps, GRID, (0.25, 0.5), max_radius_m=limit) for limit in (math.inf, 0.5))
    assert torch.equal(whole.detection.nan_to_num(-1), bounded.detection.nan_to_num(-1))
    assert (bounded.radius[bounded.observed_frames > 0] <= 0.5).all()


def test_without_radii_distant_points_change_no_bit():
    steps = random_steps(11, steps=6)
    near = [(sensor[torch.cdist(sensor, reference).amin(dim=1) <= 0.6], reference) for sensor, reference in steps]
    assert sum(len(sensor) for sensor, _ in near) < 0.5 * sum(len(sensor) for sensor, _ in steps)
    whole, less = coverage(steps, GRID, (0.25, 0.5)), coverage(near, GRID, (0.25, 0.5), needs_radii=False)
    assert torch.equal(whole.detection.nan_to_num(-1), less.detection.nan_to_num(-1))
    assert less.radius.isnan().all()
    assert less.counts["saturated_points"] == 0
    with pytest.raises(ValueError, match="needs_radii: aggregations and sensor_names need radii"):
        CoverageMetric(GRID, (0.25,), needs_radii=False, aggregations=[Maximum()])
    with pytest.raises(ValueError, match="belongs to another metric"):
        CoverageMetric(GRID, (0.25,)).merge_state(CoverageMetric(GRID, (0.25,), needs_radii=False))


# Against plain loops


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32), dyadic=st.booleans(), max_radius=st.sampled_from([math.inf, 2.0]))
def test_random_clouds_give_what_plain_loops_give(slow_coverage, seed, dyadic, max_radius):
    steps = random_steps(seed, dyadic=dyadic)
    thresholds = (0.5, 1.25, 2.0)
    expected = slow_coverage(GRID, steps, thresholds, max_radius)
    for backend in ("cdist", "kdtree"):
        result = coverage(steps, GRID, thresholds, max_radius_m=max_radius, backend=backend, **OPTIONS)
        for name, values in expected.items():
            np.testing.assert_allclose(map_of(result, name).numpy(), values, rtol=1e-12, err_msg=name)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_shorter_types_give_what_their_rounded_coordinates_give(slow_coverage, dtype):
    steps = [(sensor.to(dtype), reference.to(dtype)) for sensor, reference in random_steps(5, dyadic=False)]
    expected = slow_coverage(GRID, [[c.double() for c in step] for step in steps])
    result = coverage(steps, GRID)
    assert result.radius.dtype == result.detection.dtype == torch.float64
    np.testing.assert_allclose(result.radius.numpy(), expected["radius"], rtol=1e-6)
    np.testing.assert_array_equal(result.point_counts.numpy(), expected["point_counts"])


@pytest.mark.parametrize(
    ("dtype", "cell", "threshold"),
    [(torch.bfloat16, 0.5, 0.4), (torch.float16, 0.25, 0.4), (torch.float16, 1.0, 0.1), (torch.float32, 0.25, 1e-4)],
)
def test_dtypes_too_coarse_for_cells_are_refused(dtype, cell, threshold):
    grid = BevGrid(x_m=(0.0, 80.0), y_m=(-20.0, 20.0), cell_m=cell)
    metric, cloud = CoverageMetric(grid, (threshold,)), torch.zeros(3, 3)
    for clouds in ((cloud.to(dtype), cloud.double()), (cloud.double(), cloud.to(dtype))):
        with pytest.raises(ValueError, match=rf"{dtype}"[6:] + r" coordinates are .* apart at 80 m, .* wider type"):
            metric.update(*clouds)
    assert metric.compute().counts["num_frames"] == 0
    metric.update(cloud.double(), cloud.double())


@pytest.mark.filterwarnings("error")
def test_misleading_settings_cause_one_warning():
    grid = BevGrid(x_m=(0.0, 10.0), y_m=(0.0, 10.0), cell_m=1.0)
    ground = torch.rand(1200, 3) * torch.tensor([10.0, 10.0, 0.2])
    in_lidar_frame, over_cells, right = (CoverageMetric(grid, max_radius_m=9.0) for _ in range(3))
    in_lidar_frame.update(ground, ground - torch.tensor([0.0, 0.0, 1.8]))
    with pytest.warns(UserWarning, match=r"reference: 1,200 of 1,200 points lie outside .* in the vehicle frame"):
        in_lidar_frame.compute()
    in_lidar_frame.update(ground, ground - torch.tensor([0.0, 0.0, 1.8]))
    in_lidar_frame.compute()
    with pytest.warns(UserWarning, match="areas were passed, but this metric averages over cells"):
        over_cells.update(ground, ground, weights=torch.ones(1200))
    over_cells.update(ground, ground, weights=torch.ones(1200))
    right.update(ground, ground)
    right.compute()


# Laws


def assert_same(one, other):
    assert one.counts == other.counts
    assert one.layers.keys() == other.layers.keys()
    for name in ("observed_frames", "point_counts", *one.layers):
        torch.testing.assert_close(map_of(one, name), map_of(other, name), rtol=1e-12, atol=0, equal_nan=True)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_order_of_points_and_frames_does_not_matter(seed):
    steps = random_steps(seed)
    generator = torch.Generator().manual_seed(seed)
    shuffled = [[c[torch.randperm(len(c), generator=generator)] for c in step] for step in reversed(steps)]
    options = {"max_radius_m": 3.0, "aggregations": EVERY_AGGREGATION}
    assert_same(coverage(steps, GRID, **options), coverage(shuffled, GRID, **options))


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_lists_of_frames_equal_single_updates(seed):
    steps = random_steps(seed, steps=4)
    metric = CoverageMetric(GRID, **OPTIONS)
    metric.update([sensor for sensor, _ in steps], tuple(reference for _, reference in steps))
    assert_same(metric.compute(), coverage(steps, GRID, **OPTIONS))


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_more_sensor_points_never_make_it_worse(seed):
    steps = random_steps(seed, empty=False)
    more = [(torch.cat([sensor, sensor + 0.5]), reference) for sensor, reference in steps]
    before, after = coverage(steps, GRID, **OPTIONS), coverage(more, GRID, **OPTIONS)
    known = before.observed_frames > 0
    assert (after.radius <= before.radius + 1e-12)[known].all()
    assert (after.detection >= before.detection - 1e-12)[:, known].all()
    assert (map_of(before, "radius_maximum_m") >= before.radius - 1e-12)[known].all()


def test_points_detect_at_thresholds_above_their_error():
    points, reference = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(2)).unbind()
    error = torch.linspace(-0.6, 0.6, 40)[torch.randperm(40, generator=torch.Generator().manual_seed(3))]
    request = {thresholds: CoverageMetric(ONE_CELL, thresholds, max_radius_m=9.0) for thresholds in SETS_OF_THRESHOLDS}
    for metric in request.values():
        metric.update([points], [reference], errors_m=[error])
    result = {thresholds: metric.compute() for thresholds, metric in request.items()}
    (radius,) = {float(one.radius) for one in result.values()}
    assert radius == float(coverage([(points[error.abs() <= 0.4], reference)], max_radius_m=9.0).radius)
    for threshold in (0.1, 0.25, 0.5):
        (known,) = {float(one.detection[given.index(threshold)]) for given, one in result.items() if threshold in given}
        near = torch.cdist(reference, points[error.abs() <= threshold]).amin(dim=1) <= threshold
        assert known == pytest.approx(float(near.double().mean()))
    assert len({float(one) for one in result[0.1, 0.25, 0.5].detection}) == 3


def test_errors_are_in_the_order_of_sensors():
    points, reference = torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(2)).unbind()
    error, far = torch.linspace(-0.6, 0.6, 40), torch.full((5,), math.inf)
    by_name, plain = (CoverageMetric(ONE_CELL, (0.3,), max_radius_m=9.0, sensor_names=("a", "b")) for _ in range(2))
    by_name.update({"b": points[:5], "a": points}, reference, errors_m=torch.cat([far, error]))
    plain.update({"a": points[error.abs() <= 0.3], "b": NOTHING}, reference)
    layers, expected = (metric.compute().redundancy.layers for metric in (by_name, plain))
    assert [key for key in layers if "radius" not in key and torch.equal(layers[key].values, expected[key].values)] == [
        key for key in layers if "radius" not in key
    ]
    blind = CoverageMetric(ONE_CELL, (3.0,), max_radius_m=9.0)
    blind.update(points, reference, errors_m=torch.full((40,), 0.5))
    assert int(blind.empty_sensor_frames) == 1
    assert (float(blind.compute().radius), float(blind.compute().detection)) == (9.0, 1.0)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (
            torch.zeros(3),
            ValueError,
            r"errors_m\[0\]: the error in meters of each of 2 points of the rig is needed; got shape \(3,\) with 0 NaN",
        ),
        (torch.tensor([0.0, math.nan]), ValueError, r"errors_m\[0\]: .*got shape \(2,\) with 1 NaN"),
        ([torch.zeros(2)] * 2, ValueError, r"2 errors for 1 reference clouds; each frame needs one of each"),
        (0.1, TypeError, r"errors_m .*tensor"),
        ({"a": torch.zeros(2)}, TypeError, r"errors_m .*tensor"),
    ],
)
def test_errors_of_other_shapes_are_refused(given, error, message):
    metric = CoverageMetric(ONE_CELL)
    with pytest.raises(error, match=message):
        metric.update(torch.zeros(2, 3), torch.zeros(2, 3), errors_m=given)
    assert int(metric.num_frames) == 0


def test_a_step_split_in_two_is_another_number():
    """Frames are the unit: two halves of the points of a frame are not the frame."""
    whole = coverage([(ORIGIN, points_at(0.125, 0.5, 0.875))])
    parts = coverage([(ORIGIN, points_at(0.125)), (ORIGIN, points_at(0.5, 0.875))])
    assert whole.point_counts.item() == parts.point_counts.item()
    assert whole.radius.item() == 0.5
    assert parts.radius.item() == (0.125 + 0.6875) / 2


# Refused inputs


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"thresholds_m": (0.4, -0.1)}, r"thresholds_m: finite distances >= 0 in meters are needed; got \(0.4, -0.1\)"),
        ({"thresholds_m": (math.nan,)}, "thresholds_m: finite distances >= 0"),
        # A blind rig would detect all points within this threshold.
        ({"thresholds_m": (0.4, math.inf)}, r"thresholds_m: finite distances .*got \(0.4, inf\)"),
        ({"thresholds_m": (0.4, 0.5, 0.4)}, r"thresholds_m: values that differ in six digits.*got \(0.4, 0.5, 0.4\)"),
        ({"thresholds_m": (0.4, 0.40000004)}, "thresholds_m: values that differ in six digits"),
        ({"thresholds_m": (0.4, 3.0), "max_radius_m": 2.0}, "thresholds_m: at most max_radius_m = 2.0 m"),
        ({"max_radius_m": 0.0}, "max_radius_m: a positive distance in meters is needed; got 0.0"),
        ({"max_radius_m": -1.0}, "max_radius_m: a positive distance"),
        ({"max_radius_m": math.nan}, "max_radius_m: a positive distance"),
        ({"aggregations": [Maximum(), Maximum()]}, "aggregations: at most one of each class.*got maximum, maximum"),
        ({"aggregations": [MeanOfMeans((0.4,))]}, "none of the built-in ones is possible; got mean"),
    ],
)
def test_parameters_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        CoverageMetric(ONE_CELL, **options)


@pytest.mark.parametrize("thresholds", [0.4, "0.4", ("0.4",), {0.4: 1}])
def test_what_is_no_sequence_of_thresholds_is_refused(thresholds):
    with pytest.raises(
        TypeError, match=r"thresholds_m: a sequence of distances in meters, as in \(0.4,\), is needed; got"
    ):
        CoverageMetric(ONE_CELL, thresholds)


@pytest.mark.parametrize(
    ("index", "error", "message"),
    [
        (
            10**20,
            ValueError,
            r"block_index\[0\]: a number from 0 to 1,000,000,000,000,000 is needed; got 1000000000000000000",
        ),
        (-1, ValueError, r"block_index\[0\]: a number from 0"),
        (1.5, TypeError, "block_index: an integer, or a list with one per frame, is needed; got 1.5"),
        (["1"], TypeError, "block_index: an integer"),
    ],
)
def test_invalid_block_index_types_are_refused(index, error, message):
    metric = CoverageMetric(ONE_CELL, num_blocks=8)
    with pytest.raises(error, match=message):
        metric.update(ORIGIN, ORIGIN, block_index=index)
    assert int(metric.num_frames) == 0


def test_largest_block_index_has_a_block():
    metric = CoverageMetric(ONE_CELL, num_blocks=8)
    metric.update(ORIGIN, ORIGIN, block_index=np.int64(3))
    metric.update(ORIGIN, ORIGIN, block_index=10**15)
    assert metric.block_frame_counts.sum() == 2
    assert 8 * int(metric.frames_per_block) > 10**15


@pytest.mark.parametrize("aggregations", [Maximum(), (Quantiles,), ("maximum",)])
def test_what_is_no_sequence_of_aggregations_is_refused(aggregations):
    with pytest.raises(TypeError, match=r"aggregations: a sequence of objects such as Maximum\(\) is needed; got"):
        CoverageMetric(ONE_CELL, aggregations=aggregations)


BAD = torch.tensor([[0.0, 0.0, math.nan], [0.0, 0.0, 0.0], [math.inf, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("sensor", "reference", "error", "message"),
    [
        (BAD, ORIGIN, ValueError, r"sensor\[0\]: 2 of 3 points have NaN or infinite coordinates"),
        ([ORIGIN, ORIGIN], [ORIGIN, BAD], ValueError, r"reference\[1\]: 2 of 3 points have NaN"),
        (
            [ORIGIN],
            [ORIGIN, ORIGIN],
            ValueError,
            "1 sensor clouds for 2 reference clouds; each frame needs one of each",
        ),
        (torch.zeros(4, 2), ORIGIN, ValueError, r"sensor\[0\]: shape \(N, 3\) is needed; got \(4, 2\)"),
        ([ORIGIN], [torch.zeros(1, 3, dtype=torch.int64)], TypeError, r"reference\[0\]: .*got torch.int64"),
        (ORIGIN.numpy(), ORIGIN, TypeError, r"sensor \(one, or a list .* NumPy array of float32; torch.from_numpy"),
        (ORIGIN, ORIGIN.numpy(), TypeError, r"reference \(one, or a list with one per frame"),
        ([[0.0, 0.0, 0.0]], [ORIGIN], TypeError, r"sensor\[0\]: a floating-point torch tensor is needed; got list"),
    ],
)
def test_bad_clouds_are_refused_before_anything_is_added(sensor, reference, error, message):
    metric = CoverageMetric(ONE_CELL)
    before = metric.state_dict()
    with pytest.raises(error, match=message):
        metric.update(sensor, reference)
    assert all(torch.equal(before[name], value) for name, value in metric.state_dict().items())


def test_clouds_that_are_coarser_than_cells_are_refused():
    near = torch.rand(50, 3)
    for far, kind, refused in ((1e3, torch.float32, False), (1e6, torch.float32, True), (1e6, torch.float64, False)):
        grid = BevGrid(x_m=(far - 5.0, far + 5.0), y_m=(-5.0, 5.0), cell_m=0.5, heights={"all": (-1.0, 2.0)})
        cloud = (near.double() + torch.tensor([far, 0.0, 0.0])).to(kind)
        if not refused:
            assert CoverageMetric(grid).update(cloud, cloud) is None
            continue
        with pytest.raises(ValueError, match=r"sensor\[0\]: float32 coordinates are 0.12 m apart at 1,000,005 m"):
            CoverageMetric(grid).update(cloud, near)
