"""Blocks of frames and their standard errors against plain loops; weights of reference points."""

import copy
import math

import numpy as np
import pytest
import torch

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.coverage import Coverage, Layer, Maximum, MeanOfMeans, PooledMean, Quantiles
from torchcover.coverage.sparse_sums import BlockSums, ObservedCells
from torchcover.estimation import compute_jackknife_error, estimate_ratio_errors

# In cells of this size the sensor point below a reference point is always the nearest.
SHAPE = {"x_m": (0.0, 400.0), "y_m": (0.0, 100.0), "cell_m": 100.0, "heights": {"all": (-1.0, 1.0)}}
GRID = BevGrid(**SHAPE)
CELLS = GRID.num_cells
THRESHOLD = 0.5
EVERYWHERE = Region("everywhere", GRID.x_m, GRID.y_m)


def clouds_of(radii: dict[int, list[float]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Create clouds with these radii in these cells: a sensor point vertically below each reference point."""
    places = [(100 * cell + 10 + 20 * at, 50.0, radius) for cell, own in radii.items() for at, radius in enumerate(own)]
    x, y, radius = torch.tensor(places, dtype=torch.float32).view(-1, 3).T
    return torch.stack([x, y, -radius], dim=1), torch.stack([x, y, 0 * radius], dim=1)


def random_steps(count: int, seed: int = 0, *, dyadic: bool = False, weighted: bool = False) -> list[dict]:
    """Sample frames with one to three points in some cells: radii, clouds, and further arguments of `update`."""
    random = np.random.default_rng(seed)
    steps = []
    for index in range(count):
        cells = np.flatnonzero(random.random(CELLS) < 0.6)
        if dyadic:  # means and sums of two such values are exact
            radii = {int(cell): (random.integers(0, 64, 2) / 64).tolist() for cell in cells}
        else:
            radii = {int(cell): random.random(random.integers(1, 4)).tolist() for cell in cells}
        weights = {cell: (random.random(len(own)) + 0.1).tolist() for cell, own in radii.items()}
        more = {"block_index": index}
        if weighted:
            more["weights"] = torch.tensor([weight for own in weights.values() for weight in own], dtype=torch.float64)
        steps.append({"radii": radii, "weights": weights, "clouds": clouds_of(radii), "more": more})
    return steps


def metric_over(steps, *, blocks=16, **options) -> CoverageMetric:
    metric = CoverageMetric(GRID, (THRESHOLD,), num_blocks=blocks, **options)
    for step in steps:
        metric.update(*step["clouds"], **step["more"])
    return metric


def slow_blocks(steps, blocks: int, *, weighted: bool = False) -> dict[str, np.ndarray]:
    """Compute the sums in blocks by plain loops."""
    last = max(step["more"]["block_index"] for step in steps)
    length = 1
    while last // length >= blocks:
        length *= 2
    sums = {name: np.zeros((blocks, CELLS)) for name in ("observed_frames", "radius", "detection")}
    sums["steps"] = np.zeros(blocks)
    for step in steps:
        block = step["more"]["block_index"] // length
        sums["steps"][block] += 1
        for cell, own in step["radii"].items():
            weights = step["weights"][cell] if weighted else [1.0] * len(own)
            radii = np.float32(own).astype(float)
            sums["observed_frames"][block, cell] += 1
            sums["radius"][block, cell] += np.average(radii, weights=weights)
            sums["detection"][block, cell] += np.average(radii <= THRESHOLD, weights=weights)
    return sums


def slow_jackknife(left_out: list[float], whole: float, sizes: list[float]) -> float:
    """Compute the delete-m_j jackknife in the notation of Busing, Meijer and van der Leeden."""
    g, n = len(sizes), sum(sizes)
    estimate = g * whole - sum((1 - m / n) * part for m, part in zip(sizes, left_out, strict=True))
    variance = 0.0
    for m, part in zip(sizes, left_out, strict=True):
        h = n / m
        variance += (h * whole - (h - 1) * part - estimate) ** 2 / (h - 1) / g
    return math.sqrt(variance)


def slow_region_error(sums: dict[str, np.ndarray], name: str) -> float:
    def mean(kept) -> float:
        frames, total = sums["observed_frames"][kept].sum(axis=0), sums[name][kept].sum(axis=0)
        return float(np.mean([total[cell] / frames[cell] for cell in range(CELLS) if frames[cell]]))

    used = [block for block in range(len(sums["steps"])) if sums["steps"][block]]
    left_out = [mean([other for other in used if other != block]) for block in used]
    return slow_jackknife(left_out, mean(used), [sums["steps"][block] for block in used])


def assert_same_state(one: CoverageMetric, other: CoverageMetric) -> None:
    """Check equality of all bits."""
    for name, value in one.metric_state.items():
        assert torch.equal(value, other.metric_state[name]), name


# The jackknife


@pytest.mark.parametrize("count", [8, 9, 100])
def test_jackknife_of_a_mean_equals_its_standard_error(count):
    values = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(count))
    left_out = (values.sum(dim=0) - values) / (count - 1)
    error = compute_jackknife_error(left_out, values.mean(dim=0), torch.ones(count))
    torch.testing.assert_close(error, values.std(dim=0) / math.sqrt(count))


@pytest.mark.parametrize("seed", range(3))
def test_unequal_blocks_are_weighed_as_in_plain_loops(seed):
    random = np.random.default_rng(seed)
    sizes, left_out, whole = random.integers(1, 9, 11), random.random(11), random.random()
    error = compute_jackknife_error(*map(torch.as_tensor, (left_out, np.array(whole), sizes)))
    assert float(error) == pytest.approx(slow_jackknife(left_out.tolist(), whole, sizes.tolist()), rel=1e-12)


def test_equal_blocks_give_no_interval():
    coverage = metric_over(
        [{"clouds": clouds_of({0: [0.25]}), "more": {"block_index": at}} for at in range(40)]
    ).compute()
    (row,) = coverage.summary([EVERYWHERE])
    assert row.numbers["radius_m"].value == 0.25
    for number in row.numbers.values():
        assert all(map(math.isnan, (number.error, number.low, number.high)))


@pytest.mark.parametrize(("radius", "detection_error"), [(0.25, 1.0), (1.0, 1.0), (0.0, 1.0)])
def test_cell_errors_are_never_zero(radius, detection_error):
    """Ten equal blocks and two pseudo-blocks with everything or nothing detected: 12 values around a mean of 10."""
    coverage = metric_over(
        [{"clouds": clouds_of({0: [radius]}), "more": {"block_index": at}} for at in range(40)]
    ).compute()
    each = math.sqrt(12 / 11) / 12
    assert float(coverage.errors["detection_0.5m"].flatten()[0]) == pytest.approx(each * detection_error)
    expected = radius * math.sqrt(1 + 4**2) * each
    assert float(coverage.errors["radius_m"].flatten()[0]) == pytest.approx(expected or math.nan, nan_ok=True)


def test_one_frame_per_block_gives_the_textbook_error():
    radii = np.random.default_rng(0).random(16).astype(np.float32)
    steps = [
        {"clouds": clouds_of({2: [float(radius)]}), "more": {"block_index": at}} for at, radius in enumerate(radii)
    ]
    coverage = metric_over(steps).compute()
    expected = radii.astype(float).std(ddof=1) / 4
    assert coverage.summary([EVERYWHERE])[0].numbers["radius_m"].error == pytest.approx(expected)


@pytest.mark.parametrize("count", [8, 16, 17, 40, 77])
def test_sums_and_errors_are_those_of_plain_loops(count):
    steps = random_steps(count, seed=count)
    coverage, sums = metric_over(steps).compute(), slow_blocks(steps, 16)
    np.testing.assert_array_equal(coverage.block_sums.frame_counts, sums["steps"])
    cells, probed_steps, listed = coverage.block_sums.extract_common_cells(1)
    assert cells.tolist() == list(range(CELLS))
    np.testing.assert_array_equal(probed_steps, sums["observed_frames"])
    np.testing.assert_allclose(listed[0], sums["radius"], rtol=1e-12)
    np.testing.assert_allclose(listed[1], sums["detection"], rtol=1e-12)
    (row,) = coverage.summary([EVERYWHERE])
    assert row.numbers["radius_m"].error == pytest.approx(slow_region_error(sums, "radius"), rel=1e-9)
    assert row.numbers["detection_0.5m"].error == pytest.approx(slow_region_error(sums, "detection"), rel=1e-9)


def test_cell_errors_use_two_pseudo_blocks():
    steps = random_steps(64, seed=3)
    coverage, sums = metric_over(steps).compute(), slow_blocks(steps, 16)
    for name, result in zip(("radius", "detection"), coverage.errors.values(), strict=True):
        for cell in range(CELLS):
            n, s = sums["observed_frames"][:, cell], sums[name][:, cell]
            mean, usual = s.sum() / n.sum(), n.sum() / np.count_nonzero(n)
            imagined = [0.0, 5.0 * mean] if name == "radius" else [0.0, 1.0]
            residual = [s[j] - mean * n[j] for j in range(16) if n[j]] + [usual * (own - mean) for own in imagined]
            k = len(residual)
            expected = math.sqrt(k / (k - 1) * sum(r * r for r in residual)) / (n.sum() + 2 * usual)
            assert float(result.flatten()[cell]) == pytest.approx(expected, rel=1e-9)


def test_fewer_than_8_blocks_give_no_error():
    steps = [{"clouds": clouds_of({0: [at / 32], **({1: [0.1]} if at < 7 else {})}), "more": {"block_index": at}}
             for at in range(8)]  # fmt: skip
    (few,), (enough,) = (metric_over(steps[:count]).compute().summary([EVERYWHERE]) for count in (7, 8))
    assert math.isnan(few.numbers["radius_m"].error)
    assert math.isnan(few.numbers["detection_0.5m"].error)
    assert enough.numbers["radius_m"].error > 0
    coverage = metric_over(steps).compute()
    assert coverage.errors["radius_m"].isnan().flatten().tolist() == [False, True, True, True]
    assert coverage.errors["detection_0.5m"].isnan().flatten().tolist() == [False, True, True, True]


def test_without_blocks_there_are_no_errors():
    coverage = metric_over(random_steps(20), blocks=1).compute()
    assert (coverage.block_sums, len(coverage.errors)) == (None, 0)
    assert math.isnan(coverage.summary([EVERYWHERE])[0].numbers["radius_m"].error)


def test_difference_errors_equal_errors_of_paired_values():
    """Shared noise of a hundred times the difference cancels out."""
    random = np.random.default_rng(0)
    shared, own = 2 * random.random(16), 0.02 * random.random(16)
    estimates = []
    for radii in (shared, shared + own):
        steps = [{"clouds": clouds_of({0: [r]}), "more": {"block_index": at}} for at, r in enumerate(radii.tolist())]
        estimates.append(metric_over(steps).compute().estimate(EVERYWHERE, "all"))
    difference = estimates[1].subtract(estimates[0])
    assert float(difference.value[0]) == pytest.approx(own.mean(), rel=1e-4)
    assert float(difference.error[0]) == pytest.approx(own.std(ddof=1) / 4, rel=1e-3)
    assert float(difference.error[0]) < 0.05 * float(estimates[0].error[0])


@pytest.mark.parametrize("blocks", [0, 2, 6, 9, -8])
def test_unreliable_numbers_of_blocks_are_refused(blocks):
    with pytest.raises(ValueError, match=f"num_blocks: 1, or an even number from 8 on, is needed; got {blocks}"):
        CoverageMetric(GRID, num_blocks=blocks)


# Blocks of frames


def test_the_order_of_the_steps_does_not_matter():
    steps = random_steps(50, dyadic=True)
    shuffled = [steps[at] for at in np.random.default_rng(1).permutation(50)]
    assert_same_state(metric_over(shuffled), metric_over(steps))
    assert_same_state(metric_over(steps[::-1]), metric_over(steps))


@pytest.mark.parametrize("parts", [2, 3, 7])
def test_interleaved_parts_merge_into_the_whole(parts):
    """Short parts have shorter blocks; merging in any order makes the lengths equal."""
    steps = random_steps(50, dyadic=True)
    shares = [steps[at::parts] for at in range(parts)]
    shares[0] = shares[0][:3]
    whole = metric_over([step for share in shares for step in share])
    for order in (shares, shares[::-1]):
        merged = metric_over(order[0])
        for share in order[1:]:
            other = metric_over(share)
            before = copy.deepcopy(other.metric_state)
            merged.merge_state(other)
            assert all(torch.equal(value, before[name]) for name, value in other.metric_state.items())
        assert_same_state(merged, whole)


def test_runs_continue_exactly_from_their_state_dict():
    steps = random_steps(70, dyadic=True)
    resumed = CoverageMetric(GRID, (THRESHOLD,), num_blocks=16)
    stopped = metric_over(steps[:23])
    stopped.persistent(True)
    resumed.load_state_dict(stopped.state_dict())
    for step in steps[23:]:
        resumed.update(*step["clouds"], **step["more"])
    assert_same_state(resumed, metric_over(steps))


@pytest.mark.parametrize("indexed", [True, False])
def test_forward_fills_the_same_blocks_as_update(indexed):
    steps = random_steps(40, dyadic=True)
    metric = CoverageMetric(GRID, (THRESHOLD,), num_blocks=16)
    for step in steps:
        metric(*step["clouds"], **(step["more"] if indexed else {}))
    assert_same_state(metric, metric_over(steps))


@pytest.mark.parametrize("forward", [True, False])
def test_steps_without_a_number_are_counted_on(forward):
    steps = random_steps(40, dyadic=True)
    metric = CoverageMetric(GRID, (THRESHOLD,), num_blocks=16)
    for start in range(0, 40, 8):
        batch = [step["clouds"] for step in steps[start : start + 8]]
        (metric if forward else metric.update)([sensor for sensor, _ in batch], [cloud for _, cloud in batch])
    assert_same_state(metric, metric_over(steps))


@pytest.mark.parametrize("count", [17, 33, 100])
def test_doubling_the_blocks_keeps_every_sum(count):
    steps = random_steps(count, dyadic=True)
    blocked, plain = metric_over(steps), metric_over(steps, blocks=1)
    sums = torch.zeros(CELLS, plain.cell_sums.shape[1] - 1, dtype=torch.float64)
    sums.index_add_(0, (blocked.cell_sums[:, 0] % CELLS).long(), blocked.cell_sums[:, 1:])
    assert torch.equal(sums, plain.cell_sums[:, 1:])
    assert blocked.block_frame_counts.sum() == plain.block_frame_counts.sum() == count
    assert int(blocked.frames_per_block) == 2 ** math.ceil(math.log2(count / 16))
    used = blocked.block_frame_counts[blocked.block_frame_counts > 0]
    assert 8 <= len(used) <= 16
    assert (used[:-1] == blocked.frames_per_block).all()


@pytest.mark.parametrize("blocks", [8, 16])
@pytest.mark.parametrize("last", [7, 127, 128, 255, 256, 511, 512, 5000])
def test_fine_blocks_are_scenes_and_merge_exactly(blocks, last):
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    places = sorted({0, 1, last // 3, last // 2, last})

    def over(some):
        metric = CoverageMetric(
            grid, num_blocks=blocks, has_area_weights=True, regions=[Region("all", (0.0, 1.0), (0.0, 1.0))]
        )
        for place in some:
            point = torch.tensor([[0.5, 0.5, 0.0]])
            metric.update(point, point, weights=torch.tensor([1.0 + place]), block_index=place)
        return metric

    whole, merged = over(places), over(places[3:])
    merged.merge_state(over(places[:3]))
    length = max(1, int(whole.frames_per_block) // 16)
    assert length == (1 if last < 16 * blocks else 2 ** math.ceil(math.log2((last + 1) / (16 * blocks))))
    expected = torch.zeros(16 * blocks, dtype=torch.float64)
    for place in places:
        expected[place // length] += 1.0 + place
    for metric in (whole, merged):
        assert torch.equal(metric.compute().region_sums.areas_m2[:, 0], expected)
        assert metric.fine_block_frame_counts.sum() == metric.block_frame_counts.sum() == len(places)


@pytest.mark.parametrize("aggregations", [(), (Maximum(), PooledMean(), Quantiles((0.5,)))])
def test_blocks_change_no_number(aggregations):
    steps = random_steps(40, weighted=True)
    blocked, plain = (metric_over(steps, blocks=blocks, aggregations=aggregations).compute() for blocks in (16, 1))
    assert torch.equal(blocked.observed_frames, plain.observed_frames)
    assert torch.equal(blocked.point_counts, plain.point_counts)
    for key, layer in plain.layers.items():
        torch.testing.assert_close(blocked.layers[key].values, layer.values, rtol=1e-12, atol=0, equal_nan=True)


def test_distant_block_indices_leave_a_gap():
    steps = random_steps(3, dyadic=True)
    steps[2]["more"]["block_index"] = 1_000_000
    coverage = metric_over(steps).compute()
    assert coverage.block_sums.frame_counts.tolist() == [2] + [0] * 14 + [1]
    assert math.isnan(coverage.summary([EVERYWHERE])[0].numbers["radius_m"].error)


@pytest.mark.parametrize(
    ("index", "message"),
    [(-1, "a number from 0 to .*; got -1"), ([0, 1], "2 block indices and 1 errors for 1 reference clouds")],
)
def test_invalid_block_indices_are_refused(index, message):
    with pytest.raises(ValueError, match=message):
        CoverageMetric(GRID, num_blocks=16).update(*clouds_of({0: [0.5]}), block_index=index)


# Weights


def test_weighted_means_are_those_of_plain_loops():
    steps = random_steps(30, seed=5, weighted=True)
    coverage, sums = metric_over(steps, aggregations=[PooledMean()]).compute(), slow_blocks(steps, 16, weighted=True)
    frames = sums["observed_frames"].sum(axis=0)
    np.testing.assert_allclose(coverage.radius.flatten(), sums["radius"].sum(axis=0) / frames, rtol=1e-12)
    np.testing.assert_allclose(coverage.detection.flatten(), sums["detection"].sum(axis=0) / frames, rtol=1e-12)
    for cell in range(CELLS):
        radii = np.float32([r for step in steps for r in step["radii"].get(cell, [])])
        weights = [w for step in steps for w in step["weights"].get(cell, [])]
        pooled = np.average(radii.astype(float), weights=weights)
        assert float(coverage.layers["radius_pooled_m"].values.flatten()[cell]) == pytest.approx(pooled, rel=1e-12)


def test_equal_weights_and_their_scale_change_nothing():
    steps = random_steps(20, seed=6, weighted=True)
    options = {"aggregations": [Maximum(), Quantiles((0.1, 0.5))]}
    plain = [{**step, "more": {"block_index": step["more"]["block_index"]}} for step in steps]
    factors = [2.0 ** (at % 5) for at in range(20)]

    def with_weights(of) -> Coverage:
        changed = [{**step, "more": {**step["more"], "weights": of(at, step)}} for at, step in enumerate(steps)]
        return metric_over(changed, **options).compute()

    equal = with_weights(lambda at, step: torch.full((len(step["clouds"][1]),), 0.3 * factors[at]))
    scaled = with_weights(lambda at, step: step["more"]["weights"] * factors[at])
    for one, other in (
        (equal, metric_over(plain, **options).compute()),
        (scaled, metric_over(steps, **options).compute()),
    ):
        torch.testing.assert_close(
            one.errors["radius_m"], other.errors["radius_m"], rtol=1e-6, atol=1e-9, equal_nan=True
        )
        for key, layer in one.layers.items():
            expected = other.layers[key].values
            torch.testing.assert_close(layer.values, expected, rtol=1e-6, atol=1e-9, equal_nan=True)


def test_weights_of_points_outside_the_grid_are_excluded():
    sensor, reference = clouds_of({0: [0.25, 0.75]})
    reference = torch.cat([torch.tensor([[-50.0, 50.0, 0.0]]), reference])
    metric = CoverageMetric(GRID, (THRESHOLD,))
    metric.update(sensor, reference, weights=torch.tensor([100.0, 3.0, 1.0]))
    assert float(metric.compute().radius[0, 0, 0]) == 0.375
    assert float(metric.compute().detection[0, 0, 0, 0]) == 0.75


def test_a_quantile_counts_weights_not_points():
    metric = CoverageMetric(GRID, aggregations=[Quantiles((0.2, 0.3))])
    metric.update(*clouds_of({0: [0.1, 0.9]}), weights=torch.tensor([1.0, 3.0]))
    low, high = (metric.compute().layers[f"radius_q{level}_m"].values[0, 0, 0].item() for level in (0.2, 0.3))
    assert low == pytest.approx(0.1, rel=0.13)
    assert high == pytest.approx(0.9, rel=0.13)


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ([1.0, 0.0], "finite weights > 0"),
        ([1.0, -1.0], "finite weights > 0"),
        ([1.0, math.nan], "finite weights > 0"),
        ([1.0, math.inf], "finite weights > 0"),
        ([1.0], r"shape \(2,\), one for each reference point"),
        ([[1.0, 1.0]], r"shape \(2,\)"),
    ],
)
def test_bad_weights_are_refused_and_nothing_is_counted(weights, message):
    metric = CoverageMetric(GRID)
    with pytest.raises(ValueError, match=rf"weights\[0\]: .*{message}"):
        metric.update(*clouds_of({0: [0.5, 0.5]}), weights=torch.tensor(weights))
    with pytest.raises(ValueError, match="2 weights, 1 heights, 1 block indices and 1 errors for 1 reference clouds"):
        metric.update(*clouds_of({0: [0.5]}), weights=[torch.ones(1), torch.ones(1)])
    assert int(metric.num_frames) == 0


def test_weights_compensate_the_density_of_points():
    """With a sensor point at x = 0, r = x: the mean over [0, 1) is 1/2, the share within 0.3 m is 0.3."""
    uniform = torch.rand(200_000, generator=torch.Generator().manual_seed(0))
    line = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    # Density p(x) = 1/2 + x, by the inverse of its integral; the weights are 1 / p(x).
    denser = (torch.sqrt(1 + 8 * uniform) - 1) / 2

    def found(x: torch.Tensor, weights: torch.Tensor | None) -> list[float]:
        metric = CoverageMetric(line, (0.3,))
        metric.update(torch.zeros(1, 3), torch.stack([x, 0 * x, 0 * x], dim=1), weights=weights)
        coverage = metric.compute()
        return [float(coverage.radius), float(coverage.detection)]

    assert found(uniform, None) == pytest.approx([0.5, 0.3], abs=0.005)
    assert found(denser, 1 / (0.5 + denser)) == pytest.approx([0.5, 0.3], abs=0.005)
    assert found(denser, None) == pytest.approx([7 / 12, 0.195], abs=0.005)


# Errors against the spread over runs


def coverage_of(radii: np.ndarray, probed: np.ndarray) -> Coverage:
    """Create a coverage from (frames, cells) radii in 16 blocks, without clouds."""
    radii, probed = (torch.from_numpy(values).double().view(16, -1, *GRID.shape) for values in (radii, probed))
    values = torch.stack([radii, (radii <= THRESHOLD).double()]) * probed
    frames, sums = probed.sum(dim=1).long(), values.sum(dim=2)
    means = sums.sum(dim=1) / frames.sum(dim=0)
    steps, at = torch.full((16,), radii.shape[1]), frames.sum(dim=0).flatten().nonzero().squeeze(1)
    counts, listed = dict.fromkeys(Coverage.COUNTS, 0), frames.flatten().nonzero().squeeze(1)
    return Coverage(
        grid=GRID,
        thresholds_m=(THRESHOLD,),
        max_radius_m=math.inf,
        observed_cells=ObservedCells(GRID.shape, at, *[frames.sum(dim=0).flatten()[at]] * 2),
        layers=map(Layer, MeanOfMeans((THRESHOLD,)).quantities, means.flatten(1)[:, at]),
        counts=counts,
        block_sums=BlockSums(steps, tuple(frames.shape), listed, frames.flatten()[listed], sums.flatten(1)[:, listed]),
    )


@pytest.mark.parametrize("alike", [1, 4])
def test_reported_errors_equal_the_spread_over_runs(alike):
    """Independent frames, and groups of four equal frames, the length of a block."""
    random = np.random.default_rng(0)
    numbers, errors, cells, of_cells = [], [], [], []
    for _ in range(300):
        radii = random.gamma(2.0, 0.3, (64 // alike, CELLS)) * [0.5, 1.0, 1.5, 2.0]
        probed = random.random((64 // alike, CELLS)) < 0.8
        coverage = coverage_of(*(np.repeat(values, alike, axis=0) for values in (radii, probed)))
        estimate = coverage.estimate(EVERYWHERE, "all")
        numbers.append(estimate.value)
        errors.append(estimate.error)
        cells.append(coverage.radius.flatten())
        of_cells.append(coverage.errors["radius_m"].flatten())
    # The spread over 300 runs is known to 4 %.
    torch.testing.assert_close(torch.stack(errors).mean(dim=0), torch.stack(numbers).std(dim=0), rtol=0.12, atol=0)
    truth = torch.tensor([0.3, 0.6, 0.9, 1.2], dtype=torch.float64)  # of 2 x 0.3 times a half, one, ...
    covers = (torch.stack(cells) - truth).abs() <= 2 * torch.stack(of_cells)
    assert covers.double().mean() >= 0.93


def test_two_errors_cover_cells_with_rare_events():
    """A cell is blind in one block of ten: most runs of 16 blocks contain it once or twice, every fifth run never."""
    blind = torch.from_numpy(np.random.default_rng(1).random((500, 16, 1, 1, 1)) < 0.1)
    once = torch.ones((16, 1, 1, 1), dtype=torch.int64)
    for unit, seen, truth in (("share", (~blind).double(), 0.9), ("m", torch.where(blind, 1.0, 0.2).double(), 0.28)):
        each = [(float(sums.mean()), float(estimate_ratio_errors(once, sums, unit))) for sums in seen]
        assert np.mean([abs(mean - truth) <= 2 * error for mean, error in each]) >= 0.93
