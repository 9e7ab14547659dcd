"""A scenario: the world around the ego, what moves in it, and the ego's own body."""

from pathlib import Path
from typing import Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, field_validator, model_validator

from torchcover.simulation.bodies import Body, Shape, in_vehicle_frame
from torchcover.simulation.documents import Document, Pose, beside, load_document
from torchcover.simulation.tracks import read_boxes, read_trajectory
from torchcover.simulation.trajectory import Trajectory
from torchcover.simulation.world import Actor, World


class Mover(Document):
    """A body that rests at a pose or follows a trajectory.

    Args:
        shape: Its body. Its frame follows from it: the origin lies on the ground under the centre of the bounding box,
            x forward, z up.
        pose: Where it rests in the world.
        trajectory: File of its trajectory instead; relative to the document.
    """

    shape: Shape
    pose: Pose | None = None
    trajectory: Path | None = None

    _path_beside = field_validator("trajectory")(beside)

    @model_validator(mode="after")
    def _check_one_of(self) -> Self:
        if self.pose is not None and self.trajectory is not None:
            raise ValueError("give a pose or a trajectory, not both")
        return self

    def actor(self, name: str, category: str) -> Actor:
        """Build it."""
        if self.trajectory is not None:
            trajectory = read_trajectory(self.trajectory)
        else:
            trajectory = Trajectory.from_poses([0.0], (self.pose or Pose()).matrix()[None])
        return Actor(name, category, in_vehicle_frame(self.shape.mesh()), trajectory)


class NamedMover(Mover):
    """An actor.

    Args:
        name: What messages call it.
        category: What it is: "car", "truck", "pedestrian", ...
    """

    name: str
    category: str


class Scenario(Document):
    """A world with an ego in it.

    Args:
        name: What tables and maps call it.
        description: What it is.
        ego: The vehicle that carries the rig.
        bodies: What never moves, in the world frame.
        actors: What moves, or may be recognised.
        boxes: File of recorded boxes that are actors too; relative to the document.
        time_step_s: Time between two frames.
        duration_s: Time of the last frame; frames beyond it start again at 0.

    Example:
        >>> Scenario.load("courtyard").ego.shape.type
        'vehicle'
    """

    name: str
    description: str = ""
    ego: Mover
    bodies: tuple[Body, ...] = Field(min_length=1)
    actors: tuple[NamedMover, ...] = ()
    boxes: Path | None = None
    time_step_s: PositiveFloat = 0.1
    duration_s: NonNegativeFloat = 0.0

    _path_beside = field_validator("boxes")(beside)

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
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A mesh or a trajectory cannot be used.
        """
        actors = tuple(actor.actor(actor.name, actor.category) for actor in self.actors)
        return World(
            static=tuple(mesh for body in self.bodies for mesh in body.meshes()),
            ego=self.ego.actor("ego", "ego"),
            actors=actors + (read_boxes(self.boxes) if self.boxes else ()),
            time_step_s=self.time_step_s,
            duration_s=self.duration_s,
        )
