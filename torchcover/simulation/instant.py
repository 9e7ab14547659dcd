"""A scene at one time, which sensors scan."""

import math
import operator
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.simulation.local_ground import LocalGround
from torchcover.simulation.moving import MovingBodies
from torchcover.simulation.raycaster import HitAttributes, Hits, RayCaster, cast_from_vehicle
from torchcover.simulation.rays import (
    TILE_ROWS,
    BoxOutlines,
    Tile,
    compute_outlines,
    compute_unit_directions,
    rotate,
    split_into_tiles,
)
from torchcover.simulation.sweep import BodyPoses, MotionSampler, RayTimes, ScanMotion, sample_no_motion

Result = TypeVar("Result")
# Directions all around, to find out whether rays get out of a body.
ALL_AROUND = compute_unit_directions(np.linspace(-85.0, 85.0, 12)[:, None], np.arange(0.0, 360.0, 30.0)[None])
ALL_AROUND_RAYS = ALL_AROUND.reshape(3, -1).astype(np.float32)
# Sweeps begin and end at whole ones of these.
WHOLE_S = 0.005

NO_GROUND = LocalGround([], np.zeros(3))


class SensorScan(NamedTuple):
    """What one sensor saw: `points` (N, 3) float32 in the vehicle frame, where they are, and how many rays went where.

    `ray_indices` (N,) says which ray, counted over the tiles, made each point, and `range_m` (N,) how far it went. `num_body_casts`
    is the number of pairs of a ray and a moving body at which it was cast: the other pairs could not meet. `find_attributes`
    finds out what they hit, for who asks, and `compute_directions` the (N, 3) directions of their rays in the vehicle frame; both are
    None of what a sensor has measured. `range_error_m` (N,) is how far off it measured them, along their rays, None if they
    are exact, and `measured_points` (N, 3) where that is, None if where they are. `num_omitted_rays` were not cast, for nothing
    was asked about where they point.
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
        """Some of its points."""
        names = ("points", "ray_indices", "range_m", "measured_points")
        given = {name: value[indices] for name in names if (value := getattr(self, name)) is not None}
        return self._replace(**given)


@dataclass(frozen=True, eq=False)
class SceneSnapshot:
    """A scene at one time. Its bodies are numbered: what never moves, then what moves and is near.

    `num_out_of_range` others that move are not near, or not there. `world_T_vehicle` is in the frame of the `ground`, and
    `sample_motion` where everything is from a time before this one to another.
    """

    static_caster: RayCaster
    static_T_vehicle: Matrix
    moving_bodies: MovingBodies
    ego_index: int
    num_out_of_range: int = 0
    ground: LocalGround = NO_GROUND
    world_T_vehicle: Matrix = field(default_factory=lambda: np.eye(4))
    sample_motion: MotionSampler = sample_no_motion
    _sweeps: dict[tuple[float, float], ScanMotion | None] = field(default_factory=dict)

    def compute_heights_m(self, points_m: NDArray[np.floating]) -> Float32:
        """(N,) heights above the local ground of (N, 3) points of the vehicle frame; see `LocalGround.heights_m`."""
        return self.ground.compute_heights_m(points_m, self.world_T_vehicle)

    def find_first_faces(self, points_m: Float32, normals: Float32, max_distance_m: float) -> Int64:
        """Which face that never moves lies at (N, 3) points of such faces, or above them: (N,) numbers, -1 for none.

        It is within so much above, towards the (N, 3) `normals` of length one, and counted as `RayCaster.faces_met`
        does.
        """
        starts_m = transform_points(self.static_T_vehicle, points_m + np.float32(max_distance_m) * normals)
        towards = -(normals @ self.static_T_vehicle[:3, :3].T)
        return self.static_caster.find_first_faces(starts_m, towards, 2 * max_distance_m)

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
        """Cast the rays of one sensor. The ego occludes, but its own points are left out unless they are wanted.

        Points are in the order of `tiles`, its rays from `split_into_tiles`, whatever the number of threads. `ego_hit_range_m` is where
        the ego's body, which is not cast at again then, ends the rays of each tile, from `Scene.own_m`; `ray_times` when
        the rays of each tile are cast, all at once if not given.
        """
        origin_m = vehicle_T_sensor[:3, 3]
        sweep = self._sweep(ray_times) if ray_times else None
        bodies = self.compute_outlines(origin_m) if sweep is None else sweep.compute_outlines(origin_m)

        def scan_tile(
            tile: Tile, own_m: Float32 | None, when: RayTimes | None
        ) -> tuple[Float32, Float32, Bools, Float32, Float32, Hits, int]:
            limit_m = _limit(tile, max_range_m)
            if sweep is None or when is None:
                directions, hits, casts = self.cast(vehicle_T_sensor, tile, limit_m, bodies, own_m)
                seen = self._seen(hits, keep_ego_points)
                points = _points(origin_m.astype(np.float32), directions, hits.range_m, seen)
                return points, points, seen, hits.range_m[seen], directions, hits, casts
            swept = sweep.cast(vehicle_T_sensor, tile, when, limit_m, bodies, self.ego_index, own_m)
            hits, seen = swept.hits, self._seen(swept.hits, keep_ego_points)
            points = landed = _points(swept.starts_m, swept.directions, hits.range_m, seen)
            if len(swept.moving_ray_indices):
                points = landed.copy()
                points[np.cumsum(seen)[swept.moving_ray_indices] - 1] = swept.moving_points_m
            return points, landed, seen, hits.range_m[seen], swept.directions, hits, swept.num_body_casts

        own: Sequence[Float32 | None] = ego_hit_range_m or [None] * len(tiles)
        whens: Sequence[RayTimes | None] = ray_times or [None] * len(tiles)
        scans = run_in_threads(num_threads, scan_tile, tiles, own, whens)
        points, landed, seen, range_m, directions, hits, casts = zip(*scans, strict=True)

        def towards(tile: int) -> Float32:
            return directions[tile].take(np.flatnonzero(seen[tile]), axis=1)  # type: ignore[no-any-return]

        def struck() -> HitAttributes:
            parts = [
                self.compute_hit_attributes(of.body_indices[there], of.triangle_indices[there], towards(tile))
                for tile, (of, there) in enumerate(zip(hits, seen, strict=True))
            ]
            return HitAttributes._make(np.concatenate(column) for column in zip(*parts, strict=True))

        return SensorScan(
            points=np.concatenate(points),
            ray_indices=np.flatnonzero(np.concatenate(seen)),
            range_m=np.concatenate(range_m),
            num_rays=sum(tile.directions.shape[1] for tile in tiles),
            self_hits=sum(int(np.count_nonzero(of.body_indices == self.ego_index)) for of in hits),
            num_body_casts=sum(casts),
            find_attributes=struck,
            compute_directions=lambda: np.concatenate([towards(tile) for tile in range(len(tiles))], axis=1).T,
            measured_points=np.concatenate(landed) if any(map(operator.is_not, landed, points)) else None,
        )

    def _seen(self, hits: Hits, ego_points: bool) -> Bools:
        return np.asarray((hits.body_indices >= 0) & (ego_points | (hits.body_indices != self.ego_index)))

    def _sweep(self, times: Sequence[RayTimes]) -> ScanMotion | None:
        """How everything moves meanwhile; for sensors that take as long it is the same."""
        edges_s = [edge for each in times if len(each.times_s) for edge in (each.times_s[0], each.times_s[-1])]
        begin, end = min(edges_s, default=0.0) / WHOLE_S, max(edges_s, default=0.0) / WHOLE_S
        ends_s = WHOLE_S * math.floor(begin), WHOLE_S * math.ceil(end)
        if ends_s not in self._sweeps:
            now = BodyPoses(self.static_T_vehicle, self.moving_bodies.vehicle_T_part)
            self._sweeps[ends_s] = ScanMotion.from_poses(
                self.static_caster, now, self.moving_bodies, *self.sample_motion(*ends_s)
            )
        return self._sweeps[ends_s]

    def compute_hit_attributes(
        self, body_indices: Int32, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """What the rays hit that ended on some faces, as `RayCaster.struck`; directions in the vehicle frame."""
        moved = np.flatnonzero(body_indices >= self.static_caster.num_bodies)
        # What moves is looked up as any face of what does not, and then put right.
        rests = (
            np.where(body_indices < self.static_caster.num_bodies, triangle_indices, 0)
            if len(moved)
            else triangle_indices
        )
        towards = rotate(self.static_T_vehicle[:3, :3], directions)
        found = self.static_caster.compute_hit_attributes(
            np.minimum(body_indices, self.static_caster.num_bodies - 1), rests, towards
        )
        if len(moved):
            part = np.searchsorted(self.moving_bodies.body_indices, body_indices[moved])
            others = self.moving_bodies.compute_hit_attributes(part, triangle_indices[moved], directions[:, moved])
            found.cos_incidence[moved], found.material_indices[moved] = others.cos_incidence, others.material_indices
        return found._replace(body_indices=body_indices, triangle_indices=triangle_indices)

    def render_range_image(
        self, vehicle_T_sensor: Matrix, directions: Float64, *, max_range_m: float = np.inf
    ) -> Float32:
        """(rows, columns) metres along (3, rows, columns) directions to what they hit, the ego's body included.

        Infinite where a ray hits nothing within the range, NaN where there is no ray.
        """
        image = np.full(directions.shape[1:], np.nan, dtype=np.float32)
        bodies = self.compute_outlines(vehicle_T_sensor[:3, 3])
        for top in range(0, len(image), TILE_ROWS):
            rows = slice(top, top + TILE_ROWS)
            (tile,) = split_into_tiles(directions[:, rows], max_columns=directions.shape[2])
            _, hits, _ = self.cast(vehicle_T_sensor, tile, _limit(tile, max_range_m), bodies)
            image[rows][~np.isnan(directions[0, rows])] = np.where(hits.body_indices >= 0, hits.range_m, np.inf)
        return image

    def is_occupied(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies below the ground or inside a wall or another body than the ego."""
        if self.ground.is_below_ground(position_m, self.world_T_vehicle):
            return True
        inside = self.static_caster.find_enclosing_bodies(transform_points(self.static_T_vehicle, position_m[None])[0])
        if (inside != self.ego_index).any():
            return True
        moving = self.moving_bodies
        near = np.linalg.norm(moving.center_m - position_m, axis=1) <= moving.radius_m
        asked = np.flatnonzero(near & (moving.body_indices != self.ego_index)).tolist()
        places_m = moving.transform_to_parts_m(position_m) if asked else position_m[None]
        return any(len(moving.casters[k].find_enclosing_bodies(places_m[k])) for k in asked)

    def is_on_surface(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies exactly on the ground, or on a face of what else never moves."""
        touched = self.static_caster.find_touched_bodies(transform_points(self.static_T_vehicle, position_m[None])[0])
        return bool((touched != self.ego_index).any())

    def compute_outlines(self, origin_m: Matrix) -> BoxOutlines:
        """The bodies that move, as they look from a place."""
        return compute_outlines(self.moving_bodies.box_corners_m, origin_m)

    def cast(
        self,
        vehicle_T_sensor: Matrix,
        tile: Tile,
        limit_m: Float32,
        outlines: BoxOutlines,
        ego_hit_range_m: Float32 | None = None,
    ) -> tuple[Float32, Hits, int]:
        """Cast n rays of a tile: (3, n) directions in the vehicle frame, hits, and how many were cast at what moves.

        Each ends at its (n,) `limit_m`, which is finite, and at (n,) `ego_hit_range_m`, the ego's body, if that is known;
        `outlines` are those that move as they look from the sensor, from `outlines`.
        """
        origin_m, vehicle_R_sensor = vehicle_T_sensor[:3, 3], vehicle_T_sensor[:3, :3]
        directions = rotate(vehicle_R_sensor, tile.directions)
        if ego_hit_range_m is not None:
            limit_m = np.minimum(limit_m, ego_hit_range_m)
        hits = cast_from_vehicle(self.static_caster, self.static_T_vehicle, origin_m, directions, limit_m)
        if ego_hit_range_m is not None:
            hits.body_indices[(hits.body_indices < 0) & (ego_hit_range_m <= limit_m)] = self.ego_index
        leaving_out = None if ego_hit_range_m is None else self.ego_index
        met, casts = self.moving_bodies.find_body_hits(
            origin_m, vehicle_R_sensor, tile, directions, hits.range_m, outlines, excluded_body=leaving_out
        )
        self.moving_bodies.update_nearest_hits(hits, met)
        return directions, hits, casts


def run_in_threads(num_threads: int, function: Callable[..., Result], *columns: Iterable[Any]) -> list[Result]:
    """What a function makes of each row of some columns, in their order, on so many threads."""
    rows = list(zip(*columns, strict=True))
    if num_threads <= 1 or len(rows) <= 1:
        return [function(*row) for row in rows]
    # A pool each time: threads do not survive the fork that makes a DataLoader worker.
    with ThreadPoolExecutor(num_threads) as pool:
        return list(pool.map(function, *zip(*rows, strict=True)))


def is_enclosed(caster: RayCaster, position_m: Matrix) -> bool:
    """Whether a (3,) place lies inside of what can be cast at, so that no ray gets out."""
    limit_m = np.full(ALL_AROUND_RAYS.shape[1], np.inf, dtype=np.float32)
    return bool((caster.cast(position_m, ALL_AROUND_RAYS, limit_m).body_indices >= 0).all())


def _limit(tile: Tile, max_range_m: float) -> Float32:
    return np.full(tile.directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)


def _points(origin_m: Float32, directions: Float32, range_m: Float32, seen: Bools) -> Float32:
    """(K, 3) where the rays that saw something ended, which start at a (3,) place or at (3, n) of their own."""
    points = np.empty((np.count_nonzero(seen), 3), dtype=np.float32)
    for axis in range(3):
        coordinate = directions[axis] * range_m
        coordinate += origin_m[axis]
        points[:, axis] = coordinate[seen]
    return points
