"""What stands along a motorway, built as if it were straight and level, and then bent with it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh, prism_faces
from torchcover.simulation.traffic.alignment import Alignment
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import Scenery, block, few, ground, post, tree
from torchcover.simulation.traffic.site import bent

# Across the road, from the middle of the median; the last is the side lane, on which one enters and exits.
LANE_M = 3.6
LANE_CENTRES_M = np.array([4.6, 8.2, 11.8, 15.4])
LANES_END_M = 13.6
MEDIAN_RAIL_M = 1.3
DELINEATOR_M = 16.2
RAIL_M = 16.8
GANTRY_POST_M = 18.0
SOUND_WALL_M = 19.5
TREES_M = (24.0, 45.0)
# Ramps turn away over such a length to such a curvature, and go straight on; there are rails along them so far.
RAMP_BENDS_M, RAMP_PER_M = 100.0, 1 / 500.0
RAMP_ENDS_M = 60.0

# A W-beam: its upper edge is 0.75 m up, and posts stand at the joints.
RAIL_HEIGHTS_M = (0.44, 0.75)
RAIL_THICKNESS_M = 0.08
RAIL_PIECE_M = 12.0
DELINEATOR_EVERY_M = 50.0
STRUCTURE_EVERY_M = (350.0, 600.0)
CLEARANCE_M = 5.4
NO_TREES_NEAR_BRIDGE_M = 25.0
GROUND_M, SQUARE_M = 320.0, 20.0


class SideLane(NamedTuple):
    """The stations between which the side lane of a direction lies beside the others; at both ends ramps lead away."""

    begin_m: float
    end_m: float

    def away_m(self, stations_m: ArrayLike) -> tuple[Float64, Float64]:
        """(...) how much farther out than that it is at stations, and how much more after each metre."""
        stations = np.asarray(stations_m, dtype=np.float64)
        beyond = np.maximum(np.maximum(self.begin_m - stations, stations - self.end_m), 0.0)
        bent, straight_on = np.minimum(beyond, RAMP_BENDS_M), np.maximum(beyond - RAMP_BENDS_M, 0.0)
        slope = RAMP_PER_M * bent**2 / (2 * RAMP_BENDS_M)
        away = RAMP_PER_M * bent**3 / (6 * RAMP_BENDS_M) + slope * straight_on
        return away, np.copysign(slope, stations - self.end_m)

    def is_inside(self, stations_m: ArrayLike, left_m: ArrayLike) -> Bools:
        """(...) whether what reaches so far from the middle stays between the other lanes and the ramp."""
        return np.asarray(self.away_m(stations_m)[0] > np.asarray(left_m) - LANES_END_M + 1.0)

    def kept_off(self, stations_m: ArrayLike, left_m: ArrayLike, wide_m: float = 0.5) -> Float64:
        """(...) how far from the middle things stand: on the outside of the ramp if there is no room before it."""
        outside_m = np.asarray(left_m) + LANE_M + self.away_m(stations_m)[0]
        return np.where(self.is_inside(stations_m, np.asarray(left_m) + wide_m), left_m, outside_m)


def roadside(
    middle: Alignment,
    sides: dict[int, SideLane],
    hills: Hills,
    span_m: tuple[float, float],
    generator: np.random.Generator,
) -> Scenery:
    """The ground, and what stands along the part of the road from one station to another.

    `middle` is that of the median, `sides` are the side lanes on the left (1) and on the right (-1).
    """
    way_m = middle.poses(np.arange(span_m[0], span_m[1] + 50.0, 50.0), 0.0)[:, :2]
    plain = (way_m.min(axis=0) - GROUND_M, way_m.max(axis=0) + GROUND_M)
    structures, bridges = _structures(sides, span_m, generator)
    stands = (
        _rails(sides, span_m),
        _delineators(sides, span_m),
        structures,
        _sound_walls(sides, span_m, generator),
        _trees(sides, span_m, bridges, generator),
    )
    level = ground(*plain) if hills.are_flat else hills.mesh(way_m, GROUND_M, SQUARE_M)
    return Scenery((level, *few(*(bent(middle, hills, pieces) for pieces in stands))), (0,))


def _prisms(outlines_m: Float64, z_m: tuple[float, float]) -> Mesh:
    """Closed bodies over (N, K, 2) convex outlines, counter-clockwise."""
    count, corners, _ = outlines_m.shape
    vertices = np.empty((count, 2, corners, 3))
    vertices[..., :2] = outlines_m[:, None]
    vertices[..., 2] = np.reshape(z_m, (2, 1))
    faces = prism_faces(2, corners) + 2 * corners * np.arange(count)[:, None, None]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3)).made_of("metal")


def _wall(x_m: Float64, y_m: Float64, there: Bools, width_m: float, z_m: tuple[float, float]) -> list[Mesh]:
    """A rail or wall through (K,) places: a straight piece between each two that are there."""
    here, ahead = (np.stack([x_m, y_m], axis=1)[ends] for ends in (slice(-1), slice(1, None)))
    aside = np.array([0.0, width_m / 2])
    outlines = np.stack([here - aside, ahead - aside, ahead + aside, here + aside], axis=1)[there[1:] & there[:-1]]
    return [_prisms(outlines, z_m)] if len(outlines) else []


def _rails(sides: dict[int, SideLane], span_m: tuple[float, float]) -> list[Mesh]:
    """Along the median, along both edges but where ramps cross them, and along the outsides of the ramps."""
    x_m = np.arange(span_m[0], span_m[1], RAIL_PIECE_M)
    everywhere = np.ones(len(x_m), dtype=bool)
    foot = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    pieces = []
    for side, lane in sides.items():
        away_m = lane.away_m(x_m)[0]
        for left_m, there, outwards in (
            (np.full(len(x_m), MEDIAN_RAIL_M), everywhere, -0.1),
            (np.full(len(x_m), RAIL_M), lane.is_inside(x_m, RAIL_M), 0.1),
            (RAIL_M + LANE_M + away_m, away_m < RAMP_ENDS_M, 0.1),
        ):
            pieces += _wall(x_m, side * left_m, there, RAIL_THICKNESS_M, RAIL_HEIGHTS_M)
            # Behind the beam, seen from the lanes.
            feet = np.stack([x_m, side * (left_m + outwards)], axis=1)[there]
            pieces.append(_prisms(feet[:, None] + foot, (0.0, 0.7)))
    return pieces


def _delineators(sides: dict[int, SideLane], span_m: tuple[float, float]) -> list[Mesh]:
    x_m = np.arange(span_m[0], span_m[1], DELINEATOR_EVERY_M)
    return [
        post((x, side * y), 0.06, 0.0, 1.0)
        for side, lane in sides.items()
        for x, y in zip(x_m, lane.kept_off(x_m, DELINEATOR_M), strict=True)
    ]


def _structures(
    sides: dict[int, SideLane], span_m: tuple[float, float], generator: np.random.Generator
) -> tuple[list[Mesh], list[float]]:
    """Sign gantries and bridges in turn over the whole road; and the places of the bridges."""
    pieces, bridges = [], []
    place, is_bridge = span_m[0] + generator.uniform(100.0, 300.0), bool(generator.random() < 0.5)
    while place < span_m[1]:
        length, half_width, height = (9.0, 50.0, 1.2) if is_bridge else (0.6, 0.0, 1.6)
        feet = {side: float(lane.kept_off(place, GANTRY_POST_M)) for side, lane in sides.items()}
        pieces += [post((place, side * y), 0.4 if is_bridge else 0.2, 0.0, CLEARANCE_M) for side, y in feet.items()]
        ends = [side * max(y + 0.3, half_width) for side, y in feet.items()]
        along = (place - length / 2, place + length / 2)
        pieces.append(block(along, (min(ends), max(ends)), (CLEARANCE_M, CLEARANCE_M + height)))
        if is_bridge:
            bridges.append(float(place))
        place += generator.uniform(*STRUCTURE_EVERY_M)
        is_bridge = not is_bridge
    return pieces, bridges


def _sound_walls(sides: dict[int, SideLane], span_m: tuple[float, float], generator: np.random.Generator) -> list[Mesh]:
    """Walls along parts of the road, on either side."""
    pieces = []
    for side, lane in sides.items():
        place = span_m[0] + generator.uniform(0.0, 300.0)
        while place < span_m[1]:
            length, height = generator.uniform(80.0, 300.0), generator.uniform(2.5, 4.5)
            x_m = np.arange(place, min(place + length, span_m[1]), RAIL_PIECE_M)
            inside, y_m = lane.is_inside(x_m, SOUND_WALL_M + 0.5), side * lane.kept_off(x_m, SOUND_WALL_M)
            for there in (inside, ~inside):
                pieces += _wall(x_m, y_m, there, 0.2, (0.0, float(height)))
            place += length + generator.uniform(100.0, 400.0)
    return pieces


def _trees(
    sides: dict[int, SideLane], span_m: tuple[float, float], bridges: list[float], generator: np.random.Generator
) -> list[Mesh]:
    pieces = []
    for side, lane in sides.items():
        x_m = span_m[0] + np.cumsum(generator.uniform(7.0, 25.0, int((span_m[1] - span_m[0]) / 16.0)))
        y_m = lane.kept_off(x_m, generator.uniform(*TREES_M, len(x_m)), 3.5)
        for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True):
            shape = generator.uniform(0.8, 2.2), generator.uniform(4.0, 11.0), generator.uniform(1.2, 2.8)
            if all(abs(x - bridge) > NO_TREES_NEAR_BRIDGE_M for bridge in bridges):
                pieces += tree((x, side * y), 0.0, *shape)
    return pieces
