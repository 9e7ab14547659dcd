"""Shapes: primitives, and meshes from files."""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveFloat

from torchcover.files import check_memory, guard_reader
from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.documents import Document, RelativePath
from torchcover.simulation.mesh_files import read_mesh_arrays
from torchcover.simulation.returns import get_material_index

CYLINDER_SIDES = 24
MAX_SIDES = 10_000
ELLIPSOID_SIDES = 12  # around the z axis; half as many bands from pole to pole

# So many faces are looked at together: what is computed for each takes far more memory than the face.
PART = 1 << 16
# What trimesh takes for each byte of a mesh's file at most: text becomes lists of words.
_BYTES_PER_TEXT_BYTE, _BYTES_PER_BINARY_BYTE = 16, 10

Length = PositiveFloat


class Mesh(NamedTuple):
    """A triangle mesh: `vertices_m` (V, 3) float64 in metres and `faces` (F, 3) int64 indices into them.

    `material_indices` (F,) uint8 is what each face is made of, by `get_material_index`; None, as 0, where that is not said.
    `is_outward` (F,) is what `find_outward_faces` says, where that is known.
    """

    vertices_m: Float64
    faces: Int64
    material_indices: NDArray[np.uint8] | None = None
    is_outward: Bools | None = None

    def transform(self, destination_T_source: Float64) -> "Mesh":
        """The mesh in another frame."""
        return self._replace(vertices_m=transform_points(destination_T_source, self.vertices_m))

    def select_faces(self, selection: Bools | Int64) -> "Mesh":
        """Some of its faces, of what they were made of."""
        material = None if self.material_indices is None else self.material_indices[selection]
        return Mesh(self.vertices_m, self.faces[selection], material)

    def iterate_parts(self) -> Iterator[tuple[slice, Float64]]:
        """Which faces, and their (3, 3, N) corners, coordinates, faces: as many at a time as there is memory for."""
        return iterate_mesh_parts([self])

    def assign_material(self, material_name: str) -> "Mesh":
        """The mesh with all its faces of a built-in material."""
        return self._replace(
            material_indices=np.full(len(self.faces), get_material_index(material_name), dtype=np.uint8)
        )

    @property
    def filled_material_indices(self) -> NDArray[np.uint8]:
        """(F,) the number of what each face is made of."""
        return np.zeros(len(self.faces), dtype=np.uint8) if self.material_indices is None else self.material_indices


def iterate_mesh_parts(meshes: Sequence[Mesh]) -> Iterator[tuple[slice, Float64]]:
    """As `Mesh.parts`, of faces that are counted through all meshes: of small ones several together."""
    first, held = 0, list[Float64]()
    for number, mesh in enumerate(meshes, 1):
        # The first index is the coordinate: three rows that are read one after the other.
        coordinates_m = np.ascontiguousarray(mesh.vertices_m.T)
        for start in range(0, max(len(mesh.faces), 1), PART):
            held.append(coordinates_m.take(mesh.faces[start : start + PART].T, axis=1))
            count, is_last = (
                sum(part.shape[2] for part in held),
                number == len(meshes) and start + PART >= len(mesh.faces),
            )
            if count and (count >= PART or is_last):
                yield slice(first, first + count), np.concatenate(held, axis=2).swapaxes(0, 1)
                first, held = first + count, []


def get_corners_m(meshes: Sequence[Mesh], face_indices: Int64) -> Float64:
    """(3, 3, N) corners, coordinates, faces, of some that are counted through all meshes."""
    starts = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
    corners_m, of_mesh = np.empty((3, 3, len(face_indices))), np.searchsorted(starts, face_indices, side="right") - 1
    for number in np.unique(of_mesh).tolist():
        some, mesh = np.flatnonzero(of_mesh == number), meshes[number]
        corners_m[..., some] = mesh.vertices_m[mesh.faces[face_indices[some] - starts[number]]].transpose(1, 2, 0)
    return corners_m


def compute_normals(corners_m: Float64) -> Float64:
    """(3, N) normals of (3, 3, N) corners, coordinates, faces; 0 without an area, for Embree does not hit that."""
    first, second, third = corners_m
    across = np.cross(second - first, third - first, axis=0)
    length = np.linalg.norm(across, axis=0)
    return np.asarray(across / np.where(length == 0, np.inf, length))


