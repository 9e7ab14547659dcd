"""Shapes: triangle meshes, primitives that build them, and mesh files."""

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

# Faces that are processed together: intermediate arrays take far more memory than the faces.
FACES_PER_CHUNK = 1 << 16

Length = PositiveFloat


class Mesh(NamedTuple):
    """Triangle mesh.

    Args:
        vertices_m: (V, 3) float64 vertices in meters.
        faces: (F, 3) int64 vertex indices of each triangle, counter-clockwise from outside.
        material_indices: (F,) uint8 material of each face, see `get_material_index`; None if unspecified (index 0).
        is_outward: (F,) True for faces of closed surfaces with outward normals, see `find_outward_faces`; None if not
            yet computed.
    """

    vertices_m: Float64
    faces: Int64
    material_indices: NDArray[np.uint8] | None = None
    is_outward: Bools | None = None

    def transform(self, destination_T_source: Float64) -> "Mesh":
        """Transform the vertices by a (4, 4) matrix."""
        return self._replace(vertices_m=transform_points(destination_T_source, self.vertices_m))

    def select_faces(self, selection: Bools | Int64) -> "Mesh":
        """Select faces with their materials by a (F,) mask or by indices; all vertices remain."""
        materials = None if self.material_indices is None else self.material_indices[selection]
        return Mesh(self.vertices_m, self.faces[selection], materials)

    def iterate_parts(self) -> Iterator[tuple[slice, Float64]]:
        """Iterate over chunks of faces: their slice, and (3, 3, N) corners (corner, coordinate, face)."""
        return iterate_mesh_parts([self])

    def assign_material(self, material_name: str) -> "Mesh":
        """Assign one built-in material, or the YAML file of a material, to all faces."""
        material_index = get_material_index(material_name)
        return self._replace(material_indices=np.full(len(self.faces), material_index, dtype=np.uint8))

    @property
    def filled_material_indices(self) -> NDArray[np.uint8]:
        """(F,) material of each face; 0 where none was assigned."""
        return np.zeros(len(self.faces), dtype=np.uint8) if self.material_indices is None else self.material_indices


def iterate_mesh_parts(meshes: Sequence[Mesh]) -> Iterator[tuple[slice, Float64]]:
    """Iterate over the faces of several meshes in chunks, so that memory stays bounded.

    Args:
        meshes: Meshes; their faces are numbered consecutively. Small meshes share a chunk.

    Yields:
        Slice of face numbers, and (3, 3, N) float64 corners (corner, coordinate, face) in meters.
    """
    first_face = face_count = 0
    pending_m: list[Float64] = []
    for mesh_number, mesh in enumerate(meshes, 1):
        # The coordinate is the first axis, so that memory is read row by row.
        coordinates_m = np.ascontiguousarray(mesh.vertices_m.T)
        for start in range(0, max(len(mesh.faces), 1), FACES_PER_CHUNK):
            pending_m.append(coordinates_m.take(mesh.faces[start : start + FACES_PER_CHUNK].T, axis=1))
            face_count += pending_m[-1].shape[2]
            is_last = mesh_number == len(meshes) and start + FACES_PER_CHUNK >= len(mesh.faces)
            if face_count and (face_count >= FACES_PER_CHUNK or is_last):
                yield slice(first_face, first_face + face_count), np.concatenate(pending_m, axis=2).swapaxes(0, 1)
                first_face += face_count
                face_count, pending_m = 0, []


def get_corners_m(meshes: Sequence[Mesh], face_indices: Int64) -> Float64:
    """Get the corners of faces that are numbered consecutively over several meshes.

    Args:
        meshes: Meshes.
        face_indices: (N,) face numbers.

    Returns:
        (3, 3, N) corners (corner, coordinate, face) in meters.
    """
    first_faces = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
    mesh_indices = np.searchsorted(first_faces, face_indices, side="right") - 1
    corners_m = np.empty((3, 3, len(face_indices)))
    for mesh_index in np.unique(mesh_indices).tolist():
        mesh = meshes[mesh_index]
        in_mesh = np.flatnonzero(mesh_indices == mesh_index)
        faces = mesh.faces[face_indices[in_mesh] - first_faces[mesh_index]]
        corners_m[..., in_mesh] = mesh.vertices_m[faces].transpose(1, 2, 0)
    return corners_m


def compute_normals(corners_m: Float64) -> Float64:
    """Compute unit normals of faces.

    Args:
        corners_m: (3, 3, N) corners (corner, coordinate, face).

    Returns:
        (3, N) normals; zeros for faces without area, which Embree does not hit either.
    """
    first, second, third = corners_m
    normals = np.cross(second - first, third - first, axis=0)
    length = np.linalg.norm(normals, axis=0)
    return np.asarray(normals / np.where(length == 0, np.inf, length))


