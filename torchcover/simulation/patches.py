"""Patches: triangles of surfaces, cut small, so that they are drawn from by place; and which faces are outward."""

from collections.abc import Callable
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.rays import rotate
from torchcover.simulation.shapes import Mesh

Int8 = NDArray[np.int8]

# No edge of a patch is longer,
LONGEST_M = 4.0
# except where all of a mesh is wanted, however large it is: then this share of its extent may be.
LONGEST_SHARE = 1 / 64
# A triangle with less area is a line: no point will ever be drawn from it.
SMALLEST_M2 = 1e-10
# The area of a half is half the area, to far less than this, which is far from the smallest.
SURE_M2 = 1e-4
# A sheet with a face on each of its sides encloses nothing, up to rounding.
VOLUME_ROUNDING = 1e-9


def find_outward_faces(mesh: Mesh) -> Bools:
    """(F,) whether each face belongs to a closed surface that is turned outwards: nobody outside sees its back.

    Faces that share an edge belong to one surface. It is closed if every edge is run through as often one way as the
    other, and turned outwards if it encloses a volume that is not negative. A face of any other surface, such as a
    plane, an open mesh, or a ball that is turned inside out, may be seen from both sides.
    """
    if mesh.is_outward is not None:
        return mesh.is_outward
    if len(mesh.faces) == 0:
        return np.empty(0, dtype=bool)
    edge, way = find_face_edges(mesh)
    return find_outward_faces_from_edges(mesh, edge, way, label_surfaces(edge))


