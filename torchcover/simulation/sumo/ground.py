"""The ground without seams, raised sidewalks, medians and bridge decks, and the bodies that stand on them."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

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
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.motion import Motion, compute_rectangle_corners_m, smooth_positions
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.alignment import Polyline
from torchcover.simulation.traffic.assemble import compute_attitude_deg
from torchcover.simulation.traffic.city import CITY, PARKED_KINDS
from torchcover.simulation.traffic.fleet import CATEGORIES, EGO, REAR_OF, Fleet, get_part_kinds
from torchcover.simulation.traffic.scenery import PAVEMENT_M, build_sidewalk
from torchcover.simulation.world import Actor

# Rounds of smoothing between the streets, at each scale; the streets' own heights stay.
SMOOTHINGS = 4
DECK_M = 0.8
GAP_M, CROSSING_GAP_M = 0.3, 1.3
# Half the width of what is left where outlines nearly meet, and of points of needles: no kerb is as narrow.
SLIVER_M = 0.1


def build_ground(vicinity: Vicinity) -> FlatGround | GroundHeightField:
    """The ground around the ego's way: plain if all lanes are of one height, else through all that are no bridges."""
    lower_m, upper_m = vicinity.lower_m - MARGIN_M, vicinity.upper_m + MARGIN_M
    places_m = vicinity.lane_points_m[~vicinity.on_bridge_mask]
    if np.ptp(vicinity.lane_points_m[:, 2]) == 0.0:
        return FlatGround(float(places_m[0, 2]), lower_m, upper_m)
    rows, columns = count_corners(lower_m, upper_m)
    total, weight = accumulate_heights((places_m[:, :2] - lower_m) / CELL_M, places_m[:, 2], rows, columns)
    wanted = vicinity.is_visible(compute_cell_centers_m(lower_m, rows, columns)).reshape(rows - 1, columns - 1)
    return GroundHeightField(lower_m, _filled(total, weight), wanted)


def _filled(total: Float64, weight: Float64) -> Float64:
    """Means where there is a weight; elsewhere what a raster of half the size has, smoothed."""
    known = weight > 0
    means: Float64 = total / np.where(known, weight, 1.0)
    if known.all() or min(means.shape) < 2:
        return means if known.any() else np.zeros_like(means)
    padding = [(0, size % 2) for size in means.shape]
    halves = []
    for raster in (total, weight):
        even = np.pad(raster, padding)
        halves.append(even.reshape(even.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3)))
    coarse = _filled(halves[0], halves[1])
    found = np.where(known, means, coarse.repeat(2, axis=0).repeat(2, axis=1)[: means.shape[0], : means.shape[1]])
    for _ in range(SMOOTHINGS):
        around = np.pad(found, 1, mode="edge")
        mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
        found = np.where(known, found, mean)
    return found


def compute_tilts_deg(ground: Ground, positions_m: Float64, yaw_deg: Float64, size_m: tuple[float, float]) -> Float64:
    """(N, 2) pitch and roll of bodies of a length and width, with the middle at (N, 2) places, on the ground."""
    yaw = np.deg2rad(yaw_deg)
    forward = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    rises = [
        ground.compute_heights_m(positions_m + half * way) - ground.compute_heights_m(positions_m - half * way)
        for way, half in ((forward, size_m[0] / 3), (left, size_m[1] / 2))
    ]
    # Up at the front is a negative pitch; up at the left lowers the right side.
    pitch, roll = np.arctan2(-rises[0], 2 * size_m[0] / 3), np.arctan2(rises[1], size_m[1])
    return np.asarray(np.rad2deg(np.stack([pitch, roll], axis=1)))


