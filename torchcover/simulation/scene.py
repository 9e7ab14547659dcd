"""Scenes: static meshes, ego vehicle and actors with their trajectories, and labels of objects."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry import BoundingBox, convert_rotation_to_euler, invert, transform_points
from torchcover.geometry.arrays import Bools
from torchcover.geometry.rigid import Matrix
from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.shapes import Mesh


@dataclass(frozen=True, eq=False)
class Actor:
    """Body with a trajectory.

    Args:
        name: Unique name.
        category: Class name, such as `car`.
        mesh: Mesh in the frame of the actor: origin on the ground under the center of the bounding box, x forward, z
            up. Actors of one kind share it.
        trajectory: `world_T_actor` over time.
    """

    name: str
    category: str
    mesh: Mesh
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry and motion of everything in a scenario.

    Args:
        static_meshes: Static meshes in the world frame.
        ego: Ego vehicle, which carries the rig.
        actors: Other moving objects.
        time_step_s: Time step.
        duration_s: Time at which the trajectories end.
        static_actors: Objects that never move, such as parked cars.
        ground_mesh_indices: Static meshes whose level faces are the ground; None if unspecified, then
            `SceneGeometry.ground_masks` finds it.
        coincident_masks: For each static mesh (F,) True for faces within 1 mm of others, one of which counts; empty if
            there are none.
        num_omitted_road_users: Number of road users near the ego vehicle in the traffic source that were omitted,
            since their bodies would overlap others.
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
        """Actors, then static actors; the index of an object is its position in this order."""
        return self.actors + self.static_actors

    @property
    def num_time_steps(self) -> int:
        """Number of time steps from 0 to the duration, both included."""
        return count_time_steps(self.duration_s, self.time_step_s)


def count_time_steps(duration_s: float, time_step_s: float) -> int:
    """Count the time steps from 0 to a duration, both included.

    Args:
        duration_s: Duration.
        time_step_s: Time step.

    Raises:
        ValueError: More than a million time steps, which is a day at ten per second.
    """
    max_time_steps = 1_000_000
    num_time_steps = duration_s / time_step_s
    if not num_time_steps < max_time_steps:
        raise ValueError(
            f"a duration of {duration_s:g} s has {num_time_steps:.6g} time steps of {time_step_s:g} s, over "
            f"{max_time_steps:,}; shorten it, or make the steps longer"
        )
    return int(num_time_steps + 1e-9) + 1


class ObjectLabel(NamedTuple):
    """Ground-truth box of an object in the vehicle frame.

    Args:
        object_index: Index in `Scene.objects`.
        name: Name of the object.
        category: Class name, such as `car`.
        center_m: (3,) center of the box.
        size_m: Length, width and height.
        yaw_rad: Yaw of the box.
        velocity_mps: (2,) velocity over ground along x and y of the vehicle frame.
    """

    object_index: int
    name: str
    category: str
    center_m: Matrix
    size_m: tuple[float, float, float]
    yaw_rad: float
    velocity_mps: Matrix


def compute_labels(scene: Scene, time_step_index: int, max_distance_m: float) -> list[ObjectLabel]:
    """Compute the labels of all objects near the ego vehicle at a time step.

    Boxes are upright in the vehicle frame: the body of an object that is tilted against the ego vehicle by a degree
    exceeds its box by a few centimeters.

    Args:
        scene: Scene.
        time_step_index: Index of the time step.
        max_distance_m: Largest horizontal distance between the origins of object and ego vehicle.

    Returns:
        Labels in the order of `Scene.objects`, without the ego vehicle.
    """
    time_s = time_step_index * scene.time_step_s
    world_T_vehicle = scene.ego.trajectory.interpolate(time_s)
    vehicle_T_world = invert(world_T_vehicle)
    labels: list[ObjectLabel] = []
    boxes: dict[int, BoundingBox] = {}  # by mesh, which actors of one kind share
    for object_index, actor in enumerate(scene.objects):
        position_m = actor.trajectory.interpolate_positions_m(np.array([time_s]))[0]
        # The position of an absent object is NaN, hence not near.
        if not np.hypot(*(position_m - world_T_vehicle[:3, 3])[:2]) <= max_distance_m:
            continue
        if id(actor.mesh) not in boxes:
            boxes[id(actor.mesh)] = BoundingBox.from_points(actor.mesh.vertices_m)
        box = boxes[id(actor.mesh)]
        vehicle_T_actor = vehicle_T_world @ actor.trajectory.interpolate(time_s)
        box_center_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
        label = ObjectLabel(
            object_index,
            actor.name,
            actor.category,
            center_m=transform_points(vehicle_T_actor, box_center_m[None])[0],
            size_m=box.size_m,
            yaw_rad=float(np.deg2rad(convert_rotation_to_euler(vehicle_T_actor[:3, :3])[0])),
            velocity_mps=(vehicle_T_world[:3, :3] @ actor.trajectory.compute_velocity_mps(time_s))[:2],
        )
        labels.append(label)
    return labels
