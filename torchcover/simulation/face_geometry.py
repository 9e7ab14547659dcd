"""Faces of all bodies of a ray casting scene: normals, and faces on which a position lies."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.shapes import FACES_PER_CHUNK, Mesh, compute_normals, get_corners_m, iterate_mesh_parts

# A position within four roundings of float32 of the plane of a face, per meter of coordinates, lies on the face.
CONTACT_ROUNDING = 4 * float(np.finfo(np.float32).eps)


class FaceGeometry:
    """Faces of all bodies, numbered consecutively, with the distance up to which a point counts as on a face.

    Arrays over all faces are float32, since there may be ten million; float64 values are computed per query for the few
    faces that it concerns.

    Args:
        bodies: Meshes.
        max_coordinate_m: Largest absolute coordinate of all bodies.
    """

    def __init__(self, bodies: Sequence[Mesh], max_coordinate_m: float) -> None:
        min_rounding = 1e-12  # per meter of the largest coordinate, since origins are rounded in float64
        max_rounding = 3 * CONTACT_ROUNDING  # twice the rounding, plus the rounding of bounding boxes
        self._bodies = bodies
        self._min_contact_m = min_rounding * max_coordinate_m
        self._num_faces = sum(len(body.faces) for body in bodies)
        # Boxes of all points that may lie on a face.
        self._lower_m = np.empty((3, self._num_faces), dtype=np.float32)
        self._upper_m = np.empty((3, self._num_faces), dtype=np.float32)
        first_face = 0
        for body in bodies:
            vertices_m = np.ascontiguousarray(body.vertices_m.T, dtype=np.float32)
            for start in range(0, len(body.faces), FACES_PER_CHUNK):
                corners_m = vertices_m.take(body.faces[start : start + FACES_PER_CHUNK].T, axis=1)
                lower_m, upper_m = corners_m.min(axis=1), corners_m.max(axis=1)
                largest_m = np.maximum(np.abs(lower_m).max(axis=0), np.abs(upper_m).max(axis=0))
                margin_m = np.float32(max_rounding) * largest_m + np.float32(2 * self._min_contact_m)
                faces = slice(first_face, first_face + corners_m.shape[2])
                first_face = faces.stop
                self._lower_m[:, faces] = lower_m - margin_m
                self._upper_m[:, faces] = upper_m + margin_m
        self._min_m = self._lower_m.min(axis=1, initial=np.inf)
        self._max_m = self._upper_m.max(axis=1, initial=-np.inf)

    @cached_property
    def normals(self) -> Float32:
        """(3, F) unit normals, 0 for faces without area; computed only for sensors with range-limited returns."""
        normals = np.empty((3, self._num_faces), dtype=np.float32)
        for faces, corners_m in iterate_mesh_parts(self._bodies):
            normals[:, faces] = compute_normals(corners_m)
        return normals

    def find_containing_faces(self, position_m: NDArray[np.floating]) -> Int64:
        """Find the faces on which a (3,) position lies, as face numbers."""
        if ((position_m < self._min_m) | (position_m > self._max_m)).any():
            return np.empty(0, dtype=np.int64)
        x, y, z = position_m
        # The height comes last, since most faces are near the ground and would pass its test.
        candidates = np.flatnonzero((self._lower_m[0] <= x) & (x <= self._upper_m[0]))
        for axis, coordinate_m in ((1, y), (2, z)):
            is_within = self._lower_m[axis, candidates] <= coordinate_m
            is_within &= coordinate_m <= self._upper_m[axis, candidates]
            candidates = candidates[is_within]
        if len(candidates) == 0:
            return candidates
        corners_m = get_corners_m(self._bodies, candidates)
        tolerance_m = 2 * self.compute_contact_distances_m(candidates)
        outside_m = np.maximum(corners_m.min(axis=0) - position_m[:, None], position_m[:, None] - corners_m.max(axis=0))
        is_near_box = (outside_m <= tolerance_m).all(axis=0)
        is_near_plane = self.compute_plane_distances_m(position_m, candidates) <= tolerance_m
        return np.asarray(candidates[is_near_box & is_near_plane])

    def find_faces_above(self, position_m: NDArray[np.floating]) -> Int64:
        """Find the faces whose boxes a vertical line upwards from a (3,) position meets, as face numbers."""
        x, y, z = position_m
        candidates = np.flatnonzero((self._lower_m[0] <= x) & (x <= self._upper_m[0]))
        candidates = candidates[(self._lower_m[1, candidates] <= y) & (y <= self._upper_m[1, candidates])]
        return np.asarray(candidates[z <= self._upper_m[2, candidates]])

    def compute_contact_distances_m(self, face_indices: Int64) -> Float64:
        """Compute the distance from the plane of each face at which float32 may place a point that lies on it.

        Args:
            face_indices: (N,) face numbers.

        Returns:
            (N,) distances; for slivers, whose plane is ill-defined, an upper bound by their coordinates.
        """
        first, second, third = corners_m = get_corners_m(self._bodies, face_indices)
        (ax, ay, az), (bx, by, bz) = np.abs(second - first), np.abs(third - first)
        length = np.linalg.norm(np.cross(second - first, third - first, axis=0), axis=0)
        # To first order, the rounding of n . x with n = a x b is proportional to the sum of all its products.
        products = np.stack([ay * bz + az * by, az * bx + ax * bz, ax * by + ay * bx])
        largest = np.abs(corners_m).max(axis=0)
        rounding_m = (products * largest).sum(axis=0) / np.where(length == 0, np.inf, length)
        contact_m = np.minimum(rounding_m, largest.max(axis=0)) * CONTACT_ROUNDING
        return np.asarray(np.maximum(contact_m, self._min_contact_m))

    def compute_plane_distances_m(self, position_m: NDArray[np.floating], face_indices: Int64) -> Float64:
        """Compute (N,) distances of a (3,) position from the planes of (N,) faces."""
        corners_m = get_corners_m(self._bodies, face_indices)
        return np.asarray(np.abs(((position_m[:, None] - corners_m[0]) * compute_normals(corners_m)).sum(axis=0)))
