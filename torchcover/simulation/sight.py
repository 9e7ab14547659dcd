"""What is seen from a place on the ego: by the rays of a sensor, or of given points."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry import build_transform
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.bodies import Body
from torchcover.simulation.instant import SceneSnapshot, SensorScan, run_in_threads
from torchcover.simulation.memory import BYTES_PER_RAY, check_memory_fits
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import BLOCK, SearchSpheres, Tile, compute_ray_pixel_indices, rotate, split_into_tiles
from torchcover.simulation.returns import CLEAR, Weather
from torchcover.simulation.scene import SceneGeometry, compute_hit_ranges_m
from torchcover.simulation.sensor import RayHits, ScanTimes, Sensor, SensorNoise
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sweep import RayTimes

# Rays in a tile: of neighbours all, so that a tile is narrow. A constant, so that nothing depends on threads.
TILE_RAYS = 8192
# If more of the rays than this have to be cast, all are, for which they need not be sorted out.
MOST_RAYS = 0.9
# A ray ends before its target by this share of its length, which float32 leaves open.
SHORTER = 1e-6


class RayEnds(NamedTuple):
    """Where n rays end, in the order of the tiles: `range_m` (n,); `is_hit` (n,) whether on something but the ego."""

    range_m: Float32
    is_hit: Bools


class MountedSensor:
    """What a sensor of a rig sees, whose rays are cast `max_range_m` far (`Scenario.reach_m`) through some weather.

    Its place on the ego is fixed, so the rays that the ego's own body ends are the same at every step, as are those
    that the housings of others and the `bodies` of its rig end: these are not cast at again. Where nothing moves at
    all, the rays are cast once for every step.
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
        timing: ScanTimes | None = getattr(sensor, "scan", None)
        if timing and timing.period_s > scene.scene.time_step_s:
            raise ValueError(
                f"sensor {sensor.name!r}: a scan of period_s {timing.period_s:g} is longer than the time step of the "
                f"scenario, {scene.scene.time_step_s:g} s; shorten its period, or make the time steps longer"
            )
        self._times = compute_ray_times(sensor, self.tiles, self.ray_pixel_indices) if scene.has_motion else None
        self._is_raw = bool(self._times and timing and not timing.deskewed)
        self.ego_hit_range_m = scene.compute_ego_hit_ranges_m(
            self.vehicle_T_sensor, self.tiles, max_range_m=max_range_m
        )
        self._knows_ego = bool(self.ego_hit_range_m)
        housings = [
            mesh.transform(other.mount.to_matrix())
            for other in other_sensors
            for body in other.housing
            for mesh in body.build_meshes()
        ]
        housings += [mesh for body in rig_bodies for mesh in body.build_meshes()]
        if housings:
            caster = RayCaster(housings)
            ends_m = [compute_hit_ranges_m(caster, self.vehicle_T_sensor, tile, max_range_m) for tile in self.tiles]
            ego_m = self.ego_hit_range_m or ends_m
            self.ego_hit_range_m = tuple(np.minimum(*both) for both in zip(ends_m, ego_m, strict=True))
        self._at_rest = not scene.has_motion
        self._resting: tuple[SensorScan, RayHits] | None = None
        self._scanned: tuple[SceneSnapshot, SensorScan] | None = None

    def scan(
        self,
        snapshot: SceneSnapshot,
        noise: SensorNoise,
        *,
        num_threads: int = 1,
        search_spheres: SearchSpheres | None = None,
    ) -> SensorScan:
        """What it makes of what its rays hit at one time of the scene; no number depends on `num_threads`.

        Rays that hit nothing `search_spheres` what is asked about need not be cast. The points within are the same: each ray
        has random numbers of its own in `noise` then.
        """
        scan, hits = self._cast(snapshot, num_threads, search_spheres)
        if self._is_raw:
            scan = self._as_cast(scan)
        hit, error_m = self.sensor.measure(hits, noise)
        ways = scan.compute_directions() if error_m is not None and scan.compute_directions else None
        scan = scan._replace(find_attributes=None, compute_directions=None)
        if hit is not None:
            scan = scan.select(hit)
        if error_m is None or ways is None:
            return scan
        landed, ways = (
            scan.points if scan.measured_points is None else scan.measured_points,
            ways if hit is None else ways[hit],
        )
        landed = (landed + error_m[:, None] * ways).astype(np.float32)
        return scan._replace(range_error_m=error_m.astype(np.float32), measured_points=landed)

    def _as_cast(self, scan: SensorScan) -> SensorScan:
        """The scan with points that land in the vehicle frame of the time at which their ray was cast."""
        towards = np.concatenate([tile.directions for tile in self.tiles], axis=1).take(scan.ray_indices, axis=1)
        ways = rotate(self.vehicle_T_sensor[:3, :3], towards).T
        landed = self.vehicle_T_sensor[:3, 3] + scan.range_m[:, None] * ways
        return scan._replace(measured_points=landed.astype(np.float32), compute_directions=lambda: ways)

    def _cast(self, instant: SceneSnapshot, threads: int, within: SearchSpheres | None) -> tuple[SensorScan, RayHits]:
        if self._resting is not None:
            return self._resting
        tiles, own_m, cast = self.tiles, self.ego_hit_range_m, None
        # A ray that is cast at another time than that of the frame starts elsewhere.
        may_spare = bool(own_m) and self._times is None and not self._at_rest
        met = self._met(within) if within is not None and may_spare else []
        if met and np.count_nonzero(np.concatenate(met)) <= MOST_RAYS * len(self.ray_pixel_indices):
            tiles = tuple(tile.select(some) for tile, some in zip(tiles, met, strict=True))
            own_m, cast = tuple(ends_m[some] for ends_m, some in zip(own_m, met, strict=True)), np.concatenate(met)
        scan = instant.scan(
            self.vehicle_T_sensor,
            tiles,
            max_range_m=self.max_range_m,
            ego_hit_range_m=own_m,
            ray_times=self._times,
            num_threads=threads,
        )
        if cast is not None:
            ended = int((np.concatenate(self.ego_hit_range_m)[~cast] <= self.max_range_m).sum())
            scan = scan._replace(
                ray_indices=np.flatnonzero(cast)[scan.ray_indices],
                num_rays=len(cast),
                num_omitted_rays=len(cast) - scan.num_rays,
                self_hits=scan.self_hits + ended,
            )
        elif self._knows_ego and self._times is None:
            self._scanned = instant, scan._replace(find_attributes=None, compute_directions=None)
        hits = RayHits(
            scan.ray_indices,
            scan.range_m,
            self.ray_pixel_indices,
            find_attributes=scan.find_attributes,
            weather=self.weather,
        )
        if self._at_rest:
            self._resting = scan, hits
        return scan, hits

    def _met(self, within: SearchSpheres) -> list[Bools]:
        """For each tile (n,) which of its rays have to be cast: all of a beam, or none."""
        met = [within.find_rays_through(tile, self.vehicle_T_sensor) for tile in self.tiles]
        beams = self.sensor.compute_beam_indices()
        if beams is None:
            return met
        beam = beams.ravel()[self.ray_pixel_indices]
        all_of_beams = np.isin(beam, beam[np.concatenate(met)])
        return np.split(all_of_beams, np.cumsum([len(each) for each in met])[:-1])

    def compute_ray_ends(self, snapshot: SceneSnapshot) -> RayEnds:
        """Where each of its rays ends: at what it hits first, the ego's body included, or at its reach."""
        if self._scanned is not None and self._scanned[0] is snapshot:  # nothing is cast twice
            scan, ends_m = (
                self._scanned[1],
                np.minimum(np.concatenate(self.ego_hit_range_m), np.float32(self.max_range_m)),
            )
            met = np.zeros(len(ends_m), dtype=bool)
            ends_m[scan.ray_indices], met[scan.ray_indices] = scan.range_m, True
            return RayEnds(ends_m, met)
        bodies, own = (
            snapshot.compute_outlines(self.vehicle_T_sensor[:3, 3]),
            self.ego_hit_range_m or [None] * len(self.tiles),
        )
        range_m, is_hit = [], []
        for tile, own_m in zip(self.tiles, own, strict=True):
            limit_m = np.full(tile.directions.shape[1], self.max_range_m, dtype=np.float32)
            _, hits, _ = snapshot.cast(self.vehicle_T_sensor, tile, limit_m, bodies, own_m)
            range_m.append(hits.range_m)
            is_hit.append((hits.body_indices >= 0) & (hits.body_indices != snapshot.ego_index))
        return RayEnds(np.concatenate(range_m), np.concatenate(is_hit))


