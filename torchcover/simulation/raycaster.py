"""Ray casting with Embree. Everything that one must know about embreex stays in this file.

embreex computes in float32, so a scene is given in coordinates near the vehicle; it does not check that origins and
directions are equal in number; it answers a miss with the distance it was given; it releases the interpreter lock, so
that threads add up.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh

# Rays that one thread takes at a time. A constant, so that no result depends on the number of threads.
CHUNK = 1 << 15

Float32 = NDArray[np.float32]


class Hits(NamedTuple):
    """Where rays ended: `points` (3, K) float32 for the K rays that hit, `body` (K,) int32 and `ray` (K,) int64."""

    points: Float32
    body: NDArray[np.int32]
    ray: NDArray[np.int64]


class RayCaster:
    """A set of bodies that rays can be cast at.

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

    def cast(
        self,
        origin_m: NDArray[np.float64],
        rotation: NDArray[np.float64],
        directions: Float32,
        *,
        min_range_m: float = 0.0,
        max_range_m: float = np.inf,
        threads: int = 1,
    ) -> Hits:
        """Cast rays from one origin.

        Args:
            origin_m: (3,) common origin of the rays.
            rotation: (3, 3) rotation from the frame of the directions to that of the bodies.
            directions: (3, N) unit directions.
            min_range_m: Hits closer than this are misses.
            max_range_m: Hits farther than this are misses.
            threads: Number of threads. The result does not depend on it.

        Returns:
            `Hits(points, body, ray)` in the order of the rays.
        """
        starts = range(0, directions.shape[1], CHUNK)
        origin, matrix = origin_m.astype(np.float32), rotation.astype(np.float32)

        def cast_chunk(start: int) -> Hits:
            hits = self._cast_chunk(origin, matrix, directions[:, start : start + CHUNK], min_range_m, max_range_m)
            return hits._replace(ray=hits.ray + start)

        if threads <= 1 or len(starts) <= 1:
            chunks = [cast_chunk(start) for start in starts]
        else:
            # A pool for each cast: threads do not survive the fork that makes a DataLoader worker.
            with ThreadPoolExecutor(threads) as pool:
                chunks = list(pool.map(cast_chunk, starts))
        return _join(chunks)

    def _cast_chunk(
        self, origin: Float32, rotation: Float32, directions: Float32, min_range_m: float, max_range_m: float
    ) -> Hits:
        directions = _rotate(rotation, directions)
        origins = np.broadcast_to(origin, (directions.shape[1], 3))
        limit = np.full(directions.shape[1], min(max_range_m, np.finfo(np.float32).max), dtype=np.float32)
        answer = self._scene.run(origins, directions.T, dists=limit, output=True)
        range_m, body = answer["tfar"], answer["geomID"]
        ray = np.flatnonzero((body >= 0) & (range_m >= min_range_m))
        return Hits(origin[:, None] + range_m[ray] * directions[:, ray], body[ray], ray)


def _rotate(rotation: Float32, directions: Float32) -> Float32:
    # Written out: the rounding of a matrix product depends on how a BLAS splits it.
    x, y, z = directions
    rotated = np.empty((3, len(x)), dtype=np.float32)
    for axis, (rx, ry, rz) in enumerate(rotation):
        np.multiply(x, rx, out=rotated[axis])
        rotated[axis] += ry * y
        rotated[axis] += rz * z
    return rotated


def _join(chunks: Sequence[Hits]) -> Hits:
    if not chunks:
        return Hits(np.empty((3, 0), np.float32), np.empty(0, np.int32), np.empty(0, np.int64))
    points, body, ray = zip(*chunks, strict=True)
    return Hits(np.concatenate(points, axis=1), np.concatenate(body), np.concatenate(ray))
