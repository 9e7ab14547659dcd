"""What a simulated rig saw at one step, as writers need it."""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchcover.data.formats.arrays import Points
from torchcover.data.frame import Frame
from torchcover.data.simulated import SimulatedFrames
from torchcover.geometry.rigid import Matrix

# Between the last step of a city and the first of the next, or of the same world again: no reference of a recording is
# accumulated over so long a time.
APART_S = 1000.0


class Step(NamedTuple):
    """A step of a simulated recording.

    Args:
        name: What its files are called.
        time_s: When it was.
        world_T_vehicle: (4, 4) where the vehicle was.
        clouds: Name of each sensor -> (N, 3) float32 points in the vehicle frame.
        frame: Everything together.
    """

    name: str
    time_s: float
    world_T_vehicle: Matrix
    clouds: Mapping[str, Points]
    frame: Frame


class Recorder(Protocol):
    """Writes a recording step by step. Made from the folder and the frames, which it refuses if it cannot hold them."""

    def write(self, step: Step, /) -> None:
        """Write a step; what was written before stays good if this one fails."""
        ...


def simulated_step(frames: SimulatedFrames, index: int) -> Step:
    """Simulate a step of the only rig.

    Args:
        frames: The simulation.
        index: Number of the step.
    """
    ((name, rig),) = frames.rigs.items()
    seen = frames.simulator.step(index)
    ends = np.cumsum(seen.sensor_points[name])
    clouds: list[NDArray[np.float32]] = np.split(seen.clouds[name], ends[:-1])
    scene, step = frames.simulator.scene_of(index)
    world = scene.world
    played = round(index * frames.every_s / world.time_step_s) // world.steps if world.steps > 1 else 0
    return Step(
        f"{index:06d}",
        index * frames.every_s + played * APART_S,
        world.ego.trajectory.at(step * world.time_step_s),
        {sensor.name: cloud for sensor, cloud in zip(rig.sensors, clouds, strict=True)},
        frames.frame_of(seen, index),
    )
