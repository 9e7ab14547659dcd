"""Sensors mounted on the ego vehicle of a scene, and visibility of points from a position."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry import build_transform
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.bodies import Body
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.memory import BYTES_PER_RAY, check_memory_fits
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import BLOCK_SIZE, Tile, compute_ray_pixel_indices, rotate, split_into_tiles
from torchcover.simulation.returns import CLEAR, Weather
from torchcover.simulation.scan_motion import RayTimes
from torchcover.simulation.scene_geometry import SceneGeometry, compute_hit_ranges_m
from torchcover.simulation.scene_snapshot import SceneSnapshot, SensorScan, run_in_threads
from torchcover.simulation.sensor import RayHits, ScanTimes, Sensor, SensorNoise
from torchcover.simulation.shapes import Mesh

# Relative rounding of a range in float32: a ray towards a target ends before it by this share of its length.
RANGE_ROUNDING = 1e-6


class RayEnds(NamedTuple):
    """Ends of all n rays of a sensor, in the order of its tiles.

    Args:
        range_m: (n,) float32 range of the hit, or the maximum range.
        is_hit: (n,) True where the ray hits something other than the ego vehicle.
    """

    range_m: Float32
    is_hit: Bools


class MountedSensor:
    """Sensor of a rig on the ego vehicle of a scene.

    The sensor is fixed to the ego vehicle, so that its rays that hit the ego vehicle, the housings of other sensors or
    the bodies of the rig are the same in every frame; they are cast once. In a scene without motion all rays are cast
    once.

    Args:
        sensor: Sensor.
        scene: Geometry of the scene.
        max_range_m: Range of the rays, see `Scenario.compute_max_range_m`.
        weather: Weather along the rays.
        other_sensors: Other sensors of the rig; their housings occlude this sensor.
        rig_bodies: Bodies that the rig adds to the vehicle.

    Raises:
        ValueError: A scan takes longer than the time step of the scene.
    """

    def __init__(
        self,
        sensor: Sensor,
        scene: SceneGeometry,
        max_range_m: float,
        weather: Weather = CLEAR,
        other_sensors: Sequence[Sensor] = (),
        rig_bodies: Sequence[Body] = (),
    ) -> None:
        self.sensor = sensor
        self.max_range_m = max_range_m
        self.weather = weather
        self.vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions()
        self.tiles = split_into_tiles(directions)
        self.ray_pixel_indices = compute_ray_pixel_indices(directions)
        scan_times: ScanTimes | None = getattr(sensor, "scan", None)
        if scan_times and scan_times.period_s > scene.scene.time_step_s:
            raise ValueError(
                f"sensor {sensor.name!r}: a scan of period_s {scan_times.period_s:g} is longer than the time step of "
                f"the scenario, {scene.scene.time_step_s:g} s; shorten its period, or make the time steps longer"
            )
        self._is_static = not scene.has_motion
        self._ray_times = None if self._is_static else compute_ray_times(sensor, self.tiles, self.ray_pixel_indices)
        self._has_motion_distortion = bool(self._ray_times and scan_times and not scan_times.deskewed)
        self.ego_hit_range_m = scene.compute_ego_hit_ranges_m(
            self.vehicle_T_sensor, self.tiles, max_range_m=max_range_m
        )
        self._has_ego_hits = bool(self.ego_hit_range_m)
        rig_meshes: list[Mesh] = []
        for other_sensor in other_sensors:
            for body in other_sensor.housing:
                rig_meshes += [mesh.transform(other_sensor.mount.to_matrix()) for mesh in body.build_meshes()]
        for body in rig_bodies:
            rig_meshes += body.build_meshes()
        if rig_meshes:
            caster = RayCaster(rig_meshes)
            rig_ranges_m = [
                compute_hit_ranges_m(caster, self.vehicle_T_sensor, tile, max_range_m) for tile in self.tiles
            ]
            ego_ranges_m = self.ego_hit_range_m or rig_ranges_m
            pairs = zip(rig_ranges_m, ego_ranges_m, strict=True)
            self.ego_hit_range_m = tuple(np.minimum(rig_m, ego_m) for rig_m, ego_m in pairs)
        self._static_scan: tuple[SensorScan, RayHits] | None = None
        self._last_scan: tuple[SceneSnapshot, SensorScan] | None = None

    def scan(
        self,
        snapshot: SceneSnapshot,
        noise: SensorNoise,
        *,
        num_threads: int = 1,
        search_spheres: SearchSpheres | None = None,
    ) -> SensorScan:
        """Simulate the measurement of one frame; the result does not depend on the number of threads.

        Args:
            snapshot: Scene at the time of the frame.
            noise: Source of random numbers; with `search_spheres` each ray needs numbers of its own.
            num_threads: Number of threads.
            search_spheres: Spheres outside of which no points are needed. Points within them are the same as without.
        """
        scan, hits = self._cast(snapshot, num_threads, search_spheres)
        if self._has_motion_distortion:
            scan = self._distort(scan)
        hit_indices, range_error_m = self.sensor.measure(hits, noise)
        directions = None
        if range_error_m is not None and scan.compute_directions:
            directions = scan.compute_directions()
        # The functions would keep the hits of all rays in memory.
        scan = scan._replace(find_attributes=None, compute_directions=None)
        if hit_indices is not None:
            scan = scan.select(hit_indices)
        if range_error_m is None or directions is None:
            return scan
        measured_points = scan.points if scan.measured_points is None else scan.measured_points
        if hit_indices is not None:
            directions = directions[hit_indices]
        measured_points = (measured_points + range_error_m[:, None] * directions).astype(np.float32)
        return scan._replace(range_error_m=range_error_m.astype(np.float32), measured_points=measured_points)

    def _distort(self, scan: SensorScan) -> SensorScan:
        """Move the measured points of a scan to the vehicle frame of the time at which their ray was cast."""
        sensor_directions = np.concatenate([tile.directions for tile in self.tiles], axis=1)
        directions = rotate(self.vehicle_T_sensor[:3, :3], sensor_directions.take(scan.ray_indices, axis=1)).T

        def get_directions() -> Float32:
            return directions

        measured_points = self.vehicle_T_sensor[:3, 3] + scan.range_m[:, None] * directions
        return scan._replace(measured_points=measured_points.astype(np.float32), compute_directions=get_directions)

    def _cast(
        self, snapshot: SceneSnapshot, num_threads: int, search_spheres: SearchSpheres | None
    ) -> tuple[SensorScan, RayHits]:
        """Cast the rays, or return the stored result if nothing moves."""
        if self._static_scan is not None:
            return self._static_scan
        max_selected_share = 0.9  # with more rays than this, the selection does not pay off
        tiles, ego_hit_range_m, is_cast = self.tiles, self.ego_hit_range_m, None
        # A ray that is not cast at the time of the frame starts at another position.
        can_omit_rays = bool(ego_hit_range_m) and self._ray_times is None and not self._is_static
        if search_spheres is not None and can_omit_rays:
            masks = self._select_rays(search_spheres)
            is_needed = np.concatenate(masks)
            if np.count_nonzero(is_needed) <= max_selected_share * len(self.ray_pixel_indices):
                is_cast = is_needed
                tiles = tuple(tile.select(mask) for tile, mask in zip(tiles, masks, strict=True))
                pairs = zip(ego_hit_range_m, masks, strict=True)
                ego_hit_range_m = tuple(range_m[mask] for range_m, mask in pairs)
        scan = snapshot.scan(
            self.vehicle_T_sensor,
            tiles,
            max_range_m=self.max_range_m,
            ego_hit_range_m=ego_hit_range_m,
            ray_times=self._ray_times,
            num_threads=num_threads,
        )
        if is_cast is not None:
            omitted_self_hits = int((np.concatenate(self.ego_hit_range_m)[~is_cast] <= self.max_range_m).sum())
            scan = scan._replace(
                ray_indices=np.flatnonzero(is_cast)[scan.ray_indices],
                num_rays=len(is_cast),
                num_omitted_rays=len(is_cast) - scan.num_rays,
                self_hits=scan.self_hits + omitted_self_hits,
            )
        elif self._has_ego_hits and self._ray_times is None:
            self._last_scan = snapshot, scan._replace(find_attributes=None, compute_directions=None)
        hits = RayHits(
            scan.ray_indices,
            scan.range_m,
            self.ray_pixel_indices,
            find_attributes=scan.find_attributes,
            weather=self.weather,
        )
        if self._is_static:
            self._static_scan = scan, hits
        return scan, hits

    def _select_rays(self, search_spheres: SearchSpheres) -> list[Bools]:
        """Select for each tile the rays that must be cast, (n,); a beam has either all of its rays or none."""
        masks = [search_spheres.find_rays_through(tile, self.vehicle_T_sensor) for tile in self.tiles]
        beam_indices = self.sensor.compute_beam_indices()
        if beam_indices is None:
            return masks
        ray_beams = beam_indices.ravel()[self.ray_pixel_indices]
        is_in_beam = np.isin(ray_beams, ray_beams[np.concatenate(masks)])
        return np.split(is_in_beam, np.cumsum([len(mask) for mask in masks])[:-1])

    def compute_ray_ends(self, snapshot: SceneSnapshot) -> RayEnds:
        """Compute where each ray ends: at its first hit, which may be the ego vehicle, or at the maximum range.

        Args:
            snapshot: Scene at the time of the frame. If it was scanned just before, no ray is cast again.
        """
        if self._last_scan is not None and self._last_scan[0] is snapshot:
            scan = self._last_scan[1]
            range_m = np.minimum(np.concatenate(self.ego_hit_range_m), np.float32(self.max_range_m))
            is_hit = np.zeros(len(range_m), dtype=bool)
            range_m[scan.ray_indices], is_hit[scan.ray_indices] = scan.range_m, True
            return RayEnds(range_m, is_hit)
        outlines = snapshot.compute_outlines(self.vehicle_T_sensor[:3, 3])
        ego_ranges_m: Sequence[Float32 | None] = self.ego_hit_range_m or [None] * len(self.tiles)
        tile_ranges_m, tile_masks = [], []
        for tile, ego_m in zip(self.tiles, ego_ranges_m, strict=True):
            limit_m = np.full(tile.directions.shape[1], self.max_range_m, dtype=np.float32)
            _, hits, _ = snapshot.cast(self.vehicle_T_sensor, tile, limit_m, outlines, ego_m)
            tile_ranges_m.append(hits.range_m)
            tile_masks.append((hits.body_indices >= 0) & (hits.body_indices != snapshot.ego_index))
        return RayEnds(np.concatenate(tile_ranges_m), np.concatenate(tile_masks))


def compute_ray_times(sensor: Sensor, tiles: Sequence[Tile], ray_pixel_indices: Int64) -> list[RayTimes] | None:
    """Compute the times at which the rays of each tile are cast.

    Args:
        sensor: Sensor.
        tiles: Its rays.
        ray_pixel_indices: (rays,) pixel of each ray, see `compute_ray_pixel_indices`.

    Returns:
        Times of each tile; None if all rays are cast at the time of the frame.
    """
    times_s = sensor.compute_ray_times_s()
    if times_s is None:
        return None
    tile_ends = np.cumsum([tile.directions.shape[1] for tile in tiles])
    tile_times_s = np.split(times_s.ravel()[ray_pixel_indices], tile_ends[:-1])
    return [RayTimes(*np.unique(ray_times_s, return_inverse=True)) for ray_times_s in tile_times_s]


def count_self_hits(sensor: Sensor, ego_mesh: Mesh) -> tuple[int, int]:
    """Count the rays of a sensor that hit the body of its vehicle, within the range of the sensor in clear weather.

    Args:
        sensor: Sensor.
        ego_mesh: Body in the vehicle frame.

    Returns:
        Number of rays that hit the body, and number of rays of the sensor.

    Raises:
        ValueError: The rays do not fit into the memory.
    """
    check_memory_fits(
        f"{sensor.num_rays:,} rays of sensor {sensor.name!r}", BYTES_PER_RAY * sensor.num_rays, "use fewer rays"
    )
    caster, vehicle_T_sensor = RayCaster([ego_mesh]), sensor.mount.to_matrix()
    self_hits = num_rays = 0
    for tile in split_into_tiles(sensor.compute_directions()):
        range_m = compute_hit_ranges_m(caster, vehicle_T_sensor, tile, sensor.max_range_m)
        self_hits += int(np.isfinite(range_m).sum())
        num_rays += len(range_m)
    return self_hits, num_rays


def describe_self_hits(sensors: Sequence[Sensor], ego_mesh: Mesh) -> str:
    """Describe in one sentence how many rays of each sensor hit its vehicle; empty if none does.

    Args:
        sensors: Sensors of a rig.
        ego_mesh: Body of the vehicle in the vehicle frame.

    Example:
        >>> from torchcover.simulation import Rig, Scenario
        >>> describe_self_hits(Rig.load("kitti").sensors, Scenario.load("courtyard").build_ego_mesh())
        'Rays that end on the own vehicle: velodyne 32,130 of 138,240 (23.2%).'
    """
    shares = []
    for sensor in sensors:
        self_hits, num_rays = count_self_hits(sensor, ego_mesh)
        if self_hits:
            shares.append(f"{sensor.name} {self_hits:,} of {num_rays:,} ({self_hits / num_rays:.1%})")
    return f"Rays that end on the own vehicle: {', '.join(shares)}." if shares else ""


class Visibility(NamedTuple):
    """Visibility of N points from a position.

    Args:
        is_visible: (N,) True for points that nothing occludes.
        self_hits: Number of points that the ego vehicle occludes.
        num_body_casts: Number of pairs of a ray and a moving body that were cast.
    """

    is_visible: Bools
    self_hits: int
    num_body_casts: int


def compute_visibility(
    snapshot: SceneSnapshot, position_m: Float64, targets_m: Float32, *, num_threads: int = 1
) -> Visibility:
    """Test which points are visible from a position; the result does not depend on the number of threads.

    Args:
        snapshot: Scene at the time of the frame.
        position_m: (3,) position in the vehicle frame.
        targets_m: (N, 3) points in the vehicle frame, slightly above their surface, so that it does not occlude them.
        num_threads: Number of threads.
    """
    rays_per_tile = 8192  # of neighboring directions, so that a tile is narrow; fixed, whatever the threads
    vehicle_T_position, outlines = build_transform(np.eye(3), position_m), snapshot.compute_outlines(position_m)
    offset_m = targets_m.T - position_m[:, None]
    distance_m = np.linalg.norm(offset_m, axis=0)
    # A point at the position itself is visible in any direction.
    offset_m[0, distance_m == 0] = 1.0
    directions = offset_m / np.where(distance_m == 0, 1.0, distance_m)
    limit_m = (distance_m * (1 - RANGE_ROUNDING)).astype(np.float32)
    order = _sort_by_direction(directions)

    def cast_tile(start: int) -> tuple[Int64, Int32, int]:
        rays = order[start : start + rays_per_tile]
        tile = _build_tile(directions[:, rays])
        _, hits, num_casts = snapshot.cast(vehicle_T_position, tile, limit_m[rays], outlines)
        return rays, hits.body_indices, num_casts

    occluder = np.full(len(targets_m), -1, dtype=np.int32)
    num_body_casts = 0
    for rays, body_indices, num_casts in run_in_threads(num_threads, cast_tile, range(0, len(order), rays_per_tile)):
        occluder[rays] = body_indices
        num_body_casts += num_casts
    self_hits = int(np.count_nonzero(occluder == snapshot.ego_index))
    return Visibility(occluder < 0, self_hits, num_body_casts)


def _sort_by_direction(directions: Float64) -> Int64:
    """Compute an order of (3, n) directions in which the directions of a block are close to each other."""
    by_azimuth = np.argsort(np.arctan2(directions[1], directions[0]))
    num_sectors = max(1, round(np.sqrt(len(by_azimuth)) / BLOCK_SIZE))
    sectors = np.arange(len(by_azimuth)) * num_sectors // max(len(by_azimuth), 1)
    # Sines of elevations differ by less than 4, so that the sector is the first sort key.
    return by_azimuth[np.argsort(4.0 * sectors + directions[2, by_azimuth])]


def _build_tile(directions: Float64) -> Tile:
    """Build a tile whose blocks are consecutive directions of (3, n); the last block repeats its last ray."""
    num_rays = directions.shape[1]
    rays_per_block = BLOCK_SIZE**2
    blocks = np.minimum(np.arange(-(-num_rays // rays_per_block) * rays_per_block), num_rays - 1)
    blocks = blocks.reshape(-1, rays_per_block)
    float_directions = directions.astype(np.float32)
    block_directions = float_directions.take(blocks, axis=1)
    lower = block_directions.min(axis=2).astype(np.float64)
    upper = block_directions.max(axis=2).astype(np.float64)
    # The cone is the whole sphere: bodies are only culled by block.
    return Tile(float_directions, np.array([1.0, 0.0, 0.0]), np.pi, blocks, lower, upper)
