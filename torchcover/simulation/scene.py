"""A world as geometry that rays can be cast at."""

from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, find_overlaps, invert
from torchcover.geometry.arrays import Bools, Float32, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import interpolate_poses
from torchcover.simulation.instant import SceneSnapshot, is_enclosed
from torchcover.simulation.local_ground import LocalGround, find_downward_faces, find_ground_faces, find_level_faces
from torchcover.simulation.memory import check_memory_fits
from torchcover.simulation.moving import BodyGeometryCache, MovingBodies
from torchcover.simulation.patches import UprightBoxes, find_outward_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import Tile, rotate
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.surface import HeightFilter, SceneSurface, compute_swept_bounds
from torchcover.simulation.sweep import SAMPLES, BodyPoses
from torchcover.simulation.world import Actor, Scene

# Three float64, and the copies that are made on the way to them.
BYTES_PER_POSITION = 96
# Of what never moves, as rays are cast at it.
BYTES_PER_FACE = 300
# Of the ground, so many places under the ego are looked at.
GROUND_LOOKS = 64
# About as many as a search looks at in a world.
INSTANTS_KEPT = 4


class SceneGeometry:
    """The geometry of a world, built once; `get_snapshot` places what moves.

    What never moves is one ray casting scene. A body that moves has a scene of its own kind, which it may share with
    those of other worlds, in its own frame, which is never built again: only the rays that point at the body are cast
    at it. An ego that rests belongs to what never moves.
    """

    def __init__(
        self, scene: Scene, geometry_cache: BodyGeometryCache | None = None, device: str | None = None
    ) -> None:
        self.scene = scene
        self.ego_box = BoundingBox.from_points(scene.ego.mesh.vertices_m)
        bodies = (scene.ego, *scene.objects)
        self._resting: list[Actor] = []
        self._moving: list[Actor] = []
        for actor in bodies:
            (self._moving if actor.trajectory.is_moving else self._resting).append(actor)
        self._solids = BodyGeometryCache() if geometry_cache is None else geometry_cache
        # (steps, bodies, 3): where they are, to find out at once which are near; NaN, so never near, if absent.
        check_memory_fits(
            f"{scene.num_time_steps:,} time steps of {len(bodies):,} bodies",
            BYTES_PER_POSITION * scene.num_time_steps * len(bodies),
            "shorten the duration, or make the time steps longer",
        )
        times_s = scene.time_step_s * np.arange(scene.num_time_steps, dtype=np.float64)
        tracks = [actor.trajectory.interpolate_positions_m(times_s) for actor in self._resting + self._moving]
        self._positions_m = np.stack(tracks, axis=1)
        self._reach_m = np.array(
            [self._solids.get_geometry(actor.mesh).reach_m for actor in self._resting + self._moving]
        )
        # Subtracted in float64: world coordinates may be of UTM size. Where the ego rests, this frame is its own.
        self._world_T_local = scene.ego.trajectory.interpolate(0.0)
        local_T_world = invert(self._world_T_local)
        self._local_T_resting = [local_T_world @ actor.trajectory.interpolate(0.0) for actor in self._resting]
        resting = [actor.mesh.transform(pose) for actor, pose in zip(self._resting, self._local_T_resting, strict=True)]
        scenery = self._scenery()
        self._static = RayCaster(resting + scenery, device)
        self._faces = sum(len(mesh.faces) for mesh in resting + scenery)
        self._surfaces: dict[tuple[float | str, ...], SceneSurface] = {}
        self._instants: dict[tuple[int, float], SceneSnapshot] = {}

    def _scenery(self) -> list[Mesh]:
        return [mesh.transform(invert(self._world_T_local)) for mesh in self.scene.static_meshes]

    @cached_property
    def ground(self) -> LocalGround:
        """The ground of the world; what is level and connected with that under the ego, if the world does not say."""
        faces = zip(self.scene.static_meshes, self.ground_masks, strict=True)
        meshes = [Mesh(mesh.vertices_m, mesh.faces[mask]) for mesh, mask in faces]
        return LocalGround(meshes, self._world_T_local[:3, 3])

    @cached_property
    def ground_masks(self) -> Sequence[Bools]:
        """For each static mesh (F,) which of its faces are ground."""
        static, known = self.scene.static_meshes, self.scene.ground_mesh_indices
        if known is None:
            looks = np.unique(np.linspace(0, self.scene.num_time_steps - 1, GROUND_LOOKS).astype(np.int64))
            times_s = self.scene.time_step_s * looks.astype(np.float64)
            return find_ground_faces(static, self.scene.ego.trajectory.interpolate_positions_m(times_s))
        return [
            find_level_faces(mesh, outward) if number in known else np.zeros(len(mesh.faces), dtype=bool)
            for number, (mesh, outward) in enumerate(zip(static, self._outward, strict=True))
        ]

    @cached_property
    def _outward(self) -> Sequence[Bools]:
        """For each static mesh what `find_outward_faces` says of it."""
        return [find_outward_faces(mesh) for mesh in self.scene.static_meshes]

    def get_surface(
        self, lower_m: Matrix, upper_m: Matrix, height_range_m: tuple[float, float] | None = None
    ) -> SceneSurface:
        """The surface of everything but the ego, for questions about a box that the vehicle carries along.

        It is cut when first asked for, once for each box. `height_range_m` are the lowest and highest above the local ground
        that are asked about in it; all if not given.
        """
        box = (*lower_m.tolist(), *upper_m.tolist(), *(height_range_m or ()))
        if box not in self._surfaces:
            ego, step_s = self.scene.ego, self.scene.time_step_s
            poses = ego.trajectory.interpolate_many(step_s * np.arange(self.scene.num_time_steps, dtype=np.float64))
            bounds = compute_swept_bounds(
                invert(self._world_T_local) @ poses, UprightBoxes(lower_m[None], upper_m[None])
            )
            objects = self.scene.objects
            number = {id(actor): k for k, actor in enumerate(objects)}
            self._surfaces[box] = SceneSurface(
                self._scenery(),
                [self._solids.get_geometry(actor.mesh).patches for actor in objects],
                {
                    number[id(actor)]: pose
                    for actor, pose in zip(self._resting, self._local_T_resting, strict=True)
                    if actor is not ego
                },
                {self._first_moving + k: number[id(actor)] for k, actor in enumerate(self._moving) if actor is not ego},
                bounds,
                self._outward,
                None if height_range_m is None else self._above_ground(*height_range_m),
                self.coincident_faces,
            )
        return self._surfaces[box]

    def get_surface_without_ground(self, lower_m: Matrix, upper_m: Matrix) -> SceneSurface:
        """Cut the scenery that has no ground at or below it, as `surface` does, such as a pit that is no ground."""
        box = (*lower_m.tolist(), *upper_m.tolist(), "without ground")
        if box not in self._surfaces:
            ego, step_s = self.scene.ego, self.scene.time_step_s
            poses = ego.trajectory.interpolate_many(step_s * np.arange(self.scene.num_time_steps, dtype=np.float64))
            bounds = compute_swept_bounds(
                invert(self._world_T_local) @ poses, UprightBoxes(lower_m[None], upper_m[None])
            )
            above, scenery = self._above_ground(-np.inf, np.inf)._replace(is_without_ground=True), self._scenery()
            self._surfaces[box] = SceneSurface(scenery, [], {}, {}, bounds, self._outward, above, self.coincident_faces)
        return self._surfaces[box]

    @cached_property
    def coincident_faces(self) -> Sequence[Int32]:
        """For each static mesh (F,) numbers of its faces that coincide with others among all that never move, or -1."""
        first = sum(len(actor.mesh.faces) for actor in self._resting)
        ends = first + np.cumsum([len(mask) for mask in self.scene.coincident_masks])
        return [
            np.where(mask, np.arange(end - len(mask), end), -1).astype(np.int32)
            for mask, end in zip(self.scene.coincident_masks, ends.tolist(), strict=True)
        ]

    def _above_ground(self, lowest_m: float, highest_m: float) -> HeightFilter:
        squares_T_static = self._world_T_local.copy()
        squares_T_static[:3, 3] -= self.ground.origin_m
        down = [
            outward & find_downward_faces(mesh)
            for mesh, outward in zip(self.scene.static_meshes, self._outward, strict=True)
        ]
        return HeightFilter(self.ground.height_pyramid, squares_T_static, self.ground_masks, down, lowest_m, highest_m)

    def get_snapshot(self, time_step_index: int, max_distance_m: float = np.inf) -> "SceneSnapshot":
        """Place everything for one step; the last few are kept, for other rigs that look at them.

        Moving bodies whose origin is farther from the vehicle than `max_distance_m` and their size are left out.

        ValueError: the bounding box of an actor overlaps that of the ego.
        """
        if (time_step_index, max_distance_m) not in self._instants:
            if len(self._instants) == INSTANTS_KEPT:
                del self._instants[next(iter(self._instants))]
            self._instants[time_step_index, max_distance_m] = self._at(time_step_index, max_distance_m)
        return self._instants[time_step_index, max_distance_m]

    def clear_snapshots(self) -> None:
        """Let it go at once, when nobody else needs it: they know it, and it them, until a collection of garbage."""
        self._instants.clear()

    def _at(self, step: int, within_m: float) -> "SceneSnapshot":
        time_s = step * self.scene.time_step_s
        world_T_vehicle = self.scene.ego.trajectory.interpolate(time_s)
        vehicle_T_world = invert(world_T_vehicle)
        distance_m = self._distance_m(step, world_T_vehicle)
        self._check_overlap(time_s, vehicle_T_world, distance_m)
        resting, first = len(self._resting), self._first_moving
        near = np.flatnonzero(distance_m[resting:] < within_m)
        solids = [self._solids.get_geometry(self._moving[k].mesh) for k in near.tolist()]
        moving = MovingBodies.from_geometries(solids, self._parts(near, vehicle_T_world, time_s), first + near)
        # Either list of bodies begins with the ego.
        if self.scene.ego.trajectory.is_moving:
            static_T_vehicle, ego = invert(self._world_T_local) @ world_T_vehicle, first
        else:
            static_T_vehicle, ego = np.eye(4), 0
        out_of_range = len(self._moving) - len(moving)
        motion = partial(self._motion, near, time_s)
        return SceneSnapshot(
            self._static, static_T_vehicle, moving, ego, out_of_range, self.ground, world_T_vehicle, motion
        )

    def check_overlaps(self, time_step_indices: Int64) -> None:
        """Refuse time steps at which an actor overlaps the ego, as `at` does for one."""
        ego = self.scene.ego
        bodies = self._resting + self._moving
        ego_m = self._positions_m[:, [body is ego for body in bodies]]
        reach_m = self._reach_m + self._solids.get_geometry(ego.mesh).reach_m
        near = (np.linalg.norm(self._positions_m - ego_m, axis=2) < reach_m).sum(axis=1) > 1  # one is the ego itself
        for step in time_step_indices[near[time_step_indices]].tolist():
            time_s = step * self.scene.time_step_s
            world_T_vehicle = ego.trajectory.interpolate(time_s)
            self._check_overlap(time_s, invert(world_T_vehicle), self._distance_m(step, world_T_vehicle))

    def _distance_m(self, step: int, world_T_vehicle: Matrix) -> Matrix:
        """(bodies,) how far each is from the vehicle at least."""
        return np.asarray(np.linalg.norm(self._positions_m[step] - world_T_vehicle[:3, 3], axis=1) - self._reach_m)

    @property
    def _first_moving(self) -> int:
        return len(self._resting) + len(self.scene.static_meshes)

    @property
    def num_bytes(self) -> int:
        """How much memory it takes, about, without the solids that it shares with others."""
        return (
            self._positions_m.nbytes
            + sum(actor.trajectory.num_bytes for actor in self._moving)
            + BYTES_PER_FACE * self._faces
            + sum(surface.num_bytes for surface in self._surfaces.values())
        )

    @property
    def has_motion(self) -> bool:
        """Whether anything ever does: the ego or an actor."""
        return bool(self._moving)

    @property
    def has_constant_self_hits(self) -> bool:
        """Whether sensors fixed to the ego need not be cast at it at every step; see `own_m`."""
        return self.scene.ego.trajectory.is_moving or not self.has_motion

    def compute_ego_hit_ranges_m(
        self, vehicle_T_sensor: Matrix, tiles: Sequence[Tile], *, max_range_m: float = np.inf
    ) -> tuple[Float32, ...]:
        """Where the ego's own body ends the rays of a sensor that is fixed to it, for `Instant.scan`.

        For each tile (n,) metres, infinite where the ego is not hit within the range. Nothing at all for an ego that
        rests: it is part of what never moves, at which the rays are cast anyway.
        """
        if not self.scene.ego.trajectory.is_moving:
            return ()
        ego = self._solids.get_geometry(self.scene.ego.mesh).caster
        return tuple(compute_hit_ranges_m(ego, vehicle_T_sensor, tile, max_range_m) for tile in tiles)

    def is_inside_ego(self, position_m: Matrix) -> bool:
        """Whether a place in the vehicle frame lies inside the ego's body, so that no ray gets out."""
        return is_enclosed(self._solids.get_geometry(self.scene.ego.mesh).caster, position_m)

    def _check_overlap(self, time_s: float, vehicle_T_world: Matrix, distance_m: Matrix) -> None:
        bodies = self._resting + self._moving
        ego_reach_m = self._solids.get_geometry(self.scene.ego.mesh).reach_m
        for k in np.flatnonzero(distance_m < ego_reach_m).tolist():
            if bodies[k] is self.scene.ego:
                continue
            vehicle_T_actor = vehicle_T_world @ bodies[k].trajectory.interpolate(time_s)
            box = self._solids.get_geometry(bodies[k].mesh).bounding_box
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
        vehicle_T_part[[actor is self.scene.ego for actor in actors]] = np.eye(4)
        return vehicle_T_part

    def _motion(
        self, numbers: NDArray[np.intp], time_s: float, first_s: float, last_s: float
    ) -> tuple[Matrix, list[BodyPoses]]:
        """Where the ego and some of the bodies that move are from one time to another, both after `time_s`.

        What was before the world began, or comes after it, is as long within it, and told from that.
        """
        world, found = self.scene, list[BodyPoses]()
        end_s = max(world.time_step_s * (world.num_time_steps - 1) - time_s, 0.0)
        begin_s = max(min(first_s, end_s - (last_s - first_s)), -time_s)
        samples_s = np.linspace(begin_s, min(begin_s + last_s - first_s, end_s), SAMPLES)
        for each_s in (time_s + samples_s).tolist():
            world_T_vehicle = world.ego.trajectory.interpolate(each_s)
            # As in `at`, to the bit.
            moves = world.ego.trajectory.is_moving
            static_T_vehicle = invert(self._world_T_local) @ world_T_vehicle if moves else np.eye(4)
            found.append(BodyPoses(static_T_vehicle, self._parts(numbers, invert(world_T_vehicle), each_s)))
        return samples_s, found


def compute_hit_ranges_m(caster: RayCaster, vehicle_T_sensor: Matrix, tile: Tile, max_range_m: float) -> Float32:
    """(n,) where bodies in the vehicle frame end the rays of a tile; infinite where they do not."""
    directions = rotate(vehicle_T_sensor[:3, :3], tile.directions)
    limit_m = np.full(directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)
    hits = caster.cast(vehicle_T_sensor[:3, 3], directions, limit_m)
    return np.where(hits.body_indices >= 0, hits.range_m, np.float32(np.inf))
