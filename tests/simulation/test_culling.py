"""Culling is conservative: scans have the same bits as with every ray cast at every body."""

import numpy as np
import pytest

from torchcover.geometry import BoundingBox, build_transform, convert_euler_to_rotation
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation import PaperReference, Pose, Scenario
from torchcover.simulation.culling import (
    compute_outlines,
    find_blocks_towards_boxes,
    find_boxes_in_cone,
    find_rays_towards_boxes,
)
from torchcover.simulation.raycaster import cast_from_vehicle
from torchcover.simulation.rays import compute_unit_directions, rotate, rotate_each, split_into_tiles
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.shapes import Box, Plane

EGO = BoundingBox((-2.45, -0.97, 0.0), (2.45, 0.97, 1.63))
SPHERE = split_into_tiles(compute_unit_directions(np.linspace(-89, 89, 60)[:, None], np.linspace(-180, 179, 120)[None]))
ROOF = Pose(x_m=0.45, z_m=1.73).to_matrix()


@pytest.fixture(scope="module", params=["urban", "highway", "parking"])
def scene(request):
    return SceneGeometry(Scenario.load(request.param).build_scene(seed=3))


def cast_at_every_body(snapshot, vehicle_T_sensor, tiles, max_range_m):
    """Cast every ray at every body in turn: slow reference implementation."""
    origin_m, answers = vehicle_T_sensor[:3, 3], []
    for tile in tiles:
        directions = rotate(vehicle_T_sensor[:3, :3], tile.directions)
        limit_m = np.full(directions.shape[1], max_range_m, dtype=np.float32)
        hits = cast_from_vehicle(snapshot.static_caster, snapshot.static_T_vehicle, origin_m, directions, limit_m)
        moving = snapshot.moving_bodies
        for caster, part_T_vehicle, body in zip(
            moving.casters, moving.part_T_vehicle, moving.body_indices, strict=True
        ):
            nearer = cast_from_vehicle(caster, part_T_vehicle, origin_m, directions, hits.range_m)
            hits.range_m[:] = nearer.range_m
            hits.body_indices[nearer.body_indices >= 0] = body
        is_point = (hits.body_indices >= 0) & (hits.body_indices != snapshot.ego_index)
        points = (directions * hits.range_m + origin_m.astype(np.float32)[:, None])[:, is_point]
        answers.append((points.T, np.count_nonzero(hits.body_indices == snapshot.ego_index)))
    points, self_hits = zip(*answers, strict=True)
    return np.concatenate(points), sum(self_hits)


def assert_same_bits(scan, expected):
    points, self_hits = expected
    np.testing.assert_array_equal(scan.points.view(np.int32), points.view(np.int32))
    assert scan.self_hits == self_hits


@pytest.mark.parametrize("time_step_index", [0, 170, 399])
@pytest.mark.parametrize("sensor", ["roof", "bumper", "paper"])
def test_culling_does_not_change_a_scan(scene, time_step_index, sensor):
    snapshot, generator = (
        scene.get_snapshot(time_step_index, max_distance_m=150.0),
        np.random.default_rng(time_step_index),
    )
    if sensor == "paper":
        reference = PaperReference(rows=60, columns=90)
        pose, tiles = reference.sample_pose(EGO, generator), split_into_tiles(reference.compute_directions())
    else:
        pose, tiles = ROOF if sensor == "roof" else Pose(x_m=2.6, z_m=0.4, pitch_deg=3).to_matrix(), SPHERE
    scan = snapshot.scan(pose, tiles, max_range_m=150.0)
    assert_same_bits(scan, cast_at_every_body(snapshot, pose, tiles, 150.0))
    assert scan.num_body_casts < 0.5 * scan.num_rays * len(snapshot.moving_bodies)


def test_grouped_casting_starts_correctly_on_a_body():
    """Of two coincident bodies a ray hits the last one, as with separate casts."""
    car, times_s = Box(type="box", size_m=(4, 2, 1.5)).build_mesh(), np.array([0.0, 3.0])
    positions = [(0, 0, 0), (8, 1, 0), (8, 1, 0), (9, -4, 0), (-7, 2, 0)]
    trajectories = [
        Trajectory.from_arrays(times_s, [position, np.add(position, (9, 0, 0))], [[15.0 * k, 0, 0]] * 2)
        for k, position in enumerate(positions)
    ]
    trajectories[2] = trajectories[1]
    actors = [Actor(f"car {k}", "car", car, trajectory) for k, trajectory in enumerate(trajectories)]
    ground = Plane(type="plane", size_m=(60, 60)).build_mesh().transform(build_transform(np.eye(3), [0, 0, -2]))
    snapshot = SceneGeometry(Scene((ground,), actors[0], tuple(actors[1:]), duration_s=3.0)).get_snapshot(0)
    roof_m = np.array([9.0, -4.0, car.vertices_m[:, 2].max()])
    touched = snapshot.moving_bodies.find_touched_bodies(roof_m, snapshot.moving_bodies.transform_to_parts_m(roof_m))
    assert touched.tolist() == [False, False, False, True, False]
    for place_m in (roof_m, np.array([4.0, 0.0, 1.0])):
        pose = build_transform(np.eye(3), place_m)
        assert_same_bits(
            snapshot.scan(pose, SPHERE, max_range_m=90.0), cast_at_every_body(snapshot, pose, SPHERE, 90.0)
        )
    (tile,) = split_into_tiles(compute_unit_directions(np.zeros((1, 1)), np.array([[14.0]])))
    _, hits, _ = snapshot.cast(
        build_transform(np.eye(3), place_m), tile, np.full(1, 90, np.float32), snapshot.compute_outlines(place_m)
    )
    assert hits.body_indices == snapshot.moving_bodies.body_indices[2]


