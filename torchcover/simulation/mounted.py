"""A sensor at its place on the ego of one scene: what is the same at every step is worked out once."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import Instant, SensorScan
from torchcover.simulation.rays import into_tiles, pixels_in_tiles
from torchcover.simulation.scene import Scene
from torchcover.simulation.sensor import Draws, RayHits, Sensor


class Ends(NamedTuple):
    """Where n rays end, in the order of the tiles: `range_m` (n,); `is_hit` (n,) whether on something but the ego."""

    range_m: NDArray[np.float32]
    is_hit: NDArray[np.bool_]


class MountedSensor:
    """What a sensor of a rig sees.

    Its place on the ego is fixed, so the rays that the ego's own body ends are the same at every step: it is not cast
    at again. Where nothing moves at all, the rays are cast once for every step.

    Args:
        sensor: The sensor.
        scene: Where it is.
        reach_m: How far its rays are cast there; `Scenario.reach_m`.
    """

    def __init__(self, sensor: Sensor, scene: Scene, reach_m: float) -> None:
        self.sensor = sensor
        self.reach_m = reach_m
        self.vehicle_T_sensor = sensor.mount.matrix()
        directions = sensor.directions()
        self.tiles = into_tiles(directions)
        self.pixel_of_ray = pixels_in_tiles(directions)
        self._own_m = scene.own_m(self.vehicle_T_sensor, self.tiles, max_range_m=reach_m)
        self._at_rest = not scene.moves
        self._hits: SensorScan | None = None

    def scan(self, instant: Instant, draws: Draws, *, threads: int = 1) -> SensorScan:
        """What it makes of what its rays hit at one time of the scene.

        Args:
            instant: From `Scene.at`.
            draws: The random numbers of its measuring.
            threads: Number of threads; the result does not depend on it.
        """
        hits = self._cast(instant, threads)
        hit, error_m = self.sensor.measure(RayHits(hits.ray, hits.range_m, self.pixel_of_ray), draws)
        if hit is not None:
            hits = hits._replace(points=hits.points[hit], ray=hits.ray[hit], range_m=hits.range_m[hit])
        if error_m is None:
            return hits
        ways_m = hits.points.astype(np.float64) - self.vehicle_T_sensor[:3, 3]
        along = error_m[:, None] / np.linalg.norm(ways_m, axis=1, keepdims=True)
        return hits._replace(points=(hits.points + ways_m * along).astype(np.float32))

    def _cast(self, instant: Instant, threads: int) -> SensorScan:
        if self._hits is not None:
            return self._hits
        hits = instant.scan(
            self.vehicle_T_sensor,
            self.tiles,
            max_range_m=self.reach_m,
            own_m=self._own_m,
            threads=threads,
        )
        if self._at_rest:
            self._hits = hits
        return hits

    def ends(self, instant: Instant) -> Ends:
        """Where each of its rays ends: at what it hits first, the ego's body included, or at its reach.

        Args:
            instant: From `Scene.at`.
        """
        bodies, own = instant.outlines(self.vehicle_T_sensor[:3, 3]), self._own_m or [None] * len(self.tiles)
        range_m, is_hit = [], []
        for tile, own_m in zip(self.tiles, own, strict=True):
            limit_m = np.full(tile.directions.shape[1], self.reach_m, dtype=np.float32)
            _, hits, _ = instant.cast(self.vehicle_T_sensor, tile, limit_m, bodies, own_m)
            range_m.append(hits.range_m)
            is_hit.append((hits.body >= 0) & (hits.body != instant.ego))
        return Ends(np.concatenate(range_m), np.concatenate(is_hit))