class Plane(Document):
    """Flat rectangle at z = 0, visible from both sides.

    Args:
        size_m: Extent along x and y.
    """

    type: Literal["plane"]
    size_m: tuple[Length, Length]

    def build_mesh(self) -> Mesh:
        """Build two triangles, centered at the origin."""
        return Mesh(_build_rectangle(self.size_m, 0.0), np.array([[0, 1, 2], [0, 2, 3]]))


class Box(Document):
    """Box that stands on z = 0.

    Args:
        size_m: Extent along x, y, z.
    """

    type: Literal["box"]
    size_m: tuple[Length, Length, Length]

    def build_mesh(self) -> Mesh:
        """Build twelve triangles; x and y are centered, z begins at 0."""
        length, width, height = self.size_m
        return _build_prism(_build_rectangle((length, width), 0.0), _build_rectangle((length, width), height))


class Frustum(Document):
    """Body between two rectangles, such as a tapered cabin; stands on z = 0.

    Args:
        bottom_m: Extent along x and y at the bottom.
        top_m: Extent along x and y at the top.
        height_m: Extent along z.
        top_shift_m: Forward offset of the center of the top from that of the bottom.
    """

    type: Literal["frustum"]
    bottom_m: tuple[Length, Length]
    top_m: tuple[Length, Length]
    height_m: Length
    top_shift_m: float = 0.0

    def build_mesh(self) -> Mesh:
        """Build twelve triangles."""
        top = _build_rectangle(self.top_m, self.height_m) + np.array([self.top_shift_m, 0.0, 0.0])
        return _build_prism(_build_rectangle(self.bottom_m, 0.0), top)


class Cylinder(Document):
    """Upright cylinder that stands on z = 0, approximated by a prism whose edges lie on the circle.

    Args:
        radius_m: Radius.
        height_m: Extent along z.
        sides: Number of sides, 3 to 10,000. A multiple of four has the full diameter along x and y.
    """

    type: Literal["cylinder"]
    radius_m: Length
    height_m: Length
    sides: Annotated[int, Field(ge=3, le=10_000)] = 24

    def build_mesh(self) -> Mesh:
        """Build a closed prism."""
        bottom = np.insert(compute_circle_points(self.sides) * self.radius_m, 2, 0.0, axis=1)
        return _build_prism(bottom, bottom + np.array([0.0, 0.0, self.height_m]))


class Ellipsoid(Document):
    """Ellipsoid that stands on z = 0, such as a head or a tree crown: 120 triangles with corners on its surface.

    Args:
        size_m: Extent along x, y, z.
    """

    type: Literal["ellipsoid"]
    size_m: tuple[Length, Length, Length]

    def build_mesh(self) -> Mesh:
        """Build two poles and the rings between them, lowest first."""
        num_sides = 12
        num_bands = num_sides // 2
        elevation = np.pi * np.arange(1, num_bands) / num_bands - np.pi / 2
        # Rings of the unit sphere; axes are ring, corner, coordinate.
        horizontal = np.cos(elevation)[:, None, None] * compute_circle_points(num_sides)
        vertical = np.broadcast_to(np.sin(elevation)[:, None, None], (*horizontal.shape[:2], 1))
        rings = np.concatenate([horizontal, vertical], axis=2).reshape(-1, 3)
        sphere = np.concatenate([[[0.0, 0.0, -1.0]], rings, [[0.0, 0.0, 1.0]]])
        vertices = (sphere + np.array([0.0, 0.0, 1.0])) * np.array(self.size_m) / 2
        return Mesh(vertices, _build_sphere_faces(num_bands - 1, num_sides))


class MeshFile(Document):
    """Mesh from any file that trimesh loads (PLY, OBJ, STL, GLB, OFF, ...).

    Args:
        path: File, relative to the document that names it.
        meters_per_unit: Scale of the file: 1 for meters, 0.001 for millimeters; COLLADA files state their unit, which
            is applied before.
        transparent: Objects or materials of the file that all rays pass, such as windows.
    """

    type: Literal["mesh"]
    path: RelativePath
    meters_per_unit: PositiveFloat = 1.0
    transparent: tuple[str, ...] = ()

    def build_mesh(self) -> Mesh:
        """Build one mesh of all geometry of the file, without its transparent parts.

        Raises:
            BadFileError: The file is not a mesh.
            ValueError: No object or material has a name of `transparent`, or nothing else is in the file.
        """
        mesh, part_indices, names, _ = _read_mesh(self.path)
        if self.transparent:
            if unknown := [name for name in self.transparent if name not in names]:
                available = ", ".join(repr(name) for name in sorted({*names.ravel().tolist()} - {""}))
                raise ValueError(
                    f"{self.path}: transparent: no object or material is called {unknown[0]!r}; it has {available}"
                )
            is_opaque = ~np.asarray(np.isin(names, self.transparent).any(axis=1))[part_indices]
            if not is_opaque.any():
                raise ValueError(
                    f"{self.path}: transparent: all {len(part_indices):,} faces are; name the windows only"
                )
            mesh = mesh.select_faces(is_opaque)
        return mesh._replace(vertices_m=mesh.vertices_m * self.meters_per_unit)

    def list_transparent_materials(self) -> list[str]:
        """List materials that the file marks as partly transparent and that `transparent` does not name."""
        _, _, names, is_transparent = _read_mesh(self.path)
        material_names = {material or name for name, material in names[is_transparent].tolist()}
        return sorted(material_names - set(self.transparent))


