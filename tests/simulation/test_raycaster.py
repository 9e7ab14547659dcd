"""Ray caster against closed forms and a slow intersection test in float64."""

import os
from functools import partial
from importlib.util import find_spec

import numpy as np
import pytest
import torch

from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.simulation import raycaster
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Box, Ellipsoid, Frustum, Mesh, Plane

HERE = np.zeros(3)
NUMBERS = np.random.default_rng
MOUNTAIN = Mesh(np.array([[1e6, 0, 0], [1e6, 100, 0], [1e6, 0, 100]]), np.array([[0, 1, 2]]))


LIBRARIES = ["Embree"]
if find_spec("warp"):
    LIBRARIES += ["Warp", "Warp on a GPU"] if torch.cuda.is_available() else ["Warp"]


@pytest.fixture(params=LIBRARIES, autouse=True)
def library(request, monkeypatch):
    """Run every test with Embree and with Warp."""
    if request.param.startswith("Warp"):
        device = "cuda:0" if "GPU" in request.param else "cpu"
        monkeypatch.setitem(globals(), "RayCaster", partial(raycaster.RayCaster, device=device))
    return request.param


def build_infinite_limits(directions):
    return np.full(directions.shape[1], np.inf, dtype=np.float32)


def sample_directions(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(3, count))
    return (directions / np.linalg.norm(directions, axis=0)).astype(np.float32)


def sample_mesh(faces, seed=0):
    generator = np.random.default_rng(seed)
    positions_m = np.repeat(generator.uniform(-10, 10, size=(faces, 3)), 3, axis=0)
    return Mesh(positions_m + generator.uniform(-2, 2, size=(3 * faces, 3)), np.arange(3 * faces).reshape(-1, 3))


def build_box_at(x, y=0.0, size=1.0):
    return (
        Box(type="box", size_m=(size, size, size)).build_mesh().transform(build_transform(np.eye(3), [x, y, -size / 2]))
    )


def compute_ranges_slowly(mesh, origin, directions):
    """Compute (N,) ranges by Möller-Trumbore in float64; inf for a miss."""
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


def test_agrees_with_a_slow_intersection_in_float64():
    mesh, directions = sample_mesh(200), sample_directions(600)
    hits = RayCaster([mesh]).cast(HERE, directions, build_infinite_limits(directions))
    expected = compute_ranges_slowly(mesh, HERE, directions)
    # A ray exactly through a border of a face may hit or miss in float32.
    assert (np.isfinite(hits.range_m) == np.isfinite(expected)).mean() > 0.995
    assert ((hits.body_indices >= 0) == np.isfinite(hits.range_m)).all()
    is_hit = np.isfinite(hits.range_m) & np.isfinite(expected)
    assert (np.abs(hits.range_m[is_hit] - expected[is_hit]) < 1e-4).mean() > 0.995
    assert 0.2 < is_hit.mean() < 1.0


def test_hit_attributes_have_the_incidence_angle():
    mesh, directions = sample_mesh(200), sample_directions(600)
    caster = RayCaster([mesh])
    hits = caster.cast(HERE, directions, build_infinite_limits(directions))
    met = hits.body_indices >= 0
    struck = caster.compute_hit_attributes(hits.body_indices[met], hits.triangle_indices[met], directions[:, met])
    first, second, third = mesh.vertices_m[mesh.faces[hits.triangle_indices[met]]].swapaxes(0, 1)
    normals = np.cross(second - first, third - first)
    expected = np.abs((normals * directions[:, met].T).sum(axis=1)) / np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(struck.cos_incidence, expected, atol=1e-4)
    assert 0.2 < met.mean() < 1.0


def test_no_ray_leaves_a_box_through_edges():
    box = Box(type="box", size_m=(4.0, 6.0, 3.0)).build_mesh()
    corners = box.vertices_m[box.faces]
    weights = np.linspace(0, 1, 101)[:, None, None, None]
    on_edges = (weights * corners + (1 - weights) * corners[:, [1, 2, 0]]).reshape(-1, 3)
    origin = np.array([0.3, -0.2, 1.1])
    range_m = np.linalg.norm(on_edges - origin, axis=1)
    directions = ((on_edges - origin).T / range_m).astype(np.float32)
    hits = RayCaster([box]).cast(origin, directions, build_infinite_limits(directions))
    assert (hits.body_indices == 0).all()
    np.testing.assert_allclose(hits.range_m, range_m, atol=1e-5)