class Sidewalks:
    """All sidewalks and medians, in plan: where neither vehicles nor crossings are."""

    def __init__(self, vicinity: Vicinity, ground: Ground) -> None:
        self._ground = ground
        walked = shapely.union_all([*vicinity.build_surfaces("sidewalk", "corner"), *vicinity.median_polygons])
        driven = shapely.union_all(vicinity.build_surfaces("road", "turn", "bay", "shoulder", "crossing"))
        narrowed = shapely.buffer(shapely.difference(walked, driven), -SLIVER_M, join_style="mitre")
        self.polygons = shapely.get_parts(shapely.buffer(narrowed, SLIVER_M, join_style="mitre"))
        self.polygons = self.polygons[~shapely.is_empty(self.polygons)]
        self._tree = shapely.STRtree(self.polygons)
        # With crossings, and without the gaps that the drawing of a network leaves, most of all before these.
        gaps = (
            (vicinity.build_surfaces("sidewalk", "corner"), GAP_M),
            (vicinity.build_surfaces("crossing"), CROSSING_GAP_M),
        )
        on_foot = [shapely.buffer(part, gap_m, join_style="mitre") for parts, gap_m in gaps for part in parts]
        self.walkable_area = shapely.union_all(on_foot).buffer(-GAP_M, join_style="mitre")

    def build_meshes(self) -> list[Mesh]:
        """One for each piece that is not connected to another."""
        pieces = self.polygons if isinstance(self._ground, FlatGround) else shapely.segmentize(self.polygons, CELL_M)
        return [build_sidewalk(piece, self._ground.compute_heights_m) for piece in pieces]

    def is_inside(self, positions_m: Float64) -> Bools:
        """(N,) whether (N, 2) places are on it."""
        held = np.zeros(len(positions_m), dtype=bool)
        held[self._tree.query(shapely.points(positions_m), predicate="intersects")[0]] = True
        return held


def build_bridges(vicinity: Vicinity) -> list[Mesh]:
    """The decks of bridges: a slab under each lane, a little farther than where another street is below."""
    found = []
    for number in sorted(vicinity.bridge_lane_indices):
        own = np.flatnonzero(vicinity.lane_indices == number)
        if vicinity.lanes[number].use == "corner":
            continue
        up = np.concatenate([[False], vicinity.on_bridge_mask[own], [False]])
        steps = np.flatnonzero(np.diff(up.astype(np.int8)))
        for first, end in steps.reshape(-1, 2).tolist():
            line_m = vicinity.lane_points_m[own[max(first - 2, 0) : end + 2]]
            found.append(_strip(line_m, vicinity.lanes[number].width_m))
    return found


def _strip(line_m: Float64, width_m: float) -> Mesh:
    """A closed slab of a width whose upper side has a line in its middle."""
    along = np.gradient(line_m[:, :2], axis=0)
    left = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    right_m, left_m = line_m.copy(), line_m.copy()
    right_m[:, :2] -= width_m / 2 * left
    left_m[:, :2] += width_m / 2 * left
    down = np.array([0.0, 0.0, DECK_M])
    # Four corners at each place, around the slab: right, left, and below left and right.
    vertices_m = np.stack([right_m, left_m, left_m - down, right_m - down], axis=1).reshape(-1, 3)
    faces = []
    for here, there in pairwise(range(0, len(vertices_m), 4)):
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
            faces += [[here + a, there + a, there + b], [here + a, there + b, here + b]]
    last = len(vertices_m) - 4
    faces += [[0, 1, 2], [0, 2, 3], [last + 2, last + 1, last], [last + 3, last + 2, last]]
    return Mesh(vertices_m, np.array(faces)).assign_material("road")


# Who is so far above the ground is on a bridge.
BRIDGE_M = 0.4
# So long, in poses, before and after it does it take to step onto a kerb.
STEP_POSES = 2


