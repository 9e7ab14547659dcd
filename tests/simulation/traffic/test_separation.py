"""No two bodies ever overlap: separating axes in the ground plane and overlap in height, at all times.

The test only uses the boxes around the meshes of actors and the connected pieces of static meshes, which are convex
because the bodies of the fixture are boxes.
"""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from torchcover.simulation.traffic.fleet import REAR_OF

TOUCHING_M = 1e-3
BENT = ("urban", "narrow", "winding")
CASES = [(kind, seed) for kind in ("urban", "highway", "parking") for seed in (0, 1)] + [
    ("narrow", 0),
    ("winding", 0),
    ("winding", 1),
    ("straight", 0),
]


def iterate_pieces(mesh):
    """Iterate over outline, lowest and highest z of each connected piece."""
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(mesh.vertices_m)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        corners = mesh.vertices_m[group]
        hull = ConvexHull(corners[:, :2])
        yield corners[hull.vertices, :2], corners[:, 2].min(), corners[:, 2].max()


def iterate_triangles(mesh):
    """Iterate over the upper triangles of a bent slab, which is not convex, in the same form."""
    corners = mesh.vertices_m[mesh.faces]
    low, high = mesh.vertices_m[:, 2].min(), mesh.vertices_m[:, 2].max()
    for triangle in corners[(corners[..., 2] == high).all(axis=1)]:
        yield triangle[:, :2], low, high


class Solids:
    """Convex prisms: `outline` (N, K, 2), padded by repeating a corner, and `low`, `high` (N,)."""

    def __init__(self, outline, low, high):
        self.outline, self.low, self.high = outline, low, high
        self.centre = (outline.max(axis=1) + outline.min(axis=1)) / 2
        self.radius = np.linalg.norm(outline - self.centre[:, None], axis=2).max(axis=1)

    @classmethod
    def from_meshes(cls, meshes, bent=()):
        found = [piece for mesh in meshes for piece in iterate_pieces(mesh)]
        found += [triangle for mesh in bent for triangle in iterate_triangles(mesh)]
        corners = max(len(outline) for outline, _, _ in found)
        outline = np.stack([o[np.minimum(np.arange(corners), len(o) - 1)] for o, _, _ in found])
        return cls(outline, np.array([low for _, low, _ in found]), np.array([high for _, _, high in found]))


class Movers:
    """Boxes of actors at several times of their trajectories."""

    def __init__(self, actors, times_s):
        self.poses = np.full((len(times_s), len(actors), 4), np.nan)  # x, y, z, yaw; NaN where absent
        for k, actor in enumerate(actors):
            own = actor.trajectory
            place = np.minimum(np.searchsorted(own.times_s, times_s - 1e-6), len(own.times_s) - 1)
            there = np.isclose(own.times_s[place], times_s, rtol=0.0, atol=1e-6)
            assert own.is_transient or there.all()
            self.poses[there, k, :3] = own.positions_m[place[there]]
            self.poses[there, k, 3] = np.deg2rad(own.angles_deg[place[there], 0])
        self.lower = np.stack([actor.mesh.vertices_m.min(axis=0) for actor in actors])
        self.upper = np.stack([actor.mesh.vertices_m.max(axis=0) for actor in actors])

    def at(self, number):
        """Return the solids of the actors that are present at a time, and their indices."""
        there = np.flatnonzero(~np.isnan(self.poses[number, :, 0]))
        lower, upper, poses = self.lower[there], self.upper[there], self.poses[number, there]
        x = np.stack([lower[:, 0], upper[:, 0], upper[:, 0], lower[:, 0]], axis=1)
        y = np.stack([lower[:, 1], lower[:, 1], upper[:, 1], upper[:, 1]], axis=1)
        cos, sin = np.cos(poses[:, 3:]), np.sin(poses[:, 3:])
        outline = np.stack([cos * x - sin * y, sin * x + cos * y], axis=2) + poses[:, None, :2]
        return Solids(outline, poses[:, 2] + lower[:, 2], poses[:, 2] + upper[:, 2]), there


