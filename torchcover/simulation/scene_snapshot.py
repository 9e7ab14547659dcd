"""Snapshot of a scene at the time of one frame, which sensors scan."""

import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.simulation.culling import BoxOutlines, compute_outlines
from torchcover.simulation.local_ground import LocalGround
from torchcover.simulation.moving_bodies import MovingBodies
from torchcover.simulation.raycaster import HitAttributes, Hits, RayCaster, cast_from_vehicle
from torchcover.simulation.rays import TILE_ROWS, Tile, compute_unit_directions, rotate, split_into_tiles
from torchcover.simulation.scan_motion import BodyPoses, MotionSampler, RayTimes, ScanMotion, sample_no_motion

Result = TypeVar("Result")

# (3, 144) directions over the sphere, to test whether rays can leave a body.
ALL_AROUND_RAYS = (
    compute_unit_directions(np.linspace(-85.0, 85.0, 12)[:, None], np.arange(0.0, 360.0, 30.0)[None])
    .reshape(3, -1)
    .astype(np.float32)
)


class SensorScan(NamedTuple):
    """Points of one sensor in one frame, with the number of rays and casts.

    Args:
        points: (N, 3) float32 ground-truth hit points in the vehicle frame.
        ray_indices: (N,) ray of each point, counted over the tiles of the sensor.
        range_m: (N,) float32 range of each point.
        num_rays: Number of rays of the sensor.
        self_hits: Number of rays that hit the ego vehicle.
        num_body_casts: Number of pairs of a ray and a moving body that were cast; the other pairs cannot meet.
        find_attributes: Function that computes the attributes of the hits on demand; None for a recorded scan.
        range_error_m: (N,) float32 error of each measured range along the ray; None for exact ranges.
        measured_points: (N, 3) float32 measured points; None if they equal `points`.
        compute_directions: Function that computes the (N, 3) ray directions in the vehicle frame; None for a recorded
            scan.
        num_omitted_rays: Number of rays that were not cast, since they cannot affect the result.
    """

    points: Float32
    ray_indices: Int64
    range_m: Float32
    num_rays: int
    self_hits: int
    num_body_casts: int = 0
    find_attributes: Callable[[], HitAttributes] | None = None
    range_error_m: Float32 | None = None
    measured_points: Float32 | None = None
    compute_directions: Callable[[], Float32] | None = None
    num_omitted_rays: int = 0

    def select(self, indices: Int64) -> "SensorScan":
        """Select points by their indices; `range_error_m` and the functions stay unchanged."""
        return self._replace(
            points=self.points[indices],
            ray_indices=self.ray_indices[indices],
            range_m=self.range_m[indices],
            measured_points=None if self.measured_points is None else self.measured_points[indices],
        )


class _TileScan(NamedTuple):
    """Scan of one tile of n rays, K of which give points.

    `points` (K, 3) are at the time of the frame; `measured_points` (K, 3) are where a sensor that takes time measures
    moving bodies, the same array if none moved. `is_point` (n,) marks the rays that give points.
    """

    points: Float32
    measured_points: Float32
    is_point: Bools
    directions: Float32
    hits: Hits
    num_body_casts: int

    @property
    def point_directions(self) -> Float32:
        """(3, K) directions of the rays that give points."""
        return self.directions.take(np.flatnonzero(self.is_point), axis=1)


