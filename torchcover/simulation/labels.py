"""What a perfect observer would write down about a world: a box around each object."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, euler_from_rotation, invert, transform
from torchcover.simulation.world import Actor, World

Matrix = NDArray[np.float64]


class Label(NamedTuple):
    """An object in the vehicle frame: the box of its body, its yaw, and its velocity over ground along x and y.

    `number` is its place in `World.objects`.
    """

    number: int
    name: str
    category: str
    centre_m: Matrix
    size_m: tuple[float, float, float]
    yaw_rad: float
    velocity_mps: Matrix


def labels(world: World, step: int, within_m: float) -> list[Label]:
    """All objects near the ego at one step, the ego itself left out.

    Args:
        world: The world.
        step: Number of time steps since its start.
        within_m: An object is near if the origin of its frame is, measured over ground.

    Returns:
        One label an object, in the order of the world. Boxes stand upright in the vehicle frame: a body that tilts
        against the ego by a degree leaves its box by a few centimetres.
    """
    time_s = step * world.time_step_s
    world_T_vehicle = world.ego.trajectory.at(time_s)
    vehicle_T_world = invert(world_T_vehicle)
    found, box_of = [], dict[int, BoundingBox]()  # actors of one kind share a mesh
    for number, actor in enumerate(world.objects):
        position_m = actor.trajectory.positions_at(np.array([time_s]))[0]
        # Not near, too, if absent: NaN.
        if np.hypot(*(position_m - world_T_vehicle[:3, 3])[:2]) <= within_m:
            if id(actor.mesh) not in box_of:
                box_of[id(actor.mesh)] = BoundingBox.around(actor.mesh.vertices_m)
            found.append(_label(number, actor, box_of[id(actor.mesh)], vehicle_T_world, time_s))
    return found


def _label(number: int, actor: Actor, box: BoundingBox, vehicle_T_world: Matrix, time_s: float) -> Label:
    vehicle_T_actor = vehicle_T_world @ actor.trajectory.at(time_s)
    middle_m = (np.array(box.lower_m) + np.array(box.upper_m)) / 2
    return Label(
        number,
        actor.name,
        actor.category,
        centre_m=transform(vehicle_T_actor, middle_m[None])[0],
        size_m=box.size_m,
        yaw_rad=float(np.deg2rad(euler_from_rotation(vehicle_T_actor[:3, :3])[0])),
        velocity_mps=(vehicle_T_world[:3, :3] @ actor.trajectory.velocity_at(time_s))[:2],
    )
