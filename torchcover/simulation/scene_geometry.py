"""Geometry of a scene, built once, at which rays of all frames are cast."""

from collections.abc import Sequence
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, find_overlaps, invert
from torchcover.geometry.arrays import Bools, Float32, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import interpolate_poses
from torchcover.simulation.ground_faces import find_downward_faces, find_ground_faces, find_level_faces
from torchcover.simulation.local_ground import LocalGround
from torchcover.simulation.memory import check_memory_fits
from torchcover.simulation.moving_bodies import BodyGeometryCache, MovingBodies
from torchcover.simulation.patches import UprightBoxes, find_outward_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.rays import Tile, rotate
from torchcover.simulation.scan_motion import NUM_SAMPLES, BodyPoses
from torchcover.simulation.scene import Actor, Scene
from torchcover.simulation.scene_snapshot import SceneSnapshot, build_range_limits_m, is_enclosed
from torchcover.simulation.scene_surface import HeightFilter, SceneSurface, compute_swept_bounds
from torchcover.simulation.shapes import Mesh


class SceneGeometry:
    """Geometry of a scene; `get_snapshot` places the moving bodies of a frame.

    All static bodies are one ray casting scene. Each kind of moving body has a ray casting scene in its own frame that
    is built once and may be shared with other scenes; only the rays towards a body are cast at it. An ego vehicle at
    rest belongs to the static bodies.

    Args:
        scene: Scene.
        geometry_cache: Geometry of moving bodies that scenes share; None for a new cache.
        device: Warp device for the static bodies, see `RayCaster`.

    Raises:
        ValueError: The positions of all bodies at all time steps do not fit into the memory.
    """

    def __init__(
        self, scene: Scene, geometry_cache: BodyGeometryCache | None = None, device: str | None = None
    ) -> None:
        self.scene = scene
        self.ego_box = BoundingBox.from_points(scene.ego.mesh.vertices_m)
        self._static_actors: list[Actor] = []
        self._moving_actors: list[Actor] = []
        for actor in (scene.ego, *scene.objects):
            (self._moving_actors if actor.trajectory.is_moving else self._static_actors).append(actor)
        self._geometries = BodyGeometryCache() if geometry_cache is None else geometry_cache
        bodies = self._bodies
        bytes_per_position = 96  # three float64, and temporary copies of them
        check_memory_fits(
            f"{scene.num_time_steps:,} time steps of {len(bodies):,} bodies",
            bytes_per_position * scene.num_time_steps * len(bodies),
            "shorten the duration, or make the time steps longer",
        )
        times_s = scene.time_step_s * np.arange(scene.num_time_steps, dtype=np.float64)
        # (time steps, bodies, 3), to find bodies in range quickly; NaN, hence out of range, while a body is absent.
        self._positions_m = np.stack([actor.trajectory.interpolate_positions_m(times_s) for actor in bodies], axis=1)
        self._reach_m = np.array([self._geometries.get_geometry(actor.mesh).reach_m for actor in bodies])
        # World coordinates may be as large as UTM coordinates, so that they are reduced in float64. The local frame is
        # the vehicle frame of the first time step.
        self._world_T_local = scene.ego.trajectory.interpolate(0.0)
        self._local_T_world = invert(self._world_T_local)
        self._local_T_static_actors: list[Matrix] = []
        static_meshes: list[Mesh] = []
        for actor in self._static_actors:
            pose = self._local_T_world @ actor.trajectory.interpolate(0.0)
            self._local_T_static_actors.append(pose)
            static_meshes.append(actor.mesh.transform(pose))
        static_meshes += self._build_scenery()
        self._static_caster = RayCaster(static_meshes, device)
        self._num_static_faces = sum(len(mesh.faces) for mesh in static_meshes)
        self._surfaces: dict[tuple[float | str, ...], SceneSurface] = {}
        self._snapshots: dict[tuple[int, float], SceneSnapshot] = {}

    @property
    def _bodies(self) -> list[Actor]:
        """Ego vehicle and actors: static bodies, then moving bodies."""
        return self._static_actors + self._moving_actors

    def _build_scenery(self) -> list[Mesh]:
        """Transform the static meshes of the scene to the local frame."""
        return [mesh.transform(self._local_T_world) for mesh in self.scene.static_meshes]

    @cached_property
    def ground(self) -> LocalGround:
        """Ground of the scene, in the world frame."""
        meshes = []
        for mesh, is_ground in zip(self.scene.static_meshes, self.ground_masks, strict=True):
            meshes.append(Mesh(mesh.vertices_m, mesh.faces[is_ground]))
        return LocalGround(meshes, self._world_T_local[:3, 3])

    @cached_property
    def ground_masks(self) -> Sequence[Bools]:
        """For each static mesh (F,) True for faces that are ground.

        If the scene does not name its ground, it is all level surface connected with that below the ego vehicle.
        """
        meshes, ground_indices = self.scene.static_meshes, self.scene.ground_mesh_indices
        if ground_indices is None:
            max_positions = 64  # of the ego vehicle, evenly over the duration
            time_steps = np.unique(np.linspace(0, self.scene.num_time_steps - 1, max_positions).astype(np.int64))
            times_s = self.scene.time_step_s * time_steps.astype(np.float64)
            return find_ground_faces(meshes, self.scene.ego.trajectory.interpolate_positions_m(times_s))
        masks = []
        for mesh_index, (mesh, is_outward) in enumerate(zip(meshes, self._outward_masks, strict=True)):
            is_ground = mesh_index in ground_indices
            masks.append(find_level_faces(mesh, is_outward) if is_ground else np.zeros(len(mesh.faces), dtype=bool))
        return masks

    @cached_property
    def _outward_masks(self) -> Sequence[Bools]:
        """For each static mesh (F,) result of `find_outward_faces`."""
        return [find_outward_faces(mesh) for mesh in self.scene.static_meshes]

    def get_surface(
        self, lower_m: Matrix, upper_m: Matrix, height_range_m: tuple[float, float] | None = None
    ) -> SceneSurface:
        """Get the surface of everything but the ego vehicle that comes into a box around the vehicle.

        It is built on first use, once per box.

        Args:
            lower_m: (3,) lower corner of the box in the vehicle frame.
            upper_m: (3,) upper corner.
            height_range_m: Smallest and largest height above the local ground that are needed; None for all.
        """
        key = (*lower_m.tolist(), *upper_m.tolist(), *(height_range_m or ()))
        if key not in self._surfaces:
            ego, objects = self.scene.ego, self.scene.objects
            object_indices = {id(actor): index for index, actor in enumerate(objects)}
            static_poses: dict[int, Matrix] = {}
            for actor, pose in zip(self._static_actors, self._local_T_static_actors, strict=True):
                if actor is not ego:
                    static_poses[object_indices[id(actor)]] = pose
            moving_objects: dict[int, int] = {}
            for body_index, actor in enumerate(self._moving_actors, self._first_moving_index):
                if actor is not ego:
                    moving_objects[body_index] = object_indices[id(actor)]
            self._surfaces[key] = SceneSurface(
                self._build_scenery(),
                [self._geometries.get_geometry(actor.mesh).patches for actor in objects],
                static_poses,
                moving_objects,
                self._compute_swept_bounds(lower_m, upper_m),
                self._outward_masks,
                None if height_range_m is None else self._create_height_filter(*height_range_m),
                self.coincident_faces,
            )
        return self._surfaces[key]

    def get_surface_without_ground(self, lower_m: Matrix, upper_m: Matrix) -> SceneSurface:
        """Get the static surface in a box that has no ground at or below it, such as in a pit; see `get_surface`."""
        key = (*lower_m.tolist(), *upper_m.tolist(), "without ground")
        if key not in self._surfaces:
            self._surfaces[key] = SceneSurface(
                self._build_scenery(),
                [],
                {},
                {},
                self._compute_swept_bounds(lower_m, upper_m),
                self._outward_masks,
                self._create_height_filter(-np.inf, np.inf)._replace(is_without_ground=True),
                self.coincident_faces,
            )
        return self._surfaces[key]

    def _compute_swept_bounds(self, lower_m: Matrix, upper_m: Matrix) -> UprightBoxes:
        """Compute the boxes through which a box of the vehicle frame moves, in the local frame."""
        times_s = self.scene.time_step_s * np.arange(self.scene.num_time_steps, dtype=np.float64)
        poses = self._local_T_world @ self.scene.ego.trajectory.interpolate_many(times_s)
        return compute_swept_bounds(poses, UprightBoxes(lower_m[None], upper_m[None]))

    @cached_property
    def coincident_faces(self) -> Sequence[Int32]:
        """For each static mesh (F,) face numbers among all static faces; -1 for faces that coincide with no other."""
        first_face = sum(len(actor.mesh.faces) for actor in self._static_actors)
        face_numbers = []
        for is_coincident in self.scene.coincident_masks:
            end_face = first_face + len(is_coincident)
            face_numbers.append(np.where(is_coincident, np.arange(first_face, end_face), -1).astype(np.int32))
            first_face = end_face
        return face_numbers

    def _create_height_filter(self, min_height_m: float, max_height_m: float) -> HeightFilter:
        """Create the filter of surfaces by height above the local ground."""
        pyramid_T_static = self._world_T_local.copy()
        pyramid_T_static[:3, 3] -= self.ground.origin_m
        downward_masks = []
        for mesh, is_outward in zip(self.scene.static_meshes, self._outward_masks, strict=True):
            downward_masks.append(is_outward & find_downward_faces(mesh))
        return HeightFilter(
            self.ground.height_pyramid, pyramid_T_static, self.ground_masks, downward_masks, min_height_m, max_height_m
        )

    def get_snapshot(self, time_step_index: int, max_distance_m: float = np.inf) -> "SceneSnapshot":
        """Place all bodies at a time step; the last four snapshots are cached for other rigs.

        Args:
            time_step_index: Index of the time step.
            max_distance_m: Moving bodies whose nearest point is certainly farther from the vehicle are excluded.

        Raises:
            ValueError: The bounding box of an actor overlaps that of the ego vehicle.
        """
        max_snapshots = 4
        key = time_step_index, max_distance_m
        if key not in self._snapshots:
            if len(self._snapshots) == max_snapshots:
                del self._snapshots[next(iter(self._snapshots))]
            self._snapshots[key] = self._build_snapshot(time_step_index, max_distance_m)
        return self._snapshots[key]

    def clear_snapshots(self) -> None:
        """Drop the cached snapshots: they and this object refer to each other, which delays their release."""
        self._snapshots.clear()

    def _build_snapshot(self, time_step_index: int, max_distance_m: float) -> "SceneSnapshot":
        """Place all bodies at a time step, see `get_snapshot`."""
        time_s = time_step_index * self.scene.time_step_s
        world_T_vehicle = self.scene.ego.trajectory.interpolate(time_s)
        vehicle_T_world = invert(world_T_vehicle)
        distances_m = self._compute_distances_m(time_step_index, world_T_vehicle)
        self._check_overlap(time_s, vehicle_T_world, distances_m)
        moving_distances_m = distances_m[len(self._static_actors) :]
        in_range = np.flatnonzero(moving_distances_m < max_distance_m)
        geometries = [self._geometries.get_geometry(self._moving_actors[index].mesh) for index in in_range.tolist()]
        moving_bodies = MovingBodies.from_geometries(
            geometries,
            self._compute_part_poses(in_range, vehicle_T_world, time_s),
            self._first_moving_index + in_range,
        )
        # The ego vehicle is the first of the moving bodies, or of the static ones.
        ego_index = self._first_moving_index if self.scene.ego.trajectory.is_moving else 0
        return SceneSnapshot(
            self._static_caster,
            self._compute_local_T_vehicle(world_T_vehicle),
            moving_bodies,
            ego_index,
            len(self._moving_actors) - len(moving_bodies),
            self.ground,
            world_T_vehicle,
            partial(self._sample_motion, in_range, time_s),
        )

    def check_overlaps(self, time_step_indices: Int64) -> None:
        """Check that no actor overlaps the ego vehicle.

        Args:
            time_step_indices: Time steps to check.

        Raises:
            ValueError: The bounding boxes of an actor and of the ego vehicle overlap at one of them.
        """
        ego = self.scene.ego
        ego_positions_m = self._positions_m[:, [body is ego for body in self._bodies]]
        sum_of_reach_m = self._reach_m + self._geometries.get_geometry(ego.mesh).reach_m
        is_near = np.linalg.norm(self._positions_m - ego_positions_m, axis=2) < sum_of_reach_m
        has_near_actor = is_near.sum(axis=1) > 1  # the ego vehicle itself counts as one
        for time_step_index in time_step_indices[has_near_actor[time_step_indices]].tolist():
            time_s = time_step_index * self.scene.time_step_s
            world_T_vehicle = ego.trajectory.interpolate(time_s)
            distances_m = self._compute_distances_m(time_step_index, world_T_vehicle)
            self._check_overlap(time_s, invert(world_T_vehicle), distances_m)

    def _compute_distances_m(self, time_step_index: int, world_T_vehicle: Matrix) -> Matrix:
        """Compute a (bodies,) lower bound of the distance of each body from the vehicle; NaN for absent bodies."""
        offsets_m = self._positions_m[time_step_index] - world_T_vehicle[:3, 3]
        return np.asarray(np.linalg.norm(offsets_m, axis=1) - self._reach_m)

    @property
    def _first_moving_index(self) -> int:
        """Index of the first moving body in snapshots."""
        return len(self._static_actors) + len(self.scene.static_meshes)

    @property
    def num_bytes(self) -> int:
        """Approximate memory of the geometry, without the geometry of moving bodies that scenes share."""
        bytes_per_static_face = 300
        return (
            self._positions_m.nbytes
            + sum(actor.trajectory.num_bytes for actor in self._moving_actors)
            + bytes_per_static_face * self._num_static_faces
            + sum(surface.num_bytes for surface in self._surfaces.values())
        )

    @property
    def has_motion(self) -> bool:
        """True if the ego vehicle or an actor moves at any time."""
        return bool(self._moving_actors)

    @property
    def has_constant_self_hits(self) -> bool:
        """True if the hits of sensors on the ego vehicle are the same in all frames and need to be cast only once."""
        return self.scene.ego.trajectory.is_moving or not self.has_motion

    def compute_ego_hit_ranges_m(
        self, vehicle_T_sensor: Matrix, tiles: Sequence[Tile], *, max_range_m: float = np.inf
    ) -> tuple[Float32, ...]:
        """Compute where the rays of a sensor on the vehicle hit the ego vehicle, for `SceneSnapshot.scan`.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            tiles: Rays of the sensor.
            max_range_m: Largest range.

        Returns:
            For each tile (n,) ranges, inf where the ego vehicle is not hit within the range. Empty for an ego vehicle
            at rest, which is part of the static bodies.
        """
        if not self.scene.ego.trajectory.is_moving:
            return ()
        caster = self._geometries.get_geometry(self.scene.ego.mesh).caster
        return tuple(compute_hit_ranges_m(caster, vehicle_T_sensor, tile, max_range_m) for tile in tiles)

    def is_inside_ego(self, position_m: Matrix) -> bool:
        """Return True if the ego vehicle encloses a (3,) position in the vehicle frame, so that no ray leaves."""
        return is_enclosed(self._geometries.get_geometry(self.scene.ego.mesh).caster, position_m)

    def _check_overlap(self, time_s: float, vehicle_T_world: Matrix, distances_m: Matrix) -> None:
        """Raise ValueError if an actor overlaps the ego vehicle; only actors that are near are tested."""
        ego_reach_m = self._geometries.get_geometry(self.scene.ego.mesh).reach_m
        for index in np.flatnonzero(distances_m < ego_reach_m).tolist():
            actor = self._bodies[index]
            if actor is self.scene.ego:
                continue
            vehicle_T_actor = vehicle_T_world @ actor.trajectory.interpolate(time_s)
            box = self._geometries.get_geometry(actor.mesh).bounding_box
            if find_overlaps(box, vehicle_T_actor[None], self.ego_box.corners_m)[0]:
                raise ValueError(
                    f"actor {actor.name!r} overlaps the ego at t = {time_s:g} s (their bounding boxes do); "
                    "change one of the trajectories"
                )

    def _compute_local_T_vehicle(self, world_T_vehicle: Matrix) -> Matrix:
        """Compute the pose of the vehicle in the local frame; exactly the identity for an ego vehicle at rest."""
        return self._local_T_world @ world_T_vehicle if self.scene.ego.trajectory.is_moving else np.eye(4)

    def _compute_part_poses(self, indices: NDArray[np.intp], vehicle_T_world: Matrix, time_s: float) -> Matrix:
        """Compute the (P, 4, 4) poses of moving bodies in the vehicle frame."""
        actors = [self._moving_actors[index] for index in indices.tolist()]
        vehicle_T_part: Matrix = vehicle_T_world @ interpolate_poses([actor.trajectory for actor in actors], time_s)
        # The pose of the ego vehicle is exact, so that sensors see the same part of it in all frames.
        vehicle_T_part[[actor is self.scene.ego for actor in actors]] = np.eye(4)
        return vehicle_T_part

    def _sample_motion(
        self, indices: NDArray[np.intp], time_s: float, begin_s: float, end_s: float
    ) -> tuple[Matrix, list[BodyPoses]]:
        """Sample the poses of vehicle and bodies in an interval, see `MotionSampler`.

        An interval that exceeds the duration of the scene is replaced by one of the same length within it.

        Args:
            indices: Moving bodies.
            time_s: Time of the frame.
            begin_s: Begin of the interval, relative to the frame.
            end_s: End of the interval, relative to the frame.
        """
        scene = self.scene
        length_s = end_s - begin_s
        scene_end_s = max(scene.time_step_s * (scene.num_time_steps - 1) - time_s, 0.0)
        first_s = max(min(begin_s, scene_end_s - length_s), -time_s)
        samples_s = np.linspace(first_s, min(first_s + end_s - begin_s, scene_end_s), NUM_SAMPLES)
        poses = []
        for sample_s in (time_s + samples_s).tolist():
            world_T_vehicle = scene.ego.trajectory.interpolate(sample_s)
            vehicle_T_part = self._compute_part_poses(indices, invert(world_T_vehicle), sample_s)
            poses.append(BodyPoses(self._compute_local_T_vehicle(world_T_vehicle), vehicle_T_part))
        return samples_s, poses


def compute_hit_ranges_m(caster: RayCaster, vehicle_T_sensor: Matrix, tile: Tile, max_range_m: float) -> Float32:
    """Compute where the rays of a tile hit bodies in the vehicle frame.

    Args:
        caster: Bodies.
        vehicle_T_sensor: (4, 4) extrinsics of the sensor.
        tile: n rays.
        max_range_m: Largest range.

    Returns:
        (n,) ranges; inf where a ray hits nothing within the range.
    """
    directions = rotate(vehicle_T_sensor[:3, :3], tile.directions)
    hits = caster.cast(vehicle_T_sensor[:3, 3], directions, build_range_limits_m(tile, max_range_m))
    return np.where(hits.body_indices >= 0, hits.range_m, np.float32(np.inf))
