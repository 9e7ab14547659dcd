"""Motorway without traffic: cross section, ramps, guard rails, bridges, sign gantries, noise barriers and trees.

Roadside objects are built along a straight, level road and then bent with it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.shapes import Mesh, build_prism_faces
from torchcover.simulation.traffic.alignment import Alignment
from torchcover.simulation.traffic.hills import Hills, bend_along_street
from torchcover.simulation.traffic.scenery import (
    Scenery,
    build_box_from_bounds,
    build_ground_plane,
    build_post,
    build_tree,
    merge_by_kind,
)


@dataclass(frozen=True)
class MotorwayParams:
    """Cross section and equipment of a motorway; offsets are distances from the middle of the median.

    Args:
        lane_width_m: Width of a lane.
        lane_centers_m: Centers of the lanes of a direction; the last one is the auxiliary lane.
        edge_m: Outer edge of the lanes without the auxiliary lane.
        ramp_bend_m: Length over which a ramp reaches its largest curvature, before it continues straight.
        ramp_curvature_per_m: Largest curvature of a ramp.
        ramp_end_m: Distance between a ramp and the road up to which the ramp has a rail.
        median_rail_m: Offset of the rails at the median.
        delineator_m: Offset of the delineators.
        rail_m: Offset of the outer rails.
        gantry_post_m: Offset of the posts of gantries and bridges.
        noise_barrier_m: Offset of the noise barriers.
        trees_m: Smallest and largest offset of trees.
        rail_heights_m: Lower and upper edge of a rail: a W-beam whose upper edge is 0.75 m above the road.
        rail_thickness_m: Thickness of a rail.
        rail_segment_m: Distance of the joints of a rail, which have posts.
        delineator_spacing_m: Distance between delineators.
        structure_spacing_m: Smallest and largest distance between gantries and bridges.
        clearance_m: Clear height below gantries and bridges.
        bridge_clearing_m: Distance to a bridge within which no trees stand.
        ground_margin_m: Distance from the road up to which the ground is built.
        ground_cell_m: Side of the squares of hilly ground.
    """

    lane_width_m: float = 3.6
    lane_centers_m: tuple[float, ...] = (4.6, 8.2, 11.8, 15.4)
    edge_m: float = 13.6
    ramp_bend_m: float = 100.0
    ramp_curvature_per_m: float = 1 / 500.0
    ramp_end_m: float = 60.0
    median_rail_m: float = 1.3
    delineator_m: float = 16.2
    rail_m: float = 16.8
    gantry_post_m: float = 18.0
    noise_barrier_m: float = 19.5
    trees_m: tuple[float, float] = (24.0, 45.0)
    rail_heights_m: tuple[float, float] = (0.44, 0.75)
    rail_thickness_m: float = 0.08
    rail_segment_m: float = 12.0
    delineator_spacing_m: float = 50.0
    structure_spacing_m: tuple[float, float] = (350.0, 600.0)
    clearance_m: float = 5.4
    bridge_clearing_m: float = 25.0
    ground_margin_m: float = 320.0
    ground_cell_m: float = 20.0


MOTORWAY = MotorwayParams()


class AuxiliaryLane(NamedTuple):
    """Auxiliary lane of a direction, with a ramp at each end.

    Args:
        begin_m: Station at which it begins to lie next to the other lanes.
        end_m: Station at which it ceases to.
    """

    begin_m: float
    end_m: float

    def compute_offsets_m(self, stations_m: ArrayLike) -> tuple[Float64, Float64]:
        """Compute how far ramps are away from the auxiliary lane.

        Args:
            stations_m: (...) stations.

        Returns:
            (...) distances in meters, 0 next to the other lanes, and (...) their derivatives along the stations.
        """
        stations = np.asarray(stations_m, dtype=np.float64)
        bend_m, curvature_per_m = MOTORWAY.ramp_bend_m, MOTORWAY.ramp_curvature_per_m
        beyond_m = np.maximum(np.maximum(self.begin_m - stations, stations - self.end_m), 0.0)
        bent_m, straight_m = np.minimum(beyond_m, bend_m), np.maximum(beyond_m - bend_m, 0.0)
        slope = curvature_per_m * bent_m**2 / (2 * bend_m)
        offset_m = curvature_per_m * bent_m**3 / (6 * bend_m) + slope * straight_m
        return offset_m, np.copysign(slope, stations - self.end_m)

    def is_inside(self, stations_m: ArrayLike, left_m: ArrayLike) -> Bools:
        """Test whether objects fit between the road and the ramp.

        Args:
            stations_m: (...) stations.
            left_m: (...) offsets from the median up to which the objects reach.
        """
        return np.asarray(self.compute_offsets_m(stations_m)[0] > np.asarray(left_m) - MOTORWAY.edge_m + 1.0)

    def find_clear_offsets_m(self, stations_m: ArrayLike, left_m: ArrayLike, width_m: float = 0.5) -> Float64:
        """Find offsets of roadside objects that keep off the ramp.

        Args:
            stations_m: (...) stations.
            left_m: (...) wanted offsets from the median.
            width_m: Room that an object needs beyond its offset.

        Returns:
            (...) the wanted offsets, or offsets beyond the ramp if there is no room before it.
        """
        beyond_ramp_m = np.asarray(left_m) + MOTORWAY.lane_width_m + self.compute_offsets_m(stations_m)[0]
        return np.where(self.is_inside(stations_m, np.asarray(left_m) + width_m), left_m, beyond_ramp_m)


AuxiliaryLanes = dict[int, AuxiliaryLane]
Bounds = tuple[float, float]


def build_roadside(
    median_alignment: Alignment,
    auxiliary_lanes: AuxiliaryLanes,
    hills: Hills,
    span_m: Bounds,
    generator: np.random.Generator,
) -> Scenery:
    """Build the ground and the roadside objects between two stations.

    Args:
        median_alignment: Alignment of the median.
        auxiliary_lanes: Auxiliary lanes on the left (1) and on the right (-1).
        hills: Ground heights.
        span_m: First and last station.
        generator: Random generator of the objects.
    """
    margin_m = MOTORWAY.ground_margin_m
    path_m = median_alignment.compute_poses(np.arange(span_m[0], span_m[1] + 50.0, 50.0), 0.0)[:, :2]
    structures, bridges_m = build_structures(auxiliary_lanes, span_m, generator)
    kinds = (
        build_rails(auxiliary_lanes, span_m),
        build_delineators(auxiliary_lanes, span_m),
        structures,
        build_noise_barriers(auxiliary_lanes, span_m, generator),
        build_roadside_trees(auxiliary_lanes, span_m, bridges_m, generator),
    )
    if hills.is_flat:
        ground = build_ground_plane(path_m.min(axis=0) - margin_m, path_m.max(axis=0) + margin_m)
    else:
        ground = hills.build_mesh(path_m, margin_m, MOTORWAY.ground_cell_m)
    bent_kinds = [bend_along_street(median_alignment, hills, meshes) for meshes in kinds]
    return Scenery((ground, *merge_by_kind(*bent_kinds)), (0,))


def build_prisms(outlines_m: Float64, z_m: Bounds) -> Mesh:
    """Build metal prisms.

    Args:
        outlines_m: (N, K, 2) convex counterclockwise outlines.
        z_m: Bottom and top.
    """
    num_prisms, num_corners, _ = outlines_m.shape
    vertices_m = np.empty((num_prisms, 2, num_corners, 3))
    vertices_m[..., :2] = outlines_m[:, None]
    vertices_m[..., 2] = np.reshape(z_m, (2, 1))
    faces = build_prism_faces(2, num_corners) + 2 * num_corners * np.arange(num_prisms)[:, None, None]
    return Mesh(vertices_m.reshape(-1, 3), faces.reshape(-1, 3)).assign_material("metal")


def build_wall(x_m: Float64, y_m: Float64, is_present: Bools, width_m: float, z_m: Bounds) -> list[Mesh]:
    """Build a rail or wall through positions, with a straight segment between each two neighbors that are present.

    Args:
        x_m: (K,) x of the positions.
        y_m: (K,) y of the positions.
        is_present: (K,) positions that belong to the wall.
        width_m: Thickness.
        z_m: Bottom and top.

    Returns:
        One mesh, or none without segments.
    """
    positions_m = np.stack([x_m, y_m], axis=1)
    start_m, end_m = positions_m[:-1], positions_m[1:]
    half_m = np.array([0.0, width_m / 2])
    outlines_m = np.stack([start_m - half_m, end_m - half_m, end_m + half_m, start_m + half_m], axis=1)
    outlines_m = outlines_m[is_present[1:] & is_present[:-1]]
    return [build_prisms(outlines_m, z_m)] if len(outlines_m) else []


def build_rails(auxiliary_lanes: AuxiliaryLanes, span_m: Bounds) -> list[Mesh]:
    """Build guard rails along the median, the outer edges except where ramps cross them, and the ramps."""
    x_m = np.arange(span_m[0], span_m[1], MOTORWAY.rail_segment_m)
    post_outline_m = np.array([[-0.05, -0.03], [0.05, -0.03], [0.05, 0.03], [-0.05, 0.03]])
    meshes = []
    for side, lane in auxiliary_lanes.items():
        ramp_offset_m = lane.compute_offsets_m(x_m)[0]
        median_m, edge_m = np.full(len(x_m), MOTORWAY.median_rail_m), np.full(len(x_m), MOTORWAY.rail_m)
        ramp_m = MOTORWAY.rail_m + MOTORWAY.lane_width_m + ramp_offset_m
        has_edge, has_ramp = lane.is_inside(x_m, MOTORWAY.rail_m), ramp_offset_m < MOTORWAY.ramp_end_m
        # Posts are behind the beam, seen from the lanes.
        for left_m, is_present, post_m in (
            (median_m, np.ones(len(x_m), dtype=bool), -0.1),
            (edge_m, has_edge, 0.1),
            (ramp_m, has_ramp, 0.1),
        ):
            meshes += build_wall(x_m, side * left_m, is_present, MOTORWAY.rail_thickness_m, MOTORWAY.rail_heights_m)
            posts_m = np.stack([x_m, side * (left_m + post_m)], axis=1)[is_present]
            meshes.append(build_prisms(posts_m[:, None] + post_outline_m, (0.0, 0.7)))
    return meshes


def build_delineators(auxiliary_lanes: AuxiliaryLanes, span_m: Bounds) -> list[Mesh]:
    """Build delineators along both outer edges."""
    x_m = np.arange(span_m[0], span_m[1], MOTORWAY.delineator_spacing_m)
    meshes = []
    for side, lane in auxiliary_lanes.items():
        for x, y in zip(x_m, lane.find_clear_offsets_m(x_m, MOTORWAY.delineator_m), strict=True):
            meshes.append(build_post((x, side * y), 0.06, 0.0, 1.0))
    return meshes


def build_structures(
    auxiliary_lanes: AuxiliaryLanes, span_m: Bounds, generator: np.random.Generator
) -> tuple[list[Mesh], list[float]]:
    """Build sign gantries and bridges, in turn.

    Args:
        auxiliary_lanes: Auxiliary lanes by side.
        span_m: First and last station.
        generator: Random generator.

    Returns:
        Meshes, and the stations of the bridges.
    """
    clearance_m = MOTORWAY.clearance_m
    meshes, bridges_m = [], []
    station_m, is_bridge = span_m[0] + generator.uniform(100.0, 300.0), bool(generator.random() < 0.5)
    while station_m < span_m[1]:
        length_m, half_width_m, height_m = (9.0, 50.0, 1.2) if is_bridge else (0.6, 0.0, 1.6)
        ends_m = []
        for side, lane in auxiliary_lanes.items():
            post_m = float(lane.find_clear_offsets_m(station_m, MOTORWAY.gantry_post_m))
            meshes.append(build_post((station_m, side * post_m), 0.4 if is_bridge else 0.2, 0.0, clearance_m))
            ends_m.append(side * max(post_m + 0.3, half_width_m))
        x_m = (station_m - length_m / 2, station_m + length_m / 2)
        z_m = (clearance_m, clearance_m + height_m)
        meshes.append(build_box_from_bounds(x_m, (min(ends_m), max(ends_m)), z_m))
        if is_bridge:
            bridges_m.append(float(station_m))
        station_m += generator.uniform(*MOTORWAY.structure_spacing_m)
        is_bridge = not is_bridge
    return meshes, bridges_m


def build_noise_barriers(auxiliary_lanes: AuxiliaryLanes, span_m: Bounds, generator: np.random.Generator) -> list[Mesh]:
    """Build noise barriers along parts of the road, on either side."""
    offset_m = MOTORWAY.noise_barrier_m
    meshes = []
    for side, lane in auxiliary_lanes.items():
        start_m = span_m[0] + generator.uniform(0.0, 300.0)
        while start_m < span_m[1]:
            length_m, height_m = generator.uniform(80.0, 300.0), generator.uniform(2.5, 4.5)
            x_m = np.arange(start_m, min(start_m + length_m, span_m[1]), MOTORWAY.rail_segment_m)
            is_inside = lane.is_inside(x_m, offset_m + 0.5)
            y_m = side * lane.find_clear_offsets_m(x_m, offset_m)
            for is_present in (is_inside, ~is_inside):
                meshes += build_wall(x_m, y_m, is_present, 0.2, (0.0, float(height_m)))
            start_m += length_m + generator.uniform(100.0, 400.0)
    return meshes


def build_roadside_trees(
    auxiliary_lanes: AuxiliaryLanes, span_m: Bounds, bridges_m: list[float], generator: np.random.Generator
) -> list[Mesh]:
    """Build trees along both sides.

    Args:
        auxiliary_lanes: Auxiliary lanes by side.
        span_m: First and last station.
        bridges_m: Stations of bridges, near which no trees stand.
        generator: Random generator.
    """
    meshes = []
    for side, lane in auxiliary_lanes.items():
        x_m = span_m[0] + np.cumsum(generator.uniform(7.0, 25.0, int((span_m[1] - span_m[0]) / 16.0)))
        y_m = lane.find_clear_offsets_m(x_m, generator.uniform(*MOTORWAY.trees_m, len(x_m)), 3.5)
        for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True):
            trunk_height_m, height_m = generator.uniform(0.8, 2.2), generator.uniform(4.0, 11.0)
            crown_radius_m = generator.uniform(1.2, 2.8)
            bridge_distances_m = [abs(x - bridge_m) for bridge_m in bridges_m]
            if min(bridge_distances_m, default=np.inf) > MOTORWAY.bridge_clearing_m:
                meshes += build_tree((x, side * y), 0.0, trunk_height_m, height_m, crown_radius_m)
    return meshes
