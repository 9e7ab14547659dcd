"""Scenes: the ego occludes, actors follow their trajectories, and absolute positions do not matter."""

import numpy as np
import pytest

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import Pose
from torchcover.simulation.bodies import move_to_vehicle_frame
from torchcover.simulation.rays import compute_unit_directions, split_into_tiles
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Plane

SPHERE = split_into_tiles(
    compute_unit_directions(np.linspace(-89, 89, 150)[:, None], np.linspace(-179, 179, 300)[None])
)
ABOVE = Pose(z_m=1.5).to_matrix()
UTM = np.array([513_248.37, 5_403_655.81, 312.5])


def box(*size_m):
    return move_to_vehicle_frame(Box(type="box", size_m=size_m).build_mesh())


def build_scene(origin_m=(0, 0, 0), yaw_deg=0.0, moving=True, ego_moves=False):
    """Build a wall 10 m ahead, a car 6 m to the left that drives at 2 m/s, and an ego that may drive at 1 m/s."""
    origin_pose = build_transform(convert_euler_to_rotation(yaw_deg, 0, 0), origin_m)

    def along(start, way):
        ends = np.array([start, np.add(start, way)], dtype=float)
        return Trajectory.from_arrays(
            [0.0, 10.0], ends @ origin_pose[:3, :3].T + origin_pose[:3, 3], [[yaw_deg, 0, 0]] * 2
        )

    static = (
        box(1, 20, 4).transform(origin_pose @ Pose(x_m=10).to_matrix()),
        Plane(type="plane", size_m=(300, 300)).build_mesh().transform(origin_pose),
    )
    ego = Actor("ego", "ego", box(4, 2, 1), along((0, 0, 0), (10 * ego_moves, 0, 0)))
    car = Actor("car", "car", box(3, 1, 1), along((0, 6, 0), (20 * moving, 0, 0)))
    return Scene(static, ego, (car,), time_step_s=1.0, duration_s=10.0)


def scan(made, time_step_index=0, pose=ABOVE, **options):
    return SceneGeometry(made).get_snapshot(time_step_index).scan(pose, SPHERE, **options)


def to_set(points):
    return points[np.lexsort(points.round(3).T)]


def test_the_ego_occludes_and_gives_no_points():
    points = scan(build_scene(moving=False))
    x, y, z = points.points.T
    assert not ((np.abs(x) < 1.999) & (np.abs(y) < 0.999) & (z < 1.001)).any()
    # From 0.5 m above the center of the roof, its edge at x = 2 hides the ground up to x = 2 * 1.5 / 0.5 = 6.
    ground_ahead = (np.abs(z) < 1e-3) & (np.abs(y) < 0.3) & (x > 0)
    assert 5.99 < x[ground_ahead].min() < 6.3
    directions = np.concatenate([tile.directions for tile in SPHERE], axis=1)
    with np.errstate(divide="ignore"):
        edge = np.maximum(np.abs(directions[0]) / 2, np.abs(directions[1]))
        onto_the_roof = (directions[2] < 0) & (edge * 0.5 < -directions[2])
    assert points.self_hits == pytest.approx(onto_the_roof.sum(), abs=2)
    assert points.num_rays == directions.shape[1]


def test_moving_and_resting_egos_have_equal_scans():
    resting = scan(build_scene(moving=False))
    moving = scan(build_scene(moving=False, ego_moves=True))
    assert moving.self_hits == resting.self_hits
    np.testing.assert_allclose(to_set(moving.points), to_set(resting.points), atol=1e-4)


def test_actors_follow_trajectories_and_occlude():
    for time_step_index in (0, 1, 2):
        x, y, z = scan(build_scene(), time_step_index).points.T
        side = (np.abs(y - 5.5) < 1e-3) & (z > 0.05)
        assert x[side].min() == pytest.approx(2 * time_step_index - 1.5, abs=0.25)
        assert x[side].max() == pytest.approx(2 * time_step_index + 1.5, abs=0.25)
        behind = (np.abs(z) < 1e-3) & (y > 6.5) & (y < 12) & (np.abs(x - 2 * time_step_index * y / 5.5) < 0.5)
        assert not behind.any()


@pytest.mark.parametrize("ego_moves", [False, True])
def test_distant_world_coordinates_give_the_same_points(ego_moves):
    near_points = scan(build_scene(ego_moves=ego_moves), 2)
    distant_points = scan(build_scene(UTM, 37.0, ego_moves=ego_moves), 2)
    assert len(near_points.points) == len(distant_points.points)
    np.testing.assert_allclose(to_set(distant_points.points), to_set(near_points.points), atol=1e-3)


def test_overlapping_actors_are_reported_with_the_time():
    made = build_scene(ego_moves=True)
    crossing = Trajectory.from_arrays([0.0, 10.0], [[5, -25, 0], [5, 25, 0]], [[90, 0, 0]] * 2)
    scene = SceneGeometry(
        Scene(made.static_meshes, made.ego, (Actor("truck", "truck", box(8, 2, 3), crossing),), 1.0, 10.0)
    )
    scene.get_snapshot(3)
    with pytest.raises(ValueError, match=r"actor 'truck' overlaps the ego at t = 5 s"):
        scene.get_snapshot(5)


@pytest.mark.parametrize("moving", [False, True])
def test_positions_inside_bodies_are_occupied(moving):
    snapshot = SceneGeometry(build_scene(moving=moving)).get_snapshot(0)
    for buried in ([3, 3, -0.2], [10, 0, 1], [0, 6, 0.5]):
        assert snapshot.is_occupied(np.array(buried, dtype=float))
    for free in ([3, 3, 0.2], [9.3, 0, 1], [0, 5.3, 0.5], [0, 0, 1.2]):
        assert not snapshot.is_occupied(np.array(free, dtype=float))