class _MeshParts(NamedTuple):
    """Mesh of a file with the part of each face; names (object, material) and transparency are listed per part."""

    mesh: Mesh
    part_indices: Int64
    names: NDArray[np.str_]
    is_transparent: Bools


@guard_reader("a mesh")
def _read_mesh(path: Path) -> _MeshParts:
    """Read a mesh file and check that faces and vertices are valid."""
    with path.open("rb") as file:
        is_binary = b"\0" in file.read(1 << 16)
    # trimesh takes at most this much memory per byte of the file; text becomes lists of words.
    memory_factor = 10 if is_binary else 16
    check_memory(memory_factor * path.stat().st_size)
    vertices, faces, part_indices, names, is_transparent = read_mesh_arrays(path).values()
    if len(faces) == 0:
        raise ValueError(f"a mesh with faces is needed; it has {len(vertices)} vertices and no face")
    if not np.isfinite(vertices).all():
        bad_count = int((~np.isfinite(vertices)).any(axis=1).sum())
        raise ValueError(f"{bad_count} of {len(vertices)} vertices are NaN or infinite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces have vertices {faces.min()} to {faces.max()}; there are {len(vertices)}")
    return _MeshParts(Mesh(vertices, faces), part_indices, names, is_transparent)


def _build_rectangle(size_m: tuple[float, float], z_m: float) -> Float64:
    """Build the (4, 3) corners of a horizontal rectangle around the z axis, counter-clockwise from above."""
    x, y = size_m[0] / 2, size_m[1] / 2
    return np.array([[-x, -y, z_m], [x, -y, z_m], [x, y, z_m], [-x, y, z_m]])


@cache
def compute_circle_points(num_corners: int) -> Float64:
    """Compute (num_corners, 2) points of the unit circle, counter-clockwise from (1, 0)."""
    angle = 2 * np.pi * np.arange(num_corners) / num_corners
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _build_sphere_faces(num_rings: int, num_corners: int) -> Int64:
    """Build triangles over vertices in the order lower pole, rings from below, upper pole."""
    corner = np.arange(num_corners)
    next_corner = (corner + 1) % num_corners
    lower_pole = np.zeros(num_corners, dtype=int)
    upper_pole = np.full(num_corners, num_rings * num_corners + 1)
    top_ring = (num_rings - 1) * num_corners + 1
    faces = [
        np.stack([lower_pole, next_corner + 1, corner + 1], axis=1),
        np.stack([upper_pole, corner + top_ring, next_corner + top_ring], axis=1),
    ]
    for ring in range(1, top_ring, num_corners):
        faces.append(build_band_faces(corner + ring, next_corner + ring, num_corners))
    return np.concatenate(faces)


def build_band_faces(lower_indices: Int64, next_indices: Int64, level_offset: int) -> Int64:
    """Build two triangles for each side between a ring and the ring above it.

    Args:
        lower_indices: (N,) vertex at the begin of each side of the lower ring.
        next_indices: (N,) vertex at the end of each side.
        level_offset: Difference between the vertex indices of the upper and the lower ring.

    Returns:
        (2 N, 3) faces.
    """
    first_triangles = np.stack([lower_indices, next_indices, next_indices + level_offset], axis=1)
    second_triangles = np.stack([lower_indices, next_indices + level_offset, lower_indices + level_offset], axis=1)
    return np.concatenate([first_triangles, second_triangles])


def _build_prism(bottom: Float64, top: Float64) -> Mesh:
    """Build the closed body between two convex polygons of K corners, given counter-clockwise from above."""
    return Mesh(np.concatenate([bottom, top]), build_prism_faces(2, len(bottom)))


@cache
def build_prism_faces(num_levels: int, num_corners: int) -> Int64:
    """Build the sides, bottom and top of a prism.

    Args:
        num_levels: Number of outlines, lowest first.
        num_corners: Number of corners of each outline.

    Returns:
        (F, 3) faces, read-only, since all callers share the cached array.
    """
    corner = np.arange(num_corners)
    side = build_band_faces(corner, (corner + 1) % num_corners, num_corners)
    fan = np.stack([np.zeros(num_corners - 2, dtype=np.int64), corner[1:-1], corner[2:]], axis=1)
    sides = [side + level * num_corners for level in range(num_levels - 1)]
    faces = np.concatenate([*sides, fan[:, ::-1], fan + (num_levels - 1) * num_corners])
    faces.flags.writeable = False
    return faces