@dataclass(frozen=True, eq=False)
class SceneSnapshot:
    """Scene at the time of one frame. Static bodies come first in the numbering, then moving bodies in range.

    Args:
        static_caster: Static bodies.
        static_T_vehicle: (4, 4) pose of the vehicle in their frame.
        moving_bodies: Moving bodies in range.
        ego_index: Index of the ego vehicle.
        num_out_of_range: Number of moving bodies that are absent or out of range.
        ground: Local ground.
        world_T_vehicle: (4, 4) pose of the vehicle in the frame of the ground.
        sample_motion: Function that samples the poses of all bodies over an interval around this time.
    """

    static_caster: RayCaster
    static_T_vehicle: Matrix
    moving_bodies: MovingBodies
    ego_index: int
    num_out_of_range: int = 0
    ground: LocalGround = field(default_factory=partial(LocalGround, [], np.zeros(3)))
    world_T_vehicle: Matrix = field(default_factory=partial(np.eye, 4))
    sample_motion: MotionSampler = sample_no_motion
    _motions: dict[tuple[float, float], ScanMotion | None] = field(default_factory=dict)

    def compute_heights_m(self, points_m: NDArray[np.floating]) -> Float32:
        """Compute heights above the local ground, see `LocalGround.compute_heights_m`.

        Args:
            points_m: (N, 3) points in the vehicle frame.

        Returns:
            (N,) heights in meters; NaN without ground at or below the point.
        """
        return self.ground.compute_heights_m(points_m, self.world_T_vehicle)

    def find_first_faces(self, points_m: Float32, normals: Float32, max_distance_m: float) -> Int64:
        """Find the outermost static face at points on static faces, where several faces lie close to each other.

        Args:
            points_m: (N, 3) points in the vehicle frame.
            normals: (N, 3) unit normals, towards the side from which the points are seen.
            max_distance_m: Largest distance of a face from the point, on either side.

        Returns:
            (N,) face numbers as in `RayCaster.find_first_faces`; -1 for none.
        """
        starts_m = transform_points(self.static_T_vehicle, points_m + np.float32(max_distance_m) * normals)
        directions = -(normals @ self.static_T_vehicle[:3, :3].T)
        return self.static_caster.find_first_faces(starts_m, directions, 2 * max_distance_m)

    def scan(
        self,
        vehicle_T_sensor: Matrix,
        tiles: Sequence[Tile],
        *,
        max_range_m: float = np.inf,
        ego_hit_range_m: Sequence[Float32] = (),
        keep_ego_points: bool = False,
        ray_times: Sequence[RayTimes] | None = None,
        num_threads: int = 1,
    ) -> SensorScan:
        """Cast the rays of one sensor. The ego vehicle occludes.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            tiles: Rays from `split_into_tiles`.
            max_range_m: Largest range.
            ego_hit_range_m: For each tile (n,) range at which the rays hit the ego vehicle, see
                `SceneGeometry.compute_ego_hit_ranges_m`; empty to cast at the ego vehicle.
            keep_ego_points: True to include points on the ego vehicle.
            ray_times: For each tile the times of its rays; None if all rays are cast at the time of the frame.
            num_threads: Number of threads.

        Returns:
            Scan with points in the order of the tiles, for any number of threads.
        """
        origin_m = vehicle_T_sensor[:3, 3]
        motion = self._get_motion(ray_times) if ray_times else None
        outlines = self.compute_outlines(origin_m) if motion is None else motion.compute_outlines(origin_m)

        def scan_tile(tile: Tile, ego_range_m: Float32 | None, tile_times: RayTimes | None) -> _TileScan:
            limit_m = build_range_limits_m(tile, max_range_m)
            if motion is None or tile_times is None:
                directions, hits, num_casts = self.cast(vehicle_T_sensor, tile, limit_m, outlines, ego_range_m)
                is_point = self._find_points(hits, keep_ego_points)
                points = _compute_points(origin_m.astype(np.float32), directions, hits.range_m, is_point)
                return _TileScan(points, points, is_point, directions, hits, num_casts)
            swept = motion.cast(vehicle_T_sensor, tile, tile_times, limit_m, outlines, self.ego_index, ego_range_m)
            is_point = self._find_points(swept.hits, keep_ego_points)
            points = measured = _compute_points(swept.starts_m, swept.directions, swept.hits.range_m, is_point)
            if len(swept.moving_ray_indices):
                points = measured.copy()
                points[np.cumsum(is_point)[swept.moving_ray_indices] - 1] = swept.moving_points_m
            return _TileScan(points, measured, is_point, swept.directions, swept.hits, swept.num_body_casts)

        tile_ego_ranges_m: Sequence[Float32 | None] = ego_hit_range_m or [None] * len(tiles)
        tile_times: Sequence[RayTimes | None] = ray_times or [None] * len(tiles)
        scans = run_in_threads(num_threads, scan_tile, tiles, tile_ego_ranges_m, tile_times)

        def find_attributes() -> HitAttributes:
            tile_attributes = []
            for scan in scans:
                bodies, triangles = scan.hits.body_indices[scan.is_point], scan.hits.triangle_indices[scan.is_point]
                tile_attributes.append(self.compute_hit_attributes(bodies, triangles, scan.point_directions))
            return HitAttributes._make(np.concatenate(column) for column in zip(*tile_attributes, strict=True))

        def compute_directions() -> Float32:
            return np.concatenate([scan.point_directions for scan in scans], axis=1).T

        measured_points = None
        if any(scan.measured_points is not scan.points for scan in scans):
            measured_points = np.concatenate([scan.measured_points for scan in scans])
        return SensorScan(
            points=np.concatenate([scan.points for scan in scans]),
            ray_indices=np.flatnonzero(np.concatenate([scan.is_point for scan in scans])),
            range_m=np.concatenate([scan.hits.range_m[scan.is_point] for scan in scans]),
            num_rays=sum(tile.directions.shape[1] for tile in tiles),
            self_hits=sum(int(np.count_nonzero(scan.hits.body_indices == self.ego_index)) for scan in scans),
            num_body_casts=sum(scan.num_body_casts for scan in scans),
            find_attributes=find_attributes,
            compute_directions=compute_directions,
            measured_points=measured_points,
        )

    def _find_points(self, hits: Hits, keep_ego_points: bool) -> Bools:
        """Find the rays that give points; rays that hit the ego vehicle only if wanted."""
        return np.asarray((hits.body_indices >= 0) & (keep_ego_points | (hits.body_indices != self.ego_index)))

    def _get_motion(self, ray_times: Sequence[RayTimes]) -> ScanMotion | None:
        """Get the motion during a scan; scans of about the same interval share it."""
        interval_s = 0.005  # scans begin and end at multiples of this
        times_s = np.concatenate([tile_times.times_s for tile_times in ray_times])
        begin_s = interval_s * math.floor(times_s.min() / interval_s) if len(times_s) else 0.0
        end_s = interval_s * math.ceil(times_s.max() / interval_s) if len(times_s) else 0.0
        if (begin_s, end_s) not in self._motions:
            current_poses = BodyPoses(self.static_T_vehicle, self.moving_bodies.vehicle_T_part)
            self._motions[begin_s, end_s] = ScanMotion.from_poses(
                self.static_caster, current_poses, self.moving_bodies, *self.sample_motion(begin_s, end_s)
            )
        return self._motions[begin_s, end_s]

    def compute_hit_attributes(
        self, body_indices: Int32, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """Compute incidence angles and materials of hits.

        Args:
            body_indices: (N,) bodies, none of them -1.
            triangle_indices: (N,) faces in their meshes.
            directions: (3, N) float32 unit directions of the rays in the vehicle frame.
        """
        num_static = self.static_caster.num_bodies
        moving = np.flatnonzero(body_indices >= num_static)
        static_triangles = triangle_indices
        # Hits on moving bodies are looked up as an arbitrary static face first, and then replaced.
        if len(moving):
            static_triangles = np.where(body_indices < num_static, triangle_indices, 0)
        static_bodies = np.minimum(body_indices, num_static - 1)
        static_directions = rotate(self.static_T_vehicle[:3, :3], directions)
        attributes = self.static_caster.compute_hit_attributes(static_bodies, static_triangles, static_directions)
        if len(moving):
            parts = np.searchsorted(self.moving_bodies.body_indices, body_indices[moving])
            moving_attributes = self.moving_bodies.compute_hit_attributes(
                parts, triangle_indices[moving], directions[:, moving]
            )
            attributes.cos_incidence[moving] = moving_attributes.cos_incidence
            attributes.material_indices[moving] = moving_attributes.material_indices
        return attributes._replace(body_indices=body_indices, triangle_indices=triangle_indices)

    def render_range_image(
        self, vehicle_T_sensor: Matrix, directions: Float64, *, max_range_m: float = np.inf
    ) -> Float32:
        """Render the ranges along directions; rays also hit the ego vehicle.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            directions: (3, rows, columns) unit directions in the sensor frame; NaN for a pixel without a ray.
            max_range_m: Largest range.

        Returns:
            (rows, columns) float32 ranges in meters; inf where a ray hits nothing within the range, NaN without a ray.
        """
        image = np.full(directions.shape[1:], np.nan, dtype=np.float32)
        outlines = self.compute_outlines(vehicle_T_sensor[:3, 3])
        for top in range(0, len(image), TILE_ROWS):
            rows = slice(top, top + TILE_ROWS)
            (tile,) = split_into_tiles(directions[:, rows], max_columns=directions.shape[2])
            _, hits, _ = self.cast(vehicle_T_sensor, tile, build_range_limits_m(tile, max_range_m), outlines)
            image[rows][~np.isnan(directions[0, rows])] = np.where(hits.body_indices >= 0, hits.range_m, np.inf)
        return image

    def is_occupied(self, position_m: Matrix) -> bool:
        """Return True for a position below the ground or inside a body other than the ego vehicle.

        Args:
            position_m: (3,) position in the vehicle frame.
        """
        if self.ground.is_below_ground(position_m, self.world_T_vehicle):
            return True
        static_position_m = transform_points(self.static_T_vehicle, position_m[None])[0]
        if (self.static_caster.find_enclosing_bodies(static_position_m) != self.ego_index).any():
            return True
        bodies = self.moving_bodies
        is_near = np.linalg.norm(bodies.center_m - position_m, axis=1) <= bodies.radius_m
        candidates = np.flatnonzero(is_near & (bodies.body_indices != self.ego_index)).tolist()
        part_positions_m = bodies.transform_to_parts_m(position_m) if candidates else position_m[None]
        return any(len(bodies.casters[k].find_enclosing_bodies(part_positions_m[k])) for k in candidates)

    def is_on_surface(self, position_m: Matrix) -> bool:
        """Return True for a (3,) position in the vehicle frame that lies exactly on a static face or the ground."""
        touched = self.static_caster.find_touched_bodies(transform_points(self.static_T_vehicle, position_m[None])[0])
        return bool((touched != self.ego_index).any())

    def compute_outlines(self, origin_m: Matrix) -> BoxOutlines:
        """Compute the bounding planes of the moving bodies, as seen from a (3,) position in the vehicle frame."""
        return compute_outlines(self.moving_bodies.box_corners_m, origin_m)

    def cast(
        self,
        vehicle_T_sensor: Matrix,
        tile: Tile,
        limit_m: Float32,
        outlines: BoxOutlines,
        ego_hit_range_m: Float32 | None = None,
    ) -> tuple[Float32, Hits, int]:
        """Cast the n rays of a tile.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            tile: Rays.
            limit_m: (n,) largest range of each ray, finite.
            outlines: Result of `compute_outlines` for the position of the sensor.
            ego_hit_range_m: (n,) range at which each ray hits the ego vehicle; None to cast at the ego vehicle as well.

        Returns:
            (3, n) directions in the vehicle frame, hits, and the number of pairs of a ray and a moving body.
        """
        origin_m, vehicle_R_sensor = vehicle_T_sensor[:3, 3], vehicle_T_sensor[:3, :3]
        directions = rotate(vehicle_R_sensor, tile.directions)
        if ego_hit_range_m is not None:
            limit_m = np.minimum(limit_m, ego_hit_range_m)
        hits = cast_from_vehicle(self.static_caster, self.static_T_vehicle, origin_m, directions, limit_m)
        if ego_hit_range_m is not None:
            hits.body_indices[(hits.body_indices < 0) & (ego_hit_range_m <= limit_m)] = self.ego_index
        excluded_body = None if ego_hit_range_m is None else self.ego_index
        body_hits, num_casts = self.moving_bodies.find_body_hits(
            origin_m, vehicle_R_sensor, tile, directions, hits.range_m, outlines, excluded_body=excluded_body
        )
        self.moving_bodies.update_nearest_hits(hits, body_hits)
        return directions, hits, num_casts


def run_in_threads(num_threads: int, function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """Call a function for each row of some columns of arguments.

    Args:
        num_threads: Number of threads; 1 runs in the calling thread.
        function: Function with one parameter per column.
        columns: Arguments, equally many in each column.

    Returns:
        Results in the order of the rows.
    """
    rows = list(zip(*columns, strict=True))
    if num_threads <= 1 or len(rows) <= 1:
        return [function(*row) for row in rows]
    # A new pool each time: threads do not survive the fork that makes a DataLoader worker.
    with ThreadPoolExecutor(num_threads) as pool:
        return list(pool.map(function, *zip(*rows, strict=True)))


def is_enclosed(caster: RayCaster, position_m: Matrix) -> bool:
    """Return True if bodies enclose a (3,) position, so that no ray leaves; tested with 144 rays."""
    limit_m = np.full(ALL_AROUND_RAYS.shape[1], np.inf, dtype=np.float32)
    return bool((caster.cast(position_m, ALL_AROUND_RAYS, limit_m).body_indices >= 0).all())


def build_range_limits_m(tile: Tile, max_range_m: float) -> Float32:
    """Build the (n,) largest ranges of the rays of a tile; finite, since culling computes with them."""
    return np.full(tile.directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)


def _compute_points(origin_m: Float32, directions: Float32, range_m: Float32, is_point: Bools) -> Float32:
    """Compute the (K, 3) points of some rays from one (3,) origin or (3, n) origins."""
    points = np.empty((np.count_nonzero(is_point), 3), dtype=np.float32)
    for axis in range(3):
        coordinate = directions[axis] * range_m
        coordinate += origin_m[axis]
        points[:, axis] = coordinate[is_point]
    return points