def label_surfaces(edge_indices: Int64) -> Int64:
    """(F,) number of the surface of each face by (3 F,) numbers of edges; see `connected`."""
    return label_connected_faces(edge_indices, np.arange(len(edge_indices)) // 3, len(edge_indices) // 3)


def find_outward_faces_from_edges(
    mesh: Mesh, edge_indices: Int64, edge_directions: Int8, surface_labels: Int64
) -> Bools:
    """`find_outward_faces` of a mesh of which `find_face_edges` and `label_surfaces` are known."""
    face = np.arange(len(edge_indices)) // 3
    turns = np.bincount(edge_indices, weights=edge_directions)
    open_edges = np.bincount(surface_labels[face], weights=turns[edge_indices] != 0, minlength=len(mesh.faces))
    centred = mesh._replace(vertices_m=mesh.vertices_m - mesh.vertices_m.mean(axis=0))
    volumes = np.empty(len(mesh.faces))
    for part, (first, second, third) in centred.iterate_parts():
        volumes[part] = (first * np.cross(second, third, axis=0)).sum(axis=0)
    volume = np.bincount(surface_labels, weights=volumes, minlength=len(mesh.faces))
    rounding = VOLUME_ROUNDING * np.bincount(surface_labels, weights=np.abs(volumes), minlength=len(mesh.faces))
    return np.asarray(((open_edges == 0) & (volume >= -rounding))[surface_labels])


def find_face_edges(mesh: Mesh) -> tuple[Int64, Int8]:
    """(3 F,) the number of each edge of each face, shared by the faces that it borders, and (3 F,) which way it runs.

    The ways are 1 and -1, and 0 from a corner to itself. Vertices at the same place are one.
    """
    corners = _welded(mesh.vertices_m)[mesh.faces]
    start, end = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    way = (end > start).astype(np.int8) - (end < start).astype(np.int8)
    key = np.minimum(start, end)
    key *= len(mesh.vertices_m)
    key += np.maximum(start, end, out=start)
    del start, end, corners
    order = key.argsort()
    key = key[order]
    edge = np.empty_like(order)
    edge[order] = np.cumsum(np.concatenate([[False], key[1:] != key[:-1]]))
    return edge, way


def _welded(vertices_m: Float64) -> Int64:
    """(V,) number of the place of each vertex; `np.unique` along an axis takes five times as long."""
    order = np.lexsort(vertices_m.T)
    differs = (np.diff(vertices_m[order], axis=0) != 0).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.concatenate([[0], np.cumsum(differs)])
    return number


def label_connected_faces(edge_indices: Int64, face_indices: Int64, num_faces: int) -> Int64:
    """(faces,) number of the surface of each face, of those that share edges: the smallest number of a face of it."""
    order = np.argsort(edge_indices)
    ordered = edge_indices[order]
    shared = np.flatnonzero(ordered[1:] == ordered[:-1])
    one, other = face_indices[order[shared]], face_indices[order[shared + 1]]
    surface = np.arange(num_faces)
    while (surface[one] != surface[other]).any():
        smaller = np.minimum(surface[one], surface[other])
        np.minimum.at(surface, surface[one], smaller)
        np.minimum.at(surface, surface[other], smaller)
        while (surface[surface] != surface).any():
            surface = surface[surface]
    return surface


class UprightBoxes(NamedTuple):
    """K upright boxes: `lower_m` (K, 3) and `upper_m` (K, 3)."""

    lower_m: Float64
    upper_m: Float64

    def mask_overlaps(self, lower_m: Float64, upper_m: Float64) -> Bools:
        """(N,) whether each of N boxes, (N, 3) and (N, 3), meets any of these."""
        met = np.zeros(len(lower_m), dtype=bool)
        for low, high in zip(self.lower_m, self.upper_m, strict=True):
            here = (lower_m[:, 0] <= high[0]) & (upper_m[:, 0] >= low[0])
            for axis in (1, 2):
                here &= (lower_m[:, axis] <= high[axis]) & (upper_m[:, axis] >= low[axis])
            met |= here
        return met


class Patches(NamedTuple):
    """N triangles in one frame.

    `corner_m`, `first_edge_m` and `second_edge_m` (3, N) float32: one corner, and the edges from there to the other two; float64
    would say no more, for rays meet float32 triangles. `is_outward` (N,): whether they are seen from the side only to
    which first x second points. `object_indices` (N,) int32: number of the object that they belong to, -1 for none.
    `height_bounds_m` (2, N) float32: between which heights above the local ground all of their points lie; (0, N) where that
    was not asked. `coincident_faces` (1, N) int32: of which of all faces that never move each is a part, if that coincides with
    another, else -1; (0, N) where none does.
    """

    corner_m: Float32
    first_edge_m: Float32
    second_edge_m: Float32
    is_outward: Bools
    object_indices: Int32
    height_bounds_m: Float32
    coincident_faces: Int32

    @classmethod
    def from_mesh(
        cls,
        mesh: Mesh,
        bounds: UprightBoxes | None = None,
        compute_heights: Callable[[Float64, Int64], tuple[Float32, Bools]] | None = None,
        coincident_faces: Int32 | None = None,
        outward_mask: Bools | None = None,
    ) -> Self:
        """Cut a mesh of no object, or what is wanted of it: what lies in some boxes, and has an area.

        `compute_heights` gives of (3, 3, N) corners, coordinates, triangles and (N,) the faces that they are parts of their
        `heights_m`, and (N,) whether any of that is wanted. `coincident_faces` (F,) is what patches of each face have as
        `face`, `outward_mask` (F,) what `find_outward_faces` says of it, if that is known.
        """
        extent_m = 0.0 if bounds is not None else float(np.ptp(mesh.vertices_m, axis=0).max())
        longest_m = max(LONGEST_M, LONGEST_SHARE * extent_m)
        none = (
            np.empty((3, 3, 0)),
            np.empty(0, dtype=np.int64),
            np.empty((0 if compute_heights is None else 2, 0), np.float32),
        )
        parts = [
            _cut(corners, part.start, bounds, longest_m, compute_heights) for part, corners in mesh.iterate_parts()
        ]
        triangles, faces, all_heights_m = zip(none, *parts, strict=True)
        (corner, second, third), face = np.concatenate(triangles, axis=2), np.concatenate(faces)
        heights_m = np.concatenate(all_heights_m, axis=1)
        first_m, second_m = (second - corner).astype(np.float32), (third - corner).astype(np.float32)
        nobodys = np.full(len(face), -1, dtype=np.int32)
        of_face = np.empty((0, len(face)), dtype=np.int32) if coincident_faces is None else coincident_faces[None, face]
        is_outward = (find_outward_faces(mesh) if outward_mask is None else outward_mask)[face]
        return cls(corner.astype(np.float32), first_m, second_m, is_outward, nobodys, heights_m, of_face)

    @classmethod
    def concatenate(cls, parts: "list[Patches]") -> Self:
        """Those of several, one after the other."""
        none, rows = np.empty((3, 0), dtype=np.float32), len(parts[0].height_bounds_m) if parts else 0
        nobodys = np.empty(0, dtype=np.int32)
        # What moves has no faces that coincide.
        faces = max((len(part.coincident_faces) for part in parts), default=0)
        of_none = (
            part._replace(coincident_faces=np.full((faces, len(part.is_outward)), -1, dtype=np.int32)) for part in parts
        )
        parts = [
            part if len(part.coincident_faces) == faces else other for part, other in zip(parts, of_none, strict=True)
        ]
        no_face = np.empty((faces, 0), dtype=np.int32)
        parts = [Patches(none, none, none, np.empty(0, dtype=bool), nobodys, none[:rows], no_face), *parts]
        return cls._make(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True))

    def select(self, indices: Int64) -> Self:
        """Some of them."""
        return type(self)._make(column.take(indices, axis=-1) for column in self)

    def transform(self, destination_T_source: Float64) -> Self:
        """Them in another frame. What becomes of one does not depend on the others."""
        rotation = destination_T_source[:3, :3]
        # The corner may be a kilometre away, in either frame.
        corner_m = np.einsum("ij,jn->in", rotation, self.corner_m.astype(np.float64)) + destination_T_source[:3, 3:]
        first_m, second_m = rotate(rotation, self.first_edge_m), rotate(rotation, self.second_edge_m)
        return self._replace(corner_m=corner_m.astype(np.float32), first_edge_m=first_m, second_edge_m=second_m)

    @property
    def corners_m(self) -> Float32:
        """(3, 3, N) corners, coordinates, patches."""
        return np.stack([self.corner_m, self.corner_m + self.first_edge_m, self.corner_m + self.second_edge_m])

    @property
    def lower_m(self) -> Float32:
        """(3, N) smallest coordinates."""
        return np.asarray(self.corner_m + np.minimum(np.minimum(self.first_edge_m, self.second_edge_m), 0))

    @property
    def upper_m(self) -> Float32:
        """(3, N) largest coordinates."""
        return np.asarray(self.corner_m + np.maximum(np.maximum(self.first_edge_m, self.second_edge_m), 0))

    @property
    def normals_m2(self) -> Float32:
        """(3, N) normals, as long as twice the area."""
        (ax, ay, az), (bx, by, bz) = self.first_edge_m, self.second_edge_m
        return np.asarray(np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]))