class BodyPlacer:
    """Puts bodies onto the ground, the pavement, or the deck of a bridge."""

    def __init__(self, ground: Ground, sidewalks: Sidewalks) -> None:
        self._ground = ground
        self._pavement = sidewalks

    def build_actors(self, motions: Sequence[Motion], fleet: Fleet, duration_s: float) -> tuple[Actor, ...]:
        """The others as actors, there for as long as they were in the simulation."""
        found = []
        for number, motion in enumerate(motions):
            name = f"{motion.road_user.kind} {motion.road_user.track.name} {number}"
            for kind, part in zip(get_part_kinds(motion.road_user.kind), motion.parts, strict=True):
                poses = self._poses(motion, *part)
                trajectory = Trajectory(motion.times_s, *poses, not motion.road_user.track.is_present_for(duration_s))
                found.append(Actor(name, CATEGORIES[kind], fleet.meshes[kind], trajectory))
                name = REAR_OF + name
        return tuple(found)

    def build_ego(self, motion: Motion, times_s: Float64, mesh: Mesh, generator: np.random.Generator) -> Actor:
        """The ego, with a body that tilts with braking and curves, too, at evenly spaced times."""
        columns = np.concatenate(self._poses(motion, *motion.parts[0]), axis=1).T
        x_m, y_m, z_m, yaw, pitch, roll = (np.interp(times_s, motion.times_s, column) for column in columns)
        way_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
        angles = compute_attitude_deg(times_s, way_m, np.gradient(way_m, times_s), yaw, generator)
        angles[:, 1:] += np.stack([pitch, roll], axis=1)
        return Actor(EGO, "car", mesh, Trajectory(times_s, np.stack([x_m, y_m, z_m], axis=1), angles))

    def _poses(self, motion: Motion, poses: Float64, size_m: tuple[float, float]) -> tuple[Float64, Float64]:
        """(K, 3) places and (K, 3) angles of a part of a body."""
        middle_m, yaw_deg, track = poses[:, :2], np.rad2deg(poses[:, 2]), motion.road_user.track
        back_m = 0.0 if track.is_pedestrian else motion.road_user.part_sizes_m[0][0] / 2
        # What is drawn along is behind.
        back_m = back_m + np.linalg.norm(middle_m - motion.poses[:, :2], axis=1)
        heights_m = self._ground.compute_heights_m(middle_m)
        told_m, slope_deg = (
            np.interp(motion.times_s, track.times_s, told) for told in (track.front_positions_m[:, 2], track.slope_deg)
        )
        on_deck_m = told_m - back_m * np.sin(np.deg2rad(slope_deg))
        up = on_deck_m > heights_m + BRIDGE_M
        angles_deg = np.column_stack([yaw_deg, np.zeros((len(yaw_deg), 2))])
        if track.is_pedestrian:
            raised_m = np.where(self._pavement.is_inside(middle_m) & ~up, PAVEMENT_M, 0.0)
            heights_m = heights_m + smooth_positions(raised_m[:, None], STEP_POSES)[:, 0]
        elif not isinstance(self._ground, FlatGround):
            angles_deg[:, 1:] = compute_tilts_deg(self._ground, middle_m, yaw_deg, size_m)
            angles_deg[up, 1], angles_deg[up, 2] = -slope_deg[up], 0.0
        return np.column_stack([middle_m, np.where(up, on_deck_m, heights_m)]), angles_deg


def place_parked_vehicles(
    vicinity: Vicinity, ground: Ground, fleet: Fleet, parked_share: float, generator: np.random.Generator
) -> NDArray[np.object_]:
    """Put cars into the bays of the streets that are near; their outlines in plan."""
    outlines_m = [np.empty((0, 4, 2))]
    poses: dict[str, list[np.ndarray]] = defaultdict(list)
    for lane in vicinity.lanes:
        if lane.use != "bay":
            continue
        line = Polyline(lane.line_m[:, :2])
        way_m, end_m = CITY.corner_clearance_m, line.length_m - CITY.corner_clearance_m
        while way_m < end_m:
            kind = fleet.sample_kind(PARKED_KINDS)
            length_m = fleet.get_length_m(kind) + CITY.parking_gap_m + float(generator.uniform(0.0, 0.5))
            taken = generator.random() < parked_share and way_m + length_m < end_m
            if taken and fleet.get_width_m(kind) < lane.width_m:
                poses[kind].append(line.compute_poses(way_m + length_m / 2))
            way_m += length_m
    for kind, drawn in poses.items():
        places = np.array(drawn).reshape(-1, 3)
        heights_m = ground.compute_heights_m(places[:, :2])
        size_m = fleet.get_length_m(kind), fleet.get_width_m(kind)
        tilts = compute_tilts_deg(ground, places[:, :2], places[:, 2], size_m)
        turned = np.column_stack([places[:, :2], np.deg2rad(places[:, 2])])
        outlines_m.append(compute_rectangle_corners_m(turned, np.tile(size_m, (len(places), 1))))
        for (x_m, y_m, yaw_deg), height_m, (pitch, roll) in zip(
            places.tolist(), heights_m.tolist(), tilts.tolist(), strict=True
        ):
            fleet.add_parked_vehicle(kind, (x_m, y_m, yaw_deg), height_m, (pitch, roll))
    return np.asarray(shapely.polygons(np.concatenate(outlines_m)))
