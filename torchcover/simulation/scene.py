"""A world as geometry that rays can be cast at."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import Box, invert, transform
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import Tile
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.world import Actor, World

# Bodies are numbered: the ego, then the actors in their order, then everything else.
EGO = 0
MISS = -1

# Angles between float32 directions are off by less than this, in radians.
ROUNDING = 1e-5

Matrix = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]


class Scan(NamedTuple):
    """What one sensor saw: `points` (N, 3) float32 in the vehicle frame, and how many rays went where."""

    points: Float32
    rays: int
    self_hits: int


class Solid(NamedTuple):
    """The geometry of one kind of body in its own frame, and a ball around it."""

    caster: RayCaster
    centre_m: Matrix
    radius_m: float

    @property
    def reach_m(self) -> float:
        """Distance from the origin of the frame that no vertex exceeds."""
        return float(np.linalg.norm(self.centre_m)) + self.radius_m


class Part(NamedTuple):
    """A caster placed at one instant, with a ball around it in the vehicle frame.

    `numbers` names the bodies of the caster, and ends with MISS, which the index -1 of a miss picks.
    """

    caster: RayCaster
    vehicle_T_part: Matrix
    numbers: Int32
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
        bodies = list(enumerate((world.ego, *world.actors)))
        self._moving = [(number, actor) for number, actor in bodies if actor.trajectory.moves]
        self._solids = {id(actor.mesh): _solid(actor.mesh) for _, actor in self._moving}
        # (steps, moving bodies, 3): where they are, to find out at once which are near.
        times_s = world.time_step_s * np.arange(world.steps, dtype=np.float64)
        tracks = [actor.trajectory.positions_at(times_s) for _, actor in self._moving]
        self._positions_m = np.stack(tracks, axis=1) if tracks else np.empty((world.steps, 0, 3))
        # Subtracted in float64: world coordinates may be of UTM size. Where the ego rests, this frame is its own.
        self._world_T_local = world.ego.trajectory.at(0.0)
        self._static = self._build_static([body for body in bodies if not body[1].trajectory.moves])

    def _build_static(self, resting: list[tuple[int, Actor]]) -> Part:
        local_T_world = invert(self._world_T_local)
        meshes = [actor.mesh.moved(local_T_world @ actor.trajectory.at(0.0)) for _, actor in resting]
        meshes += [mesh.moved(local_T_world) for mesh in self._world.static]
        something_else = len(self._world.actors) + 1
        numbers = [number for number, _ in resting] + [something_else] * len(self._world.static)
        return Part(RayCaster(meshes), np.eye(4), np.array([*numbers, MISS], np.int32), np.zeros(3), np.inf)

    def at(self, step: int, within_m: float = np.inf) -> "Instant":
        """Place everything for one step.

        Args:
            step: Number of time steps since the start of the world.
            within_m: Moving bodies whose origin is farther from the vehicle than this and their size are left out.

        Returns:
            The `Instant`, which sensors can scan.
        """
        time_s = step * self._world.time_step_s
        world_T_vehicle = self._world.ego.trajectory.at(time_s)
        vehicle_T_world = invert(world_T_vehicle)
        distance_m = np.linalg.norm(self._positions_m[step] - world_T_vehicle[:3, 3], axis=1)
        parts = [
            self._place(number, actor, vehicle_T_world @ actor.trajectory.at(time_s))
            for (number, actor), distance in zip(self._moving, distance_m, strict=True)
            if distance < within_m + self._solids[id(actor.mesh)].reach_m
        ]
        parts.append(self._static._replace(vehicle_T_part=vehicle_T_world @ self._world_T_local))
        return Instant(tuple(parts))

    def _place(self, number: int, actor: Actor, vehicle_T_actor: Matrix) -> Part:
        solid = self._solids[id(actor.mesh)]
        centre_m = transform(vehicle_T_actor, solid.centre_m[None])[0]
        return Part(solid.caster, vehicle_T_actor, np.array([number, MISS], np.int32), centre_m, solid.radius_m)


@dataclass(frozen=True, eq=False)
class Instant:
    """A scene at one time.

    Args:
        parts: What moves, placed in the vehicle frame; then what never moves.
    """

    parts: tuple[Part, ...]

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
        return Scan(np.concatenate(points, axis=1).T.copy(), rays, sum(self_hits))

    def _scan_tile(
        self, vehicle_T_sensor: Matrix, tile: Tile, min_range_m: float, max_range_m: float
    ) -> tuple[Float32, int]:
        origin_m = vehicle_T_sensor[:3, 3]
        directions = _rotate(vehicle_T_sensor[:3, :3], tile.directions)
        axis = vehicle_T_sensor[:3, :3] @ tile.axis
        range_m = np.full(directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)
        body = np.full(directions.shape[1], MISS, dtype=np.int32)
        for part in self.parts:
            rays = _rays_towards(part, origin_m, directions, axis, tile.half_angle, max_range_m)
            if rays is not None:
                _cast(part, origin_m, directions, rays, range_m, body)
        seen = np.flatnonzero((body > EGO) & (range_m >= min_range_m))
        points = origin_m.astype(np.float32)[:, None] + range_m[seen] * directions[:, seen]
        return points, int(np.count_nonzero(body == EGO))


def _rays_towards(
    part: Part, origin_m: Matrix, directions: Float32, axis: Matrix, half_angle: float, max_range_m: float
) -> slice | NDArray[np.int64] | None:
    """Which rays of a cone may hit a part: all (a slice), some, or none."""
    way_m = part.centre_m - origin_m
    distance_m = float(np.linalg.norm(way_m))
    if distance_m <= part.radius_m:
        return slice(None)
    towards = way_m / distance_m
    opening = float(np.arcsin(part.radius_m / distance_m))
    angle = float(np.arccos(np.clip(towards @ axis, -1.0, 1.0)))
    if distance_m - part.radius_m > max_range_m or angle > half_angle + opening + ROUNDING:
        return None
    x, y, z = directions
    cosine = towards[0] * x + towards[1] * y + towards[2] * z
    rays = np.flatnonzero(cosine > np.cos(opening + ROUNDING))
    return rays if len(rays) else None


def _cast(
    part: Part,
    origin_m: Matrix,
    directions: Float32,
    rays: slice | NDArray[np.int64],
    range_m: Float32,
    body: Int32,
) -> None:
    """Cast some rays at one part; shorten `range_m` and set `body` in place where they hit."""
    part_T_vehicle = invert(part.vehicle_T_part)
    towards = _rotate(part_T_vehicle[:3, :3], directions[:, rays])
    hits = part.caster.cast(transform(part_T_vehicle, origin_m[None])[0], towards, range_m[rays])
    numbers = part.numbers[hits.body]
    range_m[rays] = hits.range_m
    body[rays] = np.where(numbers == MISS, body[rays], numbers)


def _rotate(rotation: Matrix, directions: Float32) -> Float32:
    if np.array_equal(rotation, np.eye(3)):
        return directions
    # Written out: the rounding of a matrix product depends on how a BLAS splits it.
    x, y, z = directions
    rotated = np.empty_like(directions)
    for axis, (rx, ry, rz) in enumerate(rotation.astype(np.float32)):
        np.multiply(x, rx, out=rotated[axis])
        rotated[axis] += ry * y
        rotated[axis] += rz * z
    return rotated


def _solid(mesh: Mesh) -> Solid:
    box = Box.around(mesh.vertices_m)
    centre_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    radius_m = float(np.linalg.norm(mesh.vertices_m - centre_m, axis=1).max())
    return Solid(RayCaster([mesh]), centre_m, radius_m)
