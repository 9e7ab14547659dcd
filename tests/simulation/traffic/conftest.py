"""Scenes of several tests; each body is a box of the size of the built-in body, so that it is convex."""

from functools import cache

import pytest

from torchcover.geometry import BoundingBox
from torchcover.simulation import shapes
from torchcover.simulation.traffic import HighwayTraffic, ParkingTraffic, UrbanTraffic
from torchcover.simulation.traffic.fleet import load_bodies

# Hills only lift and tilt bodies: overlaps are tested on a plane.
PLAIN = {"hill_height_std_m": 0.0}
STRAIGHT = {**PLAIN, "max_bend_deg": 0.0, "turn_share": 0.0}
KINDS = {
    "urban": UrbanTraffic(**PLAIN),
    "narrow": UrbanTraffic(num_lanes=2, **PLAIN),
    "winding": UrbanTraffic(num_lanes=4, max_bend_deg=35.0, turn_share=0.6, built_share=1.0, **PLAIN),
    "straight": UrbanTraffic(built_share=1.0, **STRAIGHT),
    "hilly": UrbanTraffic(hill_height_std_m=2.0),
    "highway": HighwayTraffic(**PLAIN),
    "motorway": HighwayTraffic(hill_height_std_m=10.0),
    "parking": ParkingTraffic(),
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
    """Return the function `world(kind, seed)`, which builds each scene once."""
    return built
