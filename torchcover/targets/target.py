"""What is put beside the vehicle: a built-in body, or one from a file."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

from torchcover.simulation.bodies import body_called, mover_mesh
from torchcover.simulation.moving import Solid
from torchcover.simulation.shapes import Mesh

# What people say -> the built-in body that is meant, whose name has its size.
TARGETS = {"child": "child_110cm", "adult": "adult", "dog": "dog_57cm", "cyclist": "cyclist", "pole": "pole_100cm"}


@dataclass(frozen=True, eq=False)
class Target:
    """A body that is asked about. It keeps the height above the ground at which its file places it.

    Args:
        name: What tables call it: the name of the body, with its size where it is built in for this.
        mesh: Its form; origin on the ground under the center of its bounding box, x ahead, z up.

    Example:
        >>> child = Target.load("child")
        >>> child.name, round(child.solid.box.size_m[2], 2)
        ('child_110cm', 1.1)
    """

    name: str
    mesh: Mesh

    @cached_property
    def solid(self) -> Solid:
        """Its geometry, to cast rays at."""
        return Solid(self.mesh)

    def __getstate__(self) -> dict[str, object]:
        return {"name": self.name, "mesh": self.mesh}  # Embree's scenes cannot be pickled

    @property
    def bottom_m(self) -> float:
        """Height of its lowest point above the ground, in meters."""
        return self.solid.box.lower_m[2]

    @classmethod
    def load(cls, name_or_path: str | Path) -> Self:
        """One of `TARGETS`, a built-in vehicle by its name, the YAML file of one, or a mesh file in meters.

        The ground is z = 0 of the file: what lies above stays there, and what reaches below is put on the ground.

        Raises:
            FileNotFoundError: No such file or name.
            ValueError: The file is neither a vehicle nor a mesh, or is flat.
        """
        name = TARGETS.get(str(name_or_path), str(name_or_path))
        mesh = mover_mesh(f"target {name!r}", body_called(name), "target", keep_height=True)
        return cls(Path(name).stem if Path(name).suffix else name, mesh)
