"""Ground through the lanes of a network, raised sidewalks, medians and bridge decks, and bodies that stand on them."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.geometry import accumulate_heights
from torchcover.geometry.arrays import Bools, Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.height_field import (
    CELL_M,
    MARGIN_M,
    FlatGround,
    Ground,
    GroundHeightField,
    compute_cell_centers_m,
    count_corners,
)
from torchcover.simulation.scene import Actor
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.motion import Motion
from torchcover.simulation.sumo.paths import compute_rectangle_corners_m, smooth_positions
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.alignment import Polyline
from torchcover.simulation.traffic.assemble import compute_attitude_deg
from torchcover.simulation.traffic.city import CITY, PARKED_KINDS
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, REAR_OF, Fleet, get_part_kinds
from torchcover.simulation.traffic.scenery import CURB_HEIGHT_M, build_sidewalk


def build_ground(vicinity: Vicinity) -> FlatGround | GroundHeightField:
    """Build the ground around the path of the ego vehicle.

    Args:
        vicinity: Part of a network.

    Returns:
        A plane if all lanes have one height, otherwise a height field through all lanes that are not on bridges.
    """
    lower_m, upper_m = vicinity.lower_m - MARGIN_M, vicinity.upper_m + MARGIN_M
    points_m = vicinity.lane_points_m[~vicinity.on_bridge_mask]
    if np.ptp(vicinity.lane_points_m[:, 2]) == 0.0:
        return FlatGround(float(points_m[0, 2]), lower_m, upper_m)
    rows, columns = count_corners(lower_m, upper_m)
    sums_m, weights = accumulate_heights((points_m[:, :2] - lower_m) / CELL_M, points_m[:, 2], rows, columns)
    is_visible = vicinity.is_visible(compute_cell_centers_m(lower_m, rows, columns)).reshape(rows - 1, columns - 1)
    return GroundHeightField(lower_m, fill_height_field(sums_m, weights), is_visible)


def fill_height_field(sums_m: Float64, weights: Float64, num_smoothings: int = 4) -> Float64:
    """Compute weighted means of heights, and fill corners without weight from coarser grids.

    Args:
        sums_m: (rows, columns) weighted sums of heights.
        weights: (rows, columns) weights.
        num_smoothings: Rounds of smoothing of the filled corners, at each scale.

    Returns:
        (rows, columns) heights; 0 without any weight.
    """
    has_weight = weights > 0
    means_m: Float64 = sums_m / np.where(has_weight, weights, 1.0)
    if has_weight.all() or min(means_m.shape) < 2:
        return means_m if has_weight.any() else np.zeros_like(means_m)
    # The coarser grid has cells of twice the size.
    rows, columns = means_m.shape
    coarse = []
    for grid in (sums_m, weights):
        padded = np.pad(grid, [(0, rows % 2), (0, columns % 2)])
        coarse.append(padded.reshape(padded.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)))
    coarse_m = fill_height_field(coarse[0], coarse[1], num_smoothings)
    heights_m = np.where(has_weight, means_m, coarse_m.repeat(2, axis=0).repeat(2, axis=1)[:rows, :columns])
    for _ in range(num_smoothings):
        padded_m = np.pad(heights_m, 1, mode="edge")
        neighbors_m = padded_m[:-2, 1:-1] + padded_m[2:, 1:-1] + padded_m[1:-1, :-2] + padded_m[1:-1, 2:]
        heights_m = np.where(has_weight, heights_m, neighbors_m / 4)
    return heights_m


def compute_tilts_deg(ground: Ground, positions_m: Float64, yaw_deg: Float64, size_m: tuple[float, float]) -> Float64:
    """Compute the tilt of bodies on the ground.

    Args:
        ground: Ground.
        positions_m: (N, 2) centers.
        yaw_deg: (N,) headings.
        size_m: Length and width.

    Returns:
        (N, 2) pitch and roll in degrees.
    """
    length_m, width_m = size_m
    yaw_rad = np.deg2rad(yaw_deg)
    forward = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    forward_m, left_m = length_m / 3 * forward, width_m / 2 * left
    compute_heights_m = ground.compute_heights_m
    front_rise_m = compute_heights_m(positions_m + forward_m) - compute_heights_m(positions_m - forward_m)
    left_rise_m = compute_heights_m(positions_m + left_m) - compute_heights_m(positions_m - left_m)
    # A raised front is a negative pitch; a raised left side is a positive roll.
    pitch_rad, roll_rad = np.arctan2(-front_rise_m, 2 * length_m / 3), np.arctan2(left_rise_m, width_m)
    return np.asarray(np.rad2deg(np.stack([pitch_rad, roll_rad], axis=1)))


class Sidewalks:
    """Sidewalks and medians: areas that are neither for vehicles nor crossings.

    Args:
        vicinity: Part of a network.
        ground: Ground.

    Attributes:
        polygons: Raised areas in the ground plane.
        walkable_area: Sidewalks and crossings, without the gaps between them.
    """

    def __init__(self, vicinity: Vicinity, ground: Ground) -> None:
        half_sliver_m = 0.1  # half of the width below which parts of an area vanish: no sidewalk is as narrow
        gap_m, crossing_gap_m = 0.3, 1.3  # gaps between sidewalks, and before crossings, that networks leave
        self._ground = ground
        # Erosion and dilation remove slivers where outlines nearly meet.
        raised = shapely.union_all([*vicinity.build_surfaces("sidewalk", "corner"), *vicinity.median_polygons])
        driven = shapely.union_all(vicinity.build_surfaces("road", "turn", "bay", "shoulder", "crossing"))
        narrowed = shapely.buffer(shapely.difference(raised, driven), -half_sliver_m, join_style="mitre")
        polygons = shapely.get_parts(shapely.buffer(narrowed, half_sliver_m, join_style="mitre"))
        self.polygons = polygons[~shapely.is_empty(polygons)]
        self._tree = shapely.STRtree(self.polygons)
        sidewalks = shapely.buffer(vicinity.build_surfaces("sidewalk", "corner"), gap_m, join_style="mitre")
        crossings = shapely.buffer(vicinity.build_surfaces("crossing"), crossing_gap_m, join_style="mitre")
        self.walkable_area = shapely.union_all([*sidewalks, *crossings]).buffer(-gap_m, join_style="mitre")

    def build_meshes(self) -> list[Mesh]:
        """Build one mesh for each connected area."""
        is_flat = isinstance(self._ground, FlatGround)
        outlines = self.polygons if is_flat else shapely.segmentize(self.polygons, CELL_M)
        return [build_sidewalk(outline, self._ground.compute_heights_m) for outline in outlines]

    def is_inside(self, positions_m: Float64) -> Bools:
        """Test which positions are on a sidewalk or median.

        Args:
            positions_m: (N, 2) positions.

        Returns:
            (N,) True inside of `polygons` or on their edges.
        """
        is_inside = np.zeros(len(positions_m), dtype=bool)
        is_inside[self._tree.query(shapely.points(positions_m), predicate="intersects")[0]] = True
        return is_inside


def build_bridges(vicinity: Vicinity) -> list[Mesh]:
    """Build the decks of bridges: slabs below lanes that are above other lanes.

    Args:
        vicinity: Part of a network.

    Returns:
        One mesh for each part of a lane, which extends two samples beyond the lane below.
    """
    meshes = []
    for lane_index in sorted(vicinity.bridge_lane_indices):
        if vicinity.lanes[lane_index].use == "corner":
            continue
        samples = np.flatnonzero(vicinity.lane_indices == lane_index)
        # Bounds of the sections above another lane.
        is_above = np.concatenate([[False], vicinity.on_bridge_mask[samples], [False]])
        changes = np.flatnonzero(np.diff(is_above.astype(np.int8)))
        for first, end in changes.reshape(-1, 2).tolist():
            line_m = vicinity.lane_points_m[samples[max(first - 2, 0) : end + 2]]
            meshes.append(build_deck(line_m, vicinity.lanes[lane_index].width_m))
    return meshes


def build_deck(line_m: Float64, width_m: float, thickness_m: float = 0.8) -> Mesh:
    """Build a closed slab below a centerline.

    Args:
        line_m: (K, 3) centerline of its upper side.
        width_m: Width.
        thickness_m: Thickness.
    """
    forward = np.gradient(line_m[:, :2], axis=0)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1) / np.linalg.norm(forward, axis=1, keepdims=True)
    right_m, left_m = line_m.copy(), line_m.copy()
    right_m[:, :2] -= width_m / 2 * left
    left_m[:, :2] += width_m / 2 * left
    down_m = np.array([0.0, 0.0, thickness_m])
    # Four corners at each position, around the slab: right, left, left below and right below.
    vertices_m = np.stack([right_m, left_m, left_m - down_m, right_m - down_m], axis=1).reshape(-1, 3)
    faces = []
    last = len(vertices_m) - 4
    for start in range(0, last, 4):
        end = start + 4
        for corner in range(4):
            next_corner = (corner + 1) % 4
            faces.append([start + corner, end + corner, end + next_corner])
            faces.append([start + corner, end + next_corner, start + next_corner])
    # Both ends are closed.
    faces += [[0, 1, 2], [0, 2, 3], [last + 2, last + 1, last], [last + 3, last + 2, last]]
    return Mesh(vertices_m, np.array(faces)).assign_material("road")


class BodyPlacer:
    """Placement of bodies on the ground, on sidewalks or on bridges.

    Args:
        ground: Ground.
        sidewalks: Sidewalks.
    """

    def __init__(self, ground: Ground, sidewalks: Sidewalks) -> None:
        self._ground = ground
        self._sidewalks = sidewalks

    def build_actors(self, motions: Sequence[Motion], fleet: Fleet, duration_s: float) -> tuple[Actor, ...]:
        """Build actors and their trailers.

        Args:
            motions: Motions.
            fleet: Meshes of bodies.
            duration_s: Duration of the scene; actors that are not present all the time appear and disappear.
        """
        actors = []
        for index, motion in enumerate(motions):
            name = f"{motion.road_user.kind} {motion.road_user.track.name} {index}"
            is_temporary = not motion.road_user.track.is_present_for(duration_s)
            for kind, (poses, size_m) in zip(get_part_kinds(motion.road_user.kind), motion.parts, strict=True):
                trajectory = Trajectory(motion.times_s, *self._place(motion, poses, size_m), is_temporary)
                actors.append(Actor(name, CATEGORIES[kind], fleet.meshes[kind], trajectory))
                name = REAR_OF + name
        return tuple(actors)

    def build_ego(self, motion: Motion, times_s: Float64, mesh: Mesh, generator: np.random.Generator) -> Actor:
        """Build the ego vehicle, whose body also tilts with acceleration and curves.

        Args:
            motion: Motion.
            times_s: (T,) evenly spaced times.
            mesh: Mesh of the ego vehicle.
            generator: Random generator of the unevenness of the road.
        """
        columns = np.concatenate(self._place(motion, *motion.parts[0]), axis=1).T
        x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg = (np.interp(times_s, motion.times_s, column) for column in columns)
        # Acceleration and unevenness depend on the distance along the path.
        distances_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
        speeds_mps = np.gradient(distances_m, times_s)
        angles_deg = compute_attitude_deg(times_s, distances_m, speeds_mps, yaw_deg, generator)
        angles_deg[:, 1:] += np.stack([pitch_deg, roll_deg], axis=1)
        return Actor(EGO, "car", mesh, Trajectory(times_s, np.stack([x_m, y_m, z_m], axis=1), angles_deg))

    def _place(self, motion: Motion, poses: Float64, size_m: tuple[float, float]) -> tuple[Float64, Float64]:
        """Compute positions (K, 3) in meters and angles (K, 3) in degrees of a body or trailer."""
        min_bridge_height_m = 0.4  # height above the ground from which a road user is on a bridge
        curb_step_poses = 2  # poses before and after a curb over which a pedestrian steps up or down
        centers_m, yaw_deg, track = poses[:, :2], np.rad2deg(poses[:, 2]), motion.road_user.track
        # The simulation gives the height of the front of the vehicle.
        half_length_m = 0.0 if track.is_pedestrian else motion.road_user.part_sizes_m[0][0] / 2
        behind_front_m = half_length_m + np.linalg.norm(centers_m - motion.poses[:, :2], axis=1)
        heights_m = self._ground.compute_heights_m(centers_m)
        front_heights_m = np.interp(motion.times_s, track.times_s, track.front_positions_m[:, 2])
        slope_deg = np.interp(motion.times_s, track.times_s, track.slope_deg)
        deck_heights_m = front_heights_m - behind_front_m * np.sin(np.deg2rad(slope_deg))
        is_on_bridge = deck_heights_m > heights_m + min_bridge_height_m
        angles_deg = np.column_stack([yaw_deg, np.zeros((len(yaw_deg), 2))])
        if track.is_pedestrian:
            is_raised = self._sidewalks.is_inside(centers_m) & ~is_on_bridge
            steps_m = np.where(is_raised, CURB_HEIGHT_M, 0.0)[:, None]
            heights_m = heights_m + smooth_positions(steps_m, curb_step_poses)[:, 0]
        elif not isinstance(self._ground, FlatGround):
            angles_deg[:, 1:] = compute_tilts_deg(self._ground, centers_m, yaw_deg, size_m)
            angles_deg[is_on_bridge, 1], angles_deg[is_on_bridge, 2] = -slope_deg[is_on_bridge], 0.0
        return np.column_stack([centers_m, np.where(is_on_bridge, deck_heights_m, heights_m)]), angles_deg


def place_parked_vehicles(
    vicinity: Vicinity, ground: Ground, fleet: Fleet, parked_share: float, generator: np.random.Generator
) -> NDArray[np.object_]:
    """Park cars in the bays of streets.

    Args:
        vicinity: Part of a network.
        ground: Ground.
        fleet: Bodies; receives the parked cars.
        parked_share: Share of the bays that are occupied.
        generator: Random generator.

    Returns:
        Polygons of the cars in the ground plane.
    """
    poses_by_kind: dict[str, list[Float64]] = defaultdict(list)
    for lane in vicinity.lanes:
        if lane.use != "bay":
            continue
        line = Polyline(lane.line_m[:, :2])
        start_m, last_m = CITY.corner_clearance_m, line.length_m - CITY.corner_clearance_m
        while start_m < last_m:
            kind = fleet.sample_kind(PARKED_KINDS)
            length_m = fleet.get_length_m(kind) + CITY.parking_gap_m + float(generator.uniform(0.0, 0.5))
            is_occupied = generator.random() < parked_share and start_m + length_m < last_m
            if is_occupied and fleet.get_width_m(kind) < lane.width_m:
                poses_by_kind[kind].append(line.compute_poses(start_m + length_m / 2))
            start_m += length_m
    # Heights and tilts are computed for all cars of a kind together.
    corners_m = [np.empty((0, 4, 2))]
    for kind, kind_poses in poses_by_kind.items():
        poses = np.array(kind_poses).reshape(-1, 3)
        positions_m, yaw_deg = poses[:, :2], poses[:, 2]
        heights_m = ground.compute_heights_m(positions_m)
        size_m = fleet.get_length_m(kind), fleet.get_width_m(kind)
        tilts_deg = compute_tilts_deg(ground, positions_m, yaw_deg, size_m)
        radian_poses = np.column_stack([positions_m, np.deg2rad(yaw_deg)])
        corners_m.append(compute_rectangle_corners_m(radian_poses, np.tile(size_m, (len(poses), 1))))
        rows = np.column_stack([poses, heights_m, tilts_deg])
        for x_m, y_m, yaw, height_m, pitch, roll in rows.tolist():
            fleet.add_parked_vehicle(kind, (x_m, y_m, yaw), height_m, (pitch, roll))
    return np.asarray(shapely.polygons(np.concatenate(corners_m)))