@pytest.mark.parametrize("gap_m", [0.001, 0.01, 0.4])
def test_distant_bodies_do_not_affect_near_hits(gap_m):
    ahead = np.array([[1], [0], [0]], np.float32)
    hits = RayCaster([MOUNTAIN, build_box_at(0.5 + gap_m)]).cast(HERE, ahead, build_infinite_limits(ahead))
    assert hits.body_indices == [1]
    np.testing.assert_allclose(hits.range_m, gap_m, rtol=1e-4)


@pytest.mark.parametrize("width_m", [1e-5, 1e-3, 1.0])
def test_a_narrow_face_in_front_is_hit(width_m):
    """The plane of a sliver is ill-defined, but a ray never passes a wall 1 cm ahead."""
    along, across = np.array([0.3, 1.0, 1.0]), np.array([-0.2, 1.0, -1.0])
    ahead = np.cross(across, along) / np.linalg.norm(np.cross(across, along))
    corners = [0.01 * ahead - along - width_m * across, 0.01 * ahead + along - width_m * across]
    sliver = Mesh(np.array([*corners, 0.01 * ahead + 2 * width_m * across]), np.array([[0, 1, 2]]))
    rays = ahead[:, None].astype(np.float32)
    hits = RayCaster([sliver, MOUNTAIN]).cast(HERE, rays, build_infinite_limits(rays))
    assert hits.body_indices == [0]
    np.testing.assert_allclose(hits.range_m, 0.01, atol=0.002)


def compute_planes(mesh):
    """Compute (F, 3) outward unit normals and (F,) plane distances of a convex body."""
    first, second, third = mesh.vertices_m[mesh.faces].transpose(1, 0, 2)
    normals = np.cross(second - first, third - first)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normals, (normals * first).sum(axis=1)


@pytest.mark.parametrize(
    "shape",
    [
        Box(type="box", size_m=(1.0, 2.0, 3.0)),
        Frustum(type="frustum", bottom_m=(3.04, 1.68), top_m=(1.12, 1.16), height_m=0.59),
        Ellipsoid(type="ellipsoid", size_m=(1.0, 2.0, 3.0)),
    ],
)
def test_rays_leave_all_faces_at_their_origin(shape):
    """From edges and corners, rays go outwards to the walls of a room and inwards to the opposite side."""
    mesh, generator = (
        shape.build_mesh().transform(build_transform(convert_euler_to_rotation(10.0, 20.0, 30.0), [1.0, 2.0, 3.0])),
        NUMBERS(5),
    )
    room = build_box_at(0.0, size=40.0)
    caster = RayCaster([room, mesh])
    (normals, distances_m), (walls, wall_distances_m) = compute_planes(mesh), compute_planes(room)
    for _ in range(60):
        corner, second_corner, _ = generator.permutation(mesh.vertices_m[generator.choice(mesh.faces)])
        position = corner + generator.choice([0.0, generator.random()]) * (second_corner - corner)
        directions = sample_directions(200, seed=generator.integers(1000))
        hits = caster.cast(position, directions, build_infinite_limits(directions))
        is_on_face = np.abs(normals @ position - distances_m) < 1e-9
        slope = (normals[is_on_face] @ directions.astype(np.float64)).max(axis=0)
        for body, selected, planes, reach in (
            (0, slope > 0.01, walls, wall_distances_m),
            (1, slope < -0.01, normals, distances_m),
        ):
            steep = planes @ directions[:, selected]
            gap = (reach - planes @ position)[:, None] * np.ones_like(steep)
            expected = np.divide(gap, steep, out=np.full_like(steep, np.inf), where=(steep > 0) & (gap > 1e-9)).min(
                axis=0
            )
            assert (hits.body_indices[selected] == body).all()
            np.testing.assert_allclose(hits.range_m[selected], expected, atol=2e-3)


