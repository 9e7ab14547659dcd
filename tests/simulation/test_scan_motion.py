"""Motion distortion: each ray has the hit of its own time."""

from dataclasses import replace

import numpy as np
import pytest

from torchcover.geometry import invert, transform_points
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import CameraSensor, Lidar, Pose, SensorNoise
from torchcover.simulation.bodies import move_to_vehicle_frame
from torchcover.simulation.mounted_sensor import MountedSensor
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.sensor import ScanTimes
from torchcover.simulation.shapes import Box, Plane

PERIOD_S, COLUMNS = 0.1, 40
LIDAR = Lidar(
    name="roof", mount=Pose(x_m=-0.3, z_m=1.5, yaw_deg=10), channels=16, vertical_fov_deg=(-40, 6),
    horizontal_fov_deg=360, columns=COLUMNS, max_range_m=60, scan={"period_s": PERIOD_S},
)  # fmt: skip
EXACT = SensorNoise(None)
STEP_S = PERIOD_S / COLUMNS / 2


def box(*size_m):
    return move_to_vehicle_frame(Box(type="box", size_m=size_m).build_mesh())


def build_trajectory(start, way, turn_deg=0.0):
    """Build a trajectory of ten seconds that begins before the scene."""
    return Trajectory.from_arrays(
        [-5.0, 5.0], [np.subtract(start, way), np.add(start, way)], [[-turn_deg, 0, 0], [turn_deg, 0, 0]]
    )


def build_scene(ego_mps=0.0, cars_mps=0.0, turn_deg=0.0, step_s=PERIOD_S):
    """Build an ego between two walls, an approaching car next to it, and a car that crosses far ahead."""
    ground, wall = Plane(type="plane", size_m=(400, 400)).build_mesh(), box(60, 0.5, 4)
    walls = [wall.transform(Pose(y_m=y_m).to_matrix()) for y_m in (-9.0, 12.0)]
    ego = Actor("ego", "ego", box(4, 2, 1), build_trajectory((0, 0, 0), (5 * ego_mps, 0, 0), turn_deg))
    near_car = Actor("beside", "car", box(4, 2, 1.5), build_trajectory((6, 5, 0), (-5 * cars_mps, 0, 0)))
    ahead = Actor("ahead", "car", box(4, 2, 1.5), build_trajectory((15, -2, 0), (0, 5 * cars_mps, 0), 2 * turn_deg))
    return Scene((ground, *walls), ego, (near_car, ahead), time_step_s=step_s, duration_s=1.0)


def scan_sweep(made, time_s=0.5, lidar=LIDAR, draws=EXACT):
    scene = SceneGeometry(made)
    mounted = MountedSensor(lidar, scene, lidar.max_range_m)
    return mounted, mounted.scan(scene.get_snapshot(round(time_s / made.time_step_s)), draws)


