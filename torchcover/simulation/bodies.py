"""Bodies: shapes at places, vehicles put together from them, and hints that one is in other units, or turned."""

import re
import warnings
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Float64
from torchcover.simulation import shapes
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
from torchcover.simulation.mount_regions import MountRegion
from torchcover.simulation.returns import Material, get_material_index
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sound import check_mesh

# No building, and no terrain within a sensor's range, is higher.
TALLEST_SCENERY_M = 1000.0
# The longest lorries of the EU (module combinations of 25.25 m) and buses; the longest tram or train unit.
LONGEST_ON_ROADS_M = 25.25
LONGEST_M = 100.0
# Smaller robots exist with any proportions; no car is shorter.
SHORTEST_CAR_M = 2.0
SHORTEST_M = 0.2
# A body that is higher than so many times its length and width is a mast, and no car on its nose.
MAST_SLENDERNESS = 5.0
# A vehicle that is moved down onto the ground by more than this is worth a warning; less is rounding in its file.
LOWERED_M = 0.01

# Words of a category that stand for what is longer than wide and high, and no longer than lorries. Of the others,
# people are wider than long, and trams longer.
ROAD_VEHICLES = {"ego", "car", "truck", "lorry", "bus", "van", "suv", "vehicle", "trailer", "taxi", "pickup"}
ON_FOOT = {"pedestrian", "person", "adult", "child"}
RAIL_VEHICLES = {"tram", "train", "rail", "railed"}

TURN = (
    "a vehicle's x axis points forward and z up: turn it in a vehicle document, as the shape of a part with `poses: "
    "[{angles}]`"
)
# Axes of files: where the vehicle's front and top are, and the pose that turns them to x and z.
WIDE = TURN.format(angles="{yaw_deg: -90}") + " if its y points forward, `{yaw_deg: 90}` if -y does"
HIGH = (
    TURN.format(angles="{yaw_deg: 90, roll_deg: 90}")
    + " if its y points up and its z forward (glTF and GLB), `{roll_deg: 90}` if y points up and x forward"
)
UNITS = (
    "a file in millimetres needs `meters_per_unit: 0.001` beside its `path`, one in centimetres 0.01, one in inches "
    "0.0254"
)


def warn_about_actor_size(owner: str, mesh: Mesh, category: str) -> None:
    """Warn if the ego or an actor is as large, as small or as wide as none is."""
    words = set(re.split(r"[^a-z]+", category.lower()))
    on_roads = bool(words & ROAD_VEHICLES) and not words & RAIL_VEHICLES
    x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
    longest_m = max(x, y, z)
    if longest_m > (LONGEST_ON_ROADS_M if on_roads else LONGEST_M):
        _warn(owner, (x, y, z), f"far too large{' for a vehicle on a road' if on_roads else ''}; {UNITS}")
    elif on_roads and longest_m < SHORTEST_M:
        _warn(owner, (x, y, z), "too small for a vehicle: is its `meters_per_unit` that of its file?")
    elif on_roads and longest_m > SHORTEST_CAR_M and max(y, z) > x and z < MAST_SLENDERNESS * max(x, y):
        _warn(owner, (x, y, z), f"wider than long; {WIDE}" if y > z else f"higher than long; {HIGH}")


def _warn(owner: str, size_m: tuple[float, float, float], what: str) -> None:
    x, y, z = (f"{extent_m:,.0f}" if extent_m >= 1000 else f"{extent_m:.3g}" for extent_m in size_m)
    warnings.warn(f"{owner}: its body is {x} x {y} x {z} m, {what}", stacklevel=4)


class VehicleShape(Document):
    """A vehicle from the folder of vehicles, or from a file.

    Args:
        vehicle: Name of a built-in vehicle, or path of a YAML file; relative to the document that names it.
    """

    type: Literal["vehicle"]
    vehicle: NameOrFile

    def build_mesh(self) -> Mesh:
        """All parts in one mesh, in the vehicle frame."""
        return self._read.build_mesh()

    def build_placed_mesh(self) -> Mesh:
        """All parts in one mesh, where the document of the vehicle places them."""
        return self._read.build_placed_mesh()

    def collect_content(self) -> dict[str, Any]:
        """Its parts, wherever they stand."""
        return self._read.collect_content()

    @cached_property
    def _read(self) -> "Vehicle":
        """Once: every survey asks for its form several times."""
        return Vehicle.load(self.vehicle)


Shape = Annotated[
    shapes.Plane | shapes.Box | shapes.Frustum | shapes.Cylinder | shapes.MeshFile | shapes.Ellipsoid | VehicleShape,
    Field(discriminator="type"),
]