class Plane(Document):
    """A flat rectangle at z = 0, seen from both sides.

    Args:
        size_m: Extent along x and y.
    """

    type: Literal["plane"]
    size_m: tuple[Length, Length]

    def build_mesh(self) -> Mesh:
        """Two triangles, centred."""
        return Mesh(_rectangle(self.size_m, 0.0), np.array([[0, 1, 2], [0, 2, 3]]))


class Box(Document):
    """A box that stands on z = 0.

    Args:
        size_m: Extent along x, y, z.
    """

    type: Literal["box"]
    size_m: tuple[Length, Length, Length]

    def build_mesh(self) -> Mesh:
        """Twelve triangles; x and y centred, z from 0."""
        length, width, height = self.size_m
        return _prism(_rectangle((length, width), 0.0), _rectangle((length, width), height))


class Frustum(Document):
    """A body between two rectangles, such as a tapered cabin; stands on z = 0.

    Args:
        bottom_m: Extent along x and y at the bottom.
        top_m: Extent along x and y at the top.
        height_m: Extent along z.
        top_shift_m: How far the top's centre lies forward of the bottom's.
    """

    type: Literal["frustum"]
    bottom_m: tuple[Length, Length]
    top_m: tuple[Length, Length]
    height_m: Length
    top_shift_m: float = 0.0

    def build_mesh(self) -> Mesh:
        """Twelve triangles."""
        top = _rectangle(self.top_m, self.height_m) + np.array([self.top_shift_m, 0.0, 0.0])
        return _prism(_rectangle(self.bottom_m, 0.0), top)


class Cylinder(Document):
    """An upright cylinder that stands on z = 0, as a prism whose edges lie on the circle.

    Args:
        radius_m: Radius.
        height_m: Extent along z.
        sides: Number of sides. A multiple of four has the full diameter along x and y.
    """

    type: Literal["cylinder"]
    radius_m: Length
    height_m: Length
    sides: Annotated[int, Field(ge=3, le=MAX_SIDES)] = CYLINDER_SIDES

    def build_mesh(self) -> Mesh:
        """A closed prism."""
        bottom = np.insert(compute_circle_points(self.sides) * self.radius_m, 2, 0.0, axis=1)
        return _prism(bottom, bottom + np.array([0.0, 0.0, self.height_m]))


class Ellipsoid(Document):
    """An ellipsoid that stands on z = 0, such as a head or a tree's crown; 120 triangles with corners on its surface.

    Args:
        size_m: Extent along x, y, z.
    """

    type: Literal["ellipsoid"]
    size_m: tuple[Length, Length, Length]

    def build_mesh(self) -> Mesh:
        """Two poles and the rings between them, lowest first."""
        bands = ELLIPSOID_SIDES // 2
        elevation = np.pi * np.arange(1, bands) / bands - np.pi / 2
        # The unit sphere: axes are bands, sides, coordinates.
        across = np.cos(elevation)[:, None, None] * compute_circle_points(ELLIPSOID_SIDES)
        upwards = np.broadcast_to(np.sin(elevation)[:, None, None], (*across.shape[:2], 1))
        rings = np.concatenate([across, upwards], axis=2).reshape(-1, 3)
        sphere = np.concatenate([[[0.0, 0.0, -1.0]], rings, [[0.0, 0.0, 1.0]]])
        vertices = (sphere + np.array([0.0, 0.0, 1.0])) * np.array(self.size_m) / 2
        return Mesh(vertices, _ball_faces(bands - 1, ELLIPSOID_SIDES))


class MeshFile(Document):
    """A mesh from any file that trimesh loads (PLY, OBJ, STL, GLB, OFF, ...).

    Args:
        path: The file; relative to the document that names it.
        meters_per_unit: Scale of the file: 1 for meters, 0.001 for millimeters; COLLADA files state their unit, which
            is applied before.
        transparent: Objects or materials of the file that all rays pass, such as windows.
    """

    type: Literal["mesh"]
    path: RelativePath
    meters_per_unit: PositiveFloat = 1.0
    transparent: tuple[str, ...] = ()

    def build_mesh(self) -> Mesh:
        """All geometry of the file in one mesh, without its transparent parts.

        Raises:
            BadFileError: The file is no mesh.
            ValueError: No object or material has a name of `transparent`, or nothing else is in the file.
        """
        mesh, part, names, _ = _read_mesh(self.path)
        if self.transparent:
            if unknown := [name for name in self.transparent if name not in names]:
                known = ", ".join(map(repr, sorted({*names.ravel().tolist()} - {""})))
                raise ValueError(
                    f"{self.path}: transparent: no object or material is called {unknown[0]!r}; it has {known}"
                )
            is_opaque = ~np.asarray(np.isin(names, self.transparent).any(axis=1))[part]
            if not is_opaque.any():
                raise ValueError(f"{self.path}: transparent: all {len(part):,} faces are; name the windows only")
            mesh = mesh.select_faces(is_opaque)
        return mesh._replace(vertices_m=mesh.vertices_m * self.meters_per_unit)

    def list_transparent_materials(self) -> list[str]:
        """Materials that are partly transparent by the file, and stop rays, since `transparent` does not name them."""
        _, _, names, is_clear = _read_mesh(self.path)
        return sorted({material or name for name, material in names[is_clear].tolist()} - set(self.transparent))