@pytest.mark.parametrize(
    ("ego_mps", "cars_mps", "turn_deg"), [(20.0, 0.0, 0.0), (0.0, 15.0, 0.0), (20.0, 15.0, 0.0), (20.0, 15.0, 150.0)]
)
def test_columns_equal_scans_at_their_own_time(ego_mps, cars_mps, turn_deg):
    """Compared with a slow implementation that places the whole scene for each column."""
    made = build_scene(ego_mps, cars_mps, turn_deg)
    mounted, sweep = scan_sweep(made)
    _, raw = scan_sweep(made, lidar=LIDAR.model_copy(update={"scan": ScanTimes(period_s=PERIOD_S, deskewed=False)}))
    np.testing.assert_array_equal(raw.points, sweep.points)
    fine = SceneGeometry(build_scene(ego_mps, cars_mps, turn_deg, step_s=STEP_S))
    now, at_once = round(0.5 / STEP_S), LIDAR.model_copy(update={"scan": None})
    world_T_now = made.ego.trajectory.interpolate(0.5)
    compared = moved = 0
    for column in range(COLUMNS):
        step = now - 2 * (COLUMNS - column) + 1
        snapshot, time_s = fine.get_snapshot(step), step * STEP_S
        column_scan = MountedSensor(at_once, fine, LIDAR.max_range_m).scan(snapshot, EXACT)
        in_column, in_sweep = (
            mounted.ray_pixel_indices[scan.ray_indices] % COLUMNS == column for scan in (column_scan, sweep)
        )
        np.testing.assert_array_equal(column_scan.ray_indices[in_column], sweep.ray_indices[in_sweep])
        np.testing.assert_allclose(sweep.range_m[in_sweep], column_scan.range_m[in_column], rtol=1e-4, atol=2e-3)
        np.testing.assert_allclose(raw.measured_points[in_sweep], column_scan.points[in_column], atol=5e-3)
        struck = snapshot.scan(at_once.mount.to_matrix(), mounted.tiles, max_range_m=60).find_attributes()
        now_T_then = invert(world_T_now) @ made.ego.trajectory.interpolate(time_s)
        true = transform_points(now_T_then, column_scan.points[in_column])
        np.testing.assert_allclose(
            (sweep.points if sweep.measured_points is None else sweep.measured_points)[in_sweep], true, atol=5e-3
        )
        moving_actors = [actor for actor in made.actors if actor.trajectory.is_moving]
        for actor, number in zip(
            moving_actors,
            [body for body in snapshot.moving_bodies.body_indices if body != snapshot.ego_index],
            strict=True,
        ):
            on_body, trajectory = struck.body_indices[in_column] == number, actor.trajectory
            travelled = (
                invert(world_T_now) @ trajectory.interpolate(0.5) @ invert(trajectory.interpolate(time_s)) @ world_T_now
            )
            true[on_body] = transform_points(travelled, true[on_body])
            moved += int(on_body.sum())
        np.testing.assert_allclose(sweep.points[in_sweep], true, atol=5e-3)
        compared += len(true)
    assert compared > 200
    assert (moved > 15) == (cars_mps > 0)


def test_static_scenes_give_identical_bits():
    _, still = scan_sweep(build_scene())
    _, at_once = scan_sweep(build_scene(), lidar=LIDAR.model_copy(update={"scan": None}))
    np.testing.assert_array_equal(still.points.view(np.int32), at_once.points.view(np.int32))
    assert still.measured_points is None
    # An ego at rest among moving actors: hits on static bodies are the same, and their measured points are exact.
    moving = build_scene(cars_mps=15.0)
    _, sweep = scan_sweep(moving)
    _, at_once = scan_sweep(moving, lidar=LIDAR.model_copy(update={"scan": None}))
    common_rays = np.intersect1d(sweep.ray_indices, at_once.ray_indices)
    same = (
        sweep.points[np.isin(sweep.ray_indices, common_rays)]
        == at_once.points[np.isin(at_once.ray_indices, common_rays)]
    ).all(axis=1)
    assert same.mean() > 0.85


@pytest.mark.parametrize("car_mps", [0.0, 12.0])
def test_motion_distortion_is_speed_times_time(car_mps):
    """The rear of a car 8 m ahead of an ego at 20 m/s: three clouds in closed form."""
    made = build_scene(ego_mps=20.0)
    car = Actor("car", "car", box(4, 6, 1.5), build_trajectory((20.0 - car_mps / 2, 0, 0), (5 * car_mps, 0, 0)))
    mounted, sweep = scan_sweep(replace(made, static_meshes=made.static_meshes[:1], actors=(car,)))
    pixel = mounted.ray_pixel_indices[sweep.ray_indices]
    time_s = LIDAR.compute_ray_times_s().reshape(-1)[pixel]
    directions = LIDAR.mount.to_matrix()[:3, :3] @ LIDAR.compute_directions().reshape(3, -1)[:, pixel]
    as_cast_m = LIDAR.mount.to_matrix()[:3, 3] + (directions * sweep.range_m).T
    rear = (sweep.points[:, 2] > 0.3) & (sweep.points[:, 2] < 1.4) & (np.abs(sweep.points[:, 0] - 8.0) < 0.01)
    landed = sweep.points if sweep.measured_points is None else sweep.measured_points
    assert rear.sum() > 5
    # Without motion compensation: distorted by the speed relative to the ego.
    np.testing.assert_allclose(as_cast_m[rear, 0], 8.0 + (car_mps - 20.0) * time_s[rear], atol=2e-3)
    # With motion compensation: distorted by the speed of the car only; static points are exact.
    np.testing.assert_allclose(landed[rear, 0], 8.0 + car_mps * time_s[rear], atol=2e-3)
    assert np.ptp(landed[rear, 0]) == pytest.approx(car_mps * np.ptp(time_s[rear]), abs=2e-3)


