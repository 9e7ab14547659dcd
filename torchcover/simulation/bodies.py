"""Bodies: shapes with poses, vehicles that consist of parts, and checks of both."""

import warnings
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Float64
from torchcover.simulation import shapes
from torchcover.simulation.body_size import warn_about_actor_size, warn_about_scenery_size
from torchcover.simulation.documents import (
    BuiltInDocument,
    Document,
    NameOrFile,
    Pose,
    find_document,
    is_file_name,
    read_mapping,
    resolve_name_or_file,
)
from torchcover.simulation.mesh_checks import check_mesh
from torchcover.simulation.mount_regions import MountRegion
from torchcover.simulation.returns import Material, get_material_index
from torchcover.simulation.shapes import Mesh

# Smaller shifts of a vehicle are rounding in its file; larger ones are reported.
MIN_REPORTED_SHIFT_M = 0.01


class VehicleShape(Document):
    """Body of a built-in vehicle or of a vehicle file.

    Args:
        vehicle: Name of a built-in vehicle, or path of a YAML file, relative to the document that names it.
    """

    type: Literal["vehicle"]
    vehicle: NameOrFile

    def build_mesh(self) -> Mesh:
        """Build one mesh of all parts, in the vehicle frame."""
        return self._vehicle.build_mesh()

    def build_placed_mesh(self) -> Mesh:
        """Build one mesh of all parts, in the frame of the vehicle document."""
        return self._vehicle.build_placed_mesh()

    def collect_content(self) -> dict[str, Any]:
        """Collect the content of the vehicle and of the files that it names."""
        return self._vehicle.collect_content()

    @cached_property
    def _vehicle(self) -> "Vehicle":
        """Vehicle document, read once."""
        return Vehicle.load(self.vehicle)


Shape = Annotated[
    shapes.Plane | shapes.Box | shapes.Frustum | shapes.Cylinder | shapes.MeshFile | shapes.Ellipsoid | VehicleShape,
    Field(discriminator="type"),
]


def build_checked_mesh(shape: Shape, owner: str) -> Mesh:
    """Build the mesh of a shape, with warnings about defects of a mesh file.

    Args:
        shape: Shape.
        owner: Name of the body in warnings.

    Warns:
        UserWarning: See `check_mesh`.
    """
    return check_mesh(owner, shape.build_mesh()) if isinstance(shape, shapes.MeshFile) else shape.build_mesh()


class Body(Document):
    """Named shape at one or more poses.

    Args:
        name: Name in messages.
        shape: Shape, in its own frame.
        poses: Poses of the shape in the frame of the document; one copy for each.
        material: Built-in material or path of a YAML file. None: ground is `road`, other scenery `brick`, vehicles and
            moving bodies `car_paint`, and pedestrians `clothing`.
        ground: In a scenario: True for a body on which one drives or walks, so that heights are measured from its level
            faces. If a scenario marks none, the ground is what is level under the ego vehicle and connected with that
            by steps of at most 0.3 m.
    """

    name: str
    shape: Shape
    poses: tuple[Pose, ...] = Field(default=(Pose(),), min_length=1)
    material: NameOrFile | None = None
    ground: bool = False

    @model_validator(mode="after")
    def _check_material(self) -> Self:
        if self.material is not None:
            try:
                get_material_index(self.material)
            except FileNotFoundError as error:
                raise ValueError(f"material: {error}") from error
        return self

    def collect_content(self) -> dict[str, Any]:
        """Collect the keys of the body; a material file is replaced by its content."""
        content = super().collect_content()
        if self.material is not None and is_file_name(self.material):
            content["material"] = Material.load(str(self.material)).collect_content()
        return content

    def build_meshes(self) -> list[Mesh]:
        """Build one mesh for each pose.

        Warns:
            UserWarning: The body is larger than any scenery, or a mesh file has defects.
        """
        mesh = build_checked_mesh(self.shape, f"body {self.name!r}")
        if self.material is not None or self.ground:
            mesh = mesh.assign_material(self.material or "road")
        warn_about_scenery_size(f"body {self.name!r}", mesh)
        return [mesh.transform(pose.to_matrix()) for pose in self.poses]


RegionName = Annotated[str, Field(min_length=1)]


