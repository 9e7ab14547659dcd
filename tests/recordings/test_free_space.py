"""Free space, visibility and moving clusters in scenes that are known exactly; compiled kernels against arrays."""

import numpy as np
import pytest

from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation, invert
from torchcover.recordings import free_space
from torchcover.recordings import moving_clusters as moved
from torchcover.recordings.free_space import (
    FreeSpaceCounter,
    RangeImage,
)
from torchcover.recordings.moving_clusters import find_moving_clusters
from torchcover.recordings.visibility import estimate_surface_areas_m2, estimate_visible_share, mark_hidden_by_arrays

CAR = BoundingBox((-2.4, -0.95, 0.0), (2.4, 0.95, 1.7))


def make_wall(x_m, half_m=6.0, step_m=0.05, low_m=-2.0, high_m=2.0):
    """A wall across the x axis."""
    y, z = np.meshgrid(np.arange(-half_m, half_m, step_m), np.arange(low_m, high_m, step_m))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1)


def count_votes(image, points_m):
    votes = np.zeros(len(points_m), np.int16)
    image.add_votes(np.ascontiguousarray(points_m, dtype=np.float64), votes)
    return votes.tolist()


def test_points_before_a_wall_are_contradicted():
    image = RangeImage.from_points(make_wall(20.0), np.eye(4))
    free_m = (20.0 - 0.4) / 1.12
    places_m = [[free_m - 0.05, 0.0, 0.0], [free_m + 0.05, 0.0, 0.0], [19.9, 0.0, 0.0], [25.0, 0.0, 0.0]]
    # Points behind the wall, beside it and above it are not contradicted.
    assert count_votes(image, [*places_m, [10.0, 8.0, 0.0], [-10.0, 0.0, 0.0], [10.0, 0.0, 5.0]]) == [
        1,
        0,
        0,
        0,
        0,
        0,
        0,
    ]


def test_rays_past_an_edge_contradict_no_edge():
    near_m = make_wall(8.0, half_m=1.0, step_m=0.02)
    near_m = near_m[near_m[:, 1] < 0]
    image = RangeImage.from_points(np.concatenate([near_m, make_wall(30.0, half_m=15.0, high_m=6.0)]), np.eye(4))
    one_bin_m = 8.0 * np.deg2rad(0.2)
    assert count_votes(image, [[8.0, -0.5, 0.0], [8.0, 0.9 * one_bin_m, 0.0], [8.0, 4 * one_bin_m, 0.0]]) == [0, 0, 1]


@pytest.mark.parametrize("rows_deg", [0.2, 0.4, 2.0])
def test_flat_ground_is_never_contradicted(rows_deg):
    elevation, azimuth = np.meshgrid(
        np.deg2rad(np.arange(-25.0, -1.0, rows_deg)), np.deg2rad(np.arange(-180, 180, 0.1))
    )
    range_m = 1.8 / -np.sin(elevation).ravel()
    sensor_m = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    image = RangeImage.from_points(sensor_m.reshape(3, -1).T * range_m[:, None], np.eye(4))
    x_m, y_m = np.random.default_rng(0).uniform(-60.0, 60.0, (2, 3000))
    votes = count_votes(image, np.stack([x_m, y_m, np.full(3000, -1.8)], axis=1))
    assert sum(votes) < 0.002 * len(votes)
    standing = [[15.0, 0.0, -1.0]]  # 0.8 m above it, before the ground 25 m away
    assert count_votes(image, standing) == [1]


def test_votes_do_not_depend_on_earlier_windows():
    generator = np.random.default_rng(0)
    scans = {("a", k): generator.uniform(-20.0, 20.0, (500, 3)) for k in range(6)}
    images = {key: RangeImage.from_points(generator.normal(0.0, 30.0, (4000, 3)), np.eye(4)) for key in scans}

    def window(first, last):
        return [{key: of[key] for key in of if first <= key[1] < last} for of in (scans, images)]

    sliding = FreeSpaceCounter()
    for first in (0, 1, 2, 1, 2, 3):
        counted = sliding.update(*window(first, first + 3))
    fresh = FreeSpaceCounter().update(*window(3, 6))
    assert counted.keys() == fresh.keys()
    for key, votes in fresh.items():
        np.testing.assert_array_equal(counted[key], votes)
        others = [np.zeros(500, np.int16) for _ in range(3)]
        for k, own in enumerate(others):
            images["a", 3 + k].add_votes(scans[key], own)
        np.testing.assert_array_equal(votes, sum(others))
    assert max(votes.max() for votes in fresh.values()) > 1


