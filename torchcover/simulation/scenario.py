"""A scenario: the world around the ego, what moves in it, and the ego's own body."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import NonNegativeFloat, PlainValidator, PositiveFloat, TypeAdapter, ValidationInfo, model_validator

from torchcover.geometry import BoundingBox, build_transform, invert, transform_points
from torchcover.geometry.trajectory import Trajectory
from torchcover.recordings.formats.tracks import read_trajectory
from torchcover.simulation.bodies import Body, Shape, VehicleShape, build_actor_mesh, get_shape_name
from torchcover.simulation.documents import BuiltInDocument, Document, Pose, RelativePath
from torchcover.simulation.kinds import TRAFFIC
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.local_ground import STEEPEST_DEG, find_level_faces
from torchcover.simulation.radar import Radar
from torchcover.simulation.recorded.bodies import read_box_actors
from torchcover.simulation.returns import CLEAR, Weather
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.shapes import Mesh, MeshFile
from torchcover.simulation.sound import find_coincident_faces, warn_about_coincident_faces
from torchcover.simulation.traffic.kind import Traffic
from torchcover.simulation.world import Actor, Scene, count_time_steps

# What carries a rig that names no vehicle, unless the document says otherwise.
DEFAULT_EGO = VehicleShape(type="vehicle", vehicle="suv")
# A hall that reaches no farther is one; and so many places of the ego are looked at.
ROOM_M, PLACES_ALONG = 40.0, 64


def _traffic(content: Any, info: ValidationInfo) -> Traffic | None:  # noqa: ANN401  (whatever stood in the file)
    if content is None:
        return None
    kind = content.get("type") if isinstance(content, dict) else getattr(content, "type", type(content).__name__)
    if not isinstance(kind, str) or kind not in TRAFFIC:
        raise ValueError(f"type: traffic is one of {', '.join(map(repr, TRAFFIC))}; got {kind!r}")
    return TypeAdapter(TRAFFIC[kind]).validate_python(content, context=info.context)


class ActorDescription(Document):
    """A body that rests at a pose or follows a trajectory.

    Args:
        shape: Its body. Its frame follows from it: the origin lies on the ground under the centre of the bounding box,
            x forward, z up. Only the ego may leave it open: see `set_ego`.
        pose: Where it rests in the world.
        trajectory: File of its trajectory instead; relative to the document.
    """

    shape: Shape | None = None
    pose: Pose | None = None
    trajectory: RelativePath | None = None

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        if self.pose is not None and self.trajectory is not None:
            raise ValueError("give a pose or a trajectory, not both")
        return self

    def build_actor(self, name: str, category: str) -> Actor:
        """Build it."""
        return Actor(name, category, self.build_mesh(name, category), self.load_trajectory())

    def load_trajectory(self) -> Trajectory:
        """Where it is at all times."""
        if self.trajectory is not None:
            return read_trajectory(self.trajectory)
        return Trajectory.from_poses([0.0], (self.pose or Pose()).to_matrix()[None])

    def build_mesh(self, name: str, category: str) -> Mesh:
        """Its body in its own frame; an SUV where that was left open."""
        return build_actor_mesh(name, self.shape or DEFAULT_EGO, category)


class NamedActorDescription(ActorDescription):
    """An actor.

    Args:
        name: What messages call it.
        category: What it is: "car", "truck", "pedestrian", ...
    """

    name: str
    category: str
    shape: Shape


class Scenario(BuiltInDocument):
    """A world with an ego in it: given body by body, or made of traffic.

    Args:
        name: What tables and maps call it.
        description: What it is.
        ego: The vehicle that carries the rig; in traffic its shape only. Without a shape, the rig's vehicle
            takes its place, or an SUV.
        bodies: What never moves, in the world frame.
        actors: What moves, or may be recognised.
        boxes: File of recorded boxes that are actors too, with bodies as of `tracks`; relative to the document.
        time_step_s: Time between two frames.
        duration_s: Time of the last frame; frames beyond it start again at 0.
        weather: Clear and dry if not given.
        traffic: Of a kind in `TRAFFIC`, drawn or recorded: it makes bodies, actors, the ego's drive, and the times.

    Example:
        >>> Scenario.load("courtyard").ego.pose.x_m
        0.0
    """

    kind: ClassVar[str] = "a scenario"
    folder: ClassVar[str] = "scenarios"

    name: str
    description: str = ""
    ego: ActorDescription | None = None
    bodies: tuple[Body, ...] = ()
    actors: tuple[NamedActorDescription, ...] = ()
    boxes: RelativePath | None = None
    time_step_s: PositiveFloat = 0.1
    duration_s: NonNegativeFloat = 0.0
    weather: Weather = CLEAR
    traffic: Annotated[Traffic | None, PlainValidator(_traffic)] = None

    @model_validator(mode="after")
    def _check_given_or_procedural(self) -> Self:
        if self.traffic is None:
            count_time_steps(self.duration_s, self.time_step_s)
            missing = [key for key in ("ego", "bodies") if not getattr(self, key)]
            if missing:
                raise ValueError(f"{' and '.join(missing)} missing: give them, or traffic that makes them")
            return self
        made = {"bodies", "actors", "boxes", "time_step_s", "duration_s"} & self.model_fields_set
        if made:
            raise ValueError(f"traffic makes {', '.join(sorted(made))} itself: leave them out")
        if self.ego is not None and (self.ego.pose is not None or self.ego.trajectory is not None):
            raise ValueError("ego: traffic drives it; give its shape only")
        return self

    def locate(self, frame_index: int) -> tuple[int, int]:
        """Which run through the scenario a frame belongs to, and its time step in it; see `repeats`."""
        episode, step = divmod(frame_index, self.num_time_steps)
        return (0 if self.is_repeating else episode), step

    def compute_max_range_m(self, sensor: Sensor, weather: Weather | None = None) -> float:
        """How far the rays of a sensor are cast in it: cameras see no farther than people, radars through fog.

        What fog leaves of the light of a LiDAR is decided hit by hit, unless every hit returns.

        Args:
            sensor: The sensor.
            weather: In place of its own.
        """
        seen_m = (weather or self.weather).visibility_m
        if seen_m is None or isinstance(sensor, Radar) or (isinstance(sensor, Lidar) and sensor.range_at_10_percent_m):
            return sensor.max_range_m
        return min(sensor.max_range_m, seen_m)

    @property
    def is_repeating(self) -> bool:
        """Whether the same plays again beyond its end: a given world, a recording.

        Else another world of its kind begins, with other random numbers.

        Example:
            >>> Scenario.load("courtyard").repeats, Scenario.load("urban").repeats
            (True, False)
        """
        return self.traffic is None or self.traffic.is_repeating

    @property
    def num_time_steps(self) -> int:
        """Number of instants of one run."""
        return (
            count_time_steps(self.duration_s, self.time_step_s) if self.traffic is None else self.traffic.num_time_steps
        )

    @property
    def num_distinct_time_steps(self) -> int | None:
        """How many different instants it can show: one if nothing moves; None if it never repeats itself.

        Example:
            >>> Scenario.load("courtyard").instants
            1
        """
        if not self.is_repeating:
            return None
        moves = self.boxes is not None or any(mover and mover.trajectory for mover in (self.ego, *self.actors))
        return self.num_time_steps if moves or self.traffic is not None else 1

    @property
    def effective_time_step_s(self) -> float:
        """Its time step, be it given or that of the traffic."""
        return (self.traffic or self).time_step_s

    def count_time_steps(self, time_s: float) -> int:
        """How many time steps a time has.

        Raises:
            ValueError: It is not a positive multiple of the time step.
        """
        time_step_s = self.effective_time_step_s
        steps = round(time_s / time_step_s) if math.isfinite(time_s / time_step_s) else 0
        if steps < 1 or not math.isclose(steps * time_step_s, time_s, rel_tol=1e-6):
            raise ValueError(
                f"frame_interval_s: a positive multiple of the time step of {self.name!r}, {time_step_s:g} s, is needed; "
                f"got {time_s:g}"
            )
        return steps

    @property
    def has_ground(self) -> bool:
        """Whether what one drives or walks on is known: of traffic always, else if a body says so.

        Example:
            >>> Scenario.load("courtyard").says_ground
            True
        """
        return self.traffic is not None or any(body.ground for body in self.bodies)

    def build_ego_mesh(self) -> Mesh:
        """The body of the vehicle that carries the rig, in the vehicle frame; no world is built for it.

        Raises:
            FileNotFoundError: A mesh or vehicle file is missing.
            ValueError: A mesh cannot be used.
        """
        return (self.ego or ActorDescription()).build_mesh("ego", "ego")

    @property
    def ego_name(self) -> str:
        """What that body is called: the name of a vehicle or of a file, or its kind of shape.

        Example:
            >>> Scenario.load("courtyard").ego_name
            'suv'
        """
        return get_shape_name((self.ego and self.ego.shape) or DEFAULT_EGO)

    def compute_ego_box(self) -> BoundingBox:
        """The bounding box of that body.

        Example:
            >>> [round(metres, 2) for metres in Scenario.load("courtyard").ego_box().size_m]
            [4.9, 1.94, 1.63]
        """
        return BoundingBox.from_points(self.build_ego_mesh().vertices_m)

    def find_room_bounds_m(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Bounds x and y of all that stands around the ego, in its frame, wherever it drives.

        Returns:
            None if that is no room or hall: it reaches farther than 40 m, the ego is beside it, or traffic makes it.

        Raises:
            ValueError: What stands around the ego is smaller than its body.

        Example:
            >>> Scenario.load("courtyard").room_m() is None
            True
        """
        if self.traffic is not None or self.ego is None:
            return None
        places = [pose.to_matrix() for body in self.bodies for pose in body.poses]
        meshes = [mesh for body in self.bodies for mesh in [body.shape.build_mesh()] * len(body.poses)]
        moved = [mesh.transform(place).vertices_m for mesh, place in zip(meshes, places, strict=True)]
        all_m, path = np.concatenate(moved), self.ego.load_trajectory()
        (x0, y0, _), (x1, y1, z1) = all_m.min(axis=0).tolist(), all_m.max(axis=0).tolist()
        outline_m = np.array([(x0, y0, z1), (x0, y1, z1), (x1, y0, z1), (x1, y1, z1)])
        times_s = np.linspace(path.times_s[0], path.times_s[-1], PLACES_ALONG if path.is_moving else 1)
        corners_m = np.stack(
            [transform_points(invert(pose), outline_m)[:, :2] for pose in path.interpolate_many(times_s)]
        )
        # A room that the ego turns in is as large as what it sweeps.
        low_m, high_m = corners_m.min(axis=(0, 1)), corners_m.max(axis=(0, 1))
        if (corners_m.min(axis=1) > 0).any() or (corners_m.max(axis=1) < 0).any():
            return None
        if (high_m - low_m < self.compute_ego_box().size_m[:2]).all():
            across = " x ".join(f"{length:.2g}" for length in high_m - low_m)
            raise ValueError(
                f"scenario {self.name!r}: all that stands in it is {across} m, smaller than {self.ego_name}; is the "
                "`meters_per_unit` of a mesh that of its file?"
            )
        if max(-low_m.min(), high_m.max()) > ROOM_M:
            return None
        (x0, y0), (x1, y1) = low_m.tolist(), high_m.tolist()
        return (x0, x1), (y0, y1)

    def build_scene(self, seed: int = 0, run_index: int = 0, ego_mesh: Mesh | None = None) -> Scene:
        """Build it.

        Args:
            seed: Seed of procedural traffic.
            run_index: Which run; see `locate`.
            ego_mesh: What `ego_mesh` gave, which the worlds of several runs share; made again if not given.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A mesh or a trajectory cannot be used.
        """
        if self.traffic is not None:
            own_seed = int(np.random.SeedSequence([seed, run_index]).generate_state(1, np.uint64)[0])
            return self.traffic.build_scene(own_seed, self.build_ego_mesh() if ego_mesh is None else ego_mesh)
        assert self.ego is not None  # checked in _check_given_or_procedural
        static = [(mesh, body) for body in self.bodies for mesh in body.build_meshes()]
        ground = tuple(number for number, (_, body) in enumerate(static) if body.ground)
        for number in ground:
            if not find_level_faces(static[number][0]).any():
                raise ValueError(
                    f"body {static[number][1].name!r} is ground, but none of its faces is an upper side that one could "
                    f"stand on, at most {STEEPEST_DEG:g} degrees steep; is z up?"
                )
        driver, *actors = _on_run_clock(
            [
                self.ego.build_actor("ego", "ego"),
                *(actor.build_actor(actor.name, actor.category) for actor in self.actors),
                *(read_box_actors(self.boxes) if self.boxes else ()),
            ],
            self.duration_s,
        )
        static_T_world = build_transform(np.eye(3), -driver.trajectory.positions_m[0])
        within = [isinstance(body.shape, MeshFile) for _, body in static]
        coincident = find_coincident_faces([mesh.transform(static_T_world) for mesh, _ in static], within)
        warn_about_coincident_faces([body.name for _, body in static], coincident)
        return Scene(
            static_meshes=tuple(mesh for mesh, _ in static),
            ego=driver,
            actors=tuple(actors),
            time_step_s=self.time_step_s,
            duration_s=self.duration_s,
            ground_mesh_indices=ground or None,
            coincident_masks=tuple(coincident) if any(mask.any() for mask in coincident) else (),
        )