def compute_ray_times(sensor: Sensor, tiles: Sequence[Tile], ray_pixel_indices: Int64) -> list[RayTimes] | None:
    """When the rays of each tile of a sensor are cast; None if all are at once."""
    times_s = sensor.compute_ray_times_s()
    if times_s is None:
        return None
    ends = np.cumsum([tile.directions.shape[1] for tile in tiles])
    of_tiles = np.split(times_s.ravel()[ray_pixel_indices], ends[:-1])
    return [RayTimes(*np.unique(of_tile, return_inverse=True)) for of_tile in of_tiles]


def count_self_hits(sensor: Sensor, ego_mesh: Mesh) -> tuple[int, int]:
    """Count the rays of a sensor that end on the body of its own vehicle.

    Args:
        sensor: The sensor; only its own rays and range count, whatever the weather.
        ego_mesh: The body in the vehicle frame.

    Returns:
        How many rays end on it, and how many rays the sensor has.
    """
    check_memory_fits(
        f"{sensor.num_rays:,} rays of sensor {sensor.name!r}", BYTES_PER_RAY * sensor.num_rays, "use fewer rays"
    )
    caster, vehicle_T_sensor, tiles = (
        RayCaster([ego_mesh]),
        sensor.mount.to_matrix(),
        split_into_tiles(sensor.compute_directions()),
    )
    ends_m = [compute_hit_ranges_m(caster, vehicle_T_sensor, tile, sensor.max_range_m) for tile in tiles]
    return sum(int(np.isfinite(end_m).sum()) for end_m in ends_m), sum(len(end_m) for end_m in ends_m)


