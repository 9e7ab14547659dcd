"""Traffic of type `tracks`: the ego vehicle and other road users as they were recorded."""

import warnings
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from torchcover.geometry import BoundingBox, find_overlaps, invert
from torchcover.geometry.arrays import Float64
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.formats import read_objects
from torchcover.recordings.formats.tracks import read_trajectory
from torchcover.recordings.objects import Ego, RecordedObjects
from torchcover.simulation.bodies import build_checked_mesh
from torchcover.simulation.builtin import hash_builtin_documents
from torchcover.simulation.documents import Pose, RelativePath
from torchcover.simulation.recorded.bodies import (
    BodyLibrary,
    apply_ground_tilt,
    collect_ground_positions,
    find_visible_sides,
    fit_ground,
)
from torchcover.simulation.recorded.excerpt import (
    Excerpt,
    build_pose_matrices,
    choose_ego,
    choose_time_span,
    split_at_gaps,
)
from torchcover.simulation.scene import Actor, Scene, count_time_steps
from torchcover.simulation.shapes import Mesh, MeshFile
from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.fleet import EGO, load_bodies
from torchcover.simulation.traffic.frontage import RoadsideDensity, place_scenery
from torchcover.simulation.traffic.kind import Traffic
from torchcover.simulation.traffic.scenery import merge_by_kind


def convert_id(content: Any) -> Any:  # noqa: ANN401  (any content of a file)
    """Convert a numeric identifier to text; return other content unchanged."""
    return str(content) if isinstance(content, int) and not isinstance(content, bool) else content


