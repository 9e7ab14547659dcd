"""Radar: one point per cell, on a surface, for any number of rays per cell."""

import numpy as np
import pytest

from torchcover import Rig
from torchcover.simulation import PaperReference, Radar, RayHits, Scenario, SensorNoise, Simulator

KEYS = {
    "name": "front", "mount": {"x_m": 2.1, "z_m": 1.0}, "horizontal_fov_deg": 60, "vertical_fov_deg": [-10, 10],
    "azimuth_cell_deg": 5, "range_cell_m": 0.5, "max_range_m": 40,
}  # fmt: skip
EGO = {"shape": {"type": "box", "size_m": [4.0, 2.0, 2.0]}}
# The face is at x = 22.1, 20 m ahead of the radar.
WALL = {"name": "wall", "shape": {"type": "box", "size_m": [1, 200, 60]}, "poses": [{"x_m": 22.6, "z_m": -20}]}


def radar(**keys):
    return Radar.model_validate(KEYS | keys)


def compute_points(sensor, *bodies):
    """Compute the points in the radar frame."""
    scenario = Scenario.model_validate({"name": "s", "ego": EGO, "bodies": [WALL, *bodies]})
    rig = Rig(name="r", sensors=(sensor,))
    [scan] = Simulator(scenario, {"r": rig}, PaperReference(2, 2)).simulate_scans(0)["r"]
    return (scan.points if scan.measured_points is None else scan.measured_points).astype(np.float64) - [2.1, 0.0, 1.0]


def compute_cells(sensor, points_m):
    """Compute the (N, 2) azimuth and range cells of points."""
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    across = (azimuth_deg + sensor.horizontal_fov_deg / 2) / sensor.horizontal_fov_deg * sensor.num_azimuth_cells
    along = np.linalg.norm(points_m, axis=1) / sensor.range_cell_m
    return np.floor(np.column_stack([across, along]) + 1e-6).astype(int)


def group_by_cell(sensor, *bodies):
    """Get the point of each occupied cell."""
    points_m = compute_points(sensor, *bodies)
    return dict(zip(map(tuple, compute_cells(sensor, points_m).tolist()), points_m, strict=True))


def test_walls_fill_the_cells_they_cross():
    """At azimuth a, the wall is 20 m / cos(a) away on the horizon, and slightly more above and below."""
    sensor = radar(vertical_fov_deg=[0, 0], ray_spacing_m=0.02)
    points_m = compute_points(sensor)
    edges = np.deg2rad(np.linspace(-30, 30, 13))
    low, high = np.sort(20 / np.cos([edges[:-1], edges[1:]]), axis=0)
    nearest = np.floor(low / 0.5)  # 20 m is in the lower of the two central cells
    expected = {(k, n) for k in range(12) for n in np.arange(nearest[k], np.floor(high[k] / 0.5) + 1).astype(int)}
    assert set(map(tuple, compute_cells(sensor, points_m).tolist())) == expected
    assert len(points_m) == len(expected)


