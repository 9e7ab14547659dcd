"""A sensor at its place on the ego of one scene: what is the same at every step is worked out once."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import Instant, Scan
from torchcover.simulation.rays import Tile
from torchcover.simulation.scene import Scene
from torchcover.simulation.sensor import Sensor


class MountedSensor:
    """What a sensor of a rig would see exactly, without noise and drop-out.

    Its place on the ego is fixed, so the rays that the ego's own body ends are the same at every step: it is not cast
    at again. Where nothing moves at all, one scan serves for every step.

    Args:
        sensor: The sensor.
        tiles: Its rays, from `into_tiles`.
        scene: Where it is.
    """

    def __init__(self, sensor: Sensor, tiles: Sequence[Tile], scene: Scene) -> None:
        self.sensor = sensor
        self.vehicle_T_sensor = sensor.mount.matrix()
        self.tiles = tiles
        self._own_m = scene.own_m(self.vehicle_T_sensor, tiles, max_range_m=sensor.max_range_m)
        self._at_rest = not scene.moves
        self._seen: Scan | None = None

    def scan(self, instant: Instant, *, threads: int = 1) -> Scan:
        """What it sees at one time of the scene.

        Args:
            instant: From `Scene.at`.
            threads: Number of threads; the result does not depend on it.
        """
        if self._seen is not None:
            return self._seen
        scan = instant.scan(
            self.vehicle_T_sensor,
            self.tiles,
            min_range_m=self.sensor.min_range_m,
            max_range_m=self.sensor.max_range_m,
            own_m=self._own_m,
            threads=threads,
        )
        if self._at_rest:
            self._seen = scan
        return scan

    def ends_m(self, instant: Instant) -> NDArray[np.float32]:
        """Where each of its rays ends: at what it hits first, the ego's body included, or at the sensor's range.

        Args:
            instant: From `Scene.at`.

        Returns:
            (n,) metres, in the order of the tiles.
        """
        bodies, own = instant.outlines(self.vehicle_T_sensor[:3, 3]), self._own_m or [None] * len(self.tiles)
        ends_m = []
        for tile, own_m in zip(self.tiles, own, strict=True):
            limit_m = np.full(tile.directions.shape[1], self.sensor.max_range_m, dtype=np.float32)
            _, hits, _ = instant.cast(self.vehicle_T_sensor, tile, limit_m, bodies, own_m)
            ends_m.append(hits.range_m)
        return np.concatenate(ends_m)
