"""Published metrics over frames: closed forms, slow implementations, invariances, and bad frames."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.metrics.cases import CASES
from torchcover import BevGrid, Region
from torchcover.contrib import (
    PUBLISHED,
    FalseVisible,
    FrameQueryCache,
    KCover,
    MetricSetup,
    ObjectCoverage,
    PerceptionEntropy,
    PointDensity,
    compute_field_of_view,
    parse_metric_names,
)
from torchcover.contrib.ratio_metrics import compute_entropy_nats, compute_standard_deviation, fuse_standard_deviations
from torchcover.simulation import CameraSensor, Lidar, Pose
from torchcover.simulation.shapes import Box

from .frames import frame_of, values

OF_FRAMES = ("object coverage", "perception entropy", "k-cover", "point density", "false visible")
EVERY = pytest.mark.parametrize("case", [CASES[name] for name in OF_FRAMES], ids=OF_FRAMES)
GRID = BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 4.0), cell_m=1.0, heights={"low": (-0.5, 0.5), "high": (0.5, 2.0)})
CAR = [10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]


# Closed forms


@pytest.mark.parametrize(
    ("points", "nats"),
    [(0, 16.651387), (1, 1.520195), (5, -1.638678), (9, -7.065483), (10, -10.975632), (100, -10.975632)],
)
def test_the_entropy_of_points_of_a_lidar(points, nats):
    assert float(compute_entropy_nats(compute_standard_deviation(torch.tensor(points), "lidar"))) == pytest.approx(
        nats, abs=1e-6
    )
    box = replace(frame_of([], boxes=[CAR]).boxes, points_in_box={"rig": torch.tensor([points])})
    metric = PerceptionEntropy()
    metric.update(replace(frame_of([]), boxes=box))
    assert values(metric)["perception_entropy"] == pytest.approx(nats, abs=1e-6)


@pytest.mark.parametrize(("pixels", "nats"), [(1, 6.229700), (1000, 2.558009), (100_000, 0.209528)])
def test_the_entropy_of_pixels_of_a_camera(pixels, nats):
    assert float(compute_entropy_nats(compute_standard_deviation(torch.tensor(pixels), "camera"))) == pytest.approx(
        nats, abs=1e-6
    )


def test_late_fusion_is_sharper_than_the_sharpest():
    sigmas = (
        compute_standard_deviation(torch.tensor(5), "lidar"),
        compute_standard_deviation(torch.tensor(1000), "camera"),
    )
    assert float(fuse_standard_deviations(sigmas)) == pytest.approx(0.105849, abs=1e-6)
    assert float(compute_entropy_nats(fuse_standard_deviations(sigmas))) == pytest.approx(-1.653611, abs=1e-6)
    assert fuse_standard_deviations(sigmas) < min(sigmas)


def test_camera_and_lidar_points_are_distinguished():
    camera = CameraSensor(name="eye", width=8, height=8, fov_deg=90, max_range_m=50)
    lidar = Lidar(name="roof", channels=2, vertical_fov_deg=(-9, 0), columns=8, horizontal_fov_deg=90, max_range_m=50)
    inside = [[10.0, 0.0, 1.0]] * 8
    frame = frame_of(inside, boxes=[CAR], sensors={"eye": 3, "roof": 5})
    metric = PerceptionEntropy((camera, lidar))
    metric.update(frame)
    kinds = compute_standard_deviation(torch.tensor(3), "camera"), compute_standard_deviation(torch.tensor(5), "lidar")
    assert values(metric)["perception_entropy"] == pytest.approx(
        float(compute_entropy_nats(fuse_standard_deviations(kinds))), abs=1e-12
    )
    alone = PerceptionEntropy((camera,))
    alone.update(frame_of(inside, boxes=[CAR], sensors={"eye": 8}))
    only = compute_standard_deviation(torch.tensor(8), "camera")
    assert values(alone)["perception_entropy"] == pytest.approx(float(compute_entropy_nats(only)), abs=1e-12)


def test_the_share_of_an_object_weighs_square_metres():
    reference = [[8.0, 0.0, 0.5], [8.0, 0.0, 1.5], [30.0, 0.0, 0.0]]
    metric = ObjectCoverage(categories=("car", "bus"))
    metric.update(frame_of([[8.0, 0.0, 0.6]], reference, [CAR], ["car"], weights=[1.0, 3.0, 50.0]))
    result = values(metric)
    assert (
        result["object_coverage_0.4m"]
        == result["object_coverage_0.4m:car"]
        == result["object_coverage_0.4m:0-20m"]
        == 0.25
    )
    assert math.isnan(result["object_coverage_0.4m:bus"])
    assert {number.count for number in metric.compute() if not number.has_value} == {0}


def test_hidden_objects_count_for_hits_only():
    hidden, far = [20.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0], [90.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0]
    metric = ObjectCoverage()
    metric.update(frame_of([[8.0, 0.0, 0.5]], [[8.0, 0.0, 0.5], [88.0, 0.0, 0.5]], [CAR, hidden, far]))
    numbers = {number.quantity.key: number for number in metric.compute()}
    assert (numbers["object_coverage_0.4m"].value, numbers["object_coverage_0.4m"].count) == (1.0, 1)
    assert (numbers["objects_hit_1"].value, numbers["objects_hit_1"].count) == (0.5, 2)


def test_uniformity_ranges_from_one_cell_to_even_points():
    even = [[x + 0.5, y + 0.5, 0.0] for x in range(8) for y in range(4)]
    for cloud, uniformity in ((even, 1.0), ([[0.5, 0.5, 0.0]] * 7, 1 / 32)):
        metric = PointDensity(GRID, [Region("near", (0.0, 2.0), (0.0, 4.0))])
        metric.update(frame_of(cloud))
        result = values(metric)
        assert result["point_uniformity_1m"] == pytest.approx(uniformity, abs=1e-15)
        assert result["point_density"] == pytest.approx(len(cloud) / 32)
        assert result["points"] == len(cloud)


def test_empty_clouds_have_density_0_without_uniformity():
    metric = PointDensity(GRID, ())
    metric.update(frame_of([]))
    result = values(metric)
    assert (result["points"], result["point_density"]) == (0.0, 0.0)
    assert math.isnan(result["point_uniformity_1m"])


# Field of view and false visible cells


def lidar(**changes):
    usual = {"name": "a", "mount": Pose(x_m=0.0, z_m=1.0), "channels": 1, "vertical_fov_deg": (-45, -45), "columns": 1}
    return Lidar(**{**usual, "horizontal_fov_deg": 0.001, "max_range_m": 50, **changes})


def test_rays_cross_cells_down_to_the_ground():
    grid = BevGrid(x_m=(-1.0, 5.0), y_m=(-1.0, 1.0), cell_m=0.25, heights={"low": (-0.1, 0.5), "high": (0.5, 2.0)})
    seen = compute_field_of_view([lidar(mount=Pose(x_m=0.05, y_m=0.1, z_m=1.0))], grid)
    low, high = (set((grid.x_centers_m[band.nonzero()[:, 1]]).tolist()) for band in seen)
    assert low == {0.625, 0.875, 1.125}  # below 0.5 m from x = 0.55 m, on the ground at x = 1.05 m
    assert high == {0.125, 0.375, 0.625}
    assert {int(row) for row in seen.nonzero()[:, 1]} == {4}


def test_no_cell_that_a_ray_crosses_is_missed():
    grid = BevGrid(x_m=(-20.0, 20.0), y_m=(-20.0, 20.0), cell_m=1.0, heights={"low": (-0.5, 0.4), "high": (0.4, 2.0)})
    around = lidar(mount=Pose(x_m=0.3, y_m=-0.2, z_m=1.7, pitch_deg=2.0), columns=90, horizontal_fov_deg=360,
                   channels=4, vertical_fov_deg=(-12, 3))  # fmt: skip
    seen = compute_field_of_view([around], grid).numpy()
    origin_m, turn = around.mount.to_matrix()[:3, 3], around.mount.to_matrix()[:3, :3]
    directions = (turn @ around.compute_directions().reshape(3, -1)).T
    ends_m = np.where(directions[:, 2] < 0, origin_m[2] / np.maximum(-directions[:, 2], 1e-9), 60.0).clip(max=50.0)
    along = np.linspace(0.0, 1.0, 4001)[1:-1]
    points = (origin_m + (directions * ends_m[:, None])[:, None] * along[None, :, None]).reshape(-1, 3)
    result = np.zeros_like(seen)
    result.reshape(-1)[grid.assign_cells(torch.from_numpy(points)).cell_indices.numpy()] = True
    assert (seen >= result).all()
    assert (seen & ~result).sum() < 0.01 * result.sum()  # a ray crosses less than a centimeter of it


def test_rays_end_at_the_vehicle_and_at_range():
    grid = BevGrid(x_m=(0.0, 8.0), y_m=(-1.0, 1.0), cell_m=0.5)
    bonnet = Box(type="box", size_m=(1.0, 2.0, 0.8)).build_mesh()
    assert not compute_field_of_view([lidar(mount=Pose(x_m=0.0, z_m=1.0))], grid, bonnet).any()
    flat = lidar(vertical_fov_deg=(0.0, 0.0), max_range_m=3.2)
    assert compute_field_of_view([flat], grid)[1].any(dim=0).nonzero().squeeze(1).tolist() == list(range(7))
    blind = lidar(vertical_fov_deg=(0.0, 0.0), max_range_m=3.2, min_range_m=2.0)
    assert compute_field_of_view([blind], grid)[1].any(dim=0).nonzero().squeeze(1).tolist() == [4, 5, 6]


def test_false_visible_is_a_share_of_blind_cells():
    sensors = [lidar(vertical_fov_deg=(0.0, 0.0), mount=Pose(x_m=0.0, y_m=0.5, z_m=1.0), max_range_m=5.0)]
    grid = BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"high": (0.5, 2.0)})
    metric = FalseVisible(sensors, None, grid)
    # Cell 0 is visible; cells 1 to 3 and 7 are blind, of which the ray crosses 1 to 3. Other cells do not count.
    reference = [[x + 0.5, 0.5, 1.0] for x in (0, 1, 2, 3, 7)] + [[0.5, 0.9, 1.9]]
    metric.update(frame_of([[0.5, 0.5, 1.1]], reference))
    (number,) = metric.compute()
    assert (number.value, number.count) == (0.75, 4)


def test_rigs_without_blind_cells_have_no_false_visible():
    metric = FalseVisible([lidar()], None, GRID)
    metric.update(frame_of([[0.5, 0.5, 0.0]], [[0.5, 0.5, 0.0]]))
    assert [number.has_value for number in metric.compute()] == [False, False]


# Slow implementations


def test_k_cover_equals_a_loop_over_sensors():
    generator = np.random.default_rng(0)
    cloud, reference = (
        generator.uniform((0, 0, 0), (8, 4, 2), (60, 3)),
        generator.uniform((0, 0, 0), (8, 4, 1.9), (80, 3)),
    )
    weights = generator.uniform(0.1, 2.0, 80)
    sensors = {"a": 20, "b": 15, "c": 25}
    near = Region("near", (0.0, 4.0), (0.0, 2.0))
    metric = KCover(GRID, [near], 0.9)
    metric.update(frame_of(cloud.tolist(), reference.tolist(), weights=weights.tolist(), sensors=sensors))
    result = values(metric)
    parts = np.split(cloud.astype(np.float32), np.cumsum(list(sensors.values()))[:-1])
    for k in (1, 2, 3):
        for name, chosen in (
            ("", lambda q: True),
            (":near_low", lambda q: q[0] < 4 and q[1] < 2 and q[2] < 0.5),
            (":near_high", lambda q: q[0] < 4 and q[1] < 2 and q[2] >= 0.5),
        ):
            above = below = 0.0
            for q, weight in zip(reference.astype(np.float32), weights, strict=True):
                if chosen(q):
                    seeing = sum((np.linalg.norm(part - q, axis=1) <= 0.9).any() for part in parts)
                    above, below = above + weight * (seeing >= k), below + weight
            assert result[f"k_cover_{k}_0.9m{name}"] == pytest.approx(above / below, rel=1e-6)


def test_errors_are_those_of_a_mean_over_worlds():
    metric = PointDensity(GRID, ())
    counts = [3, 8, 1, 4, 4, 9, 2, 6, 5, 7]
    for index, count in enumerate(counts):
        metric.update(frame_of([[0.5, 0.5, 0.0]] * count, index=index))
    number = metric.compute()[0]
    assert number.value == pytest.approx(np.mean(counts))
    assert number.error == pytest.approx(np.std(counts, ddof=1) / len(counts) ** 0.5)


def test_frames_of_one_world_are_no_more_worlds():
    metric = PointDensity(GRID, ())
    for index in range(40):
        metric.update(frame_of([[0.5, 0.5, 0.0]] * (index % 5), index=index, block_index=index // 6))
    assert all(math.isnan(number.error) for number in metric.compute())  # 7 of them


@pytest.mark.parametrize(
    ("worlds", "with_objects", "known"), [(10, 7, False), (10, 8, True), (5, 4, False), (5, 5, True)]
)
def test_numbers_of_few_scenes_have_no_error(worlds, with_objects, known):
    metric = ObjectCoverage()
    for index in range(worlds):
        there = index < with_objects
        metric.update(frame_of([[10.0, 0.0, 1.0]] * (index % 2), boxes=[CAR] if there else [], index=index))
    (at,) = (at for at, one in enumerate(metric.compute()) if one.quantity.key == "objects_hit_1")
    assert math.isfinite(float(metric.estimate().compute_errors(min_blocks=3)[at])) == known
    assert math.isfinite(metric.compute()[at].error) == (known and worlds >= 8)


def test_resampled_metrics_equal_metrics_over_resampled_scenes():
    case = CASES["object coverage"]
    estimate = case.over(case.frames).estimate()
    assert len(estimate.frame_counts) == len(case.frames)  # one scene per frame
    drawn = case.over([case.frames[0], case.frames[0], case.frames[3]]).compute()
    weights = torch.zeros(1, len(case.frames))
    weights[0, 0], weights[0, 3] = 2, 1
    again = torch.tensor([[number.value for number in drawn]]).double()
    torch.testing.assert_close(estimate.resample(weights), again, equal_nan=True)


@pytest.mark.parametrize("name", OF_FRAMES)
def test_jackknife_values_equal_metrics_without_the_scene(name):
    case = CASES[name]
    telling = [step["frame"] for step in case.frames if case.over([step]).compute()[0].has_value]
    frames = [
        replace(frame, block_index=world) for world, frame in zip(range(10), itertools.cycle(telling), strict=False)
    ]

    def over(some):
        metric = case.make()
        metric.update(some)
        return metric

    metric = over(frames)
    estimate = metric.estimate()
    assert [number.value for number in metric.compute()] == pytest.approx(estimate.value.tolist(), abs=0, nan_ok=True)
    assert estimate.frame_counts.tolist() == [1] * 10
    for world, row in enumerate(estimate.jackknife_values):
        expected = over(frames[:world] + frames[world + 1 :]).estimate().value
        torch.testing.assert_close(row, expected.where(row.isfinite(), math.nan), equal_nan=True)
    errors = estimate.error.where(estimate.compute_errors() > 1e-12, math.nan)
    assert [number.error for number in metric.compute()] == pytest.approx(errors.tolist(), nan_ok=True)
    assert errors.isfinite().any()


# Invariances and unknown numbers


@EVERY
def test_order_of_points_boxes_frames_does_not_matter(case):
    def shuffled(step):
        frame = step["frame"]
        generator = torch.Generator().manual_seed(7)
        order = torch.randperm(len(frame.reference), generator=generator)
        parts = torch.split(frame.sensor, list(frame.sensor_point_counts["rig"].values()))
        cloud = torch.cat([part[torch.randperm(len(part), generator=generator)] for part in parts])
        return {
            "frame": replace(
                frame,
                clouds={"rig": cloud},
                reference=frame.reference[order],
                reference_weights=frame.reference_weights[order],
                boxes=frame.boxes.select(torch.randperm(len(frame.boxes), generator=generator)),
            )
        }

    first, second = case.over(case.frames), case.over([shuffled(step) for step in case.frames[::-1]])
    for one, other in zip(first.compute(), second.compute(), strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-12, nan_ok=True), one.quantity.key
        assert one.count == other.count


@EVERY
def test_shared_queries_give_equal_numbers(case):
    query_cache = FrameQueryCache()
    together = {name: CASES[name].make() for name in OF_FRAMES}
    for metric in together.values():
        metric.query_cache = query_cache
    query_cache.searches_by_sensor = True
    for step in case.frames:
        for metric in together.values():
            metric.update(**step)
    for name in OF_FRAMES:
        alone = CASES[name].over(case.frames)
        for one, other in zip(together[name].compute(), alone.compute(), strict=True):
            assert one.value == pytest.approx(other.value, abs=0, nan_ok=True)


@EVERY
def test_only_unknown_numbers_are_nan_with_count_0(case):
    for metric in (case.over([case.bland]), case.over(case.frames[:1]), case.over(case.frames)):
        for number in metric.compute():
            assert math.isnan(number.value) == (number.count == 0), number.quantity.key
            assert math.isnan(number.error) or number.error > 0


@pytest.mark.parametrize("name", ["object coverage", "perception entropy"])
def test_frames_without_boxes_are_refused_with_a_remedy(name):
    metric = CASES[name].make()
    with pytest.raises(ValueError, match=r"no boxes.*SimulatedFrames\(\.\.\., boxes=True\)"):
        metric.update(replace(CASES[name].frames[0]["frame"], boxes=None))
    assert metric.num_frames == 0


def test_square_metres_that_are_missing_are_refused():
    frame = replace(CASES["k-cover"].frames[0]["frame"], reference_weights=None)
    with pytest.raises(ValueError, match="the areas of its reference points"):
        CASES["k-cover"].make().update(frame)
    CASES["k-cover"].make(has_area_weights=False).update(frame)
    CASES["object coverage"].make().update(frame)


def test_sensors_that_nobody_can_tell_apart_are_refused():
    with pytest.raises(ValueError, match="sensor_point_counts"):
        CASES["k-cover"].make().update(replace(CASES["k-cover"].frames[0]["frame"], sensor_point_counts=None))


def test_rigs_without_sensors_have_no_field_of_view():
    with pytest.raises(ValueError, match="YAML file"):
        FalseVisible((), None, GRID)


def test_another_rig_is_refused():
    with pytest.raises(ValueError, match="no rig 'other'"):
        ObjectCoverage(rig_name="other").update(CASES["k-cover"].frames[0]["frame"])


@pytest.mark.parametrize(
    "make",
    [
        lambda: ObjectCoverage(-1.0),
        lambda: ObjectCoverage(math.nan),
        lambda: ObjectCoverage(min_point_counts=(0,)),
        lambda: ObjectCoverage(categories=("car", "car")),
        lambda: ObjectCoverage(range_borders_m=(20.0, 10.0)),
        lambda: KCover(GRID, (), min_sensor_counts=(0,)),
        lambda: KCover(GRID, [Region("far", (0.0, 99.0), (0.0, 1.0))]),
        lambda: FalseVisible([lidar()], None, GRID, math.inf),
    ],
)
def test_parameters_that_make_no_sense_are_refused(make):
    with pytest.raises(ValueError, match=r"needed|once|beyond"):
        make()


def test_names_of_metrics():
    assert parse_metric_names("all") == tuple(PUBLISHED)
    assert parse_metric_names("k_cover, point_density,k_cover") == ("k_cover", "point_density")
    with pytest.raises(ValueError, match="got 'nosuch'"):
        parse_metric_names(["nosuch"])


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_metric_is_made_from_a_setup(name):
    metric = PUBLISHED[name].build(MetricSetup(rig_name="rig", sensors=(lidar(),), grid=GRID, regions=()))
    assert metric.rig_name == "rig"
    assert PUBLISHED[name].description