class Vehicle(BuiltInDocument):
    """Body of a vehicle that consists of parts.

    Args:
        name: Name in messages.
        description: Vehicle and source of its dimensions.
        extends: Another vehicle, by name or file, whose parts and mount regions are added.
        parts: Parts in one frame with x forward and z up; the frame of the extended vehicle if there is one.
        mount_regions: Areas of the body on which sensors can be mounted, by name, in the vehicle frame.
    """

    kind: ClassVar[str] = "a vehicle"
    folder: ClassVar[str] = "vehicles"

    name: str
    description: str = ""
    extends: NameOrFile | None = None
    parts: tuple[Body, ...] = Field(min_length=1)
    mount_regions: dict[RegionName, MountRegion] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _add_parts_of_base(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (raw content of a file)
        if not isinstance(content, dict) or not isinstance(content.get("extends"), str):
            return content
        base_name = resolve_name_or_file(content["extends"], info)
        base_of_base = read_mapping(find_document(cls.folder, base_name)).get("extends")
        if base_of_base is not None:  # a chain may be endless
            raise ValueError(
                f"extends: {base_name} extends {base_of_base!r} itself; extend that one, and copy the other parts"
            )
        base = cls.load(base_name)
        parts, regions = content.get("parts", ()), content.get("mount_regions", {})
        if not isinstance(parts, list | tuple) or not isinstance(regions, dict):
            return content
        return {**content, "parts": (*base.parts, *parts), "mount_regions": {**base.mount_regions, **regions}}

    @model_validator(mode="after")
    def _check_parts(self) -> Self:
        for part in self.parts:
            if part.ground:
                raise ValueError(
                    f"part {part.name!r} is ground; only bodies of a scenario can be, since they do not move"
                )
            if isinstance(part.shape, VehicleShape):
                raise ValueError(
                    f"part {part.name!r} is the vehicle {part.shape.vehicle!r}, which may contain this one; copy that "
                    "vehicle's parts"
                )
        return self

    @model_validator(mode="after")
    def _check_origin(self) -> Self:
        if self.extends is not None:
            base_m = Vehicle.load(self.extends).build_placed_mesh().vertices_m
            shift_m = _compute_center_m(self.build_placed_mesh().vertices_m) - _compute_center_m(base_m)
            if np.abs(shift_m).max() > MIN_REPORTED_SHIFT_M:
                warnings.warn(
                    f"vehicle {self.name!r}: its additions to {self.extends} shift the center of its bounding box, "
                    f"from which mounts are measured, by x {shift_m[0]:+.2f}, y {shift_m[1]:+.2f} m; subtract "
                    f"that from mounts on {self.extends} to keep them at the same spot",
                    stacklevel=2,
                )
        return self

    def build_mesh(self) -> Mesh:
        """Build one mesh of all parts in the vehicle frame; parts without a material are `car_paint`."""
        return move_to_vehicle_frame(self.build_placed_mesh())

    def build_placed_mesh(self) -> Mesh:
        """Build one mesh of all parts in the frame of the document; parts without a material are `car_paint`."""
        meshes = []
        for part in self.parts:
            for mesh in part.build_meshes():
                meshes.append(mesh.assign_material("car_paint") if mesh.material_indices is None else mesh)
        return merge_meshes(meshes)

    def collect_content(self) -> dict[str, Any]:
        """Collect the parts of the body; mount regions do not affect mounted sensors."""
        content = super().collect_content()
        return {key: value for key, value in content.items() if key not in ("mount_regions", "extends")}


def get_mount_regions(shape: Shape | None) -> dict[str, MountRegion]:
    """Get the mount regions of a body by name; empty for shapes other than vehicles.

    Args:
        shape: Shape of the ego vehicle; None for the default.
    """
    if not isinstance(shape, VehicleShape):
        return {}
    return Vehicle.load(shape.vehicle).mount_regions


def describe_windows(shape: Shape | None) -> str:
    """Describe which materials of a mesh file look transparent but stop rays; empty if there are none.

    Args:
        shape: Shape of the ego vehicle; the mesh files of all its parts are checked.

    Returns:
        Finding and remedy for the first such mesh file.
    """
    parts: tuple[Body, ...] = Vehicle.load(shape.vehicle).parts if isinstance(shape, VehicleShape) else ()
    for mesh in (shape, *(part.shape for part in parts)):
        if isinstance(mesh, shapes.MeshFile) and (names := mesh.list_transparent_materials()):
            return (
                f"{mesh.path.name}: {', '.join(repr(name) for name in names)} look transparent and stop rays; to let "
                f"rays pass, give its shape `transparent: [{', '.join(names)}]` in a vehicle file"
            )
    return ""


def _compute_center_m(vertices_m: Float64) -> Float64:
    """Compute the (2,) center of the bounding box in bird's-eye view."""
    return np.asarray((vertices_m.min(axis=0) + vertices_m.max(axis=0))[:2] / 2)


def move_to_vehicle_frame(mesh: Mesh, *, keep_height: bool = False) -> Mesh:
    """Move a mesh so that the origin lies on the ground under the center of its bounding box.

    Args:
        mesh: Mesh in any frame with z up.
        keep_height: True to keep a mesh above z = 0 at its height; a mesh that reaches below is lifted in any case.
    """
    box = BoundingBox.from_points(mesh.vertices_m)
    (x0, y0, z0), (x1, y1, _) = box.lower_m, box.upper_m
    z_m = -min(z0, 0.0) if keep_height else -z0
    return mesh.transform(build_transform(np.eye(3), [-(x0 + x1) / 2, -(y0 + y1) / 2, z_m]))


def build_actor_mesh(name: str, shape: Shape, category: str = "ego", *, keep_height: bool = False) -> Mesh:
    """Build the body of the ego vehicle or of an actor in its vehicle frame.

    Args:
        name: Name in messages.
        shape: Shape of the body.
        category: Class name; pedestrians are `clothing`, all others `car_paint`, unless their material is given.
        keep_height: See `move_to_vehicle_frame`.

    Warns:
        UserWarning: The body has an impossible size or proportions, or is moved down onto the ground.
    """
    mesh = shape.build_placed_mesh() if isinstance(shape, VehicleShape) else build_checked_mesh(shape, name)
    bottom_m = float(mesh.vertices_m[:, 2].min())
    is_lowered = category != "ego" and bottom_m > MIN_REPORTED_SHIFT_M and not keep_height
    if isinstance(shape, VehicleShape) and is_lowered:
        warnings.warn(
            f"{name}: all parts of {get_shape_name(shape)} are {bottom_m:.3g} m or more above z = 0, and it is moved "
            "down onto the ground; give it a part that stands on the ground, or its lowest z_m in the pose",
            stacklevel=3,
        )
    mesh = move_to_vehicle_frame(mesh, keep_height=keep_height)
    if mesh.material_indices is None:
        is_pedestrian = category in ("pedestrian", "person", "adult", "child")
        mesh = mesh.assign_material("clothing" if is_pedestrian else "car_paint")
    warn_about_actor_size(name, mesh, category)
    return mesh


def get_shape_name(shape: Shape) -> str:
    """Get the name of a body for tables: the name of a built-in vehicle, of a file, or the type of the shape.

    Args:
        shape: Shape.

    Example:
        >>> get_shape_name(VehicleShape(type="vehicle", vehicle="here/my_van.yaml"))
        'my_van.yaml'
    """
    if isinstance(shape, VehicleShape):
        return Path(shape.vehicle).name
    return shape.path.name if isinstance(shape, shapes.MeshFile) else shape.type


def create_body_shape(name_or_path: str | Path) -> VehicleShape | shapes.MeshFile:
    """Create the shape of a built-in vehicle, a vehicle file (YAML), or a mesh file in meters.

    Args:
        name_or_path: Name of a built-in vehicle, or path.

    Example:
        >>> create_body_shape("suv").type, create_body_shape("robot.stl").type
        ('vehicle', 'mesh')
    """
    path = Path(name_or_path)
    if path.suffix == "" or is_file_name(path):
        return VehicleShape(type="vehicle", vehicle=str(name_or_path))
    return shapes.MeshFile(type="mesh", path=path)


def merge_meshes(meshes: list[Mesh]) -> Mesh:
    """Merge meshes into one.

    Args:
        meshes: At least one mesh.

    Returns:
        Mesh with the vertices, faces and materials of all. `is_outward` is known if all faces of all meshes are
        outward, since closed outward surfaces that share edges form one closed outward surface.
    """
    first_vertices = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes[:-1])])
    outward_masks = [mesh.is_outward for mesh in meshes if mesh.is_outward is not None]
    is_outward = None
    if len(outward_masks) == len(meshes) and all(mask.all() for mask in outward_masks):
        is_outward = np.concatenate(outward_masks)
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + first for mesh, first in zip(meshes, first_vertices, strict=True)]),
        np.concatenate([mesh.filled_material_indices for mesh in meshes]),
        is_outward,
    )
