"""Ray casting with Warp on a GPU or CPU, with the interface that `RayCaster` uses of Embree.

The mesh query of Warp lets rays slip between boxes without thickness. Here boxes are enlarged, and faces are tested in
float64: two faces with a common edge compute the same number for it with opposite signs, so that no ray passes between
them. Of several faces at the same range the first is hit.
"""

# The types of Warp's functions are Warp's own.
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, operator, call-overload, assignment"
# ruff: noqa: ANN202

from collections.abc import Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Float32
from torchcover.neighbors.warp import wp  # type: ignore[attr-defined]  # set up there
from torchcover.simulation.shapes import Mesh

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


class WarpScene:
    """Faces of bodies, numbered consecutively, on a Warp device; `run` answers as `EmbreeScene.run` with `output`.

    Args:
        bodies: Meshes.
        device: Warp device, such as `cuda:0`.
    """

    def __init__(self, bodies: Sequence[Mesh], device: str) -> None:
        self._device = wp.get_device(device)
        self._lock = Lock()  # one query at a time
        self._first_faces = np.cumsum([0, *(len(body.faces) for body in bodies)])
        corners_m = np.concatenate([body.vertices_m.astype(np.float32)[body.faces] for body in bodies])
        # float32 rounds the way to a box by a share of its coordinates and of the origins of rays, within 1 km.
        relative_margin = 8 * float(np.finfo(np.float32).eps)
        margin_m = relative_margin * (np.abs(corners_m).max(axis=(1, 2), initial=0.0) + 1e3)[:, None]
        self._corners_m = self._to_device(corners_m.reshape(-1, 3), wp.vec3)
        self._tree = None  # Warp builds no tree of zero faces
        if len(corners_m):
            lower_m = self._to_device(corners_m.min(axis=1) - margin_m, wp.vec3)
            upper_m = self._to_device(corners_m.max(axis=1) + margin_m, wp.vec3)
            self._tree = wp.Bvh(lower_m, upper_m)

    def run(self, origins_m: Float32, directions: Float32, *, dists: Float32, output: bool) -> Any:  # noqa: ANN401
        """Cast rays.

        Args:
            origins_m: (N, 3) float32 origins.
            directions: (N, 3) float32 unit directions.
            dists: (N,) float32 largest range of each ray.
            output: True, as for Embree.

        Returns:
            `tfar` (N,) range, `geomID` (N,) body, `primID` (N,) face of the body; -1 where a ray hits nothing.
        """
        range_m, face = dists, np.full(len(origins_m), -1, dtype=np.int32)
        if self._tree is not None and len(face):
            with self._lock:
                range_array = self._to_device(range_m, wp.float32)
                face_array = self._to_device(face, wp.int32)
                inputs = [
                    self._tree.id,
                    self._corners_m,
                    self._to_device(origins_m, wp.vec3),
                    self._to_device(directions, wp.vec3),
                    range_array,
                    face_array,
                ]
                wp.launch(_find_nearest_face, dim=len(face), inputs=inputs, device=self._device)
                range_m, face = range_array.numpy(), face_array.numpy()
        body = np.searchsorted(self._first_faces, face, side="right").astype(np.int32) - 1
        triangle = np.where(face < 0, -1, face - self._first_faces.take(body, mode="clip")).astype(np.int32)
        return {"tfar": range_m, "geomID": body, "primID": triangle}

    def _to_device(self, values: NDArray[Any], dtype: Any) -> Any:  # noqa: ANN401  (a type and an array of Warp)
        """Copy an array to the device."""
        return wp.array(np.ascontiguousarray(values, values.dtype), dtype=dtype, device=self._device)


@wp.kernel
def _find_nearest_face(
    tree: wp.uint64,
    corners_m: wp.array(dtype=wp.vec3),
    origins_m: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ranges_m: wp.array(dtype=wp.float32),
    faces: wp.array(dtype=wp.int32),
):
    """Find the nearest face of each ray within its range; writes the range and the face."""
    i = wp.tid()
    origin, direction = wp.vec3d(origins_m[i]), wp.vec3d(directions[i])
    nearest_range = wp.float64(ranges_m[i])
    nearest_face = wp.int32(-1)
    face = wp.int32(0)
    query = wp.bvh_query_ray(tree, origins_m[i], directions[i])
    while wp.bvh_query_next(query, face, wp.float32(nearest_range) * (1.0 + 4.0 * 1.1920929e-07)):
        a = wp.vec3d(corners_m[3 * face]) - origin
        b = wp.vec3d(corners_m[3 * face + 1]) - origin
        c = wp.vec3d(corners_m[3 * face + 2]) - origin
        # The signs tell on which side of each edge the ray passes.
        u = wp.dot(direction, wp.cross(b, c))
        v = wp.dot(direction, wp.cross(c, a))
        w = wp.dot(direction, wp.cross(a, b))
        is_inside = (u >= 0.0 and v >= 0.0 and w >= 0.0) or (u <= 0.0 and v <= 0.0 and w <= 0.0)
        if is_inside and u + v + w != 0.0:
            # A weighted mean of the corners, since the plane of a sliver is ill-defined.
            range_ = (u * wp.dot(direction, a) + v * wp.dot(direction, b) + w * wp.dot(direction, c)) / (u + v + w)
            range_ /= wp.dot(direction, direction)
            if range_ >= 0.0 and (range_ < nearest_range or (range_ == nearest_range and face < nearest_face)):
                nearest_range = range_
                nearest_face = face
    if nearest_face >= 0:
        ranges_m[i] = wp.float32(nearest_range)
        faces[i] = nearest_face
