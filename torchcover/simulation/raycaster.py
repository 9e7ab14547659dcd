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
        ValueError: There is no body.
    """

    def __init__(self, bodies: Sequence[Mesh]) -> None:
        if not bodies:
            raise ValueError("a scene needs at least one body")
        # Robust: a ray through a shared edge hits one of the two faces instead of slipping between them.
        self._scene = EmbreeScene(robust=True)
        for body in bodies:
            TriangleMesh(self._scene, body.vertices_m.astype(np.float32), body.faces.astype(np.int32))
        # embreex commits the scene when it is first used; do it before several threads do.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def cast(self, origin_m: NDArray[np.floating], directions: Float32, limit_m: Float32) -> Hits:
        """Cast rays from one origin.

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
        return Hits(answer["tfar"], answer["geomID"])

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
