"""What of a network is near to the ego's way; all else is not built."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.sumo.network import Network, Use
from torchcover.simulation.traffic.assemble import HORIZON_M

# Lanes are asked for their height this often.
SAMPLE_M = 2.0
# A lane so far above another one, in a square of this size or next to it, is on a bridge.
BRIDGE_M = 2.5
SQUARE_M = 4.0
# Streets are built a little farther than is seen, so that none ends in sight; bodies are as long as this.
BEYOND_M = 25.0
# What lies between carriageways that are no farther apart, and has this share of its outline in common with them, is a
# median; what is smaller is a gap that the drawing of a network left.
MEDIAN_M = 6.0
ENCLOSED = 0.95
SMALLEST_MEDIAN_M2 = 3.0
ALONGSIDE_M = 0.05
WAY_WITHIN_M = 0.5
# Whoever is farther from all streets has left them.
OFF_STREET_M = 10.0


class Vicinity:
    """A piece of a network, near the ego's (T, 2) way, of whose places `origin_m` (2,) was subtracted in float64."""

    def __init__(self, network: Network, way_m: Float64, origin_m: Float64) -> None:
        self.way = shapely.LineString(way_m if len(way_m) > 1 else np.repeat(way_m, 2, axis=0)).simplify(WAY_WITHIN_M)
        shapely.prepare(self.way)
        self.lower_m, self.upper_m = way_m.min(axis=0) - HORIZON_M, way_m.max(axis=0) + HORIZON_M
        self.left_hand = network.left_hand
        shift_m = np.array([*origin_m, 0.0])
        near = self._near([lane.line_m for lane in network.lanes], shift_m)
        lanes = (network.lanes[number] for number in near.tolist())
        self.lanes = tuple(lane._replace(line_m=lane.line_m - shift_m) for lane in lanes)
        near = self._near(network.junctions, shift_m)
        self.junctions = tuple(network.junctions[number] - shift_m for number in near.tolist())

    def _near(self, lines_m: Sequence[Float64], shift_m: Float64) -> Int64:
        """Numbers of the lines that may be seen from the way."""
        if not lines_m:
            return np.empty(0, dtype=np.int64)
        first = np.concatenate([[0], np.cumsum([len(line) for line in lines_m])[:-1]])
        places_m = (np.concatenate(lines_m) - shift_m)[:, :2]
        low_m, high_m = np.minimum.reduceat(places_m, first), np.maximum.reduceat(places_m, first)
        meet = (low_m <= self.upper_m + BEYOND_M) & (high_m >= self.lower_m - BEYOND_M)
        near = np.flatnonzero(meet.all(axis=1))
        boxes = shapely.box(*low_m[near].T, *high_m[near].T)
        return np.asarray(near[shapely.dwithin(boxes, self.way, HORIZON_M + BEYOND_M)])

    def sees(self, places_m: Float64) -> Bools:
        """(N,) whether (N, 2) places may be seen from the way."""
        return np.asarray(shapely.dwithin(shapely.points(places_m), self.way, HORIZON_M + BEYOND_M))

    def on_streets(self, places_m: Float64) -> Bools:
        """(N,) whether (N, 2) places are on a street, or at least near to one."""
        on = np.zeros(len(places_m), dtype=bool)
        if self.lanes:
            near = shapely.STRtree(self.covered).query(shapely.points(places_m), "dwithin", OFF_STREET_M)
            on[near[0]] = True
        return on

    def surfaces(self, *uses: Use) -> NDArray[np.object_]:
        """The polygons in plan of all lanes of some uses that lie on the ground."""
        lanes = [lane for k, lane in enumerate(self.lanes) if lane.use in uses and k not in self.decks]
        along = [lane for lane in lanes if lane.use != "corner"]
        lines = _lines([lane.line_m[:, :2] for lane in along])
        found = shapely.buffer(lines, [lane.width_m / 2 for lane in along], cap_style="flat", join_style="mitre")
        corners = [_polygon(lane.line_m) for lane in lanes if lane.use == "corner"]
        return np.concatenate([found, np.array(corners, dtype=object)])

    @cached_property
    def decks(self) -> frozenset[int]:
        """Numbers of the lanes that lie on bridges, at least in part."""
        return frozenset(self.of_lane[self.on_deck].tolist())

    def bridges(self, beside_m: float) -> shapely.Geometry:
        """What is no farther in plan from the middle of a lane on a bridge."""
        lines = _lines([self.lanes[number].line_m[:, :2] for number in sorted(self.decks)])
        return shapely.union_all(shapely.buffer(lines, beside_m))

    @cached_property
    def covered(self) -> NDArray[np.object_]:
        """The polygons in plan of all that is street, be it on a bridge or not."""
        along = [lane for lane in self.lanes if lane.use != "corner"]
        lines = _lines([lane.line_m[:, :2] for lane in along])
        found = shapely.buffer(lines, [lane.width_m / 2 for lane in along], cap_style="flat", join_style="mitre")
        outlines_m = [*self.junctions, *(lane.line_m for lane in self.lanes if lane.use == "corner")]
        outlines = np.array([_polygon(outline_m) for outline_m in outlines_m], dtype=object)
        return np.concatenate([found, outlines, self.medians])

    @cached_property
    def medians(self) -> NDArray[np.object_]:
        """The polygons in plan of what lies between carriageways."""
        driven = shapely.union_all([*self.surfaces("road", "turn", "shoulder"), *map(_polygon, self.junctions)])
        closed = shapely.buffer(shapely.buffer(driven, MEDIAN_M / 2, quad_segs=2), -MEDIAN_M / 2, quad_segs=2)
        others = shapely.union_all(self.surfaces("bay", "sidewalk", "corner", "crossing"))
        pieces = shapely.get_parts(shapely.difference(shapely.difference(closed, driven), others))
        pieces = pieces[(shapely.get_type_id(pieces) == 3) & (shapely.area(pieces) > SMALLEST_MEDIAN_M2)]
        outlines = shapely.get_exterior_ring(pieces)
        shared = shapely.intersection(outlines, shapely.buffer(driven, ALONGSIDE_M))
        return np.asarray(pieces[shapely.length(shared) > ENCLOSED * shapely.length(outlines)])

    @cached_property
    def samples_m(self) -> Float64:
        """(N, 3) places along all lanes."""
        return self._samples[0]

    @cached_property
    def of_lane(self) -> Int64:
        """(N,) to which lane each sample belongs."""
        return self._samples[1]

    @cached_property
    def _samples(self) -> tuple[Float64, Int64]:
        lines = shapely.segmentize(_lines([lane.line_m for lane in self.lanes]), SAMPLE_M)
        places_m, of_lane = shapely.get_coordinates(lines, include_z=True, return_index=True)
        return places_m, of_lane

    @cached_property
    def on_deck(self) -> Bools:
        """(N,) which samples lie on bridges: there is a street below."""
        square = ((self.samples_m[:, :2] - self.samples_m[:, :2].min(axis=0)) / SQUARE_M).astype(np.int64) + 1
        lowest = np.full(square.max(axis=0) + 2, np.inf)
        np.minimum.at(lowest, tuple(square.T), self.samples_m[:, 2])
        for axis in (0, 1):
            lowest = np.minimum.reduce([lowest, np.roll(lowest, 1, axis), np.roll(lowest, -1, axis)])
        return np.asarray(self.samples_m[:, 2] > lowest[tuple(square.T)] + BRIDGE_M)


def _lines(lines_m: Sequence[Float64]) -> NDArray[np.object_]:
    if not lines_m:
        return np.empty(0, dtype=object)
    count = [len(line) for line in lines_m]
    of_line = np.repeat(np.arange(len(count)), count)
    return np.asarray(shapely.linestrings(np.concatenate(lines_m), indices=of_line))


def _polygon(outline_m: Float64) -> shapely.Geometry:
    """What an outline encloses, also one that crosses itself."""
    return shapely.make_valid(shapely.Polygon(outline_m[:, :2]))
