"""Patches: small triangles of surfaces, from which points are sampled by area; and the faces of closed surfaces."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float32, Float64, Int32, Int64
from torchcover.simulation.rays import rotate
from torchcover.simulation.shapes import Mesh

Int8 = NDArray[np.int8]

# Longest edge of a patch that is cut from a mesh within bounds.
LONGEST_M = 4.0

# (3, 3, N) triangles (corners, coordinates, triangles) and their (N,) faces -> (2, N) bounds of their heights above
# ground, and (N,) True where the triangle is needed.
HeightFunction = Callable[[Float64, Int64], tuple[Float32, Bools]]


@dataclass(frozen=True)
class CutParams:
    """Parameters of cutting meshes into patches.

    Args:
        longest_edge_share: Longest edge of a patch as a share of the extent of a mesh without bounds, if that is more
            than `LONGEST_M`: large meshes would give too many patches.
        min_area_m2: Smaller triangles are degenerate and are removed; no point would be sampled from them.
        recompute_area_m2: Areas of halves are half the area; below this area they are computed from the corners, since
            rounding errors could matter for `min_area_m2`.
    """

    longest_edge_share: float = 1 / 64
    min_area_m2: float = 1e-10
    recompute_area_m2: float = 1e-4


def find_outward_faces(mesh: Mesh) -> Bools:
    """Find the faces of closed surfaces that face outwards, whose back is never visible from outside.

    Faces with a common edge belong to one surface. It is closed if each edge is used equally often in both directions,
    and faces outwards if its volume is not negative. Faces of other surfaces (planes, open meshes, inverted spheres)
    are visible from both sides.

    Args:
        mesh: Mesh with F faces; its `is_outward` is returned if it has one.

    Returns:
        (F,) True for faces of closed surfaces that face outwards.
    """
    if mesh.is_outward is not None:
        return mesh.is_outward
    if len(mesh.faces) == 0:
        return np.empty(0, dtype=bool)
    edge_indices, edge_directions = find_face_edges(mesh)
    return find_outward_faces_from_edges(mesh, edge_indices, edge_directions, label_surfaces(edge_indices))


def label_surfaces(edge_indices: Int64) -> Int64:
    """Label the surface of each face.

    Args:
        edge_indices: (3 F,) edges of the faces, see `find_face_edges`.

    Returns:
        (F,) labels, see `label_connected_faces`.
    """
    return label_connected_faces(edge_indices, np.arange(len(edge_indices)) // 3, len(edge_indices) // 3)


def find_outward_faces_from_edges(
    mesh: Mesh, edge_indices: Int64, edge_directions: Int8, surface_labels: Int64, relative_rounding: float = 1e-9
) -> Bools:
    """Find outward faces as `find_outward_faces` does, with known edges and surfaces.

    Args:
        mesh: Mesh with F faces.
        edge_indices: (3 F,) edges of the faces, see `find_face_edges`.
        edge_directions: (3 F,) direction in which each face uses its edge.
        surface_labels: (F,) surface of each face, see `label_surfaces`.
        relative_rounding: Rounding error of a volume relative to the sum of its parts; the volume of a sheet with a
            face on both sides is 0 up to rounding.

    Returns:
        (F,) True for faces of closed surfaces that face outwards.
    """
    face = np.arange(len(edge_indices)) // 3
    turns = np.bincount(edge_indices, weights=edge_directions)
    num_open_edges = np.bincount(surface_labels[face], weights=turns[edge_indices] != 0, minlength=len(mesh.faces))
    centered = mesh._replace(vertices_m=mesh.vertices_m - mesh.vertices_m.mean(axis=0))
    face_volumes = np.empty(len(mesh.faces))
    for part, (first, second, third) in centered.iterate_parts():
        face_volumes[part] = (first * np.cross(second, third, axis=0)).sum(axis=0)
    volume = np.bincount(surface_labels, weights=face_volumes, minlength=len(mesh.faces))
    absolute_volume = np.bincount(surface_labels, weights=np.abs(face_volumes), minlength=len(mesh.faces))
    is_outward = (num_open_edges == 0) & (volume >= -(relative_rounding * absolute_volume))
    return np.asarray(is_outward[surface_labels])


def find_face_edges(mesh: Mesh) -> tuple[Int64, Int8]:
    """Find the edges of all faces; vertices at the same position are one vertex.

    Args:
        mesh: Mesh with F faces.

    Returns:
        (3 F,) index of each edge of each face, shared by adjacent faces, and (3 F,) direction in which the face uses
        it: 1 or -1, or 0 from a vertex to itself.
    """
    corners = _weld_vertices(mesh.vertices_m)[mesh.faces]
    start, end = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    directions = (end > start).astype(np.int8) - (end < start).astype(np.int8)
    # In place, to save memory for large meshes.
    key = np.minimum(start, end)
    key *= len(mesh.vertices_m)
    key += np.maximum(start, end, out=start)
    del start, end, corners
    order = key.argsort()
    key = key[order]
    edge_indices = np.empty_like(order)
    edge_indices[order] = np.cumsum(np.concatenate([[False], key[1:] != key[:-1]]))
    return edge_indices, directions


def _weld_vertices(vertices_m: Float64) -> Int64:
    """Compute (V,) index of the position of each vertex, five times as fast as `np.unique` along an axis."""
    order = np.lexsort(vertices_m.T)
    differs = (np.diff(vertices_m[order], axis=0) != 0).any(axis=1)
    position_indices = np.empty(len(order), dtype=np.int64)
    position_indices[order] = np.concatenate([[0], np.cumsum(differs)])
    return position_indices


def label_connected_faces(edge_indices: Int64, face_indices: Int64, num_faces: int) -> Int64:
    """Label faces that are connected by common edges.

    Args:
        edge_indices: (N,) edge of each pair of an edge and a face.
        face_indices: (N,) face of each pair.
        num_faces: Number of faces.

    Returns:
        (num_faces,) smallest face index of the surface of each face.
    """
    order = np.argsort(edge_indices)
    ordered = edge_indices[order]
    shared = np.flatnonzero(ordered[1:] == ordered[:-1])
    first_face, second_face = face_indices[order[shared]], face_indices[order[shared + 1]]
    labels = np.arange(num_faces)
    while (labels[first_face] != labels[second_face]).any():
        smaller = np.minimum(labels[first_face], labels[second_face])
        np.minimum.at(labels, labels[first_face], smaller)
        np.minimum.at(labels, labels[second_face], smaller)
        while (labels[labels] != labels).any():
            labels = labels[labels]
    return labels


class UprightBoxes(NamedTuple):
    """K boxes whose sides are parallel to the axes.

    Args:
        lower_m: (K, 3) lower bounds.
        upper_m: (K, 3) upper bounds.
    """

    lower_m: Float64
    upper_m: Float64

    def mask_overlaps(self, lower_m: Float64, upper_m: Float64) -> Bools:
        """Mark boxes that overlap at least one of these boxes.

        Args:
            lower_m: (N, 3) lower bounds of the boxes to test.
            upper_m: (N, 3) upper bounds of the boxes to test.

        Returns:
            (N,) True for boxes that overlap or touch.
        """
        mask = np.zeros(len(lower_m), dtype=bool)
        for low, high in zip(self.lower_m, self.upper_m, strict=True):
            overlaps = (lower_m[:, 0] <= high[0]) & (upper_m[:, 0] >= low[0])
            for axis in (1, 2):
                overlaps &= (lower_m[:, axis] <= high[axis]) & (upper_m[:, axis] >= low[axis])
            mask |= overlaps
        return mask


class Patches(NamedTuple):
    """N triangles in one frame; float32 suffices, since rays hit float32 triangles.

    Args:
        corner_m: (3, N) first corner.
        first_edge_m: (3, N) edge from the first to the second corner.
        second_edge_m: (3, N) edge from the first to the third corner.
        is_outward: (N,) True if only the side is visible to which `first_edge_m` x `second_edge_m` points.
        object_indices: (N,) object that the patch belongs to; -1 for none.
        height_bounds_m: (2, N) lower and upper bound of the heights above the local ground; (0, N) if unknown.
        coincident_faces: (1, N) index among all static faces of the face that the patch is part of, if that coincides
            with another face; else -1. (0, N) if no faces coincide.
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
        compute_heights: HeightFunction | None = None,
        coincident_faces: Int32 | None = None,
        outward_mask: Bools | None = None,
        params: CutParams = CutParams(),
    ) -> Self:
        """Cut a mesh that is no object into patches, without degenerate triangles.

        Args:
            mesh: Mesh with F faces.
            bounds: Only triangles that overlap these boxes are needed; None for all.
            compute_heights: Computes height bounds of triangles and selects those that are needed.
            coincident_faces: (F,) `coincident_faces` of the patches of each face; None if no faces coincide.
            outward_mask: (F,) result of `find_outward_faces` if it is known.
            params: Sizes of patches.
        """
        extent_m = 0.0 if bounds is not None else float(np.ptp(mesh.vertices_m, axis=0).max())
        max_edge_m = max(LONGEST_M, params.longest_edge_share * extent_m)
        num_height_rows = 0 if compute_heights is None else 2
        parts = [(np.empty((3, 3, 0)), np.empty(0, dtype=np.int64), np.empty((num_height_rows, 0), np.float32))]
        for part, corners in mesh.iterate_parts():
            parts.append(_cut_triangles(corners, part.start, bounds, max_edge_m, compute_heights, params))
        triangles, faces, heights_m = zip(*parts, strict=True)
        (corner, second, third), face = np.concatenate(triangles, axis=2), np.concatenate(faces)
        face_rows = np.empty((0, len(face)), np.int32) if coincident_faces is None else coincident_faces[None, face]
        return cls(
            corner_m=corner.astype(np.float32),
            first_edge_m=(second - corner).astype(np.float32),
            second_edge_m=(third - corner).astype(np.float32),
            is_outward=(find_outward_faces(mesh) if outward_mask is None else outward_mask)[face],
            object_indices=np.full(len(face), -1, dtype=np.int32),
            height_bounds_m=np.concatenate(heights_m, axis=1),
            coincident_faces=face_rows,
        )

    @classmethod
    def concatenate(cls, parts: "Sequence[Patches]") -> Self:
        """Concatenate patches.

        Args:
            parts: Patches in one frame; parts without coincident faces (moving bodies) get -1 if others have them.
        """
        num_height_rows = len(parts[0].height_bounds_m) if parts else 0
        num_face_rows = max((len(part.coincident_faces) for part in parts), default=0)
        no_edge = np.empty((3, 0), dtype=np.float32)
        empty = Patches(
            corner_m=no_edge,
            first_edge_m=no_edge,
            second_edge_m=no_edge,
            is_outward=np.empty(0, dtype=bool),
            object_indices=np.empty(0, dtype=np.int32),
            height_bounds_m=no_edge[:num_height_rows],
            coincident_faces=np.empty((num_face_rows, 0), dtype=np.int32),
        )
        completed = [empty]
        for part in parts:
            has_faces = len(part.coincident_faces) == num_face_rows
            no_face = np.full((num_face_rows, len(part.is_outward)), -1, dtype=np.int32)
            completed.append(part if has_faces else part._replace(coincident_faces=no_face))
        return cls._make(np.concatenate(column, axis=-1) for column in zip(*completed, strict=True))

    def select(self, indices: Int64) -> Self:
        """Select patches.

        Args:
            indices: (K,) indices of the patches.
        """
        return type(self)._make(column.take(indices, axis=-1) for column in self)

    def transform(self, destination_T_source: Float64) -> Self:
        """Transform the patches to another frame, each independently of the others.

        Args:
            destination_T_source: (4, 4) transform.
        """
        rotation = destination_T_source[:3, :3]
        # In float64: the corner may be a kilometer away in either frame.
        corner_m = np.einsum("ij,jn->in", rotation, self.corner_m.astype(np.float64)) + destination_T_source[:3, 3:]
        return self._replace(
            corner_m=corner_m.astype(np.float32),
            first_edge_m=rotate(rotation, self.first_edge_m),
            second_edge_m=rotate(rotation, self.second_edge_m),
        )

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
        """(3, N) normals whose length is twice the area."""
        (ax, ay, az), (bx, by, bz) = self.first_edge_m, self.second_edge_m
        return np.asarray(np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]))


