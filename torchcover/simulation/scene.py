"""A world as geometry that rays can be cast at."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import Box, invert, overlap, transform
from torchcover.simulation.raycaster import Hits, RayCaster
from torchcover.simulation.rays import Tile, into_tiles, unit_directions
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.world import Actor, World

# Angles between float32 directions are off by less than this, in radians.
ROUNDING = 1e-5

# Directions all around, to find out whether a place lies inside a body.
ALL_AROUND = unit_directions(np.linspace(-85.0, 85.0, 12)[:, None], np.arange(0.0, 360.0, 30.0)[None])
ALL_AROUND_RAYS = ALL_AROUND.reshape(3, -1).astype(np.float32)
# Above the ground no ray meets the back of a face; below it, those that go up do.
BURIED_SHARE = 0.25

Matrix = NDArray[np.float64]
Float32 = NDArray[np.float32]


class Scan(NamedTuple):
    """What one sensor saw: `points` (N, 3) float32 in the vehicle frame, and how many rays went where."""

    points: Float32
    rays: int
    self_hits: int


class Solid(NamedTuple):
    """The geometry of one kind of body in its own frame, and a ball around it."""

    caster: RayCaster
    box: Box
    centre_m: Matrix
    radius_m: float

    @property
    def reach_m(self) -> float:
        """Distance from the origin of the frame that no vertex exceeds."""
        return float(np.linalg.norm(self.centre_m)) + self.radius_m


class Part(NamedTuple):
    """A solid placed at one instant, with a ball around it in the vehicle frame; `body` is its number."""

    caster: RayCaster
    part_T_vehicle: Matrix
    body: int
    centre_m: Matrix
    radius_m: float


class Scene:
    """The geometry of a world, built once; `at` places what moves.

    What never moves is one ray casting scene. A body that moves has a scene of its own kind, in its own frame, which
    is never built again: only the rays that point at the body are cast at it. An ego that rests belongs to what never
    moves.

    Args:
        world: Meshes, actors and the ego.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        self.ego_box = Box.around(world.ego.mesh.vertices_m)
        bodies = (world.ego, *world.actors)
        self._resting = [actor for actor in bodies if not actor.trajectory.moves]
        self._moving = [actor for actor in bodies if actor.trajectory.moves]
        # One solid for each mesh object, however many actors share it.
        self._solids = {id(mesh): _solid(mesh) for mesh in {id(actor.mesh): actor.mesh for actor in bodies}.values()}
        # (steps, bodies, 3): where they are, to find out at once which are near; NaN, so never near, if absent.
        times_s = world.time_step_s * np.arange(world.steps, dtype=np.float64)
        tracks = [actor.trajectory.positions_at(times_s) for actor in self._resting + self._moving]
        self._positions_m = np.stack(tracks, axis=1)
        self._reach_m = np.array([self._solids[id(actor.mesh)].reach_m for actor in self._resting + self._moving])
        # Subtracted in float64: world coordinates may be of UTM size. Where the ego rests, this frame is its own.
        self._world_T_local = world.ego.trajectory.at(0.0)
        self._static = RayCaster(self._static_meshes())

    def _static_meshes(self) -> list[Mesh]:
        local_T_world = invert(self._world_T_local)
        meshes = [actor.mesh.moved(local_T_world @ actor.trajectory.at(0.0)) for actor in self._resting]
        return meshes + [mesh.moved(local_T_world) for mesh in self._world.static]

    def at(self, step: int, within_m: float = np.inf) -> "Instant":
        """Place everything for one step.

        Args:
            step: Number of time steps since the start of the world.
            within_m: Moving bodies whose origin is farther from the vehicle than this and their size are left out.

        Returns:
            The `Instant`, which sensors can scan.

        Raises:
            ValueError: The bounding box of an actor overlaps that of the ego.
        """
        time_s = step * self._world.time_step_s
        world_T_vehicle = self._world.ego.trajectory.at(time_s)
        vehicle_T_world = invert(world_T_vehicle)
        distance_m = np.linalg.norm(self._positions_m[step] - world_T_vehicle[:3, 3], axis=1) - self._reach_m
        self._check_overlap(time_s, vehicle_T_world, distance_m)
        resting, first = len(self._resting), len(self._resting) + len(self._world.static)
        moving = tuple(
            self._place(first + k, self._moving[k], vehicle_T_world @ self._moving[k].trajectory.at(time_s))
            for k in np.flatnonzero(distance_m[resting:] < within_m).tolist()
        )
        # Either list of bodies begins with the ego.
        if self._world.ego.trajectory.moves:
            return Instant(self._static, invert(self._world_T_local) @ world_T_vehicle, moving, ego=first)
        return Instant(self._static, np.eye(4), moving, ego=0)

    def encloses(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies inside the ego's body, so that no ray gets out."""
        ego = self._solids[id(self._world.ego.mesh)].caster
        hits = ego.cast(position_m, ALL_AROUND_RAYS, np.full(ALL_AROUND_RAYS.shape[1], np.inf, dtype=np.float32))
        return bool((hits.body >= 0).all())

    def _check_overlap(self, time_s: float, vehicle_T_world: Matrix, distance_m: Matrix) -> None:
        bodies = self._resting + self._moving
        ego_reach_m = self._solids[id(self._world.ego.mesh)].reach_m
        for k in np.flatnonzero(distance_m < ego_reach_m).tolist():
            if bodies[k] is self._world.ego:
                continue
            vehicle_T_actor = vehicle_T_world @ bodies[k].trajectory.at(time_s)
            if overlap(self.ego_box, vehicle_T_actor, self._solids[id(bodies[k].mesh)].box):
                raise ValueError(
                    f"actor {bodies[k].name!r} overlaps the ego at t = {time_s:g} s (their bounding boxes do); "
                    "change one of the trajectories"
                )

    def _place(self, body: int, actor: Actor, vehicle_T_actor: Matrix) -> Part:
        solid = self._solids[id(actor.mesh)]
        centre_m = transform(vehicle_T_actor, solid.centre_m[None])[0]
        return Part(solid.caster, invert(vehicle_T_actor), body, centre_m, solid.radius_m)


@dataclass(frozen=True, eq=False)
class Instant:
    """A scene at one time. Its bodies are numbered: what never moves, then what moves.

    Args:
        static: What never moves.
        static_T_vehicle: From the vehicle frame to that of what never moves.
        moving: The bodies that move and are near.
        ego: Number of the ego.
    """

    static: RayCaster
    static_T_vehicle: Matrix
    moving: tuple[Part, ...]
    ego: int

    def scan(
        self,
        vehicle_T_sensor: Matrix,
        tiles: Sequence[Tile],
        *,
        min_range_m: float = 0.0,
        max_range_m: float = np.inf,
        threads: int = 1,
    ) -> Scan:
        """Cast the rays of one sensor. The ego occludes, but its own points are left out.

        Args:
            vehicle_T_sensor: (4, 4) pose of the sensor.
            tiles: Its rays, from `into_tiles`.
            min_range_m: Closer hits give no point; they hide what lies behind all the same.
            max_range_m: Farther hits give no point.
            threads: Number of threads; the result does not depend on it.

        Returns:
            `Scan(points, rays, self_hits)`, the points in the order of the tiles.
        """

        def scan_tile(tile: Tile) -> tuple[Float32, int]:
            return self._scan_tile(vehicle_T_sensor, tile, min_range_m, max_range_m)

        if threads <= 1 or len(tiles) <= 1:
            scans = [scan_tile(tile) for tile in tiles]
        else:
            # A pool for each scan: threads do not survive the fork that makes a DataLoader worker.
            with ThreadPoolExecutor(threads) as pool:
                scans = list(pool.map(scan_tile, tiles))
        points, self_hits = zip(*scans, strict=True)
        rays = sum(tile.directions.shape[1] for tile in tiles)
        return Scan(np.concatenate(points), rays, sum(self_hits))

    def range_image(
        self, vehicle_T_sensor: Matrix, directions: NDArray[np.float64], *, max_range_m: float = np.inf
    ) -> Float32:
        """Distance along the ray of every pixel, the ego's body included.

        Args:
            vehicle_T_sensor: (4, 4) pose of the frame of the directions.
            directions: (3, rows, columns) unit directions; NaN for a pixel that has no ray.
            max_range_m: Hits farther than this are none.

        Returns:
            (rows, columns) metres; infinite where a ray hits nothing, NaN where there is none.
        """
        (tile,) = into_tiles(directions, tile_rows=directions.shape[1], tile_columns=directions.shape[2])
        _, hits = self._cast_tile(vehicle_T_sensor, tile, max_range_m)
        image = np.full(directions.shape[1:], np.nan, dtype=np.float32)
        image[~np.isnan(directions[0])] = np.where(hits.body >= 0, hits.range_m, np.inf)
        return image

    def buried(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies below the ground or inside a wall or another body."""
        casters = [(self.static, self.static_T_vehicle)]
        casters += [(part.caster, part.part_T_vehicle) for part in self.moving]
        return any(
            caster.back_faces(transform(part_T_vehicle, position_m[None])[0], ALL_AROUND_RAYS).mean() > BURIED_SHARE
            for caster, part_T_vehicle in casters
        )

    def _scan_tile(
        self, vehicle_T_sensor: Matrix, tile: Tile, min_range_m: float, max_range_m: float
    ) -> tuple[Float32, int]:
        origin_m = vehicle_T_sensor[:3, 3]
        directions, hits = self._cast_tile(vehicle_T_sensor, tile, max_range_m)
        seen = (hits.body >= 0) & (hits.body != self.ego)
        if min_range_m > 0:
            seen &= hits.range_m >= min_range_m
        return _points(origin_m, directions, hits.range_m, seen), int(np.count_nonzero(hits.body == self.ego))

    def _cast_tile(self, vehicle_T_sensor: Matrix, tile: Tile, max_range_m: float) -> tuple[Float32, Hits]:
        """Directions in the vehicle frame, and their hits."""
        origin_m = vehicle_T_sensor[:3, 3]
        directions = _rotate(vehicle_T_sensor[:3, :3], tile.directions)
        axis = vehicle_T_sensor[:3, :3] @ tile.axis
        limit_m = np.full(directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)
        hits = _cast(self.static, self.static_T_vehicle, origin_m, directions, limit_m)
        for part in self.moving:
            rays = _rays_towards(part, origin_m, directions, axis, tile.half_angle, max_range_m)
            if len(rays):
                nearer = _cast(part.caster, part.part_T_vehicle, origin_m, directions[:, rays], hits.range_m[rays])
                hits.range_m[rays] = nearer.range_m
                hits.body[rays[nearer.body >= 0]] = part.body
        return directions, hits


def _points(origin_m: Matrix, directions: Float32, range_m: Float32, seen: NDArray[np.bool_]) -> Float32:
    """(K, 3) where the rays that saw something ended."""
    points = np.empty((np.count_nonzero(seen), 3), dtype=np.float32)
    for axis in range(3):
        coordinate = directions[axis] * range_m
        coordinate += np.float32(origin_m[axis])
        points[:, axis] = coordinate[seen]
    return points


def _rays_towards(
    part: Part, origin_m: Matrix, directions: Float32, axis: Matrix, half_angle: float, max_range_m: float
) -> NDArray[np.int64]:
    """Which rays of a cone may hit the ball around a part."""
    way_m = part.centre_m - origin_m
    distance_m = float(np.linalg.norm(way_m))
    if distance_m <= part.radius_m:
        return np.arange(directions.shape[1])
    towards = way_m / distance_m
    opening = float(np.arcsin(part.radius_m / distance_m))
    angle = float(np.arccos(np.clip(towards @ axis, -1.0, 1.0)))
    if distance_m - part.radius_m > max_range_m or angle > half_angle + opening + ROUNDING:
        return np.empty(0, dtype=np.int64)
    x, y, z = directions
    cosine = towards[0] * x + towards[1] * y + towards[2] * z
    return np.flatnonzero(cosine > np.cos(opening + ROUNDING))


def _cast(caster: RayCaster, part_T_vehicle: Matrix, origin_m: Matrix, directions: Float32, limit_m: Float32) -> Hits:
    """Cast rays of the vehicle frame at a caster in its own frame."""
    towards = _rotate(part_T_vehicle[:3, :3], directions)
    return caster.cast(transform(part_T_vehicle, origin_m[None])[0], towards, limit_m)


def _rotate(rotation: Matrix, directions: Float32) -> Float32:
    if np.array_equal(rotation, np.eye(3)):
        return directions
    rotated: Float32 = rotation.astype(np.float32) @ directions
    return rotated


def _solid(mesh: Mesh) -> Solid:
    box = Box.around(mesh.vertices_m)
    centre_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    radius_m = float(np.linalg.norm(mesh.vertices_m - centre_m, axis=1).max())
    return Solid(RayCaster([mesh]), box, centre_m, radius_m)