class _MeshParts(NamedTuple):
    """A mesh, the part that each face belongs to, names (object, material) of the parts, and which are transparent."""

    mesh: Mesh
    part: Int64
    names: NDArray[np.str_]
    is_clear: Bools


@guard_reader("a mesh")
def _read_mesh(path: Path) -> _MeshParts:
    with path.open("rb") as file:
        is_binary = b"\0" in file.read(PART)
    check_memory((_BYTES_PER_BINARY_BYTE if is_binary else _BYTES_PER_TEXT_BYTE) * path.stat().st_size)
    vertices, faces, part, names, is_clear = read_mesh_arrays(path).values()
    if len(faces) == 0:
        raise ValueError(f"a mesh with faces is needed; it has {len(vertices)} vertices and no face")
    if not np.isfinite(vertices).all():
        bad = int((~np.isfinite(vertices)).any(axis=1).sum())
        raise ValueError(f"{bad} of {len(vertices)} vertices are NaN or infinite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces have vertices {faces.min()} to {faces.max()}; there are {len(vertices)}")
    return _MeshParts(Mesh(vertices, faces), part, names, is_clear)


def _rectangle(size_m: tuple[float, float], z_m: float) -> Float64:
    x, y = size_m[0] / 2, size_m[1] / 2
    return np.array([[-x, -y, z_m], [x, -y, z_m], [x, y, z_m], [-x, y, z_m]])


@cache
def compute_circle_points(num_corners: int) -> Float64:
    """(corners, 2) points of the unit circle, counter-clockwise from (1, 0)."""
    angle = 2 * np.pi * np.arange(num_corners) / num_corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _ball_faces(rings: int, corners: int) -> Int64:
    """Triangles over vertices in the order lower pole, rings from below, upper pole."""
    here = np.arange(corners)
    following = (here + 1) % corners
    lower, upper = np.zeros(corners, dtype=int), np.full(corners, rings * corners + 1)
    top = (rings - 1) * corners + 1
    faces = [np.stack([lower, following + 1, here + 1], axis=1), np.stack([upper, here + top, following + top], axis=1)]
    for first in range(1, top, corners):
        faces.append(build_band_faces(here + first, following + first, corners))
    return np.concatenate(faces)


def build_band_faces(lower_indices: Int64, next_indices: Int64, level_offset: int) -> Int64:
    """Two triangles for each side between a ring and the one above it, whose indices are larger by `level_offset`."""
    return np.concatenate(
        [
            np.stack([lower_indices, next_indices, next_indices + level_offset], axis=1),
            np.stack([lower_indices, next_indices + level_offset, lower_indices + level_offset], axis=1),
        ]
    )


def _prism(bottom: Float64, top: Float64) -> Mesh:
    """Close the space between two convex polygons with K corners each, given counter-clockwise from above."""
    return Mesh(np.concatenate([bottom, top]), build_prism_faces(2, len(bottom)))


@cache
def build_prism_faces(num_levels: int, num_corners: int) -> Int64:
    """Sides, bottom and top of a prism through so many outlines, which share them: nobody may write into them."""
    here = np.arange(num_corners)
    side = build_band_faces(here, (here + 1) % num_corners, num_corners)
    fan = np.stack([np.zeros(num_corners - 2, dtype=np.int64), here[1:-1], here[2:]], axis=1)
    sides = [side + level * num_corners for level in range(num_levels - 1)]
    faces = np.concatenate([*sides, fan[:, ::-1], fan + (num_levels - 1) * num_corners])
    faces.flags.writeable = False
    return faces
