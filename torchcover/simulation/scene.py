"""A world as geometry that rays can be cast at."""

from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, find_overlaps, invert
from torchcover.geometry.arrays import Bools, Float32, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import interpolate_poses
from torchcover.simulation.instant import Instant, encloses
from torchcover.simulation.local_ground import LocalGround, ground_under, level_faces, looks_down
from torchcover.simulation.memory import check_fits
from torchcover.simulation.moving import Moving, Solids
from torchcover.simulation.patches import Bounds, outward_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import Tile, rotate
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.surface import AboveGround, SceneSurface, bounds_along
from torchcover.simulation.sweep import SAMPLES, Poses
from torchcover.simulation.world import Actor, World

# Three float64, and the copies that are made on the way to them.
BYTES_PER_POSITION = 96
# Of what never moves, as rays are cast at it.
BYTES_PER_FACE = 300
# Of the ground, so many places under the ego are looked at.
GROUND_LOOKS = 64
# About as many as a search looks at in a world.
INSTANTS_KEPT = 4


class Scene:
    """The geometry of a world, built once; `at` places what moves.

    What never moves is one ray casting scene. A body that moves has a scene of its own kind, which it may share with
    those of other worlds, in its own frame, which is never built again: only the rays that point at the body are cast
    at it. An ego that rests belongs to what never moves.
    """

    def __init__(self, world: World, solids: Solids | None = None, device: str | None = None) -> None:
        self.world = world
        self.ego_box = BoundingBox.from_points(world.ego.mesh.vertices_m)
        bodies = (world.ego, *world.objects)
        self._resting: list[Actor] = []
        self._moving: list[Actor] = []
        for actor in bodies:
            (self._moving if actor.trajectory.is_moving else self._resting).append(actor)
        self._solids = Solids() if solids is None else solids
        # (steps, bodies, 3): where they are, to find out at once which are near; NaN, so never near, if absent.
        check_fits(
            f"{world.steps:,} time steps of {len(bodies):,} bodies",
            BYTES_PER_POSITION * world.steps * len(bodies),
            "shorten the duration, or make the time steps longer",
        )
        times_s = world.time_step_s * np.arange(world.steps, dtype=np.float64)
        tracks = [actor.trajectory.interpolate_positions_m(times_s) for actor in self._resting + self._moving]
        self._positions_m = np.stack(tracks, axis=1)
        self._reach_m = np.array([self._solids.of(actor.mesh).reach_m for actor in self._resting + self._moving])
        # Subtracted in float64: world coordinates may be of UTM size. Where the ego rests, this frame is its own.
        self._world_T_local = world.ego.trajectory.interpolate(0.0)
        local_T_world = invert(self._world_T_local)
        self._local_T_resting = [local_T_world @ actor.trajectory.interpolate(0.0) for actor in self._resting]
        resting = [actor.mesh.moved(pose) for actor, pose in zip(self._resting, self._local_T_resting, strict=True)]
        scenery = self._scenery()
        self._static = RayCaster(resting + scenery, device)
        self._faces = sum(len(mesh.faces) for mesh in resting + scenery)
        self._surfaces: dict[tuple[float | str, ...], SceneSurface] = {}
        self._instants: dict[tuple[int, float], Instant] = {}

    def _scenery(self) -> list[Mesh]:
        return [mesh.moved(invert(self._world_T_local)) for mesh in self.world.static]

    @cached_property
    def ground(self) -> LocalGround:
        """The ground of the world; what is level and connected with that under the ego, if the world does not say."""
        faces = zip(self.world.static, self.is_ground, strict=True)
        meshes = [Mesh(mesh.vertices_m, mesh.faces[mask]) for mesh, mask in faces]
        return LocalGround(meshes, self._world_T_local[:3, 3])

    @cached_property
    def is_ground(self) -> Sequence[Bools]:
        """For each static mesh (F,) which of its faces are ground."""
        static, known = self.world.static, self.world.ground
        if known is None:
            looks = np.unique(np.linspace(0, self.world.steps - 1, GROUND_LOOKS).astype(np.int64))
            times_s = self.world.time_step_s * looks.astype(np.float64)
            return ground_under(static, self.world.ego.trajectory.interpolate_positions_m(times_s))
        return [
            level_faces(mesh, outward) if number in known else np.zeros(len(mesh.faces), dtype=bool)
            for number, (mesh, outward) in enumerate(zip(static, self._outward, strict=True))
        ]

    @cached_property
    def _outward(self) -> Sequence[Bools]:
        """For each static mesh what `outward_faces` says of it."""
        return [outward_faces(mesh) for mesh in self.world.static]

    def surface(self, lower_m: Matrix, upper_m: Matrix, heights_m: tuple[float, float] | None = None) -> SceneSurface:
        """The surface of everything but the ego, for questions about a box that the vehicle carries along.

        It is cut when first asked for, once for each box. `heights_m` are the lowest and highest above the local ground
        that are asked about in it; all if not given.
        """
        box = (*lower_m.tolist(), *upper_m.tolist(), *(heights_m or ()))
        if box not in self._surfaces:
            ego, step_s = self.world.ego, self.world.time_step_s
            poses = ego.trajectory.interpolate_many(step_s * np.arange(self.world.steps, dtype=np.float64))
            bounds = bounds_along(invert(self._world_T_local) @ poses, Bounds(lower_m[None], upper_m[None]))
            objects = self.world.objects
            number = {id(actor): k for k, actor in enumerate(objects)}
            self._surfaces[box] = SceneSurface(
                self._scenery(),
                [self._solids.of(actor.mesh).patches for actor in objects],
                {
                    number[id(actor)]: pose
                    for actor, pose in zip(self._resting, self._local_T_resting, strict=True)
                    if actor is not ego
                },
                {self._first_moving + k: number[id(actor)] for k, actor in enumerate(self._moving) if actor is not ego},
                bounds,
                self._outward,
                None if heights_m is None else self._above_ground(*heights_m),
                self.coincident,
            )
        return self._surfaces[box]

    def surface_without_ground(self, lower_m: Matrix, upper_m: Matrix) -> SceneSurface:
        """Cut the scenery that has no ground at or below it, as `surface` does, such as a pit that is no ground."""
        box = (*lower_m.tolist(), *upper_m.tolist(), "without ground")
        if box not in self._surfaces:
            ego, step_s = self.world.ego, self.world.time_step_s
            poses = ego.trajectory.interpolate_many(step_s * np.arange(self.world.steps, dtype=np.float64))
            bounds = bounds_along(invert(self._world_T_local) @ poses, Bounds(lower_m[None], upper_m[None]))
            above, scenery = self._above_ground(-np.inf, np.inf)._replace(is_below=True), self._scenery()
            self._surfaces[box] = SceneSurface(scenery, [], {}, {}, bounds, self._outward, above, self.coincident)
        return self._surfaces[box]

    @cached_property
    def coincident(self) -> Sequence[Int32]:
        """For each static mesh (F,) numbers of its faces that coincide with others among all that never move, or -1."""
        first = sum(len(actor.mesh.faces) for actor in self._resting)
        ends = first + np.cumsum([len(mask) for mask in self.world.coincident])
        return [
            np.where(mask, np.arange(end - len(mask), end), -1).astype(np.int32)
            for mask, end in zip(self.world.coincident, ends.tolist(), strict=True)
        ]

    def _above_ground(self, lowest_m: float, highest_m: float) -> AboveGround:
        squares_T_static = self._world_T_local.copy()
        squares_T_static[:3, 3] -= self.ground.origin_m
        down = [outward & looks_down(mesh) for mesh, outward in zip(self.world.static, self._outward, strict=True)]
        return AboveGround(self.ground.squares, squares_T_static, self.is_ground, down, lowest_m, highest_m)

    def at(self, step: int, within_m: float = np.inf) -> "Instant":
        """Place everything for one step; the last few are kept, for other rigs that look at them.

        Moving bodies whose origin is farther from the vehicle than `within_m` and their size are left out.

        ValueError: the bounding box of an actor overlaps that of the ego.
        """
        if (step, within_m) not in self._instants:
            if len(self._instants) == INSTANTS_KEPT:
                del self._instants[next(iter(self._instants))]
            self._instants[step, within_m] = self._at(step, within_m)
        return self._instants[step, within_m]

    def forget_instants(self) -> None:
        """Let it go at once, when nobody else needs it: they know it, and it them, until a collection of garbage."""
        self._instants.clear()

    def _at(self, step: int, within_m: float) -> "Instant":
        time_s = step * self.world.time_step_s
        world_T_vehicle = self.world.ego.trajectory.interpolate(time_s)
        vehicle_T_world = invert(world_T_vehicle)
        distance_m = self._distance_m(step, world_T_vehicle)
        self._check_overlap(time_s, vehicle_T_world, distance_m)
        resting, first = len(self._resting), self._first_moving
        near = np.flatnonzero(distance_m[resting:] < within_m)
        solids = [self._solids.of(self._moving[k].mesh) for k in near.tolist()]
        moving = Moving.placed(solids, self._parts(near, vehicle_T_world, time_s), first + near)
        # Either list of bodies begins with the ego.
        if self.world.ego.trajectory.is_moving:
            static_T_vehicle, ego = invert(self._world_T_local) @ world_T_vehicle, first
        else:
            static_T_vehicle, ego = np.eye(4), 0
        out_of_range = len(self._moving) - len(moving)
        motion = partial(self._motion, near, time_s)
        return Instant(self._static, static_T_vehicle, moving, ego, out_of_range, self.ground, world_T_vehicle, motion)

    def check_apart(self, steps: Int64) -> None:
        """Refuse time steps at which an actor overlaps the ego, as `at` does for one."""
        ego = self.world.ego
        bodies = self._resting + self._moving
        ego_m = self._positions_m[:, [body is ego for body in bodies]]
        reach_m = self._reach_m + self._solids.of(ego.mesh).reach_m
        near = (np.linalg.norm(self._positions_m - ego_m, axis=2) < reach_m).sum(axis=1) > 1  # one is the ego itself
        for step in steps[near[steps]].tolist():
            time_s = step * self.world.time_step_s
            world_T_vehicle = ego.trajectory.interpolate(time_s)
            self._check_overlap(time_s, invert(world_T_vehicle), self._distance_m(step, world_T_vehicle))

    def _distance_m(self, step: int, world_T_vehicle: Matrix) -> Matrix:
        """(bodies,) how far each is from the vehicle at least."""
        return np.asarray(np.linalg.norm(self._positions_m[step] - world_T_vehicle[:3, 3], axis=1) - self._reach_m)

    @property
    def _first_moving(self) -> int:
        return len(self._resting) + len(self.world.static)

    @property
    def bytes(self) -> int:
        """How much memory it takes, about, without the solids that it shares with others."""
        return (
            self._positions_m.nbytes
            + sum(actor.trajectory.num_bytes for actor in self._moving)
            + BYTES_PER_FACE * self._faces
            + sum(surface.bytes for surface in self._surfaces.values())
        )

    @property
    def moves(self) -> bool:
        """Whether anything ever does: the ego or an actor."""
        return bool(self._moving)

    @property
    def knows_self_hits(self) -> bool:
        """Whether sensors fixed to the ego need not be cast at it at every step; see `own_m`."""
        return self.world.ego.trajectory.is_moving or not self.moves

    def own_m(
        self, vehicle_T_sensor: Matrix, tiles: Sequence[Tile], *, max_range_m: float = np.inf
    ) -> tuple[Float32, ...]:
        """Where the ego's own body ends the rays of a sensor that is fixed to it, for `Instant.scan`.

        For each tile (n,) metres, infinite where the ego is not hit within the range. Nothing at all for an ego that
        rests: it is part of what never moves, at which the rays are cast anyway.
        """
        if not self.world.ego.trajectory.is_moving:
            return ()
        ego = self._solids.of(self.world.ego.mesh).caster
        return tuple(ends_at(ego, vehicle_T_sensor, tile, max_range_m) for tile in tiles)

    def encloses(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies inside the ego's body, so that no ray gets out."""
        return encloses(self._solids.of(self.world.ego.mesh).caster, position_m)

    def _check_overlap(self, time_s: float, vehicle_T_world: Matrix, distance_m: Matrix) -> None:
        bodies = self._resting + self._moving
        ego_reach_m = self._solids.of(self.world.ego.mesh).reach_m
        for k in np.flatnonzero(distance_m < ego_reach_m).tolist():
            if bodies[k] is self.world.ego:
                continue
            vehicle_T_actor = vehicle_T_world @ bodies[k].trajectory.interpolate(time_s)
            box = self._solids.of(bodies[k].mesh).box
            if find_overlaps(box, vehicle_T_actor[None], self.ego_box.corners_m)[0]:
                raise ValueError(
                    f"actor {bodies[k].name!r} overlaps the ego at t = {time_s:g} s (their bounding boxes do); "
                    "change one of the trajectories"
                )

    def _parts(self, numbers: NDArray[np.intp], vehicle_T_world: Matrix, time_s: float) -> Matrix:
        """(P, 4, 4) where some of the bodies that move are at a time."""
        actors = [self._moving[k] for k in numbers.tolist()]
        vehicle_T_part: Matrix = vehicle_T_world @ interpolate_poses([actor.trajectory for actor in actors], time_s)
        # The ego is where it is, to the last bit: what a sensor sees of it is the same at every step.
        vehicle_T_part[[actor is self.world.ego for actor in actors]] = np.eye(4)
        return vehicle_T_part

    def _motion(
        self, numbers: NDArray[np.intp], time_s: float, first_s: float, last_s: float
    ) -> tuple[Matrix, list[Poses]]:
        """Where the ego and some of the bodies that move are from one time to another, both after `time_s`.

        What was before the world began, or comes after it, is as long within it, and told from that.
        """
        world, found = self.world, list[Poses]()
        end_s = max(world.time_step_s * (world.steps - 1) - time_s, 0.0)
        begin_s = max(min(first_s, end_s - (last_s - first_s)), -time_s)
        samples_s = np.linspace(begin_s, min(begin_s + last_s - first_s, end_s), SAMPLES)
        for each_s in (time_s + samples_s).tolist():
            world_T_vehicle = world.ego.trajectory.interpolate(each_s)
            # As in `at`, to the bit.
            moves = world.ego.trajectory.is_moving
            static_T_vehicle = invert(self._world_T_local) @ world_T_vehicle if moves else np.eye(4)
            found.append(Poses(static_T_vehicle, self._parts(numbers, invert(world_T_vehicle), each_s)))
        return samples_s, found


def ends_at(caster: RayCaster, vehicle_T_sensor: Matrix, tile: Tile, max_range_m: float) -> Float32:
    """(n,) where bodies in the vehicle frame end the rays of a tile; infinite where they do not."""
    directions = rotate(vehicle_T_sensor[:3, :3], tile.directions)
    limit_m = np.full(directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)
    hits = caster.cast(vehicle_T_sensor[:3, 3], directions, limit_m)
    return np.where(hits.body >= 0, hits.range_m, np.float32(np.inf))
