"""Bodies: shapes at places, and vehicles put together from them."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from torchcover.geometry import BoundingBox, rigid
from torchcover.simulation import shapes
from torchcover.simulation.documents import Document, Pose, load_document
from torchcover.simulation.shapes import Mesh


class VehicleShape(Document):
    """A vehicle from the folder of vehicles, or from a file.

    Args:
        vehicle: Name of a built-in vehicle, or path of a YAML file.
    """

    type: Literal["vehicle"]
    vehicle: str

    def mesh(self) -> Mesh:
        """All parts in one mesh, in the vehicle frame."""
        return load_document(Vehicle, "vehicles", self.vehicle).mesh()

    def content(self) -> dict[str, Any]:
        """Its parts, wherever they stand."""
        return load_document(Vehicle, "vehicles", self.vehicle).content()


Shape = Annotated[
    shapes.Plane | shapes.Box | shapes.Frustum | shapes.Cylinder | shapes.MeshFile | shapes.Ellipsoid | VehicleShape,
    Field(discriminator="type"),
]


class Body(Document):
    """A shape with a name, at one or more places.

    Args:
        name: What messages call it.
        shape: Its form, in its own frame.
        poses: Where its frame lies in that of the document; one copy for each.
    """

    name: str
    shape: Shape
    poses: tuple[Pose, ...] = Field(default=(Pose(),), min_length=1)

    def meshes(self) -> list[Mesh]:
        """One mesh for each pose."""
        mesh = self.shape.mesh()
        shapes.warn_of_units(f"body {self.name!r}", mesh, moves=False)
        return [mesh.moved(pose.matrix()) for pose in self.poses]


class Vehicle(Document):
    """The body of a vehicle, put together from parts.

    Args:
        name: What messages call it.
        description: What it is.
        parts: Its parts, in one frame with x forward and z up.
    """

    name: str
    description: str = ""
    parts: tuple[Body, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_parts(self) -> Self:
        for part in self.parts:
            if isinstance(part.shape, VehicleShape):
                raise ValueError(
                    f"part {part.name!r} is the vehicle {part.shape.vehicle!r}; a vehicle is put together from other "
                    "shapes, or it would never end: copy that vehicle's parts"
                )
        return self

    def mesh(self) -> Mesh:
        """All parts in one mesh, in the vehicle frame."""
        return in_vehicle_frame(merge([mesh for part in self.parts for mesh in part.meshes()]))


def in_vehicle_frame(mesh: Mesh) -> Mesh:
    """Move a mesh so that the origin lies on the ground under the centre of its bounding box."""
    box = BoundingBox.around(mesh.vertices_m)
    (x0, y0, z0), (x1, y1, _) = box.lower_m, box.upper_m
    return mesh.moved(rigid(np.eye(3), [-(x0 + x1) / 2, -(y0 + y1) / 2, -z0]))


def mover_mesh(name: str, shape: Shape) -> Mesh:
    """The body of the ego or of an actor in its vehicle frame; a warning if it is too large for one.

    Args:
        name: What the warning calls it.
        shape: Its form, in its own frame.
    """
    mesh = in_vehicle_frame(shape.mesh())
    shapes.warn_of_units(name, mesh, moves=True)
    return mesh


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh with the vertices and faces of all."""
    offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes[:-1])])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )
