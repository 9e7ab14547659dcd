"""What a scenario builds: bodies that rest, bodies that move, and the ego."""

from dataclasses import dataclass

from torchcover.geometry.trajectory import Trajectory
from torchcover.simulation.shapes import Mesh

# A day at ten to a second.
MAX_STEPS = 1_000_000


@dataclass(frozen=True, eq=False)
class Actor:
    """A body with a place for every time.

    Args:
        name: Different for each actor of a world.
        category: What it is: "car", "truck", "bus", "cyclist", "pedestrian", ...
        mesh: Its form in its own frame: origin on the ground under the centre of the bounding box, x forward, z up.
            Actors of one kind share one mesh object.
        trajectory: `world_T_actor` over time.
    """

    name: str
    category: str
    mesh: Mesh
    trajectory: Trajectory


@dataclass(frozen=True, eq=False)
class World:
    """Everything there is, over time.

    Args:
        static: Meshes in the world frame that never move.
        ego: The vehicle that carries the rig.
        actors: The others.
        time_step_s: Time between two frames.
        duration_s: Time after which the trajectories end.
        parked: Objects that never move, of which there may be many.
    """

    static: tuple[Mesh, ...]
    ego: Actor
    actors: tuple[Actor, ...] = ()
    time_step_s: float = 0.1
    duration_s: float = 0.0
    parked: tuple[Actor, ...] = ()

    @property
    def objects(self) -> tuple[Actor, ...]:
        """What may be recognised: the actors, then the parked. An object's number is its place in this order."""
        return self.actors + self.parked

    @property
    def steps(self) -> int:
        """Number of instants: at 0, one time step, two time steps, ... up to the duration."""
        return steps_of(self.duration_s, self.time_step_s)


def steps_of(duration_s: float, time_step_s: float) -> int:
    """Number of instants from 0 to a duration, both included.

    Raises:
        ValueError: More than a million.
    """
    steps = duration_s / time_step_s
    if not steps < MAX_STEPS:
        raise ValueError(
            f"a duration of {duration_s:g} s has {steps:.6g} time steps of {time_step_s:g} s, over {MAX_STEPS:,}; "
            "shorten it, or make the steps longer"
        )
    return int(steps + 1e-9) + 1
