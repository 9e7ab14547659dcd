"""Ray casting with Embree. Everything that one must know about embreex stays in this file.

embreex computes in float32, so a scene is given in coordinates near the vehicle; it does not check that origins and
directions are equal in number; it writes into the distances it is given, and answers a miss with them; it releases the
interpreter lock, so that threads add up.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh

Float32 = NDArray[np.float32]

# Farther from the origin float32 resolves no better than 64 m, and at 2e18 Embree drops faces without a word.
MOST_M = 1e9
# An origin lies on a face if it is no farther from its plane than this many roundings of the largest coordinate.
CONTACT_ROUNDINGS = 4
# Only hits this near are looked at: what a sensor is mounted on.
TOUCHING_M = 1.0


class Hits(NamedTuple):
    """For each of N rays: `range_m` (N,) float32 where it ended, and `body` (N,) int32, -1 if at its limit."""

    range_m: Float32
    body: NDArray[np.int32]


class RayCaster:
    """A set of bodies that rays can be cast at, from several threads at once.

    Args:
        bodies: One closed or open mesh a body, in metres, in the frame that rays are given in. Coordinates should be
            near the origin: they become float32.

    Raises:
        ValueError: There is no body, or one with a vertex that is not a number or farther than 1e9 m.
    """

    def __init__(self, bodies: Sequence[Mesh]) -> None:
        if not bodies:
            raise ValueError("a scene needs at least one body")
        reach_m = float(np.max([np.abs(body.vertices_m).max(initial=0.0) for body in bodies]))  # NaN if one is
        if not reach_m <= MOST_M:
            raise ValueError(
                f"bodies within {MOST_M:g} m of the origin are needed; a vertex has the coordinate {reach_m}"
            )
        self._contact_m = CONTACT_ROUNDINGS * float(np.finfo(np.float32).eps) * reach_m
        # Robust: a ray through a shared edge hits one of the two faces instead of slipping between them.
        self._scene = EmbreeScene(robust=True)
        for body in bodies:
            TriangleMesh(self._scene, body.vertices_m.astype(np.float32), body.faces.astype(np.int32))
        # embreex commits the scene when it is first used; do it before several threads do.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def cast(self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32) -> Hits:
        """Cast rays from one origin. A ray that starts on a face does not hit that face.

        Args:
            origin_m: (3,) common origin of the rays.
            directions: (3, N) unit directions.
            limit_m: (N,) distance at which each ray ends; may be infinite.

        Returns:
            `Hits(range_m, body)`: the nearest hit within the limit; else the limit, and -1.
        """
        # One origin for all rays: an array that steps over no memory from row to row.
        origins = np.ndarray(
            (directions.shape[1], 3), np.float32, origin_m.astype(np.float32).tobytes(), strides=(0, 4)
        )
        answer = self._scene.run(origins, directions.T, dists=limit_m.copy(), output=True)
        hits = Hits(answer["tfar"], answer["geomID"])
        self._leave_faces(origin_m, directions, limit_m, answer["Ng"], hits)
        return hits

    def _leave_faces(
        self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32, normals: Float32, hits: Hits
    ) -> None:
        """Cast the rays again that hit the face they start on, from a place beside it, on the side they point to."""
        near = np.flatnonzero((hits.range_m < TOUCHING_M) & (hits.body >= 0))
        if len(near) == 0:
            return
        # Column by column: sums over rows of three numbers are slow.
        (nx, ny, nz), (x, y, z) = normals[near].T, directions[:, near]
        length, slope = np.sqrt(nx * nx + ny * ny + nz * nz), nx * x + ny * y + nz * z
        # By the distance from the face, not along the ray: a grazing ray meets the rounded face far from its origin.
        touching = (hits.range_m[near] * np.abs(slope) <= self._contact_m * length) & (length > 0)
        near = near[touching]
        if len(near):
            away = np.sign(slope[touching]) / length[touching]
            beside = origin_m + 2 * self._contact_m * away[:, None] * normals[near]
            answer = self._scene.run(beside.astype(np.float32), directions.T[near], dists=limit_m[near], output=True)
            hits.range_m[near], hits.body[near] = answer["tfar"], answer["geomID"]

    def back_faces(self, origin_m: NDArray[np.floating], directions: Float32) -> NDArray[np.bool_]:
        """Which rays first meet a face from behind, as rays that start inside a closed body do.

        Args:
            origin_m: (3,) common origin of the rays.
            directions: (3, N) unit directions.

        Returns:
            (N,) whether the ray's first hit is the back of a face.
        """
        origins = np.ascontiguousarray(np.broadcast_to(origin_m.astype(np.float32), (directions.shape[1], 3)))
        answer = self._scene.run(origins, directions.T, output=True)
        # Embree's Ng points to where the corners of the face turn counter-clockwise.
        behind: NDArray[np.bool_] = (answer["Ng"] * directions.T).sum(axis=1) > 0
        behind &= answer["geomID"] >= 0
        return behind
