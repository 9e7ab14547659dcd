"""A sensor at its place on the ego of one scene: what is the same at every step is worked out once."""

from collections.abc import Sequence

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
        self._tiles = tiles
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
            self._tiles,
            min_range_m=self.sensor.min_range_m,
            max_range_m=self.sensor.max_range_m,
            own_m=self._own_m,
            threads=threads,
        )
        if self._at_rest:
            self._seen = scan
        return scan
