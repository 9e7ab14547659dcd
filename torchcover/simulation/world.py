"""What a scenario builds: bodies that rest, bodies that move, and the ego; and a box around each object."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry import BoundingBox, convert_rotation_to_euler, invert, transform_points
from torchcover.geometry.arrays import Bools
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.shapes import Mesh

# A day at ten to a second.
MAX_STEPS = 1_000_000


@dataclass(frozen=True, eq=False)
class Actor:
    """A body with a place for every time, and a name of its own.

    Its mesh is in its own frame: origin on the ground under the centre of the bounding box, x forward, z up; actors of
    one kind share it. The trajectory is `world_T_actor`.
    """

    name: str
    category: str
    mesh: Mesh
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything there is, over time.

    Args:
        static_meshes: Meshes in the world frame that never move.
        ego: The vehicle that carries the rig.
        actors: The others.
        time_step_s: Time between two frames.
        duration_s: Time after which the trajectories end.
        static_actors: Objects that never move, of which there may be many.
        ground_mesh_indices: Numbers of the static meshes that one drives or walks on: their level faces are the ground. None if
            that is not known: then `Scene.ground` finds it.
        coincident_masks: For each static mesh (F,) which of its faces lie within 1 mm of others, of which one counts; empty
            if none do.
        num_omitted_road_users: How many more road users the source of the traffic had near the ego, where bodies cannot be.
    """

    static_meshes: tuple[Mesh, ...]
    ego: Actor
    actors: tuple[Actor, ...] = ()
    time_step_s: float = 0.1
    duration_s: float = 0.0
    static_actors: tuple[Actor, ...] = ()
    ground_mesh_indices: tuple[int, ...] | None = None
    coincident_masks: tuple[Bools, ...] = ()
    num_omitted_road_users: int = 0

    @property
    def objects(self) -> tuple[Actor, ...]:
        """What may be recognised: the actors, then the parked. An object's number is its place in this order."""
        return self.actors + self.static_actors

    @property
    def num_time_steps(self) -> int:
        """Number of instants: at 0, one time step, two time steps, ... up to the duration."""
        return count_time_steps(self.duration_s, self.time_step_s)


def count_time_steps(duration_s: float, time_step_s: float) -> int:
    """Number of instants from 0 to a duration, both included."""
    steps = duration_s / time_step_s
    if not steps < MAX_STEPS:
        raise ValueError(
            f"a duration of {duration_s:g} s has {steps:.6g} time steps of {time_step_s:g} s, over {MAX_STEPS:,}; "
            "shorten it, or make the steps longer"
        )
    return int(steps + 1e-9) + 1


class ObjectLabel(NamedTuple):
    """An object in the vehicle frame: the box of its body, its yaw, and its velocity over ground along x and y.

    `object_index` is its place in `World.objects`.
    """

    object_index: int
    name: str
    category: str
    center_m: Matrix
    size_m: tuple[float, float, float]
    yaw_rad: float
    velocity_mps: Matrix


def compute_labels(scene: Scene, time_step_index: int, max_distance_m: float) -> list[ObjectLabel]:
    """All objects near the ego at one step, in the order of the world; the ego itself is left out.

    An object is near if the origin of its frame is, over ground. Boxes stand upright in the vehicle frame: a body that
    tilts against the ego by a degree leaves its box by a few centimetres.
    """
    time_s = time_step_index * scene.time_step_s
    world_T_vehicle = scene.ego.trajectory.interpolate(time_s)
    vehicle_T_world = invert(world_T_vehicle)
    found, box_of = [], dict[int, BoundingBox]()  # actors of one kind share a mesh
    for number, actor in enumerate(scene.objects):
        position_m = actor.trajectory.interpolate_positions_m(np.array([time_s]))[0]
        # Not near, too, if absent: NaN.
        if np.hypot(*(position_m - world_T_vehicle[:3, 3])[:2]) <= max_distance_m:
            if id(actor.mesh) not in box_of:
                box_of[id(actor.mesh)] = BoundingBox.from_points(actor.mesh.vertices_m)
            found.append(_label(number, actor, box_of[id(actor.mesh)], vehicle_T_world, time_s))
    return found


def _label(number: int, actor: Actor, box: BoundingBox, vehicle_T_world: Matrix, time_s: float) -> ObjectLabel:
    vehicle_T_actor = vehicle_T_world @ actor.trajectory.interpolate(time_s)
    middle_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    return ObjectLabel(
        number,
        actor.name,
        actor.category,
        center_m=transform_points(vehicle_T_actor, middle_m[None])[0],
        size_m=box.size_m,
        yaw_rad=float(np.deg2rad(convert_rotation_to_euler(vehicle_T_actor[:3, :3])[0])),
        velocity_mps=(vehicle_T_world[:3, :3] @ actor.trajectory.compute_velocity_mps(time_s))[:2],
    )
