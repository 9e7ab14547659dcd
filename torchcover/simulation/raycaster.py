"""Ray casting with Embree, or with Warp on a device.

Properties of embreex that this module relies on:

- It computes in float32: a scene needs coordinates near the vehicle, and an origin may lie on a face by rounding.
- It does not check that there are as many origins as directions.
- It writes ranges into the array of limits that it receives; a miss keeps its limit.
- It releases the interpreter lock, so that several threads cast in parallel.
- It builds scenes with threads of its own. A forked process, such as a DataLoader worker, inherits their locks but not
  the threads, and about one in a thousand deadlocks. TBB counts the available cores at its first use, which therefore
  happens with one core (`_disable_embree_threads`).
"""

import os
from collections.abc import Sequence
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float32, Int32, Int64
from torchcover.geometry.rigid import Matrix
from torchcover.simulation.face_geometry import FaceGeometry
from torchcover.simulation.patches import find_outward_faces
from torchcover.simulation.rays import rotate
from torchcover.simulation.shapes import Mesh, get_corners_m


@cache
def _disable_embree_threads() -> None:
    """Use Embree for the first time on a single core of this thread, so that it starts no threads."""
    if not hasattr(os, "sched_setaffinity"):  # systems that start new processes instead of forking
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        scene = EmbreeScene()
        TriangleMesh(scene, np.eye(3, dtype=np.float32), np.arange(3, dtype=np.int32).reshape(1, 3))
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    finally:
        os.sched_setaffinity(0, cores)


def _build_embree_scene(bodies: Sequence[Mesh]) -> EmbreeScene:
    """Build an Embree scene whose geometries are the bodies, in their order."""
    _disable_embree_threads()
    # Robust: a ray through a shared edge hits one of the two faces instead of slipping between them.
    scene = EmbreeScene(robust=True)
    for body in bodies:
        TriangleMesh(scene, body.vertices_m.astype(np.float32), _convert_faces_for_embreex(body.faces))
    # embreex commits the scene at its first use; do it before several threads do.
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
    return scene


def _convert_faces_for_embreex(faces: NDArray[np.integer]) -> NDArray[Any]:
    """Convert (F, 3) faces to the type that embreex reads fastest: lists, since it indexes number by number."""
    max_list_count = 2**18  # lists take some hundred bytes per face
    if len(faces) > max_list_count:
        return faces.astype(np.int32)
    return np.fromiter(faces.tolist(), dtype=object, count=len(faces))


class Hits(NamedTuple):
    """Hits of N rays.

    Args:
        range_m: (N,) float32 range of each hit; the limit of the ray if it hit nothing.
        body_indices: (N,) int32 body; -1 if the ray hit nothing.
        triangle_indices: (N,) int32 face in the mesh of that body.
    """

    range_m: Float32
    body_indices: Int32
    triangle_indices: Int32


class HitAttributes(NamedTuple):
    """Attributes of the surfaces that N rays hit.

    Args:
        body_indices: (N,) int32 body, see `SceneSnapshot`; -1 if the ray hit nothing.
        triangle_indices: (N,) int32 face in the mesh of that body.
        cos_incidence: (N,) float32 cosine of the angle between ray and surface normal, 0 to 1 on either side.
        material_indices: (N,) uint8 material of the face.
    """

    body_indices: Int32
    triangle_indices: Int32
    cos_incidence: Float32
    material_indices: NDArray[np.uint8]


class RayCaster:
    """Bodies at which rays can be cast, from several threads at once.

    Args:
        bodies: Closed or open meshes with coordinates near the origin of the rays' frame, since they become float32.
        device: Warp device, such as `cuda:0`; None for Embree. Both agree up to the last bits.

    Raises:
        ValueError: There is no body, or a vertex is NaN or farther than 1e9 m from the origin.
    """

    def __init__(self, bodies: Sequence[Mesh], device: str | None = None) -> None:
        if not bodies:
            raise ValueError("a scene needs at least one body")
        max_coordinate_m = float(np.max([np.abs(body.vertices_m).max(initial=0.0) for body in bodies]))  # may be NaN
        # Farther out float32 resolves no better than 64 m, and at 2e18 m Embree drops faces silently.
        limit_m = 1e9
        if not max_coordinate_m <= limit_m:
            raise ValueError(
                f"bodies within {limit_m:g} m of the origin are needed; a vertex has the coordinate {max_coordinate_m}"
            )
        self._max_coordinate_m = max_coordinate_m
        self._first_faces = np.cumsum([0] + [len(body.faces) for body in bodies])
        self._bodies = bodies
        self._outward_masks: dict[int, Bools] = {}  # by body; needed for few, since rays hardly ever start inside
        self._last_touched: tuple[bytes, Int64] = b"", np.empty(0, dtype=np.int64)
        if device is None:
            self._scene = _build_embree_scene(bodies)
        else:
            from torchcover.simulation.warp_scene import WarpScene  # Warp is imported on first use

            self._scene = WarpScene(bodies, device)

    @cached_property
    def _faces(self) -> FaceGeometry:
        """Faces of all bodies; needed only if rays start at one origin, which may lie on a face."""
        return FaceGeometry(self._bodies, self._max_coordinate_m)

    @cached_property
    def _material_indices(self) -> NDArray[np.uint8]:
        """(F,) material of each face."""
        return np.concatenate([body.filled_material_indices for body in self._bodies])

    @property
    def num_bodies(self) -> int:
        """Number of bodies; their indices begin at 0."""
        return len(self._bodies)

    def cast(self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32) -> Hits:
        """Cast rays from one origin; a ray that starts on a face does not hit that face.

        Args:
            origin_m: (3,) origin of all rays.
            directions: (3, N) float32 unit directions.
            limit_m: (N,) float32 largest range of each ray, possibly infinite.

        Returns:
            Hits; rays that hit nothing have their limit as range and body -1.
        """
        # A stride of 0 repeats one origin for all rays without copies.
        num_rays = directions.shape[1]
        origins = np.ndarray((num_rays, 3), np.float32, origin_m.astype(np.float32).tobytes(), strides=(0, 4))
        hits = self.cast_from_each(origins, directions, limit_m)
        if len(self.find_touched_bodies(origin_m)):
            self._continue_rays_from_faces(origin_m, directions, limit_m, hits)
        return hits

    def cast_from_each(self, origins_m: Float32, directions: Float32, limit_m: Float32) -> Hits:
        """Cast rays that have an origin each, none of which lies on a face.

        Args:
            origins_m: (N, 3) float32 origins.
            directions: (3, N) float32 unit directions.
            limit_m: (N,) float32 largest range of each ray, possibly infinite.

        Returns:
            Hits, see `cast`.
        """
        result = self._scene.run(origins_m, directions.T, dists=limit_m.copy(), output=True)
        return Hits(result["tfar"], result["geomID"], result["primID"])

    def compute_hit_attributes(
        self, body_indices: Int32, triangle_indices: Int32, directions: Float32
    ) -> HitAttributes:
        """Compute incidence angles and materials of hits.

        Args:
            body_indices: (N,) bodies, none of them -1.
            triangle_indices: (N,) faces in the meshes of these bodies.
            directions: (3, N) float32 unit directions of the rays.
        """
        face_indices = self._first_faces.take(body_indices) + triangle_indices
        (nx, ny, nz), (x, y, z) = self._faces.normals.take(face_indices, axis=1), directions
        cosine = np.abs(nx * x + ny * y + nz * z)
        np.minimum(cosine, 1.0, out=cosine)
        return HitAttributes(body_indices, triangle_indices, cosine, self._material_indices.take(face_indices))

    def find_first_faces(
        self, origins_m: NDArray[np.floating], directions: NDArray[np.floating], limit_m: float
    ) -> Int64:
        """Find the first face that each ray hits.

        Args:
            origins_m: (N, 3) origins.
            directions: (N, 3) unit directions.
            limit_m: Largest range.

        Returns:
            (N,) face numbers, consecutive over all bodies; -1 where a ray hits nothing.
        """
        limits_m = np.full(len(origins_m), limit_m, dtype=np.float32)
        hits = self.cast_from_each(origins_m.astype(np.float32), directions.astype(np.float32).T, limits_m)
        return np.asarray(np.where(hits.body_indices >= 0, self._compute_face_indices(hits), -1))

    def _compute_face_indices(self, hits: Hits) -> Int64:
        """Compute the (N,) face numbers over all bodies; arbitrary for rays that hit nothing."""
        return np.asarray(self._first_faces[np.maximum(hits.body_indices, 0)] + np.maximum(hits.triangle_indices, 0))

    def find_touched_bodies(self, position_m: NDArray[np.floating]) -> Int64:
        """Find the bodies on whose faces a (3,) position lies; usually none.

        The last result is cached, since all ray tiles of a scan have the same origin.
        """
        last_position, touched = self._last_touched  # one read: other threads may replace the pair
        if last_position != position_m.tobytes():
            faces = self._faces.find_containing_faces(position_m)
            touched = np.searchsorted(self._first_faces, faces, side="right") - 1
            self._last_touched = (position_m.tobytes(), touched)
        return touched

    def _continue_rays_from_faces(
        self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32, hits: Hits
    ) -> None:
        """Continue rays beyond a face on whose plane they start, which they hit by rounding only; changes `hits`."""

        def is_start_on_plane(faces: Int64) -> Bools:
            plane_distances_m = self._faces.compute_plane_distances_m(origin_m, faces)
            return np.asarray(plane_distances_m <= self._faces.compute_contact_distances_m(faces))

        rays, faces = np.flatnonzero(hits.body_indices >= 0), self._compute_face_indices(hits)
        rays = rays[is_start_on_plane(faces[rays])]
        range_m, faces, travelled_m = hits.range_m[rays], faces[rays], np.zeros(len(rays))
        for attempt in range(1, 13):
            if len(rays) == 0:
                return
            # Each attempt skips twice the distance. The hit is the nearest one, so that nothing before it is skipped.
            travelled_m = travelled_m + range_m + 2.0**attempt * self._faces.compute_contact_distances_m(faces)
            ray_directions = directions.T[rays]
            remaining_m = np.maximum(limit_m[rays] - travelled_m, 0.0)
            starts_m = origin_m + travelled_m[:, None] * ray_directions
            new_hits = self.cast_from_each(
                starts_m.astype(np.float32), ray_directions.T, remaining_m.astype(np.float32)
            )
            is_hit, range_m, faces = new_hits.body_indices >= 0, new_hits.range_m, self._compute_face_indices(new_hits)
            hits.range_m[rays] = np.where(is_hit, travelled_m + range_m, limit_m[rays])
            hits.body_indices[rays], hits.triangle_indices[rays] = new_hits.body_indices, new_hits.triangle_indices
            is_blocked = is_hit & is_start_on_plane(faces)
            rays, travelled_m = rays[is_blocked], travelled_m[is_blocked]
            range_m, faces = range_m[is_blocked], faces[is_blocked]

    def find_enclosing_bodies(self, position_m: NDArray[np.floating]) -> Int64:
        """Find the bodies inside which a (3,) position lies; an open surface has no inside.

        A position is inside a closed surface with outward normals if a vertical line upwards leaves the surface more
        often than it enters. No ray is cast, since the order of hits where bodies touch depends on the processor.
        """
        faces = self._faces.find_faces_above(position_m)
        face_bodies = np.searchsorted(self._first_faces, faces, side="right") - 1
        bodies, body_rows = np.unique(face_bodies, return_inverse=True)
        is_closed = np.zeros(len(faces), dtype=bool)
        for body in bodies.tolist():
            if body not in self._outward_masks:
                self._outward_masks[body] = find_outward_faces(self._bodies[body])
            in_body = face_bodies == body
            is_closed[in_body] = self._outward_masks[body][faces[in_body] - self._first_faces[body]]
        corners_m = get_corners_m(self._bodies, faces) - position_m[:, None]
        # Small shifts are tried where the line meets an edge exactly.
        for shift_x_m, shift_y_m in ((0.0, 0.0), (1.1e-7, 2.3e-7), (-3.7e-7, 1.9e-7)):
            x_m, y_m = corners_m[:, 0] - shift_x_m, corners_m[:, 1] - shift_y_m
            # Twice the signed areas between the line and each edge; two faces compute identical bits for their edge.
            areas = np.roll(x_m, -1, 0) * np.roll(y_m, -2, 0) - np.roll(y_m, -1, 0) * np.roll(x_m, -2, 0)
            total_area = areas.sum(axis=0)
            if not ((areas == 0).any(axis=0) & (total_area != 0)).any():
                break
        with np.errstate(divide="ignore", invalid="ignore"):
            height_m = (areas * corners_m[:, 2]).sum(axis=0) / total_area
            is_above = height_m > self._faces.compute_contact_distances_m(faces)
        crossing = (areas > 0).all(axis=0).astype(np.int64) - (areas < 0).all(axis=0)  # 1 leaves, -1 enters
        return bodies[np.bincount(body_rows, crossing * (is_above & is_closed), len(bodies)) > 0]


def cast_from_vehicle(
    caster: RayCaster, part_T_vehicle: Matrix, origin_m: Matrix, directions: Float32, limit_m: Float32
) -> Hits:
    """Cast rays of the vehicle frame at bodies in another frame.

    Args:
        caster: Bodies.
        part_T_vehicle: (4, 4) transform from the vehicle frame to that of the bodies.
        origin_m: (3,) origin in the vehicle frame.
        directions: (3, N) unit directions in the vehicle frame.
        limit_m: (N,) largest range of each ray.
    """
    part_directions = rotate(part_T_vehicle[:3, :3], directions)
    return caster.cast(transform_points(part_T_vehicle, origin_m[None])[0], part_directions, limit_m)
