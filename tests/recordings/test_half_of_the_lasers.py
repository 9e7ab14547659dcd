"""Half of a LiDAR's lasers against all of them, from files to numbers, beside an independent computation in float64."""

import numpy as np
from scipy.spatial import cKDTree

from torchcover import BevGrid, CoverageMetric
from torchcover.data import RecordedFrames, Scan
from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation
from torchcover.recordings.vehicle_cloud import transform_to_vehicle

MOUNT = build_transform(convert_euler_to_rotation(1.0, -0.5, 0.2), [0.943, 0.02, 1.84])
GRID = BevGrid(x_m=(-20.0, 20.0), y_m=(-15.0, 15.0), cell_m=0.5)


def turn(generator):
    """(N, 3) float32 in the frame of a LiDAR over a flat ground with a wall around it, and the laser of each."""
    elevation, azimuth = np.meshgrid(
        np.deg2rad(np.linspace(-30, 10, 32)), np.linspace(0, 2 * np.pi, 180), indexing="ij"
    )
    ray = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    with np.errstate(divide="ignore"):
        ground_m = np.where(ray[2] < 0, -1.84 / ray[2], np.inf)
    range_m = np.minimum(ground_m, 18.0 / np.cos(elevation)) + generator.normal(0, 0.02, elevation.shape)
    laser = np.repeat(np.arange(32), 180)
    return (ray * range_m).reshape(3, -1).T.astype("<f4"), laser


def test_numbers_equal_an_independent_computation(tmp_path):
    metric = CoverageMetric(GRID, max_radius_m=5.0)
    for place in ("sensor", "reference"):
        (tmp_path / place).mkdir()
    mount = f"{{vehicle_T_sensor: {MOUNT.tolist()}}}"
    (tmp_path / "frames.yaml").write_text(f"sensor: {mount}\nreference: {mount}\n")
    means, shares, counts = [], [], 0
    for number in range(3):
        points_m, laser = turn(np.random.default_rng(number))
        for place, chosen in (("sensor", points_m[laser % 2 == 0]), ("reference", points_m)):
            (tmp_path / place / f"{number}.bin").write_bytes(
                np.c_[chosen, np.full(len(chosen), 0.5)].astype("<f4").tobytes()
            )
        world_m = points_m.astype(np.float64) @ MOUNT[:3, :3].T + MOUNT[:3, 3]
        radius_m = np.minimum(cKDTree(world_m[laser % 2 == 0]).query(world_m)[0], 5.0)
        column, row = np.floor((world_m[:, :2] - [-20.0, -15.0]) / 0.5).astype(int).T
        band = np.select([world_m[:, 2] < -0.5, world_m[:, 2] < 0.5, world_m[:, 2] < 2.0], [-1, 0, 1], -1)
        inside = (band >= 0) & (column >= 0) & (column < 80) & (row >= 0) & (row < 60)
        bins = (band[inside], row[inside], column[inside])
        count, total, near = (np.zeros((2, 60, 80)) for _ in range(3))
        np.add.at(count, bins, 1)
        np.add.at(total, bins, radius_m[inside])
        np.add.at(near, bins, radius_m[inside] <= 0.4)
        with np.errstate(invalid="ignore"):
            means.append(total / count)
            shares.append(near / count)
        counts = counts + count
    for frame in RecordedFrames(tmp_path):
        metric.update(frame.sensor, frame.reference)
    coverage = metric.compute()
    np.testing.assert_array_equal(coverage.point_counts, counts)
    np.testing.assert_array_equal(coverage.observed_frames, np.isfinite(means).sum(axis=0))
    known = counts > 0
    assert known.sum() > 1000
    np.testing.assert_allclose(coverage.radius[known], np.nanmean(np.array(means)[:, known], axis=0), rtol=0, atol=1e-5)
    np.testing.assert_allclose(coverage.detection[0][known], np.nanmean(np.array(shares)[:, known], axis=0), atol=1e-12)
    assert 0.01 < np.nanmean(shares) < 0.99


def test_weights_stay_with_their_points():
    points_m = np.random.default_rng(0).uniform(-4, 4, (9000, 3))
    scan = Scan(points_m, None, "", weights=np.arange(9000.0))
    kept = transform_to_vehicle(scan, BoundingBox((-2, -1, 0), (2, 1, 2)))
    own = ((points_m > [-2, -1, 0]) & (points_m < [2, 1, 2])).all(axis=1)
    assert kept.excluded_counts["ego_vehicle"] == own.sum() > 100
    np.testing.assert_array_equal(kept.points_m, points_m[~own].astype(np.float32))
    np.testing.assert_array_equal(kept.weights, np.flatnonzero(~own))