def find_overlaps(a, b, pairs):
    """Find the candidate pairs (P, 2) that no axis separates."""
    first, second = pairs.T
    in_height = np.minimum(a.high[first], b.high[second]) - np.maximum(a.low[first], b.low[second]) > TOUCHING_M
    first, second = first[in_height], second[in_height]
    p, q = a.outline[first], b.outline[second]
    edges = np.concatenate([np.roll(p, -1, axis=1) - p, np.roll(q, -1, axis=1) - q], axis=1)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    normals = np.stack([-edges[..., 1], edges[..., 0]], axis=2) / np.where(length < 1e-9, np.inf, length)
    on_p, on_q = normals @ p.transpose(0, 2, 1), normals @ q.transpose(0, 2, 1)
    depth = np.minimum(on_p.max(axis=2), on_q.max(axis=2)) - np.maximum(on_p.min(axis=2), on_q.min(axis=2))
    depth = np.where(length[..., 0] < 1e-9, np.inf, depth).min(axis=1)
    return [(i, j, d) for i, j, d in zip(first, second, depth, strict=True) if d > TOUCHING_M]


def find_near_pairs(a, b):
    """Find pairs (P, 2) whose bounding circles overlap."""
    away = np.subtract.outer(a.centre[:, 0], b.centre[:, 0]) ** 2
    away += np.subtract.outer(a.centre[:, 1], b.centre[:, 1]) ** 2
    return np.argwhere(away < np.add.outer(a.radius, b.radius) ** 2)


def find_overlaps_among(solids):
    """Find overlaps of solids with each other."""
    pairs = find_near_pairs(solids, solids)
    return find_overlaps(solids, solids, pairs[pairs[:, 0] < pairs[:, 1]])


def collect_static_solids(world, bends):
    """Collect all static solids; the blocks of bent streets are not convex."""
    parked = [actor.mesh.transform(actor.trajectory.interpolate(0.0)) for actor in world.static_actors]
    return Solids.from_meshes([*world.static_meshes[1 + bends :], *parked], world.static_meshes[1:2] if bends else ())


def test_overlap_checker_finds_exactly_the_overlaps():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    turned = square @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    aside, corner, beyond = np.array([2.3, 0.0]), np.array([1.9, 1.9]), np.array([2.2, 2.2])
    outline = np.stack([square, turned + aside, square + corner, turned + beyond, square])
    solids = Solids(outline, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), np.array([1.0, 1.0, 1.0, 1.0, 2.0]))
    found = {(int(i), int(j)) for i, j, _ in find_overlaps_among(solids)}
    assert found == {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)}


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_static_meshes_do_not_overlap(kind, seed, world):
    static = collect_static_solids(world(kind, seed), kind in BENT)
    found = find_overlaps_among(static)
    assert not found, [(static.centre[i], static.centre[j], d) for i, j, d in found[:3]]


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_actors_do_not_overlap(kind, seed, world):
    w = world(kind, seed)
    static = collect_static_solids(w, kind in BENT)
    everybody = (w.ego, *w.actors)
    times_s = w.ego.trajectory.times_s[::5]
    movers = Movers(everybody, times_s)
    for number, time_s in enumerate(times_s):
        moving, who = movers.at(number)
        found = [
            (i, j, d)
            for i, j, d in find_overlaps_among(moving)
            if REAR_OF + everybody[who[i]].name != everybody[who[j]].name
        ]
        assert not found, [(time_s, everybody[who[i]].name, everybody[who[j]].name, d) for i, j, d in found[:3]]
        if number % 2:
            continue
        found = find_overlaps(moving, static, find_near_pairs(moving, static))
        assert not found, [(time_s, everybody[who[i]].name, static.centre[j], d) for i, j, d in found[:3]]
