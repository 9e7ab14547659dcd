"""Omitted rays: rays that cannot give needed points are not cast, and needed points are identical."""

import numpy as np
import pytest

from torchcover.simulation import CameraSensor, Lidar, Pose, Radar, Scenario, SensorNoise
from torchcover.simulation.camera_sensor import Stereo
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.mounted_sensor import MountedSensor
from torchcover.simulation.rays import compute_ray_pixel_indices, compute_unit_directions, split_into_tiles
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.sensor import ScanTimes

ROOF = Pose(x_m=0.45, z_m=1.73, yaw_deg=20, pitch_deg=3)
MAX_SEPARATE_POINTS = 800  # default of SearchSpheres.from_points
ERRS = {"range_noise_m": 0.05, "dropout": 0.1}
ROWS = {"channels": 40, "vertical_fov_deg": (-60, 10), "horizontal_fov_deg": 360, "columns": 150, "max_range_m": 90}
SENSORS = {
    "lidar": Lidar(name="a", mount=ROOF, **ROWS, **ERRS, range_at_10_percent_m=15.0),
    "exact lidar": Lidar(name="a", mount=ROOF, **ROWS),
    "lidar that takes time": Lidar(name="a", mount=ROOF, **ROWS, **ERRS, scan=ScanTimes(period_s=0.1)),
    "camera": CameraSensor(
        name="a", mount=Pose(x_m=1.0, z_m=1.5), width=320, height=200, stride=4, lens="brown_conrady", fx=200, fy=190,
        cx=160, cy=100, coefficients=(-0.2, 0.05, 0, 0), max_range_m=90, stereo=Stereo(baseline_m=0.2, subpixel_px=0.2),
    ),
    "radar": Radar(
        name="a", mount=Pose(x_m=2.6, z_m=0.5), horizontal_fov_deg=90, vertical_fov_deg=(-10, 10), azimuth_cell_deg=3,
        range_cell_m=0.5, max_range_m=70, ray_spacing_m=1.0, **ERRS,
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return SceneGeometry(Scenario.load("parking").build_scene(seed=3))


def is_near(scan, balls):
    """Return the (N,) mask of points within a sphere."""
    away_m = np.linalg.norm(scan.points[:, None].astype(float) - balls.centers_m, axis=2)
    return (away_m <= balls.radius_m).any(axis=1)


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize("radius_m", [0.1, 0.4, 2.0])
def test_needed_points_do_not_change_by_a_bit(scene, name, radius_m):
    snapshot, sensor = scene.get_snapshot(30, max_distance_m=90.0), SENSORS[name]
    mounted = MountedSensor(sensor, scene, sensor.max_range_m)

    def scan(**options):
        draws = SensorNoise(np.random.default_rng(7), num_rays=len(mounted.ray_pixel_indices))
        return mounted.scan(snapshot, draws, num_threads=2, **options)

    full, generator = scan(), np.random.default_rng(8)
    places_m = full.points[generator.choice(len(full.points), 12)] + generator.normal(0, radius_m / 2, (12, 3))
    balls = SearchSpheres(places_m.astype(np.float32), radius_m)
    spared = scan(search_spheres=balls)
    of_full, of_spared = is_near(full, balls), is_near(spared, balls)
    assert of_full.sum() > 0
    for column in ("points", "ray_indices", "range_m", "range_error_m", "measured_points"):
        expected, actual = getattr(full, column), getattr(spared, column)
        assert (expected is None) == (actual is None)
        if expected is not None:
            np.testing.assert_array_equal(expected[of_full], actual[of_spared], err_msg=column)
    assert (spared.num_rays, spared.self_hits) == (full.num_rays, full.self_hits)
    assert (spared.num_omitted_rays > 0.3 * full.num_rays) == (name != "lidar that takes time") or radius_m > 1


def test_rays_are_selected_if_they_pass_spheres():
    """Up to some millimeters, plus a millimeter per meter of range; a sphere at the sensor selects all rays."""
    generator = np.random.default_rng(5)
    directions = compute_unit_directions(np.linspace(-89, 89, 50)[:, None], np.linspace(-179, 179, 100)[None])
    pose = ROOF.to_matrix()
    pixels, tiles = compute_ray_pixel_indices(directions), split_into_tiles(directions)
    towards = (pose[:3, :3] @ directions.reshape(3, -1)[:, pixels]).T
    for count, far_m, radius_m in ((1, 3, 1.5), (40, 60, 0.4), (300, 200, 0.2), (3, 0.5, 0.6), (0, 1, 1)):
        centres_m = generator.normal(0, far_m, (count, 3)).astype(np.float32)
        ways_m = centres_m - pose[:3, 3]
        along_m = np.maximum(towards @ ways_m.T, 0)
        squared_m2 = (ways_m**2).sum(axis=1)
        away_m = np.sqrt(np.maximum(squared_m2 - 2 * along_m * (towards @ ways_m.T) + along_m**2, 0))
        met = np.concatenate([SearchSpheres(centres_m, radius_m).find_rays_through(tile, pose) for tile in tiles])
        assert met[(away_m <= radius_m).any(axis=1)].all()
        if (squared_m2 > radius_m**2).all():
            assert not met[(away_m > np.hypot(radius_m + 5e-3, 1.5e-3 * np.sqrt(squared_m2))).all(axis=1)].any()


@pytest.mark.parametrize("name", ["lidar", "camera"])
def test_many_points_share_larger_spheres(scene, name):
    """Larger spheres select all rays of the spheres that they replace; if nearly all are needed, all are cast."""
    sensor, snapshot = SENSORS[name], scene.get_snapshot(0, max_distance_m=90.0)
    mounted, generator = MountedSensor(sensor, scene, 90.0), np.random.default_rng(9)
    full = mounted.scan(snapshot, SensorNoise(np.random.default_rng(7), num_rays=len(mounted.ray_pixel_indices)))
    ahead = full.points[(full.points[:, 0] > 2) & (np.abs(full.points[:, 1]) < 4)]
    ahead_m = ahead[generator.integers(0, len(ahead), MAX_SEPARATE_POINTS + 1)] + generator.normal(
        0, 0.3, (MAX_SEPARATE_POINTS + 1, 3)
    )
    merged_spheres, single_spheres = SearchSpheres.from_points(ahead_m, 0.4), SearchSpheres(ahead_m, 0.4)
    assert 1 < len(merged_spheres.centers_m) < MAX_SEPARATE_POINTS
    assert (
        (np.linalg.norm(ahead_m[:, None] - merged_spheres.centers_m, axis=2) + 0.4 <= merged_spheres.radius_m + 1e-9)
        .any(axis=1)
        .all()
    )
    for tile in mounted.tiles:
        needed = single_spheres.find_rays_through(tile, mounted.vehicle_T_sensor)
        assert merged_spheres.find_rays_through(tile, mounted.vehicle_T_sensor)[needed].all()
    spared = mounted.scan(
        snapshot,
        SensorNoise(np.random.default_rng(7), num_rays=len(mounted.ray_pixel_indices)),
        search_spheres=merged_spheres,
    )
    of_full, of_spared = is_near(full, single_spheres), is_near(spared, single_spheres)
    np.testing.assert_array_equal(full.points[of_full], spared.points[of_spared])
    assert 0.2 * full.num_rays < spared.num_omitted_rays
    everywhere = SearchSpheres.from_points(generator.normal(0, 9, (MAX_SEPARATE_POINTS + 1, 3)), 4.0)
    assert mounted.scan(snapshot, SensorNoise(None), search_spheres=everywhere).num_omitted_rays == 0


def test_rigs_share_snapshots_and_few_are_cached(scene):
    first = scene.get_snapshot(0, max_distance_m=90.0)
    assert scene.get_snapshot(0, max_distance_m=90.0) is first
    assert scene.get_snapshot(0, max_distance_m=80.0) is not first
    for time_step_index in range(1, 9):
        scene.get_snapshot(time_step_index, max_distance_m=90.0)
    assert scene.get_snapshot(0, max_distance_m=90.0) is not first