def test_compiled_kernels_equal_array_kernels():
    pytest.importorskip("numba")
    from torchcover.recordings import compiled_kernels as loops

    generator = np.random.default_rng(0)
    points_m = generator.normal(0.0, 20.0, (5000, 3))
    points_m[:3] = [[0.0, 0.0, 0.0], [0.0, 0.0, 5.0], [-5.0, -0.0, 0.0]]
    sensor_T_local = invert(build_transform(convert_euler_to_rotation(20.0, 3.0, -2.0), [1.0, 2.0, 0.5]))
    image = RangeImage.from_points(generator.normal(0.0, 30.0, (40_000, 3)), sensor_T_local)
    one, other = np.zeros((2, 5000), np.int16)
    for kernel, votes in ((loops.count_votes_by_loop, one), (free_space.count_votes_by_arrays, other)):
        arrays = (image.free_range_m, image.first_row, image.sensor_T_local, image.max_free_range_m)
        kernel(points_m, *arrays, image.params.columns, image.params.rows, votes, 2)
    np.testing.assert_array_equal(one, other)
    assert 0 < one.sum() < 2 * len(one)

    hidden = np.zeros((2, 5000), np.bool_)
    reach_m = np.array([np.inf, 70.0, 30.0, 10.0])
    for kernel, of in zip((loops.mark_hidden_by_loop, mark_hidden_by_arrays), hidden, strict=True):
        kernel(
            points_m,
            np.array([0.1, 3.2, 0.3]),
            np.array([[-2.0, -1.0, -1.0], [2.0, 1.0, 1.5]]),
            np.deg2rad([0.2, 0.4, 0.8, 1.6]),
            reach_m,
            0.4,
            0.12,
            0.15,
            of,
        )
    np.testing.assert_array_equal(*hidden)
    assert 0 < hidden[0].sum() < 5000

    filled = generator.integers(0, 3, (3, 40, 50)).astype(np.uint8)
    tried = generator.uniform(-30.0, 30.0, (200, 2))
    overlaps = np.zeros((2, 200))
    for kernel, of in zip((loops.compute_overlap_by_loop, moved.compute_overlap_by_arrays), overlaps, strict=True):
        kernel(np.ascontiguousarray(points_m[:80, :2] % 12.0), np.array([-0.1, 0.1, 0.2]), filled, 0.3, tried, of)
    np.testing.assert_allclose(*overlaps, rtol=1e-12)
    assert np.ptp(overlaps[0]) > 0.1


def test_occluded_points_are_not_visible():
    wall_m = make_wall(6.0, half_m=4.0, step_m=0.1, low_m=0.0, high_m=4.0)
    behind_m = [[9.0, 0.0, 1.0], [30.0, 5.0, 1.0]]
    beside_m, above_m, close_m = [[9.0, 12.0, 1.0], [9.0, 0.0, 9.0]], [[0.0, 30.0, 1.0]], [[6.3, 0.0, 1.0]]
    points_m = np.concatenate([wall_m, behind_m, beside_m, above_m, close_m])
    share = estimate_visible_share(points_m, CAR, 0.1, 3)
    assert share[: len(wall_m)].max() > 0.8  # one place is behind the vehicle
    assert share[-6:-4].tolist() == [0.0, 0.0]
    assert share[-4:-2].min() > 0.5
    assert share[-1] > 0.0  # within the tolerance it is the wall
    ground_m = np.array([[0.0, 1.2, 0.0], [0.0, -1.2, 0.0]])  # from the other side, the vehicle is in between
    assert 0.0 < estimate_visible_share(ground_m, CAR, 0.1, 3).mean() < 0.9
    np.testing.assert_array_equal(share, estimate_visible_share(points_m, CAR, 0.1, 3))


def test_areas_add_up_to_the_surface():
    generator = np.random.default_rng(0)
    sparse_m = np.column_stack([generator.uniform(0.0, 40.0, (4000, 2)), np.zeros(4000)])
    dense_m = np.column_stack([generator.uniform(60.0, 70.0, (4000, 2)), np.zeros(4000)])
    area_m2 = estimate_surface_areas_m2(np.concatenate([sparse_m, dense_m]))
    assert abs(area_m2[:4000].sum() / 1600.0 - 1) < 0.2
    assert abs(area_m2[4000:].sum() / 100.0 - 1) < 0.2
    assert estimate_surface_areas_m2(sparse_m[:3]).tolist() == [np.pi * 9.0 / 8] * 3


@pytest.mark.parametrize("velocity_mps", [(0.0, 0.0), (1.3, -0.8), (-28.0, 2.0)])
def test_moving_objects_are_placed_at_the_frame(velocity_mps):
    generator = np.random.default_rng(0)
    times_s = np.array([-0.3, -0.2, -0.1, 0.1, 0.2, 0.3])
    box_m = np.concatenate([make_wall(0.0, 0.9, 0.15, 0.3, 1.4), make_wall(0.0, 2.0, 0.15, 0.3, 1.4)[:, [1, 0, 2]]])
    scans_m = []
    for time_s in times_s:
        own = box_m[generator.random(len(box_m)) < 0.7]
        clutter = generator.uniform([-60.0, -60.0, 0.3], [60.0, 60.0, 1.4], (20, 3))
        scans_m.append(
            np.concatenate([own + np.array([*velocity_mps, 0.0]) * time_s + np.array([30.0, 8.0, 0.0]), clutter])
        )
    found = max(find_moving_clusters(scans_m, times_s), key=lambda cluster: len(cluster.points_m))
    assert np.linalg.norm(found.velocity_mps - velocity_mps) < 0.5
    apart_m = np.linalg.norm((found.points_m - [30.0, 8.0, 0.0])[:, None] - box_m, axis=2).min(axis=1)
    assert np.median(apart_m) < 0.1
    assert apart_m.max() < 1.0
    assert len(found.points_m) > 0.6 * 6 * len(box_m)
    # The scans of two sensors with a half of the points each, or of three sensors, one without points.
    for halves in ([scan_m[:, 1] < 8.0 for scan_m in scans_m], [scan_m[:, 1] < 99.0 for scan_m in scans_m]):
        parts = [
            scan_m[half == one] for one in (True, False, None) for scan_m, half in zip(scans_m, halves, strict=True)
        ]
        same = max(find_moving_clusters(parts, np.tile(times_s, 3)), key=lambda cluster: len(cluster.points_m))
        np.testing.assert_array_equal(same.velocity_mps, found.velocity_mps)
        assert len(same.points_m) == len(found.points_m)


def test_empty_scans_have_no_moving_objects():
    assert find_moving_clusters([], np.empty(0)) == []
    assert find_moving_clusters([np.empty((0, 3))] * 3, np.array([-0.1, 0.1, 0.2])) == []
    assert find_moving_clusters([np.zeros((9, 3)), np.empty((0, 3))], np.array([-0.1, 0.1])) == []