class RecordedTraffic(Traffic):
    """Recorded traffic, repeated after the end of the recording.

    Args:
        path: Log of Argoverse 2, tables of nuScenes, scenario of CommonRoad, table of boxes, or any recording with
            poses and boxes (KITTI raw, CARLA, a plain folder); relative to the document.
        scene: Name or token of a scene, for tables of nuScenes with several scenes.
        ego_id: Track of the ego vehicle; default: the ego vehicle of the recording, in CommonRoad the start of the
            first planning problem.
        ego_trajectory: File with the trajectory of the ego vehicle instead, at times of the same clock.
        ego_T_vehicle: Pose of the vehicle frame (on the ground below the center of the body) in the frame of the
            recorded ego vehicle or its trajectory. Default: the published pose for Argoverse 2 and nuScenes, whose
            frames are at the rear axle, else the identity.
        begin_s: Begin of the scene, after the first time at which the ego vehicle and others are recorded.
        duration_s: Duration of the scene; default: until the end.
        max_gap_s: Objects without observation for longer than this are absent.
        ground: File of a ground mesh in meters, in the frame of the recording; default: a height field below the
            tracks.
        built_share: Share of the sides with houses; if given, scenery is sampled along the driven paths, which is not
            part of the recording.
        roadside_density: Factor of the density of scenery other than houses, or factors of some kinds of it.
        time_step_s: Time between two frames.
    """

    is_repeating: ClassVar[bool] = True

    type: Literal["tracks"] = "tracks"
    path: RelativePath
    scene: str | None = None
    ego_id: Annotated[str | None, BeforeValidator(convert_id)] = None
    ego_trajectory: RelativePath | None = None
    ego_T_vehicle: Pose | None = None
    begin_s: Annotated[float, Field(ge=0.0)] = 0.0
    duration_s: Annotated[float | None, Field(ge=0.0)] = None
    max_gap_s: Annotated[float, Field(gt=0.0)] = 1.0
    ground: RelativePath | None = None
    built_share: Annotated[float | None, Field(ge=0.0, le=1.0)] = None
    roadside_density: RoadsideDensity = 1.0

    @model_validator(mode="after")
    def _check_scenery(self) -> Self:
        if self.built_share is None and self.roadside_density != 1.0:
            raise ValueError("roadside_density scales sampled scenery: set built_share, too, from 0 to 1")
        if self.built_share is not None and self.ground is not None:
            raise ValueError("built_share is for tracks without a ground mesh; remove ground, or built_share")
        return self

    @property
    def sampling_note(self) -> str:
        """Note about sampled scenery; empty without it."""
        if self.built_share is None:
            return ""
        return f"Sampled, not recorded: scenery along the tracks, with houses on {self.built_share:.0%} of the sides."

    @property
    def num_time_steps(self) -> int:
        """Number of frames."""
        return count_time_steps(self._excerpt.duration_s, self.time_step_s)

    def collect_content(self) -> dict[str, Any]:
        """Collect the keys, the recorded objects and the bodies that may represent them, for the fingerprint."""
        return {
            **Traffic.collect_content(self.model_copy(update={"path": None})),
            "objects": self._objects.compute_digest(),
            "vehicles": hash_builtin_documents("vehicles"),
        }

    def build_scene(self, seed: int, ego_mesh: Mesh | None = None) -> Scene:
        """Build the scene in the frame of the recording, with sampled scenery if `built_share` is set.

        Objects that overlap the ego vehicle at any time are removed, with a warning.

        Args:
            seed: Seed of the scenery.
            ego_mesh: Body of the ego vehicle; an SUV if None.

        Returns:
            The scene.

        Raises:
            FileNotFoundError: A file is missing.
            ValueError: The recording has no such ego vehicle or time span.
        """
        trajectory = self._shift_times(self._excerpt.ego_trajectory)
        # Recordings do not contain the shape of their vehicle.
        mesh = load_bodies()["suv"] if ego_mesh is None else ego_mesh
        # Without the transient flag: the ego vehicle is always present.
        ego = Actor(EGO, "car", mesh, Trajectory(trajectory.times_s, trajectory.positions_m, trajectory.angles_deg))
        all_actors = list(self._create_actors(ego.trajectory, BodyLibrary()))
        actors = self._remove_overlapping(ego, all_actors)
        num_omitted = len(all_actors) - len(actors)
        scenery: tuple[Mesh, ...] = ()
        if self.ground is not None:
            ground_mesh = build_checked_mesh(MeshFile(type="mesh", path=self.ground), str(self.ground))
        else:
            tracks = [track for track in self._excerpt.other_tracks if track.vehicle_class is not None]
            ego_positions_m = ego.trajectory.interpolate_positions_m(self._times_s)
            # Only road users stand on the ground: other objects may hang above it.
            ground = fit_ground(
                collect_ground_positions([track.trajectory.positions_m for track in tracks]),
                collect_ground_positions([ego_positions_m]),
            )
            if self.built_share is not None:
                # Recorded objects do not depend on the seed; only sampled scenery does.
                generator = np.random.default_rng(seed)
                sides, drivable, walkable = find_visible_sides(ego, actors, self.built_share, generator)
                meshes = place_scenery(
                    sides, drivable, walkable, (), ground.compute_heights_m, self.roadside_density, generator
                )
                scenery = merge_by_kind(*meshes)
            ground_mesh = ground.build_mesh()
            ego = apply_ground_tilt(ego, ground)
            actors = [apply_ground_tilt(actor, ground) for actor in actors]
        return Scene(
            (ground_mesh, *scenery),
            ego,
            tuple(actors),
            self.time_step_s,
            self._excerpt.duration_s,
            ground_mesh_indices=(0,),
            num_omitted_road_users=num_omitted,
        )

    @cached_property
    def _objects(self) -> RecordedObjects:
        return read_objects(self.path, self.scene)

    @cached_property
    def _excerpt(self) -> Excerpt:
        recording = self._objects
        if self.ego_trajectory is not None:
            if self.ego_id is not None:
                raise ValueError("ego_id and ego_trajectory exclude each other: set only one of them")
            trajectory = read_trajectory(self.ego_trajectory)
            ego = Ego(self.ego_trajectory.name, trajectory.times_s, build_pose_matrices(trajectory), np.eye(4))
            recording = RecordedObjects(recording.tracks, (ego,))
        ego_T_vehicle = None if self.ego_T_vehicle is None else self.ego_T_vehicle.to_matrix()
        try:
            excerpt = choose_ego(recording, self.ego_id, ego_T_vehicle)
            return choose_time_span(excerpt, self.begin_s, self.duration_s, self.max_gap_s)
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def _shift_times(self, trajectory: Trajectory) -> Trajectory:
        """Shift a trajectory to the times of the scene; times within a microsecond of a frame are snapped to it."""
        times_s = trajectory.times_s - self._excerpt.begin_s
        frame_times_s = self.time_step_s * np.round(times_s / self.time_step_s)
        times_s = np.where(np.abs(times_s - frame_times_s) < 1e-6, frame_times_s, times_s)
        return Trajectory(times_s, trajectory.positions_m, trajectory.angles_deg, trajectory.is_transient)

    @property
    def _times_s(self) -> Float64:
        """(T,) times of the frames."""
        return self.time_step_s * np.arange(self.num_time_steps, dtype=np.float64)

    def _create_actors(self, ego_trajectory: Trajectory, bodies: BodyLibrary) -> Iterator[Actor]:
        """Create the actors that are present during the scene and ever within the range of sensors."""
        for track in self._excerpt.other_tracks:
            category, mesh = bodies.get_category_and_mesh(track)
            for number, piece in enumerate(split_at_gaps(track.trajectory, self.max_gap_s), 1):
                trajectory = self._shift_times(piece)
                first_s, last_s = trajectory.times_s[0], trajectory.times_s[-1]
                is_present = not trajectory.is_transient or (first_s <= self._excerpt.duration_s and last_s >= 0.0)
                ego_positions_m = ego_trajectory.interpolate_positions_m(trajectory.times_s)
                distances_m = np.linalg.norm(trajectory.positions_m - ego_positions_m, axis=1)
                # Objects beyond the horizon are out of the range of all sensors.
                if is_present and distances_m.min() < HORIZON_M + max(track.size_m[:2]):
                    name = track.name if number == 1 else f"{track.name} #{number}"
                    yield Actor(name, category, mesh, trajectory)

    def _remove_overlapping(self, ego: Actor, actors: list[Actor]) -> list[Actor]:
        """Remove the actors whose bounding boxes overlap the ego vehicle in any frame, with a warning."""
        times_s = self._times_s
        ego_m, ego_box = ego.trajectory.interpolate_positions_m(times_s), BoundingBox.from_points(ego.mesh.vertices_m)
        ego_radius_m = float(np.linalg.norm(ego_box.corners_m, axis=1).max())
        overlapping: list[str] = []
        for actor in actors:
            box = BoundingBox.from_points(actor.mesh.vertices_m)
            distances_m = np.linalg.norm(actor.trajectory.interpolate_positions_m(times_s) - ego_m, axis=1)
            # The exact test is slow: it is needed only where the spheres around the boxes overlap.
            near_s = times_s[distances_m < ego_radius_m + np.linalg.norm(box.corners_m, axis=1).max()]
            ego_T_actor = invert(ego.trajectory.interpolate_many(near_s)) @ actor.trajectory.interpolate_many(near_s)
            if find_overlaps(box, ego_T_actor, ego_box.corners_m).any():
                overlapping.append(actor.name)
        if overlapping:
            examples = ", ".join(repr(name) for name in overlapping[:3])
            warnings.warn(
                f"{self.path}: {len(overlapping)} of {len(actors)} tracks overlap the ego vehicle at some time "
                f"({examples}); they are removed",
                stacklevel=2,
            )
        return [actor for actor in actors if actor.name not in overlapping]