@pytest.mark.parametrize("limit_m", [1e-6, 0.3, 1.0, 7.0, np.inf])
def test_rays_that_leave_a_face_keep_limits(limit_m):
    turned = build_transform(convert_euler_to_rotation(37.0, 21.0, -13.0), [1.0, 2.0, 3.0])
    floor, position = (
        Plane(type="plane", size_m=(200, 200)).build_mesh().transform(turned),
        (turned @ [5.1, 7.2, 0.0, 1.0])[:3],
    )
    up = turned[:3, 2]
    wall = Mesh(position + 5.0 * up + floor.vertices_m - turned[:3, 3], floor.faces)
    upwards = sample_directions(500)
    upwards = upwards[:, up @ upwards > 0.06]
    hits = RayCaster([floor, wall]).cast(position, upwards, np.full(upwards.shape[1], limit_m, np.float32))
    expected = 5.0 / (up @ upwards)
    assert (hits.range_m <= np.float32(limit_m)).all()
    np.testing.assert_array_equal(hits.body_indices, np.where(expected <= limit_m, 1, -1))
    np.testing.assert_allclose(hits.range_m, np.minimum(expected, limit_m), rtol=1e-4)


def test_rays_leave_the_sliver_at_their_origin():
    generator = NUMBERS(7)
    for _ in range(50):
        along, across = generator.normal(size=(2, 3))
        corners = generator.normal(size=3) + np.array([0.0 * along, along, 0.4 * along + 1e-4 * across])
        caster = RayCaster([Mesh(corners, np.array([[0, 1, 2]]))])
        directions = sample_directions(100, seed=generator.integers(1000))
        hits = caster.cast(generator.dirichlet(np.ones(3)) @ corners, directions, build_infinite_limits(directions))
        assert (hits.body_indices == -1).all()


def test_one_caster_handles_different_origins():
    caster, outwards = (
        RayCaster([build_box_at(9.0), build_box_at(0.0)]),
        np.array([[1.0], [0.0], [0.0]], dtype=np.float32),
    )
    for _ in range(2):
        inside = caster.cast(HERE, outwards, build_infinite_limits(outwards))
        assert (inside.body_indices, inside.range_m) == ([1], [pytest.approx(0.5, rel=1e-6)])
        on_the_wall = caster.cast(np.array([0.5, 0.1, 0.1]), outwards, build_infinite_limits(outwards))
        assert (on_the_wall.body_indices, on_the_wall.range_m) == ([0], [pytest.approx(8.0, rel=1e-6)])


def test_positions_on_a_face_within_rounding_touch_it():
    ground, down = (
        Plane(type="plane", size_m=(100, 100)).build_mesh(),
        np.array([[0.0], [0.0], [-1.0]], dtype=np.float32),
    )
    hits = RayCaster([ground]).cast(np.array([1.0, 2.0, 1e-15]), down, build_infinite_limits(down))
    assert hits.body_indices == [-1]


@pytest.mark.parametrize(("limit", "body", "range_m"), [(4.4, -1, 4.4), (4.6, 0, 4.5), (np.inf, 0, 4.5)])
def test_a_ray_ends_at_its_limit(limit, body, range_m):
    ray = np.array([[1.0], [0.0], [0.0]], dtype=np.float32)
    hits = RayCaster([build_box_at(5.0)]).cast(HERE, ray, np.array([limit], dtype=np.float32))
    assert hits.body_indices.tolist() == [body]
    np.testing.assert_allclose(hits.range_m, [range_m], rtol=1e-6)


def test_the_arguments_are_left_alone():
    caster, directions, origin = RayCaster([sample_mesh(50)]), sample_directions(100), np.ones(3)
    before, limit = directions.copy(), build_infinite_limits(directions)
    caster.cast(origin, directions, limit)
    assert np.isinf(limit).all()
    np.testing.assert_array_equal(directions, before)
    np.testing.assert_array_equal(origin, np.ones(3))


def test_bodies_without_faces_keep_their_numbers():
    nothing, up = Mesh(np.zeros((3, 3)), np.empty((0, 3), dtype=np.int64)), np.array([[0.0, 0.1, 1.0]] * 3, np.float32)
    caster = RayCaster([nothing, build_box_at(0.0, size=4.0), nothing, build_box_at(9.0), nothing])
    starts = np.array([[0.0, 0.0, -5.0], [9.0, 0.0, -5.0], [30.0, 0.0, -5.0]])
    hits = caster.cast_from_each(starts.astype(np.float32), up.T, np.full(3, 9.0, np.float32))
    assert hits.body_indices.tolist() == [1, 3, -1]
    bodies = np.searchsorted([0, 12, 24], caster.find_first_faces(starts, up, 9.0), side="right")
    assert bodies.tolist() == [1, 2, 0]
    assert (RayCaster([nothing]).cast(HERE, up.T, build_infinite_limits(up.T)).body_indices == -1).all()


