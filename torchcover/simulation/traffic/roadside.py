"""What stands along a motorway."""

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.roads import Polyline
from torchcover.simulation.traffic.scenery import beside, box, few, ground, post, rail, tree

Numbers = NDArray[np.float64]

# Across the road, from the middle of the median.
LANE_CENTRES_M = (4.6, 8.2, 11.8)
MEDIAN_RAIL_M = 1.3
DELINEATOR_M = 16.2
RAIL_M = 16.8
GANTRY_POST_M = 18.0
SOUND_WALL_M = 19.5
TREES_M = (24.0, 45.0)

# A W-beam: its upper edge is 0.75 m up, and posts stand at the joints.
RAIL_HEIGHTS_M = (0.44, 0.75)
RAIL_THICKNESS_M = 0.08
RAIL_PIECE_M = 12.0
DELINEATOR_EVERY_M = 50.0
STRUCTURE_EVERY_M = (350.0, 600.0)
CLEARANCE_M = 5.4
NO_TREES_NEAR_BRIDGE_M = 25.0


def roadside(
    middle: Polyline, span_m: tuple[float, float], everybody_m: Numbers, generator: np.random.Generator
) -> tuple[Mesh, ...]:
    """The ground, and what stands along the part of the road that the ego gets to see."""
    corners = everybody_m.reshape(-1, 3)[:, :2]
    ends = np.concatenate([corners, beside(middle, np.array(span_m), 0.0)[:, :2]])
    structures, bridges = _structures(middle, span_m, generator)
    return (
        ground(ends.min(axis=0) - 300.0, ends.max(axis=0) + 300.0),
        *few(
            _rails(middle, span_m),
            _delineators(middle, span_m),
            structures,
            _sound_walls(middle, span_m, generator),
            _trees(middle, span_m, bridges, generator),
        ),
    )


def _rails(middle: Polyline, span_m: tuple[float, float]) -> list[Mesh]:
    places = np.arange(span_m[0], span_m[1], RAIL_PIECE_M)
    pieces = []
    for left in (-RAIL_M, -MEDIAN_RAIL_M, MEDIAN_RAIL_M, RAIL_M):
        pieces += rail(middle, places, left, RAIL_THICKNESS_M, RAIL_HEIGHTS_M)
        # Behind the beam, seen from the lanes.
        behind = left + np.copysign(0.1, left if abs(left) == RAIL_M else -left)
        for x, y, yaw in beside(middle, places, behind):
            pieces.append(box((x, y), (0.1, 0.06, 0.7), yaw_deg=yaw))
    return pieces


def _delineators(middle: Polyline, span_m: tuple[float, float]) -> list[Mesh]:
    places = np.arange(span_m[0], span_m[1], DELINEATOR_EVERY_M)
    return [
        post(pose[:2], 0.06, 0.0, 1.0)
        for left in (-DELINEATOR_M, DELINEATOR_M)
        for pose in beside(middle, places, left)
    ]


def _structures(
    middle: Polyline, span_m: tuple[float, float], generator: np.random.Generator
) -> tuple[list[Mesh], list[float]]:
    """Sign gantries and bridges in turn over the whole road; and the places of the bridges."""
    pieces, bridges = [], []
    place, is_bridge = span_m[0] + generator.uniform(100.0, 300.0), bool(generator.random() < 0.5)
    while place < span_m[1]:
        x, y, yaw = middle.poses(place)
        length, half_width, height = (9.0, 50.0, 1.2) if is_bridge else (0.6, GANTRY_POST_M + 0.3, 1.6)
        pieces.append(box((x, y), (length, 2 * half_width, height), CLEARANCE_M, yaw))
        for left in (-GANTRY_POST_M, GANTRY_POST_M):
            foot = beside(middle, place, left)[:2]
            pieces.append(post(foot, 0.4 if is_bridge else 0.2, 0.0, CLEARANCE_M))
        if is_bridge:
            bridges.append(float(place))
        place += generator.uniform(*STRUCTURE_EVERY_M)
        is_bridge = not is_bridge
    return pieces, bridges


def _sound_walls(middle: Polyline, span_m: tuple[float, float], generator: np.random.Generator) -> list[Mesh]:
    """Walls along parts of the road, on either side."""
    pieces = []
    for side in (-1, 1):
        place = span_m[0] + generator.uniform(0.0, 300.0)
        while place < span_m[1]:
            length, height = generator.uniform(80.0, 300.0), generator.uniform(2.5, 4.5)
            places = np.arange(place, min(place + length, span_m[1]), RAIL_PIECE_M)
            pieces += rail(middle, places, side * SOUND_WALL_M, 0.2, (0.0, float(height)))
            place += length + generator.uniform(100.0, 400.0)
    return pieces


def _trees(
    middle: Polyline, span_m: tuple[float, float], bridges: list[float], generator: np.random.Generator
) -> list[Mesh]:
    pieces = []
    for side in (-1, 1):
        place = span_m[0]
        while place < span_m[1]:
            foot = beside(middle, place, side * generator.uniform(*TREES_M))[:2]
            shape = generator.uniform(0.8, 2.2), generator.uniform(4.0, 11.0), generator.uniform(1.2, 2.8)
            if all(abs(place - bridge) > NO_TREES_NEAR_BRIDGE_M for bridge in bridges):
                pieces += tree(foot, 0.0, *shape)
            place += generator.uniform(7.0, 25.0)
    return pieces