def _on_run_clock(actors: Sequence[Actor], duration_s: float) -> list[Actor]:
    """Let the times of trajectories count from the beginning of the run.

    Files may have another clock, such as seconds since 1970: if all trajectories begin after the end of the run, the
    first of their times is its beginning. A warning names those that still lie outside of the run.
    """
    moving = [actor for actor in actors if actor.trajectory.is_moving]
    first_s = min((float(actor.trajectory.times_s[0]) for actor in moving), default=0.0)
    start_s = first_s if first_s > duration_s else 0.0
    placed = [
        replace(actor, trajectory=actor.trajectory.shift_time(start_s))
        if start_s and actor.trajectory.is_moving
        else actor
        for actor in actors
    ]
    for actor in placed:
        times_s = actor.trajectory.times_s
        if actor.trajectory.is_moving and not (times_s[0] <= duration_s and times_s[-1] >= 0.0):
            state = "is not there" if actor.trajectory.is_transient else "rests"
            warnings.warn(
                f"{actor.name} {state}: its times, {times_s[0] + start_s:.3f} to {times_s[-1] + start_s:.3f} s, lie "
                f"outside of the run, {start_s:.3f} to {start_s + duration_s:.3f} s; give all trajectories one clock",
                stacklevel=3,
            )
    return placed