def build_checked_mesh(shape: Shape, owner: str) -> Mesh:
    """The form of a body, with warnings if a file has lies in it; see `told`."""
    return check_mesh(owner, shape.build_mesh()) if isinstance(shape, shapes.MeshFile) else shape.build_mesh()


class Body(Document):
    """A shape with a name, at one or more places.

    Args:
        name: What messages call it.
        shape: Its form, in its own frame.
        poses: Where its frame lies in that of the document; one copy for each.
        material: What it is made of, a built-in material or the path of a YAML file. Not given: ground is `road`, other
            scenery `brick`, and what moves or is a vehicle `car_paint`, or `clothing` if it walks.
        ground: In a scenario: whether one drives or walks on it, so that heights are measured from its level faces. If
            no body of a scenario is, the ground is what is level under the ego and connected with that by steps of at
            most 0.3 m.
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
        """Its keys; of a material from a file what stands there."""
        own = self.material is not None and is_file_name(self.material)
        return super().collect_content() | (
            {"material": Material.load(str(self.material)).collect_content()} if own else {}
        )

    def build_meshes(self) -> list[Mesh]:
        """One mesh for each pose."""
        mesh = build_checked_mesh(self.shape, f"body {self.name!r}")
        if self.material is not None or self.ground:
            mesh = mesh.assign_material(self.material or "road")
        x, y, z = np.ptp(mesh.vertices_m, axis=0).tolist()
        if min(x, y, z) > TALLEST_SCENERY_M:  # of what may be a whole city
            _warn(f"body {self.name!r}", (x, y, z), f"far too large; {UNITS}")
        return [mesh.transform(pose.to_matrix()) for pose in self.poses]


RegionName = Annotated[str, Field(min_length=1)]


class Vehicle(BuiltInDocument):
    """The body of a vehicle, put together from parts.

    Args:
        name: What messages call it.
        description: What it is.
        extends: Another vehicle, by its name or file, whose parts and mount regions it has, too.
        parts: Its parts, in one frame with x forward and z up: that of the vehicle that it extends.
        mount_regions: By name, patches of its skin that sensors can be mounted on, in the vehicle frame.
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
    def _add_parts_of_base(cls, content: Any, info: ValidationInfo) -> Any:  # noqa: ANN401  (whatever stood in the file)
        if not isinstance(content, dict) or not isinstance(content.get("extends"), str):
            return content
        name = resolve_name_or_file(content["extends"], info)
        further = read_mapping(find_document(cls.folder, name)).get("extends")
        if further is not None:  # which may be a ring, too
            raise ValueError(f"extends: {name} extends {further!r} itself; extend that one, and copy the other parts")
        base = cls.load(name)
        parts, regions = content.get("parts", ()), content.get("mount_regions", {})
        if not isinstance(parts, list | tuple) or not isinstance(regions, dict):
            return content
        return {**content, "parts": (*base.parts, *parts), "mount_regions": {**base.mount_regions, **regions}}

    @model_validator(mode="after")
    def _check_parts(self) -> Self:
        for part in self.parts:
            if part.ground:
                raise ValueError(f"part {part.name!r} is ground; only the bodies of a scenario can be, for they rest")
            if isinstance(part.shape, VehicleShape):
                raise ValueError(
                    f"part {part.name!r} is the vehicle {part.shape.vehicle!r}; a vehicle is put together from other "
                    "shapes, or it would never end: copy that vehicle's parts"
                )
        return self

    @model_validator(mode="after")
    def _check_origin(self) -> Self:
        if self.extends is not None:
            base = Vehicle.load(self.extends).build_placed_mesh().vertices_m
            shift_m = _middle_m(self.build_placed_mesh().vertices_m) - _middle_m(base)
            if np.abs(shift_m).max() > LOWERED_M:
                warnings.warn(
                    f"vehicle {self.name!r}: what it adds to {self.extends} moves the middle of its bounding box, from "
                    f"which mounts are measured, by x {shift_m[0]:+.2f}, y {shift_m[1]:+.2f} m; subtract that from "
                    f"mounts on {self.extends} to keep them at the same spot",
                    stacklevel=2,
                )
        return self

    def build_mesh(self) -> Mesh:
        """All parts in one mesh, in the vehicle frame; painted, where they do not say their material."""
        return move_to_vehicle_frame(self.build_placed_mesh())

    def build_placed_mesh(self) -> Mesh:
        """All parts in one mesh, where the document places them."""
        meshes = [mesh for part in self.parts for mesh in part.build_meshes()]
        return merge_meshes(
            [mesh.assign_material("car_paint") if mesh.material_indices is None else mesh for mesh in meshes]
        )

    def collect_content(self) -> dict[str, Any]:
        """Its body; where sensors may be mounted on it means nothing to those that are."""
        return {
            key: value for key, value in super().collect_content().items() if key not in ("mount_regions", "extends")
        }