def describe_self_hits(sensors: Sequence[Sensor], ego_mesh: Mesh) -> str:
    """Say how many rays of each sensor end on its own vehicle, in one sentence; empty if none does.

    Example:
        >>> from torchcover.simulation import Rig, Scenario
        >>> describe_self_hits(Rig.load("kitti").sensors, Scenario.load("courtyard").build_ego_mesh())
        'Rays that end on the own vehicle: velodyne 32,130 of 138,240 (23.2%).'
    """
    shares = []
    for sensor in sensors:
        self_hits, rays = count_self_hits(sensor, ego_mesh)
        if self_hits:
            shares.append(f"{sensor.name} {self_hits:,} of {rays:,} ({self_hits / rays:.1%})")
    return f"Rays that end on the own vehicle: {', '.join(shares)}." if shares else ""


class Visibility(NamedTuple):
    """What a place sees of N points: `is_visible` (N,); `self_hits` were hidden by the ego; the rest as in `SensorScan`."""

    is_visible: Bools
    self_hits: int
    num_body_casts: int


def compute_visibility(
    snapshot: SceneSnapshot, position_m: Float64, targets_m: Float32, *, num_threads: int = 1
) -> Visibility:
    """Cast a ray from a (3,) place to each of (N, 3) targets; one is seen if nothing lies in between.

    Targets lie a little above their surface, lest it hides them. The result does not depend on the number of threads.
    """
    vehicle_T_place, bodies = build_transform(np.eye(3), position_m), snapshot.compute_outlines(position_m)
    way_m = targets_m.T - position_m[:, None]
    distance_m = np.linalg.norm(way_m, axis=0)
    # A point at the place itself is seen in any direction.
    way_m[0, distance_m == 0] = 1.0
    directions = way_m / np.where(distance_m == 0, 1.0, distance_m)
    limit_m = (distance_m * (1 - SHORTER)).astype(np.float32)
    order = _neighbours(directions)

    def cast(first: int) -> tuple[Int64, Int32, int]:
        rays = order[first : first + TILE_RAYS]
        tile = _tile(directions[:, rays])
        _, hits, casts = snapshot.cast(vehicle_T_place, tile, limit_m[rays], bodies)
        return rays, hits.body_indices, casts

    hidden_by, tiles = np.full(len(targets_m), -1, dtype=np.int32), range(0, len(order), TILE_RAYS)
    answers = run_in_threads(num_threads, cast, tiles)
    for rays, body, _ in answers:
        hidden_by[rays] = body
    self_hits = int(np.count_nonzero(hidden_by == snapshot.ego_index))
    return Visibility(hidden_by < 0, self_hits, sum(casts for _, _, casts in answers))


def _neighbours(directions: Float64) -> Int64:
    """An order in which as many directions as a block of a tile has are close to each other."""
    by_azimuth = np.argsort(np.arctan2(directions[1], directions[0]))
    sectors = max(1, round(np.sqrt(len(by_azimuth)) / BLOCK))
    sector = np.arange(len(by_azimuth)) * sectors // max(len(by_azimuth), 1)
    # The sine of an elevation is never as much as 4 from another.
    return by_azimuth[np.argsort(4.0 * sector + directions[2, by_azimuth])]


def _tile(directions: Float64) -> Tile:
    """The tile of (3, n) directions; those that follow each other are a block, the last one repeats its last ray."""
    rays = directions.shape[1]
    blocks = np.minimum(np.arange(-(-rays // BLOCK**2) * BLOCK**2), rays - 1).reshape(-1, BLOCK**2)
    rounded = directions.astype(np.float32)
    in_blocks = rounded.take(blocks, axis=1)
    lower, upper = in_blocks.min(axis=2).astype(np.float64), in_blocks.max(axis=2).astype(np.float64)
    # They go all around: what they may meet is looked for by the block.
    return Tile(rounded, np.array([1.0, 0.0, 0.0]), np.pi, blocks, lower, upper)
