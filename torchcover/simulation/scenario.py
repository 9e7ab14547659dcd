"""A scenario: the world around the ego, and the ego's own body."""

from pathlib import Path
from typing import Self

from pydantic import Field

from torchcover.simulation.bodies import Body, Shape, in_vehicle_frame
from torchcover.simulation.documents import Document, Pose, load_document
from torchcover.simulation.trajectory import Trajectory
from torchcover.simulation.world import Actor, World


class Ego(Document):
    """The vehicle that carries the rig.

    Args:
        shape: Its body. The vehicle frame follows from it: the origin lies on the ground under the centre of the
            bounding box, x forward, z up.
        pose: `world_T_vehicle`.
    """

    shape: Shape
    pose: Pose = Pose()


class Scenario(Document):
    """A static world with an ego in it.

    Args:
        name: What tables and maps call it.
        description: What it is.
        ego: The vehicle that carries the rig.
        bodies: Everything else, in the world frame.

    Example:
        >>> Scenario.load("courtyard").ego.shape.type
        'vehicle'
    """

    name: str
    description: str = ""
    ego: Ego
    bodies: tuple[Body, ...] = Field(min_length=1)

    @classmethod
    def load(cls, path_or_name: str | Path) -> Self:
        """Read a scenario from a YAML file, or a built-in one by its name (`torchcover list`).

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is not a scenario; the message names the file and the key.
        """
        return load_document(cls, "scenarios", path_or_name)

    def world(self) -> World:
        """Build it.

        Raises:
            FileNotFoundError: A mesh or vehicle file is missing.
            ValueError: A mesh cannot be used.
        """
        ego = Actor(
            "ego",
            "ego",
            in_vehicle_frame(self.ego.shape.mesh()),
            Trajectory.from_poses([0.0], self.ego.pose.matrix()[None]),
        )
        return World(static=tuple(mesh for body in self.bodies for mesh in body.meshes()), ego=ego)
