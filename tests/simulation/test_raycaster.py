"""The ray caster against closed forms and against a slow intersection test in float64."""

import numpy as np
import pytest

from torchcover.geometry import rigid
from torchcover.simulation.lidar import unit_directions
from torchcover.simulation.raycaster import CHUNK, RayCaster
from torchcover.simulation.shapes import Box, Mesh, Plane

HERE = np.zeros(3)
IDENTITY = np.eye(3)


def random_directions(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(3, count))
    return (directions / np.linalg.norm(directions, axis=0)).astype(np.float32)


def random_mesh(faces, seed=0):
    generator = np.random.default_rng(seed)
    places = np.repeat(generator.uniform(-10, 10, size=(faces, 3)), 3, axis=0)
    return Mesh(places + generator.uniform(-2, 2, size=(3 * faces, 3)), np.arange(3 * faces).reshape(-1, 3))


def slow_hits(mesh, origin, directions):
    """Möller-Trumbore in float64: (N,) distance to the nearest face, inf for a miss."""
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    nearest = np.full(directions.shape[1], np.inf)
    for i, direction in enumerate(directions.T.astype(np.float64)):
        p = np.cross(direction, c - a)
        determinant = ((b - a) * p).sum(1)
        s = origin - a
        u = (s * p).sum(1) / determinant
        q = np.cross(s, b - a)
        v = q @ direction / determinant
        t = ((c - a) * q).sum(1) / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hit.any():
            nearest[i] = t[hit].min()
    return nearest


def test_rays_onto_a_plane_end_where_geometry_says():
    elevation = np.linspace(-89.0, -1.0, 45)
    directions = unit_directions(elevation[:, None], np.linspace(0, 350, 36)[None])
    hits = RayCaster([Plane(type="plane", size_m=(1000, 1000)).mesh()]).cast(
        np.array([1.0, 2.0, 1.7]), IDENTITY, directions
    )
    assert len(hits.ray) == directions.shape[1]
    assert np.abs(hits.points[2]).max() < 1e-5
    ground_range = np.hypot(hits.points[0] - 1.0, hits.points[1] - 2.0)
    expected = np.repeat(1.7 / np.tan(np.deg2rad(-elevation)), 36)
    np.testing.assert_allclose(ground_range, expected, rtol=2e-5)


def test_agrees_with_a_slow_intersection_in_float64():
    mesh, directions = random_mesh(200), random_directions(600)
    hits = RayCaster([mesh]).cast(HERE, IDENTITY, directions)
    expected = slow_hits(mesh, HERE, directions)
    found = np.full(directions.shape[1], np.inf)
    found[hits.ray] = np.linalg.norm(hits.points, axis=0)
    # A ray through the very border of a face may go either way in float32.
    same_verdict = np.isfinite(found) == np.isfinite(expected)
    assert same_verdict.mean() > 0.995
    both = np.isfinite(found) & np.isfinite(expected)
    close = np.abs(found[both] - expected[both]) < 1e-4
    assert close.mean() > 0.995
    assert 0.2 < both.mean() < 1.0


def test_no_ray_slips_out_of_a_closed_box_through_its_edges():
    box = Box(type="box", size_m=(4.0, 6.0, 3.0)).mesh()
    targets = box.vertices_m[box.faces]
    weights = np.linspace(0, 1, 101)[:, None, None, None]
    on_edges = (weights * targets[None] + (1 - weights) * targets[None][:, :, [1, 2, 0]]).reshape(-1, 3)
    origin = np.array([0.3, -0.2, 1.1])
    directions = (on_edges - origin).T
    directions = (directions / np.linalg.norm(directions, axis=0)).astype(np.float32)
    hits = RayCaster([box]).cast(origin, IDENTITY, directions)
    assert len(hits.ray) == directions.shape[1]
    np.testing.assert_allclose(hits.points.T, on_edges, atol=1e-5)


def test_hits_name_their_body():
    bodies = [
        Box(type="box", size_m=(1, 1, 1)).mesh().moved(rigid(IDENTITY, place))
        for place in ([5.0, 0.0, -0.5], [0.0, 7.0, -0.5])
    ]
    directions = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0]], dtype=np.float32).T
    hits = RayCaster(bodies).cast(HERE, IDENTITY, directions)
    assert hits.body.tolist() == [0, 1]
    assert hits.ray.tolist() == [0, 1]
    np.testing.assert_allclose(hits.points.T, [[4.5, 0, 0], [0, 6.5, 0]], atol=1e-6)


def test_the_rotation_takes_directions_into_the_frame_of_the_bodies():
    plane = Plane(type="plane", size_m=(100, 100)).mesh()
    quarter_turn_down = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # x -> -z
    hits = RayCaster([plane]).cast(
        np.array([0.0, 0.0, 2.0]), quarter_turn_down, np.array([[1.0], [0.0], [0.0]], dtype=np.float32)
    )
    np.testing.assert_allclose(hits.points[:, 0], [0, 0, 0], atol=1e-6)


@pytest.mark.parametrize(("near", "far", "expected"), [(0, 10, 1), (0, 4.9, 0), (5.1, 10, 0), (0, 5.0, 1), (5, 10, 1)])
def test_range_limits(near, far, expected):
    wall = Box(type="box", size_m=(2, 2, 2)).mesh().moved(rigid(IDENTITY, [6.0, 0.0, -1.0]))
    ray = np.array([[1.0], [0.0], [0.0]], dtype=np.float32)
    assert len(RayCaster([wall]).cast(HERE, IDENTITY, ray, min_range_m=near, max_range_m=far).ray) == expected


def test_a_hit_that_is_too_close_hides_what_lies_behind():
    walls = [Box(type="box", size_m=(1, 2, 2)).mesh().moved(rigid(IDENTITY, [x, 0.0, -1.0])) for x in (1.0, 9.0)]
    ray = np.array([[1.0], [0.0], [0.0]], dtype=np.float32)
    assert len(RayCaster(walls).cast(HERE, IDENTITY, ray, min_range_m=2.0).ray) == 0


def test_the_result_does_not_depend_on_threads():
    caster, directions = RayCaster([random_mesh(500)]), random_directions(3 * CHUNK + 17)
    one = caster.cast(HERE, IDENTITY, directions, threads=1)
    many = caster.cast(HERE, IDENTITY, directions, threads=5)
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.ray[-1] > 3 * CHUNK  # the last, short chunk took part
    assert (np.diff(one.ray) > 0).all()


def test_the_arguments_are_left_alone():
    caster, directions, origin = RayCaster([random_mesh(50)]), random_directions(100), np.ones(3)
    before = directions.copy()
    caster.cast(origin, IDENTITY, directions, max_range_m=5.0)
    np.testing.assert_array_equal(directions, before)
    np.testing.assert_array_equal(origin, np.ones(3))


def test_no_rays_and_no_hits_are_empty_results():
    caster = RayCaster([random_mesh(5)])
    assert caster.cast(HERE, IDENTITY, np.empty((3, 0), np.float32)).points.shape == (3, 0)
    up = np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
    assert caster.cast(np.array([0.0, 0.0, 99.0]), IDENTITY, up).points.shape == (3, 0)


def test_a_scene_without_bodies_is_refused():
    with pytest.raises(ValueError, match="at least one body"):
        RayCaster([])