def test_first_frames_are_simulated_like_later_frames():
    """Motion before the begin of a scene is taken from its first frames."""
    made = build_scene(ego_mps=20.0)
    made = replace(made, static_meshes=made.static_meshes[:1], actors=())
    (_, first), (_, later), (_, at_once) = (
        scan_sweep(made, time_s, lidar)
        for time_s, lidar in ((0.0, LIDAR), (0.5, LIDAR), (0.0, LIDAR.model_copy(update={"scan": None})))
    )
    np.testing.assert_allclose(first.points, later.points, atol=2e-3)
    assert np.abs(first.points - at_once.points).max() > 1.0


@pytest.mark.parametrize(
    ("sensor", "axis"),
    [
        (LIDAR, 1),
        (CameraSensor(name="c", width=50, height=30, fov_deg=90, stride=4, max_range_m=9, scan={"period_s": 0.1}), 0),
    ],
)
def test_lidar_columns_and_camera_rows_are_consecutive(sensor, axis):
    times_s = sensor.compute_ray_times_s()
    assert times_s.shape == sensor.compute_directions().shape[1:]
    assert (np.diff(times_s, axis=axis) > 0).all()
    assert (np.diff(times_s, axis=1 - axis) == 0).all()
    assert -0.1 < times_s.min() < times_s.max() < 0.0
    assert sensor.model_copy(update={"scan": None}).compute_ray_times_s() is None
    later = sensor.model_copy(update={"scan": ScanTimes(period_s=0.1, start_s=0.02)}).compute_ray_times_s()
    np.testing.assert_allclose(later, times_s + 0.12)


def test_range_errors_are_along_the_distorted_ray():
    """Errors are along the ray as it was cast, from the sensor position at that time."""
    made = build_scene(ego_mps=20.0)
    exact, erring = (
        scan_sweep(made, lidar=LIDAR.model_copy(update={"range_noise_m": sigma_m}), draws=draws)[1]
        for sigma_m, draws in ((0.0, EXACT), (0.5, SensorNoise(np.random.default_rng(1))))
    )
    np.testing.assert_array_equal(erring.points, exact.points)
    way = (erring.measured_points - exact.points).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), np.abs(erring.range_error_m), atol=1e-4)
    origins = (exact.points - way / erring.range_error_m[:, None] * exact.range_m[:, None])[
        np.abs(erring.range_error_m) > 0.1
    ]
    assert np.abs(origins[:, 1:] - LIDAR.mount.to_matrix()[1:3, 3]).max() < 0.05
    assert 1.8 < np.ptp(origins[:, 0]) < 2.1


def test_scans_longer_than_time_steps_are_refused():
    for ego_mps in (0.0, 1.0):
        with pytest.raises(
            ValueError, match=r"'roof': a scan of period_s 0\.1 is longer than the time step .* 0\.05 s"
        ):
            scan_sweep(build_scene(ego_mps=ego_mps, step_s=0.05))
    with pytest.raises(ValueError, match=r"scan\.period_s: a number above 0"):
        Lidar(**{**LIDAR.model_dump(), "scan": {"period_s": 0.0}})
