"""Mounted sensors: reused results are identical, and occluders between sensor and ego are seen."""

from dataclasses import replace

import numpy as np
import pytest

from torchcover.geometry import invert
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import Lidar, Pose, SensorNoise
from torchcover.simulation.bodies import Body, move_to_vehicle_frame
from torchcover.simulation.mounted_sensor import MountedSensor
from torchcover.simulation.rays import split_into_tiles
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SceneSnapshot
from torchcover.simulation.shapes import Box, Cylinder, Plane

UTM = np.array([513_248.37, 5_403_655.81, 312.5])
LIDAR = Lidar(
    name="roof", mount=Pose(x_m=-0.3, z_m=1.5, yaw_deg=10), channels=30, vertical_fov_deg=(-80, 20),
    horizontal_fov_deg=360, columns=120, max_range_m=40,
)  # fmt: skip
TILES = split_into_tiles(LIDAR.compute_directions())
EXACT = SensorNoise(None)


def box(*size_m):
    return move_to_vehicle_frame(Box(type="box", size_m=size_m).build_mesh())


def build_trajectory(start, way, yaw_deg=0.0):
    ends_m = np.array([start, np.add(start, way)], dtype=float)
    return Trajectory.from_arrays([0.0, 10.0], ends_m, [[yaw_deg, 0, 0]] * 2)


def build_scene(ego_moves=True, actor_moves=True, origin_m=(0.0, 0.0, 0.0)):
    """Build an ego at up to 1 m/s under a bar 0.1 m above its roof, with a car next to it."""
    origin_m = np.array(origin_m)
    bar = box(0.4, 6, 0.1).transform(Pose(x_m=4.0, z_m=1.1).to_matrix())
    static = [bar, Plane(type="plane", size_m=(200, 200)).build_mesh()]
    for k, mesh in enumerate(static):
        static[k] = mesh._replace(vertices_m=mesh.vertices_m + origin_m)
    ego = Actor("ego", "ego", box(4, 2, 1), build_trajectory(origin_m, (10.0 * ego_moves, 0, 0)))
    car = Actor("car", "car", box(3, 1, 1), build_trajectory(np.add(origin_m, [0, 5, 0]), (20.0 * actor_moves, 0, 0)))
    return Scene(tuple(static), ego, (car,), time_step_s=1.0, duration_s=10.0)


def scan_again(snapshot):
    return snapshot.scan(LIDAR.mount.to_matrix(), TILES, max_range_m=40)


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), UTM])
@pytest.mark.parametrize("actor_moves", [False, True])
@pytest.mark.parametrize("ego_moves", [False, True])
def test_reused_results_equal_new_scans_every_frame(ego_moves, actor_moves, origin_m):
    scene = SceneGeometry(build_scene(ego_moves, actor_moves, origin_m))
    mounted, self_hits = MountedSensor(LIDAR, scene, LIDAR.max_range_m), []
    for time_step_index in (0, 3, 4, 5, 9):
        snapshot = scene.get_snapshot(time_step_index, max_distance_m=40.0)
        first_scan, expected = mounted.scan(snapshot, EXACT), scan_again(snapshot)
        np.testing.assert_array_equal(first_scan.points.view(np.int32), expected.points.view(np.int32))
        np.testing.assert_array_equal(first_scan.ray_indices, expected.ray_indices)
        assert (first_scan.num_rays, first_scan.self_hits) == (expected.num_rays, expected.self_hits)
        self_hits.append(first_scan.self_hits)
    # The bar is between sensor and ego body while the ego passes below it.
    assert self_hits[0] > 500
    assert (min(self_hits) < self_hits[0] - 20) == ego_moves


@pytest.mark.parametrize("moves", [False, True])
def test_too_close_hits_occlude_without_points(moves):
    scene = SceneGeometry(build_scene(moves, moves))
    snapshot, exact = (
        scene.get_snapshot(3),
        MountedSensor(LIDAR, scene, LIDAR.max_range_m).scan(scene.get_snapshot(3), EXACT),
    )
    mounted = MountedSensor(LIDAR.model_copy(update={"min_range_m": 4.0}), scene, LIDAR.max_range_m)
    first_scan, repeated = mounted.scan(snapshot, EXACT), mounted.scan(snapshot, EXACT)
    is_far = exact.range_m >= 4.0
    assert 0 < is_far.sum() < len(is_far) - 20
    for scan in (first_scan, repeated):
        np.testing.assert_array_equal(scan.points, exact.points[is_far])
        np.testing.assert_array_equal(scan.ray_indices, exact.ray_indices[is_far])
        np.testing.assert_array_equal(scan.range_m, exact.range_m[is_far])
    ways_m = np.linalg.norm(first_scan.points - LIDAR.mount.to_matrix()[:3, 3], axis=1)
    np.testing.assert_allclose(first_scan.range_m, ways_m, rtol=1e-5)


def test_scans_are_repeated_only_with_motion(monkeypatch):
    scans, original = [], SceneSnapshot.scan
    monkeypatch.setattr(SceneSnapshot, "scan", lambda *args, **options: scans.append(1) or original(*args, **options))
    for moves, expected in [((False, False), 1), ((False, True), 3), ((True, False), 3)]:
        scans.clear()
        scene = SceneGeometry(build_scene(*moves))
        mounted = MountedSensor(LIDAR, scene, LIDAR.max_range_m)
        for time_step_index in (0, 1, 2):
            mounted.scan(scene.get_snapshot(time_step_index), EXACT)
        assert len(scans) == expected