def get_mount_regions(shape: Shape | None) -> dict[str, MountRegion]:
    """Where sensors can be mounted on a body: on a vehicle that says it."""
    if not isinstance(shape, VehicleShape):
        return {}
    return Vehicle.load(shape.vehicle).mount_regions


def describe_windows(shape: Shape | None) -> str:
    """Say which materials of a body look transparent and stop rays, and how to let these pass; empty if none does."""
    parts: tuple[Body, ...] = Vehicle.load(shape.vehicle).parts if isinstance(shape, VehicleShape) else ()
    for mesh in (shape, *(part.shape for part in parts)):
        if isinstance(mesh, shapes.MeshFile) and (names := mesh.list_transparent_materials()):
            return (
                f"{mesh.path.name}: {', '.join(map(repr, names))} look transparent and stop rays; to let rays pass, "
                f"give its shape `transparent: [{', '.join(names)}]` in a vehicle file"
            )
    return ""


def _middle_m(vertices_m: Float64) -> Float64:
    """(2,) middle of the bounding box, seen from above."""
    return np.asarray((vertices_m.min(axis=0) + vertices_m.max(axis=0))[:2] / 2)


def move_to_vehicle_frame(mesh: Mesh, *, keep_height: bool = False) -> Mesh:
    """Move a mesh so that the origin lies on the ground under the center of its bounding box.

    Args:
        mesh: The mesh, in any frame.
        keep_height: Whether a mesh above z = 0 stays so high above the ground. One that reaches below is lifted anyway.
    """
    box = BoundingBox.from_points(mesh.vertices_m)
    (x0, y0, z0), (x1, y1, _) = box.lower_m, box.upper_m
    z_m = -min(z0, 0.0) if keep_height else -z0
    return mesh.transform(build_transform(np.eye(3), [-(x0 + x1) / 2, -(y0 + y1) / 2, z_m]))


def build_actor_mesh(name: str, shape: Shape, category: str = "ego", *, keep_height: bool = False) -> Mesh:
    """The body of the ego or of an actor in its vehicle frame; a warning if it is too large, too small or turned.

    `keep_height` is that of `move_to_vehicle_frame`.
    """
    mesh = shape.build_placed_mesh() if isinstance(shape, VehicleShape) else build_checked_mesh(shape, name)
    bottom_m = float(mesh.vertices_m[:, 2].min())
    if isinstance(shape, VehicleShape) and category != "ego" and bottom_m > LOWERED_M and not keep_height:
        warnings.warn(
            f"{name}: all parts of {get_shape_name(shape)} are {bottom_m:.3g} m or more above z = 0, and it is put on the "
            "ground; give it a part that stands on the ground, or the z_m of its lowest point in the pose",
            stacklevel=3,
        )
    mesh = move_to_vehicle_frame(mesh, keep_height=keep_height)
    if mesh.material_indices is None:
        mesh = mesh.assign_material("clothing" if category in ON_FOOT else "car_paint")
    warn_about_actor_size(name, mesh, category)
    return mesh


def get_shape_name(shape: Shape) -> str:
    """What a picture or a table calls a body: the name of a built-in vehicle, the name of a file, or the kind of shape.

    Example:
        >>> get_shape_name(VehicleShape(type="vehicle", vehicle="here/my_van.yaml"))
        'my_van.yaml'
    """
    if isinstance(shape, VehicleShape):
        return Path(shape.vehicle).name
    return shape.path.name if isinstance(shape, shapes.MeshFile) else shape.type


def create_body_shape(name_or_path: str | Path) -> VehicleShape | shapes.MeshFile:
    """The shape that a name or a path means: a vehicle's, unless it is a file that is no YAML.

    Example:
        >>> create_body_shape("suv").type, create_body_shape("robot.stl").type
        ('vehicle', 'mesh')
    """
    path = Path(name_or_path)
    if path.suffix == "" or is_file_name(path):
        return VehicleShape(type="vehicle", vehicle=str(name_or_path))
    return shapes.MeshFile(type="mesh", path=path)


def merge_meshes(meshes: list[Mesh]) -> Mesh:
    """One mesh with the vertices and faces of all."""
    offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes[:-1])])
    outward = [mesh.is_outward for mesh in meshes if mesh.is_outward is not None]
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
        np.concatenate([mesh.filled_material_indices for mesh in meshes]),
        # Those of surfaces that share edges, all of them closed and turned outwards, are one that is.
        np.concatenate(outward) if len(outward) == len(meshes) and all(one.all() for one in outward) else None,
    )
