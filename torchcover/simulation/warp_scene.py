"""Rays on a GPU, or on the CPU from the same source, with Warp, as `RayCaster` asks Embree for them.

Warp's own query of a mesh lets rays slip between boxes without thickness, so boxes are grown here, and faces are asked
in float64: two that share an edge compute the same number for it with opposite signs, and no ray passes between them.
Of several faces at the same range the first is met.
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

# Of a box, as a share of its coordinates and of those of origins: what float32 makes of the way to it.
GROWN, ORIGINS_M = 8 * float(np.finfo(np.float32).eps), 1e3


class WarpScene:
    """The faces of bodies, one after the other, on a device of Warp; `run` is that of `EmbreeScene` with `output`."""

    def __init__(self, bodies: Sequence[Mesh], device: str) -> None:
        self._device, self._one_at_a_time = wp.get_device(device), Lock()
        self._first_face = np.cumsum([0, *(len(body.faces) for body in bodies)])
        corners_m = np.concatenate([body.vertices_m.astype(np.float32)[body.faces] for body in bodies])
        grown_m = GROWN * (np.abs(corners_m).max(axis=(1, 2), initial=0.0) + ORIGINS_M)[:, None]
        self._corners_m = self._there(corners_m.reshape(-1, 3), wp.vec3)
        bounds = corners_m.min(axis=1) - grown_m, corners_m.max(axis=1) + grown_m
        # Of no faces there is no tree.
        self._tree = wp.Bvh(*(self._there(each, wp.vec3) for each in bounds)) if len(corners_m) else None

    def run(self, origins_m: Float32, directions: Float32, *, dists: Float32, output: bool) -> Any:  # noqa: ANN401
        """Range, body and face of what each of (N, 3) rays meets within (N,) limits."""
        ends_m, face = dists, np.full(len(origins_m), -1, dtype=np.int32)
        if self._tree is not None and len(face):
            with self._one_at_a_time:
                rays = [self._there(origins_m, wp.vec3), self._there(directions, wp.vec3)]
                told = [self._there(ends_m, wp.float32), self._there(face, wp.int32)]
                given = [self._tree.id, self._corners_m, *rays, *told]
                wp.launch(_meet, dim=len(face), inputs=given, device=self._device)
                ends_m, face = (each.numpy() for each in told)
        body = np.searchsorted(self._first_face, face, side="right").astype(np.int32) - 1
        triangle = np.where(face < 0, -1, face - self._first_face.take(body, mode="clip")).astype(np.int32)
        return {"tfar": ends_m, "geomID": body, "primID": triangle}

    def _there(self, values: NDArray[Any], dtype: Any) -> Any:  # noqa: ANN401  (a type and an array of Warp)
        return wp.array(np.ascontiguousarray(values, values.dtype), dtype=dtype, device=self._device)


@wp.kernel
def _meet(
    tree: wp.uint64,
    corners_m: wp.array(dtype=wp.vec3),
    origins_m: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    ends_m: wp.array(dtype=wp.float32),
    met: wp.array(dtype=wp.int32),
):
    """Where each ray ends at its nearest face within its limit, and which face that is."""
    i = wp.tid()
    origin, along = wp.vec3d(origins_m[i]), wp.vec3d(directions[i])
    end = wp.float64(ends_m[i])
    nearest = wp.int32(-1)
    face = wp.int32(0)
    query = wp.bvh_query_ray(tree, origins_m[i], directions[i])
    while wp.bvh_query_next(query, face, wp.float32(end) * (1.0 + 4.0 * 1.1920929e-07)):
        a = wp.vec3d(corners_m[3 * face]) - origin
        b = wp.vec3d(corners_m[3 * face + 1]) - origin
        c = wp.vec3d(corners_m[3 * face + 2]) - origin
        # On which sides of the edges the ray passes.
        u, v, w = wp.dot(along, wp.cross(b, c)), wp.dot(along, wp.cross(c, a)), wp.dot(along, wp.cross(a, b))
        inside = (u >= 0.0 and v >= 0.0 and w >= 0.0) or (u <= 0.0 and v <= 0.0 and w <= 0.0)
        if inside and u + v + w != 0.0:
            # A mean of the corners: the plane of a sliver is anybody's guess.
            way = (u * wp.dot(along, a) + v * wp.dot(along, b) + w * wp.dot(along, c)) / (u + v + w)
            way /= wp.dot(along, along)
            if way >= 0.0 and (way < end or (way == end and face < nearest)):
                end = way
                nearest = face
    if nearest >= 0:
        ends_m[i] = wp.float32(end)
        met[i] = nearest
