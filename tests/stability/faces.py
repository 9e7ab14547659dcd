"""Rays at faces that are thin, without area, many, or met at their borders, against closed forms."""

from functools import lru_cache, partial

import numpy as np
import trimesh

from torchcover.simulation.shapes import Mesh

from .case import Case, relative
from .rays import FORMULA, ROOM_M, alone, at, bare_embree, box, directions, moeller_trumbore, ours, to_walls

EDGES, VERTICES = 0, 1

not_robust = partial(bare_embree, robust=False)


def missed(range_m):
    return int((~np.isfinite(range_m)).sum())


@lru_cache
def slivers():
    """A floor of 100 m x 10 m in 20,000 faces 1 mm wide, and rays at the points where they meet."""
    y = np.linspace(-5.0, 5.0, 10_001)
    vertices = np.concatenate([np.stack([np.full_like(y, x), y, np.full_like(y, -1.5)], axis=1) for x in (-50.0, 50.0)])
    left = np.arange(10_000)
    right = left + 10_001
    faces = np.concatenate([np.stack([left, right, left + 1], 1), np.stack([right, right + 1, left + 1], 1)])
    weight = np.random.default_rng(5).uniform(0.01, 0.99, size=(20_000, 1))
    ends = np.concatenate([vertices[:-1][:10_000], vertices[left]]) * weight
    ends = ends + np.concatenate([vertices[10_001:-1], vertices[right + 1][:, :]]) * (1 - weight)
    return Mesh(vertices, faces), (ends / np.linalg.norm(ends, axis=1, keepdims=True)).astype(np.float32).T


def sliver_misses(caster):
    mesh, towards = slivers()
    return missed(caster([mesh], np.zeros(3), towards))


@lru_cache
def ball(subdivisions=5):
    """A closed ball of 20,480 faces, and rays from inside at the middle of every edge and at every vertex."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=20.0)
    mesh = Mesh(np.asarray(sphere.vertices) + np.array([0.7, -0.4, 0.2]), np.asarray(sphere.faces))
    ends = mesh.vertices_m[sphere.edges_unique].mean(axis=1), mesh.vertices_m
    return mesh, [(end / np.linalg.norm(end, axis=1, keepdims=True)).astype(np.float32).T for end in ends]


def leaks(at_what, caster):
    mesh, towards = ball()
    return missed(caster([mesh], np.zeros(3), towards[at_what]))


@lru_cache
def room_with_needles():
    """The room, and faces without area in front of its walls: single points, and three corners on a line."""
    room, generator = box(*ROOM_M).transform(at(0.0, 0.0, -ROOM_M[2] / 2)), np.random.default_rng(6)
    start, along = np.round(generator.uniform(-4, 4, size=(2, 500, 3)) * 64) / 64  # exact in float32, so is the line
    lines = np.stack([start, start + along, start + 2 * along], axis=1)
    points = np.repeat(start[:, None] / 2, 3, axis=1)
    needles = np.concatenate([lines, points]).reshape(-1, 3)
    faces = np.arange(len(needles)).reshape(-1, 3) + len(room.vertices_m)
    ends = np.concatenate([lines.mean(axis=1), points[:, 0]])
    towards = (ends / np.linalg.norm(ends, axis=1, keepdims=True)).astype(np.float32).T
    mesh = Mesh(np.concatenate([room.vertices_m, needles]), np.concatenate([room.faces, faces]))
    return mesh, np.concatenate([directions(1000), towards], axis=1)


def without_area(caster):
    """Rays that end elsewhere than at the walls."""
    mesh, towards = room_with_needles()
    range_m, expected = caster(mesh, np.zeros(3), towards), to_walls(towards, -ROOM_M / 2, ROOM_M / 2)
    return int((~(np.abs(range_m - expected) < 1e-4)).sum())


@lru_cache
def fine_floor(side):
    """A floor of 200 m x 200 m at -1.5 m in 2 side^2 faces."""
    axis = np.linspace(-100.0, 100.0, side + 1)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    first = np.stack([corner, corner + side + 1, corner + 1], axis=1)
    second = np.stack([corner + side + 1, corner + side + 2, corner + 1], axis=1)
    return Mesh(np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.5)], axis=1), np.concatenate([first, second]))


def on_fine_floor(side, caster):
    ends = np.random.default_rng(7).uniform([-99, -99, -1.5], [99, 99, -1.499999], size=(20_000, 3))
    towards = (ends / np.linalg.norm(ends, axis=1, keepdims=True)).astype(np.float32).T
    return relative(caster([fine_floor(side)], np.zeros(3), towards), 1.5 / -towards[2].astype(np.float64))


CASES = [
    Case("slivers, 100 m x 1 mm", "every ray hits", "of 20,000 missed", 0, partial(sliver_misses, ours),
         "Embree, not robust", partial(sliver_misses, not_robust)),
    Case("rays at the edges of a closed mesh", "every ray hits", "of 30,720 missed", 0, partial(leaks, EDGES, ours),
         "Embree, not robust", partial(leaks, EDGES, not_robust)),
    # All edges that meet in a vertex may round to the same side of a ray that goes through it.
    Case("rays at the vertices of a closed mesh", "every ray hits", "of 10,242 missed", 100,
         partial(leaks, VERTICES, ours),
         "Embree, not robust", partial(leaks, VERTICES, not_robust)),
    Case("faces without area", "closed form", "of 2,000 wrong", 0, partial(without_area, alone),
         FORMULA + ", no epsilon", partial(without_area, partial(moeller_trumbore, least_determinant=-1.0))),
    Case("a mesh of 4,999,122 faces", "closed form", "relative", 2e-6, partial(on_fine_floor, 1581, ours),
         "Embree, not robust", partial(on_fine_floor, 1581, not_robust), naive_fails=False, benchmark_only=True),
    Case("a mesh of 80,000 faces", "closed form", "relative", 2e-6, partial(on_fine_floor, 200, ours),
         "Embree, not robust", partial(on_fine_floor, 200, not_robust), naive_fails=False),
]  # fmt: skip