def _cut(
    triangles: Float64,
    first: int,
    bounds: UprightBoxes | None,
    longest_m: float,
    heights: Callable[[Float64, Int64], tuple[Float32, Bools]] | None,
) -> tuple[Float64, Int64, Float32]:
    """(3, 3, N) triangles with short edges, (N,) of which one of those given, (3, 3, M), each is a part, and heights.

    The first of those given has the number `first`. Axes are the corner, the coordinate, the triangle: NumPy is quick
    along the last one.
    """
    face, area_m2 = np.arange(first, first + triangles.shape[2]), _areas(triangles)
    done, done_face = [np.empty((3, 3, 0))], [np.empty(0, dtype=np.int64)]
    done_heights_m = [np.empty((0 if heights is None else 2, 0), dtype=np.float32)]
    while len(face):
        kept = area_m2 >= SMALLEST_M2
        if bounds is not None:
            kept &= bounds.mask_overlaps(triangles.min(axis=0).T, triangles.max(axis=0).T)
        heights_m = np.empty((0, len(face)), dtype=np.float32)
        if heights is not None:
            if not kept.all():
                some = np.flatnonzero(kept)
                triangles, face, area_m2 = triangles.take(some, axis=2), face[some], area_m2[some]
            heights_m, kept = heights(triangles, face)
        edges_m = np.linalg.norm(triangles[[1, 2, 0]] - triangles, axis=1)
        small = edges_m.max(axis=0) <= longest_m
        ready, large = np.flatnonzero(kept & small), np.flatnonzero(kept & ~small)
        done.append(triangles.take(ready, axis=2))
        done_face.append(face[ready])
        done_heights_m.append(heights_m.take(ready, axis=1))
        triangles = _halved(triangles.take(large, axis=2), edges_m.take(large, axis=1).argmax(axis=0))
        face, area_m2 = np.tile(face[large], 2), np.tile(area_m2[large] / 2, 2)
        unsure = np.flatnonzero(area_m2 < SURE_M2)
        area_m2[unsure] = _areas(triangles[..., unsure])
    return np.concatenate(done, axis=2), np.concatenate(done_face), np.concatenate(done_heights_m, axis=1)


def _halved(triangles: Float64, longest: Int64) -> Float64:
    """(3, 3, 2 N) halves of N triangles on either side of the middle of one edge, first one of each, then the other."""
    first, second = longest == 0, longest == 1
    a, b, c = triangles
    start = np.where(first, a, np.where(second, b, c))
    end = np.where(first, b, np.where(second, c, a))
    across = np.where(first, c, np.where(second, a, b))
    middle = (start + end) / 2
    return np.stack([np.hstack([start, middle]), np.hstack([middle, end]), np.hstack([across, across])])


def _areas(triangles: Float64) -> Float64:
    a, b, c = triangles
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a, axis=0), axis=0) / 2)
