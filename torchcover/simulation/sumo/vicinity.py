"""Part of a road network near the path of the ego vehicle: surfaces of lanes, medians and bridges."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.sumo.network import LaneUse, Network, NetworkLane
from torchcover.simulation.traffic.assemble import HORIZON_M


@dataclass(frozen=True)
class VicinityParams:
    """Parameters of the extraction of streets.

    Args:
        margin_m: Addition to the horizon within which streets are built, so that none ends within sight.
        path_tolerance_m: Tolerance of the path of the ego vehicle.
        sample_spacing_m: Distance of the samples along lanes.
        bridge_clearance_m: Height above another lane from which a lane is on a bridge.
        bridge_cell_m: Side of the squares in which heights of lanes are compared, with neighboring squares.
        max_median_m: Largest width of a median between carriageways.
        min_median_m2: Smallest area of a median; smaller gaps are inaccuracies of the network.
        min_enclosed_share: Share of its outline that a median has in common with carriageways.
        adjacency_m: Distance from a carriageway within which an outline is in common with it.
        max_off_street_m: Distance from streets up to which a position is still on a street.
    """

    margin_m: float = 25.0
    path_tolerance_m: float = 0.5
    sample_spacing_m: float = 2.0
    bridge_clearance_m: float = 2.5
    bridge_cell_m: float = 4.0
    max_median_m: float = 6.0
    min_median_m2: float = 3.0
    min_enclosed_share: float = 0.95
    adjacency_m: float = 0.05
    max_off_street_m: float = 10.0


class Vicinity:
    """Part of a network near the path of the ego vehicle.

    Args:
        network: Road network.
        ego_path_m: (T, 2) path of the ego vehicle, relative to the origin.
        origin_m: (2,) position in the network that is subtracted from all positions, in float64.
        params: Parameters.

    Attributes:
        lanes: Lanes near the path, relative to the origin.
        junctions: Outlines of junctions near the path, relative to the origin.
        lane_points_m: (N, 3) samples along all lanes.
        lane_indices: (N,) index of the lane of each sample.
        lower_m: (2,) smallest x and y within the horizon.
        upper_m: (2,) largest x and y within the horizon.
    """

    def __init__(
        self, network: Network, ego_path_m: Float64, origin_m: Float64, params: VicinityParams = VicinityParams()
    ) -> None:
        self.params = params
        path_m = ego_path_m if len(ego_path_m) > 1 else np.repeat(ego_path_m, 2, axis=0)
        self.ego_path = shapely.LineString(path_m).simplify(params.path_tolerance_m)
        shapely.prepare(self.ego_path)
        self.lower_m, self.upper_m = ego_path_m.min(axis=0) - HORIZON_M, ego_path_m.max(axis=0) + HORIZON_M
        shift_m = np.array([*origin_m, 0.0])
        lanes = []
        for index in self._find_nearby([lane.line_m for lane in network.lanes], shift_m).tolist():
            lane = network.lanes[index]
            lanes.append(lane._replace(line_m=lane.line_m - shift_m))
        self.lanes = tuple(lanes)
        lines = shapely.segmentize(build_lines([lane.line_m for lane in self.lanes]), params.sample_spacing_m)
        self.lane_points_m, self.lane_indices = shapely.get_coordinates(lines, include_z=True, return_index=True)
        nearby_junctions = self._find_nearby(network.junctions, shift_m).tolist()
        self.junctions = tuple(network.junctions[index] - shift_m for index in nearby_junctions)

    def _find_nearby(self, lines_m: Sequence[Float64], shift_m: Float64) -> Int64:
        """Find the indices of lines that may be visible from the path."""
        if not lines_m:
            return np.empty(0, dtype=np.int64)
        counts = [len(line_m) for line_m in lines_m]
        positions_m = (np.concatenate(lines_m) - shift_m)[:, :2]
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        lower_m, upper_m = np.minimum.reduceat(positions_m, first), np.maximum.reduceat(positions_m, first)
        margin_m = self.params.margin_m
        overlaps = (lower_m <= self.upper_m + margin_m) & (upper_m >= self.lower_m - margin_m)
        nearby = np.flatnonzero(overlaps.all(axis=1))
        boxes = shapely.box(*lower_m[nearby].T, *upper_m[nearby].T)
        return np.asarray(nearby[shapely.dwithin(boxes, self.ego_path, HORIZON_M + margin_m)])

    def is_visible(self, positions_m: Float64) -> Bools:
        """Test which positions may be visible from the path.

        Args:
            positions_m: (N, 2) positions.

        Returns:
            (N,) True within `HORIZON_M` and a margin.
        """
        max_distance_m = HORIZON_M + self.params.margin_m
        return np.asarray(shapely.dwithin(shapely.points(positions_m), self.ego_path, max_distance_m))

    def is_on_street(self, positions_m: Float64) -> Bools:
        """Test which positions (N, 2) are on a street or at most `max_off_street_m` away."""
        is_near = np.zeros(len(positions_m), dtype=bool)
        if self.lanes:
            tree, max_distance_m = shapely.STRtree(self.street_polygons), self.params.max_off_street_m
            is_near[tree.query(shapely.points(positions_m), "dwithin", max_distance_m)[0]] = True
        return is_near

    def build_surfaces(self, *uses: LaneUse) -> NDArray[np.object_]:
        """Build polygons in the ground plane of all lanes of some uses that are not on bridges."""
        lanes = []
        for index, lane in enumerate(self.lanes):
            if lane.use in uses and index not in self.bridge_lane_indices:
                lanes.append(lane)
        return build_polygons(lanes, [lane.line_m for lane in lanes if lane.use == "corner"])

    @cached_property
    def bridge_lane_indices(self) -> frozenset[int]:
        """Indices of the lanes of which at least a part is on a bridge."""
        return frozenset(self.lane_indices[self.on_bridge_mask].tolist())

    def build_bridge_area(self, margin_m: float) -> shapely.Geometry:
        """Build the area of bridges in the ground plane.

        Args:
            margin_m: Distance from the centerlines of lanes on bridges.
        """
        lines = build_lines([self.lanes[index].line_m[:, :2] for index in sorted(self.bridge_lane_indices)])
        return shapely.union_all(shapely.buffer(lines, margin_m))

    @cached_property
    def street_polygons(self) -> NDArray[np.object_]:
        """Polygons in the ground plane of all lanes, junctions and medians, also on bridges."""
        corners_m = [lane.line_m for lane in self.lanes if lane.use == "corner"]
        return np.concatenate([build_polygons(self.lanes, [*self.junctions, *corners_m]), self.median_polygons])

    @cached_property
    def median_polygons(self) -> NDArray[np.object_]:
        """Polygons in the ground plane of the medians between carriageways."""
        params = self.params
        carriageways = [*self.build_surfaces("road", "turn", "shoulder")]
        carriageways += [build_polygon(outline_m) for outline_m in self.junctions]
        driven = shapely.union_all(carriageways)
        # Closing by half of the largest width fills the gaps between carriageways.
        half_m = params.max_median_m / 2
        closed = shapely.buffer(shapely.buffer(driven, half_m, quad_segs=2), -half_m, quad_segs=2)
        other_surfaces = shapely.union_all(self.build_surfaces("bay", "sidewalk", "corner", "crossing"))
        gaps = shapely.get_parts(shapely.difference(shapely.difference(closed, driven), other_surfaces))
        is_polygon = shapely.get_type_id(gaps) == shapely.GeometryType.POLYGON
        gaps = gaps[is_polygon & (shapely.area(gaps) > params.min_median_m2)]
        outlines = shapely.get_exterior_ring(gaps)
        enclosed = shapely.intersection(outlines, shapely.buffer(driven, params.adjacency_m))
        is_enclosed = shapely.length(enclosed) > params.min_enclosed_share * shapely.length(outlines)
        return np.asarray(gaps[is_enclosed])

    @cached_property
    def on_bridge_mask(self) -> Bools:
        """(N,) samples on bridges: another lane is below."""
        offsets_m = self.lane_points_m[:, :2] - self.lane_points_m[:, :2].min(axis=0)
        cells = (offsets_m / self.params.bridge_cell_m).astype(np.int64) + 1
        lowest_m = np.full(cells.max(axis=0) + 2, np.inf)
        np.minimum.at(lowest_m, tuple(cells.T), self.lane_points_m[:, 2])
        # A lane may cross another one near the edge of a square: neighboring squares count, too.
        for axis in (0, 1):
            lowest_m = np.minimum.reduce([lowest_m, np.roll(lowest_m, 1, axis), np.roll(lowest_m, -1, axis)])
        max_ground_m = lowest_m[tuple(cells.T)] + self.params.bridge_clearance_m
        return np.asarray(self.lane_points_m[:, 2] > max_ground_m)


def build_lines(lines_m: Sequence[Float64]) -> NDArray[np.object_]:
    """Build line strings.

    Args:
        lines_m: N arrays (K, 2 or 3) of positions.

    Returns:
        (N,) line strings.
    """
    if not lines_m:
        return np.empty(0, dtype=object)
    counts = [len(line_m) for line_m in lines_m]
    return np.asarray(shapely.linestrings(np.concatenate(lines_m), indices=np.repeat(np.arange(len(counts)), counts)))


def build_polygons(lanes: Sequence[NetworkLane], outlines_m: Sequence[Float64]) -> NDArray[np.object_]:
    """Build polygons in the ground plane.

    Args:
        lanes: Lanes; corners are skipped.
        outlines_m: Outlines (K, 2 or 3) of further areas.

    Returns:
        Polygons of the lanes, then of the outlines.
    """
    strips = [lane for lane in lanes if lane.use != "corner"]
    lines = build_lines([lane.line_m[:, :2] for lane in strips])
    half_widths_m = [lane.width_m / 2 for lane in strips]
    surfaces = shapely.buffer(lines, half_widths_m, cap_style="flat", join_style="mitre")
    areas = np.array([build_polygon(outline_m) for outline_m in outlines_m], dtype=object)
    return np.concatenate([surfaces, areas])


def build_polygon(outline_m: Float64) -> shapely.Geometry:
    """Build a valid polygon in the ground plane from an outline (K, 2 or 3) that may cross itself."""
    return shapely.make_valid(shapely.Polygon(outline_m[:, :2]))