def sample_boxes(generator, count):
    """Sample boxes of all sizes and orientations, some around the origin: (count, 8, 3) corners, sizes, poses."""
    corners = BoundingBox((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)).corners_m
    sizes = generator.uniform(0.05, 1.0, size=(count, 3)) * 10 ** generator.uniform(-1, 1.3, size=(count, 1))
    positions = generator.normal(size=(count, 3)) * 10 ** generator.uniform(-1, 1.5, size=(count, 1))
    poses = [
        build_transform(convert_euler_to_rotation(*generator.uniform(-180, 180, 3)), position) for position in positions
    ]
    return np.array([(corners * s) @ p[:3, :3].T + p[:3, 3] for s, p in zip(sizes, poses, strict=True)]), sizes, poses


def test_empty_tiles_have_no_candidate_blocks():
    empty_tile = SPHERE[0].select(np.zeros(SPHERE[0].directions.shape[1], dtype=bool))
    outlines = compute_outlines(EGO.corners_m[None], ROOF[:3, 3] / 2)
    assert find_boxes_in_cone(outlines, empty_tile.axis, empty_tile.half_angle_rad, 0.0).tolist() == [0]
    assert find_blocks_towards_boxes(outlines, empty_tile, np.eye(3), np.empty(0, dtype=np.float32)).shape == (1, 0)


def test_no_ray_that_hits_a_box_is_culled():
    """Directions to points inside boxes, including corners, pass every test for these boxes."""
    generator = np.random.default_rng(0)
    corners_m, sizes, poses = sample_boxes(generator, 300)
    origin_m = np.array([0.3, -0.2, 0.1])
    outlines = compute_outlines(corners_m, origin_m)
    turned = convert_euler_to_rotation(30, 20, 10)
    close = 0
    for k, (size, pose) in enumerate(zip(sizes, poses, strict=True)):
        inside = (
            np.vstack([generator.uniform(-0.5, 0.5, size=(92, 3)), BoundingBox((-0.5,) * 3, (0.5,) * 3).corners_m])
            * size
        )
        way_m = inside @ pose[:3, :3].T + pose[:3, 3] - origin_m
        range_m = np.linalg.norm(way_m, axis=1)
        directions = (way_m / range_m[:, None]).T
        (tile,) = split_into_tiles((turned.T @ directions).reshape(3, 10, 10))
        ends_m = range_m.astype(np.float32)
        assert outlines.min_distance_m[k] < range_m.min()
        assert k in find_boxes_in_cone(outlines, turned @ tile.axis, tile.half_angle_rad, float(ends_m.max()))
        blocks = find_blocks_towards_boxes(outlines.select(np.array([k])), tile, turned, ends_m)
        assert blocks.all()
        rays = tile.block_rays[blocks[0]]
        box, candidates = find_rays_towards_boxes(
            outlines, np.full(len(rays), k), rays, directions.astype(np.float32), ends_m
        )
        assert (box == k).all()
        np.testing.assert_array_equal(np.unique(candidates), np.arange(100))
        close += bool((outlines.normals[k] == 0).all())
    assert 3 < close < 150


def test_rotating_a_ray_is_independent_of_other_rays():
    turn, rays = convert_euler_to_rotation(31, 7, 3), np.concatenate([tile.directions for tile in SPHERE], axis=1)
    together = rotate(turn, rays)
    for first in range(0, 2000, 40):
        for count in (1, 2, 3, 5, 8):
            part = slice(first, first + count)
            np.testing.assert_array_equal(rotate(turn, rays[:, part]), together[:, part])
    turns = np.array(
        [convert_euler_to_rotation(*angles) for angles in np.random.default_rng(1).uniform(-90, 90, (50, 3))]
    )
    alone = [rotate(turn, ray[:, None])[:, 0] for turn, ray in zip(turns, rays.T[:50], strict=True)]
    np.testing.assert_array_equal(rotate_each(turns.astype(np.float32), rays[:, :50]).T, alone)