def _cut_triangles(
    triangles_m: Float64,
    first_face: int,
    bounds: UprightBoxes | None,
    max_edge_m: float,
    compute_heights: HeightFunction | None,
    params: CutParams,
) -> tuple[Float64, Int64, Float32]:
    """Halve triangles until no edge exceeds the limit.

    Args:
        triangles_m: (3, 3, M) corners, coordinates, triangles (NumPy is fastest along the last axis).
        first_face: Face index of the first triangle.
        bounds: Only triangles that overlap these boxes are needed; None for all.
        max_edge_m: Longest edge.
        compute_heights: Computes height bounds of triangles and selects those that are needed.
        params: Limits of areas.

    Returns:
        (3, 3, N) triangles, (N,) their faces, and (2, N) or (0, N) height bounds.
    """
    face, area_m2 = np.arange(first_face, first_face + triangles_m.shape[2]), _compute_areas_m2(triangles_m)
    finished, finished_faces = [np.empty((3, 3, 0))], [np.empty(0, dtype=np.int64)]
    finished_heights_m = [np.empty((0 if compute_heights is None else 2, 0), dtype=np.float32)]
    while len(face):
        is_needed = area_m2 >= params.min_area_m2
        if bounds is not None:
            is_needed &= bounds.mask_overlaps(triangles_m.min(axis=0).T, triangles_m.max(axis=0).T)
        heights_m = np.empty((0, len(face)), dtype=np.float32)
        if compute_heights is not None:
            if not is_needed.all():
                needed = np.flatnonzero(is_needed)
                triangles_m, face, area_m2 = triangles_m.take(needed, axis=2), face[needed], area_m2[needed]
            heights_m, is_needed = compute_heights(triangles_m, face)
        edges_m = np.linalg.norm(triangles_m[[1, 2, 0]] - triangles_m, axis=1)
        is_small = edges_m.max(axis=0) <= max_edge_m
        small, large = np.flatnonzero(is_needed & is_small), np.flatnonzero(is_needed & ~is_small)
        finished.append(triangles_m.take(small, axis=2))
        finished_faces.append(face[small])
        finished_heights_m.append(heights_m.take(small, axis=1))
        triangles_m = _halve_triangles(triangles_m.take(large, axis=2), edges_m.take(large, axis=1).argmax(axis=0))
        face, area_m2 = np.tile(face[large], 2), np.tile(area_m2[large] / 2, 2)
        recomputed = np.flatnonzero(area_m2 < params.recompute_area_m2)
        area_m2[recomputed] = _compute_areas_m2(triangles_m[..., recomputed])
    return np.concatenate(finished, axis=2), np.concatenate(finished_faces), np.concatenate(finished_heights_m, axis=1)


def _halve_triangles(triangles_m: Float64, longest_edge: Int64) -> Float64:
    """Halve N triangles at the midpoint of an edge: (3, 3, 2 N), the first half of each, then the second halves."""
    is_first, is_second = longest_edge == 0, longest_edge == 1
    a, b, c = triangles_m
    start = np.where(is_first, a, np.where(is_second, b, c))
    end = np.where(is_first, b, np.where(is_second, c, a))
    opposite = np.where(is_first, c, np.where(is_second, a, b))
    midpoint = (start + end) / 2
    return np.stack([np.hstack([start, midpoint]), np.hstack([midpoint, end]), np.hstack([opposite, opposite])])


def _compute_areas_m2(triangles_m: Float64) -> Float64:
    a, b, c = triangles_m
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a, axis=0), axis=0) / 2)