def test_no_rays_are_an_empty_result():
    none = np.empty((3, 0), np.float32)
    assert RayCaster([sample_mesh(5)]).cast(HERE, none, build_infinite_limits(none)).range_m.shape == (0,)


def test_a_scene_without_bodies_is_refused():
    with pytest.raises(ValueError, match="at least one body"):
        RayCaster([])


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="the system does not tell its threads")
def test_building_scenes_starts_no_threads():
    threads = len(os.listdir("/proc/self/task"))
    cores = os.sched_getaffinity(0)
    RayCaster([sample_mesh(20_000)])
    assert len(os.listdir("/proc/self/task")) == threads
    assert os.sched_getaffinity(0) == cores


def stack_slabs(sizes):
    """Stack slabs on each other."""
    tops = np.cumsum([size[2] for size in sizes])
    boxes = [Box(type="box", size_m=size).build_mesh() for size in sizes]
    starts = [np.array([0.0, 0.0, top - size[2]]) for top, size in zip(tops, sizes, strict=True)]
    return [Mesh(mesh.vertices_m + start, mesh.faces) for mesh, start in zip(boxes, starts, strict=True)]


@pytest.mark.parametrize("seed", range(12))
def test_touching_bodies_leave_no_gap_between_them(seed):
    """Touching bodies have coincident faces, so that the order of ray hits depends on rounding."""
    numbers = NUMBERS(seed)
    turn = build_transform(
        convert_euler_to_rotation(*numbers.uniform(-np.pi, np.pi, 3) * (seed % 3 > 0)), numbers.uniform(-50, 50, 3)
    )
    slabs = stack_slabs([(20, 20, 1), (20, 20, 2), (24, 16, 1)])
    order = numbers.permutation(3)
    caster = RayCaster([slabs[k].transform(turn) for k in order])
    for height_m, expected in ((0.5, [0]), (2.0, [1]), (3.5, [2]), (4.5, []), (-0.5, [])):
        for beside_m in ((0.0, 0.0), (0.3, -4.2), (7.0, 7.0)):
            place_m = turn[:3, :3] @ [*beside_m, height_m] + turn[:3, 3]
            assert order[caster.find_enclosing_bodies(place_m)].tolist() == expected


def test_sheets_do_not_enclose_positions():
    """Convex bodies against half spaces, nested bodies, and a body of two touching parts."""
    ball, cube = Ellipsoid(type="ellipsoid", size_m=(4, 3, 2)).build_mesh(), build_box_at(0.0, size=2.0)
    caster = RayCaster([ball, Plane(type="plane", size_m=(9, 9)).build_mesh(), cube])
    positions_m = NUMBERS(0).uniform(-2.2, 2.2, (2000, 3))
    positions_m[:100, :2] = 0.0  # above and below vertices, edges and the middles of faces
    for position in positions_m:
        expected_bodies = [number for number, body in ((0, ball), (2, cube)) if is_behind_all(body, position)]
        assert caster.find_enclosing_bodies(position).tolist() == expected_bodies
    ahead = cube.transform(build_transform(np.eye(3), [2, 0, 0]))
    vertices_m, faces = (
        np.concatenate([cube.vertices_m, ahead.vertices_m]),
        np.concatenate([cube.faces, cube.faces + 8]),
    )
    caster = RayCaster([Mesh(vertices_m, faces)])
    enclosing_counts = [len(caster.find_enclosing_bodies(np.array([x, 0.2, 0.1]))) for x in (-1.5, 0.0, 1.0, 2.0, 3.5)]
    assert enclosing_counts == [0, 1, 1, 1, 0]


def is_behind_all(mesh, position):
    """Return True for a position behind every face of a convex body."""
    a, b, c = mesh.vertices_m[mesh.faces].transpose(1, 0, 2)
    return bool((((position - a) * np.cross(b - a, c - a)).sum(axis=1) < 0).all())


def test_positions_on_body_surfaces_are_not_inside():
    for seed in range(50):
        shift = NUMBERS(seed).uniform(-500, 500, 3)
        slab = stack_slabs([(4, 4, 0.3)])[0]
        caster = RayCaster([Mesh(slab.vertices_m + shift, slab.faces)])
        heights = {-1e-3: [], 1e-3: [0], 0.3 - 1e-3: [0], 0.3: [], 0.3 + 1e-3: []}
        for height, expected in heights.items():
            assert caster.find_enclosing_bodies(shift + np.array([0.1, 0.7, height])).tolist() == expected