def test_points_are_central_hits_of_cells():
    """Compared with a slow implementation at random ranges and positions."""
    sensor, random = radar(min_range_m=3.0, range_cell_m=2.0), np.random.default_rng(3)
    rays = sensor.num_rays
    beams = sensor.compute_beam_indices().ravel()
    ray, position = np.tile(np.arange(rays), 2), np.repeat([0, 1], rays)
    is_hit = random.random(2 * rays) < 0.4
    hits = RayHits(
        ray[is_hit], random.uniform(2, 12, is_hit.sum()).astype(np.float32), np.arange(rays), position[is_hit]
    )
    cells = {}
    for number, (position_hits, range_m, where) in enumerate(
        zip(hits.ray_indices, hits.range_m, hits.position_indices, strict=True)
    ):
        if range_m >= 3.0:
            cells.setdefault((where, beams[position_hits], int(range_m / 2.0)), []).append((range_m, number))
    expected = sorted(sorted(cell)[(len(cell) - 1) // 2][1] for cell in cells.values())
    assert sensor.measure(hits, SensorNoise(None)).hit_indices.tolist() == expected
    assert max(map(len, cells.values())) > 5


def test_more_rays_per_cell_find_the_same_surfaces():
    """With more rays, a box ahead of a wall occupies no more cells, and ranges converge."""
    box = {"name": "box", "shape": {"type": "box", "size_m": [2, 2, 3]}, "poses": [{"x_m": 12.0, "y_m": 2.0}]}
    finest = group_by_cell(radar(ray_spacing_m=0.05), box)
    missing, moved_m = [], []
    for spacing_m in (2.0, 0.5, 0.1):
        points = group_by_cell(radar(ray_spacing_m=spacing_m), box)
        common_cells = sorted(points.keys() & finest.keys())
        missing.append(len(finest) - len(common_cells))
        moved_m.append(
            np.mean([abs(np.linalg.norm(points[cell]) - np.linalg.norm(finest[cell])) for cell in common_cells])
        )
    assert missing[0] > missing[1] > missing[2]
    assert missing[2] < 0.05 * len(finest)
    assert moved_m[0] > moved_m[1] > moved_m[2]
    assert moved_m[2] < 0.01


def test_road_hits_do_not_replace_body_points():
    """In a shared cell, the point lies on the body that fills more of the view."""
    floor = {"name": "floor", "shape": {"type": "plane", "size_m": [200, 200]}}
    body = {"name": "body", "shape": {"type": "box", "size_m": [0.4, 3, 1.8]}, "poses": [{"x_m": 7.55}]}
    sensor = radar(horizontal_fov_deg=10, azimuth_cell_deg=5, vertical_fov_deg=[-15, 15])
    points_m = compute_points(sensor, floor, body)
    # The face is 5.25 m ahead; the floor from 5.0 m on is in the same cell.
    in_its_cell = points_m[compute_cells(sensor, points_m)[:, 1] == 10]
    assert len(in_its_cell) == 2
    np.testing.assert_allclose(in_its_cell[:, 0], 5.25, atol=1e-4)


def test_noise_and_dropout_apply_per_cell():
    exact = compute_points(radar())
    noisy = compute_points(radar(range_noise_m=0.05))
    error_m = np.linalg.norm(noisy, axis=1) - np.linalg.norm(exact, axis=1)
    np.testing.assert_allclose(np.cross(noisy, exact), 0.0, atol=1e-4)
    assert 0.035 < error_m.std() < 0.07
    left = compute_points(radar(dropout=0.5))
    assert 0.3 < len(left) / len(exact) < 0.7
    assert set(map(tuple, left)) < set(map(tuple, exact))


def test_rays_fill_the_fov_at_the_requested_spacing():
    sensor = radar(azimuth_cell_deg=7.0)
    assert sensor.num_azimuth_cells == 9  # cells of 6.67 degrees; none is wider
    x, y, z = sensor.compute_directions()
    assert sensor.num_rays == x.size == sensor.compute_beam_indices().size
    azimuth_deg, elevation_deg = np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arcsin(z))
    for angle_deg, axis, opening_deg in ((azimuth_deg, 1, 60), (elevation_deg, 0, 20)):
        step_deg = np.diff(angle_deg, axis=axis)
        assert step_deg.min() > 0
        assert step_deg.max() <= np.rad2deg(0.5 / 40) + 1e-9
        np.testing.assert_allclose(angle_deg.max() - angle_deg.min() + step_deg.mean(), opening_deg, rtol=1e-6)
    across = np.floor((azimuth_deg + 30) / 60 * 9).astype(int)
    np.testing.assert_array_equal(across, sensor.compute_beam_indices())


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"azimuth_cell_deg": 61.0},
            r"azimuth_cell_deg: a cell within .* horizontal_fov_deg \(60\) wide; got 61",
        ),
        ({"range_cell_m": 41.0}, r"range_cell_m: a cell within .* max_range_m \(40\) wide; got 41"),
        ({"azimuth_cell_deg": 0.0}, r"azimuth_cell_deg\n"),
        ({"range_cell_m": -1.0}, r"range_cell_m\n"),
        ({"ray_spacing_m": 0.0}, r"ray_spacing_m\n"),
        ({"horizontal_fov_deg": 361.0}, r"horizontal_fov_deg\n"),
        ({"vertical_fov_deg": [5, -5]}, r"vertical_fov_deg: the lower elevation comes first; got \(5.0, -5.0\)"),
        ({"min_range_m": 40.0}, r"min_range_m \(40.0\) must be below max_range_m \(40.0\)"),
    ],
)
def test_invalid_radars_are_refused_with_the_key(keys, message):
    with pytest.raises(ValueError, match=message):
        radar(**keys)


def test_nuscenes_radars_cover_all_azimuths():
    sensors = Rig.load("nuscenes_radars").sensors
    assert len(sensors) == 10
    for near_radar, far_radar in zip(sensors[::2], sensors[1::2], strict=True):
        assert far_radar.name == f"{near_radar.name}_far"
        assert (near_radar.mount, near_radar.max_range_m) == (far_radar.mount, far_radar.min_range_m)
    yaw_deg = np.sort([sensor.mount.yaw_deg % 360 for sensor in sensors[::2]])
    gaps = np.diff([*yaw_deg, yaw_deg[0] + 360])
    assert np.sort(gaps)[-1] < 95
