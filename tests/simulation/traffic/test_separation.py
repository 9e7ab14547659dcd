"""No two bodies ever interpenetrate: separating axes in plan view with overlap in height, for all, over all times.

Knows nothing of how worlds are made: it takes the boxes around the actors' meshes, and the connected pieces of the
static meshes, each of which is convex here because the bodies of the fixture are boxes.
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


def pieces(mesh):
    """Plan outline, lowest and highest z of each connected piece."""
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(mesh.vertices_m)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        corners = mesh.vertices_m[group]
        hull = ConvexHull(corners[:, :2])
        yield corners[hull.vertices, :2], corners[:, 2].min(), corners[:, 2].max()


def triangles(mesh):
    """The same of a slab that bends, cut into its upper triangles: none of it is convex."""
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
    def of_static(cls, meshes, bent=()):
        found = [piece for mesh in meshes for piece in pieces(mesh)]
        found += [triangle for mesh in bent for triangle in triangles(mesh)]
        corners = max(len(outline) for outline, _, _ in found)
        outline = np.stack([o[np.minimum(np.arange(corners), len(o) - 1)] for o, _, _ in found])
        return cls(outline, np.array([low for _, low, _ in found]), np.array([high for _, _, high in found]))


class Movers:
    """The boxes of actors at several times, each of which is one of those of their trajectories, or not among them."""

    def __init__(self, actors, times_s):
        self.poses = np.full((len(times_s), len(actors), 4), np.nan)  # x, y, z, yaw; NaN who is not there
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
        """Who is there at one of the times, and their numbers."""
        there = np.flatnonzero(~np.isnan(self.poses[number, :, 0]))
        lower, upper, poses = self.lower[there], self.upper[there], self.poses[number, there]
        x = np.stack([lower[:, 0], upper[:, 0], upper[:, 0], lower[:, 0]], axis=1)
        y = np.stack([lower[:, 1], lower[:, 1], upper[:, 1], upper[:, 1]], axis=1)
        cos, sin = np.cos(poses[:, 3:]), np.sin(poses[:, 3:])
        outline = np.stack([cos * x - sin * y, sin * x + cos * y], axis=2) + poses[:, None, :2]
        return Solids(outline, poses[:, 2] + lower[:, 2], poses[:, 2] + upper[:, 2]), there


def overlaps(a, b, pairs):
    """Of the candidate pairs (P, 2), those that no axis separates."""
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


def near_pairs(a, b):
    """(P, 2) indices of those whose circles in plan view meet: nobody else can overlap."""
    away = np.subtract.outer(a.centre[:, 0], b.centre[:, 0]) ** 2
    away += np.subtract.outer(a.centre[:, 1], b.centre[:, 1]) ** 2
    return np.argwhere(away < np.add.outer(a.radius, b.radius) ** 2)


def among(solids):
    """Overlaps of solids with each other."""
    pairs = near_pairs(solids, solids)
    return overlaps(solids, solids, pairs[pairs[:, 0] < pairs[:, 1]])


def at_rest(world, bends):
    """All that stands on the ground and never moves; the blocks of streets that bend apart."""
    parked = [actor.mesh.transform(actor.trajectory.interpolate(0.0)) for actor in world.static_actors]
    return Solids.of_static([*world.static_meshes[1 + bends :], *parked], world.static_meshes[1:2] if bends else ())


def test_the_checker_finds_what_overlaps_and_only_that():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    turned = square @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)
    aside, corner, beyond = np.array([2.3, 0.0]), np.array([1.9, 1.9]), np.array([2.2, 2.2])
    outline = np.stack([square, turned + aside, square + corner, turned + beyond, square])
    solids = Solids(outline, np.array([0.0, 0.0, 0.0, 0.0, 1.0]), np.array([1.0, 1.0, 1.0, 1.0, 2.0]))
    found = {(int(i), int(j)) for i, j, _ in among(solids)}
    assert found == {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)}


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_what_rests_does_not_interpenetrate(kind, seed, world):
    static = at_rest(world(kind, seed), kind in BENT)
    found = among(static)
    assert not found, [(static.centre[i], static.centre[j], d) for i, j, d in found[:3]]


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_who_moves_does_not_interpenetrate(kind, seed, world):
    w = world(kind, seed)
    static = at_rest(w, kind in BENT)
    everybody = (w.ego, *w.actors)
    times_s = w.ego.trajectory.times_s[::5]
    movers = Movers(everybody, times_s)
    for number, time_s in enumerate(times_s):
        moving, who = movers.at(number)
        found = [(i, j, d) for i, j, d in among(moving) if REAR_OF + everybody[who[i]].name != everybody[who[j]].name]
        assert not found, [(time_s, everybody[who[i]].name, everybody[who[j]].name, d) for i, j, d in found[:3]]
        if number % 2:
            continue
        found = overlaps(moving, static, near_pairs(moving, static))
        assert not found, [(time_s, everybody[who[i]].name, static.centre[j], d) for i, j, d in found[:3]]