def test_the_ego_pose_is_exactly_constant():
    """With coordinates of UTM size, a pose times its inverse is not exactly the identity."""
    made = build_scene(origin_m=UTM)
    turned = replace(made, ego=replace(made.ego, trajectory=build_trajectory(UTM, (10, 0, 0), yaw_deg=37.3)), actors=())
    for time_step_index in (0, 3, 7):
        np.testing.assert_array_equal(
            SceneGeometry(turned).get_snapshot(time_step_index).moving_bodies.part_T_vehicle, np.eye(4)[None]
        )


@pytest.mark.parametrize("origin_m", [(0.0, 0.0, 0.0), UTM])
@pytest.mark.parametrize(("ego_moves", "actor_moves"), [(False, False), (False, True), (True, True)])
def test_hits_lie_on_their_face_at_their_angle(ego_moves, actor_moves, origin_m):
    made = build_scene(ego_moves, actor_moves, origin_m)
    bar, ground = made.static_meshes
    bar = bar._replace(material_indices=np.arange(len(bar.faces), dtype=np.uint8))
    car = replace(made.actors[0], mesh=made.actors[0].mesh._replace(material_indices=np.full(12, 77, dtype=np.uint8)))
    turning = Trajectory.from_arrays([0.0, 10.0], [origin_m, np.add(origin_m, (3, 1, 0))], [[0, 0, 0], [40, 0, 0]])
    ego = replace(made.ego, trajectory=turning if ego_moves else made.ego.trajectory)
    scene, time_s = SceneGeometry(replace(made, static_meshes=(bar, ground), actors=(car,), ego=ego)), 3.0
    scan = scan_again(scene.get_snapshot(3))
    struck, origin = scan.find_attributes(), LIDAR.mount.to_matrix()[:3, 3]
    vehicle_T_world = invert(ego.trajectory.interpolate(time_s))
    world_meshes = {0: bar.transform(vehicle_T_world), 1: ground.transform(vehicle_T_world)}
    world_meshes[2] = car.mesh.transform(vehicle_T_world @ car.trajectory.interpolate(time_s))
    # Order of the bodies: static actors, static meshes, moving bodies.
    of_body = {(False, False): [-1, 2, 0, 1], (False, True): [-1, 0, 1, 2], (True, True): [0, 1, -1, 2]}
    number = np.array(of_body[ego_moves, actor_moves])[struck.body_indices]
    assert set(number) == {0, 1, 2}
    for body, mesh in world_meshes.items():
        is_on_body = number == body
        points, triangle = scan.points[is_on_body].astype(np.float64), struck.triangle_indices[is_on_body]
        first, second, third = mesh.vertices_m[mesh.faces[triangle]].transpose(1, 0, 2)
        across = np.cross(second - first, third - first)
        normals = across / np.linalg.norm(across, axis=1, keepdims=True)
        assert np.abs(((points - first) * normals).sum(axis=1)).max() < 1e-4
        for start, end in ((first, second), (second, third), (third, first)):
            assert (np.cross(end - start, points - start) * normals).sum(axis=1).min() > -1e-3
        directions = (points - origin) / np.linalg.norm(points - origin, axis=1, keepdims=True)
        np.testing.assert_allclose(
            struck.cos_incidence[is_on_body], np.abs((directions * normals).sum(axis=1)), atol=1e-5
        )
        assert (struck.material_indices[is_on_body] == mesh.filled_material_indices[triangle]).all()


@pytest.mark.parametrize("traffic", [False, True], ids=["standing", "driving"])
def test_housings_occlude_only_other_sensors(traffic):
    """A mast 0.2 m wide, 1 m ahead of the other sensor, occludes 11.5 degrees."""
    mast = Body(name="mast", shape=Cylinder(type="cylinder", radius_m=0.1, height_m=3.0), poses=(Pose(z_m=-1.5),))
    front = LIDAR.model_copy(update={"name": "front", "mount": Pose(x_m=1.0, z_m=2.5), "housing": (mast,)})
    level = {"columns": 360, "channels": 4, "vertical_fov_deg": (-20.0, -5.0)}
    rear = LIDAR.model_copy(update={"mount": Pose(z_m=2.5), **level})
    trajectory = Trajectory(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [float(traffic), 0, 0]]), np.zeros((2, 3)))
    plain = Plane(type="plane", size_m=(200.0, 200.0)).build_mesh()
    scene = SceneGeometry(
        Scene((plain,), Actor("ego", "car", box(0.1, 0.1, 0.1), trajectory), time_step_s=1.0, duration_s=1.0)
    )

    def azimuths_deg(sensor, other_sensors=()):
        points_m = (
            MountedSensor(sensor, scene, 40.0, other_sensors=other_sensors).scan(scene.get_snapshot(0), EXACT).points
        )
        x, y, _ = (points_m - sensor.mount.to_matrix()[:3, 3]).T
        return set(np.round(np.rad2deg(np.arctan2(y, x)), 1).tolist())

    assert azimuths_deg(front, (rear,)) == azimuths_deg(front)
    assert sorted(azimuths_deg(rear) - azimuths_deg(rear, (front,))) == [k + 0.5 for k in range(-6, 6)]
