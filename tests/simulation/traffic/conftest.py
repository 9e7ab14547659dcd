"""Worlds that several tests look at, with every body a box of the built-in body's size: one convex piece a body."""

from functools import cache

import pytest

from torchcover.geometry import BoundingBox
from torchcover.simulation import shapes
from torchcover.simulation.traffic import Highway, Parking, Urban
from torchcover.simulation.traffic.fleet import load_bodies

# Hills lift and tilt, and change no place: what overlaps is found out on a plain.
PLAIN = {"hills_m": 0.0}
STRAIGHT = {**PLAIN, "bend_deg": 0.0, "turn_share": 0.0}
KINDS = {
    "urban": Urban(**PLAIN),
    "narrow": Urban(lanes=2, **PLAIN),
    "winding": Urban(lanes=4, bend_deg=35.0, turn_share=0.6, built_share=1.0, **PLAIN),
    "straight": Urban(built_share=1.0, **STRAIGHT),
    "hilly": Urban(hills_m=2.0),
    "highway": Highway(**PLAIN),
    "motorway": Highway(hills_m=10.0),
    "parking": Parking(),
}


@cache
def boxes():
    sizes = {kind: BoundingBox.from_points(mesh.vertices_m).size_m for kind, mesh in load_bodies().items()}
    return {kind: shapes.Box(type="box", size_m=size).build_mesh() for kind, size in sizes.items()}


@cache
def built(kind, seed):
    return KINDS[kind].build_scene(seed, bodies=boxes())


@pytest.fixture(scope="session")
def bodies():
    return boxes()


@pytest.fixture(scope="session")
def world():
    """`world(kind, seed)`, built once."""
    return built
