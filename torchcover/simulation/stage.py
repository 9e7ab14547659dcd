"""Where a run through a scenario plays: its geometry, and the rigs' sensors in it."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.instant import Instant
from torchcover.simulation.mounted import MountedSensor
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import Scene

# A sensor on the ground is asked about a place this far above it: whether it is inside of something else.
LIFT_M = np.array([0.0, 0.0, 0.01])


@dataclass(eq=False)
class Stage:
    """One run's geometry, and the sensors of each rig at their places on its ego."""

    scene: Scene
    mounted: Mapping[str, Sequence[MountedSensor]]
    _free_for_good: bool = field(default=False, init=False)

    def check_mounts(self, instant: Instant) -> None:
        """Refuse a sensor that is where none can be; where nothing moves, the first answer holds.

        Raises:
            ValueError: It lies below the ground or inside a body.
        """
        if self._free_for_good:
            return
        for rig, sensors in self.mounted.items():
            for mounted in sensors:
                place_m = mounted.vehicle_T_sensor[:3, 3]
                _check_place(f"rig {rig!r}: sensor {mounted.sensor.name!r}", place_m, instant)
        self._free_for_good = not self.scene.moves


def _check_place(sensor: str, place_m: NDArray[np.float64], instant: Instant) -> None:
    where = f"{sensor} at {place_m.round(3).tolist()} m"
    on_a_face = instant.on_a_face(place_m)
    if instant.buried(place_m + LIFT_M if on_a_face else place_m):
        raise ValueError(
            f"{where} lies below the ground, or inside a wall or another body, so that it sees what is none; "
            "is the sign of z_m right, does the ego stand on the ground, and do faces point outwards?"
        )
    if on_a_face:
        warnings.warn(
            f"{where} lies exactly on the ground or on a wall, and sees nothing of it; move its mount away from it",
            stacklevel=2,
        )


class Stages:
    """The stages of a scenario's runs: each is built when first needed, and the last one is kept.

    In each process, that is: Embree's scenes cannot be pickled, so that a DataLoader worker builds its own.

    Args:
        scenario: What plays.
        rigs: Whose sensors are mounted.
        seed: Seed of procedural traffic.
    """

    def __init__(self, scenario: Scenario, rigs: Mapping[str, Rig], seed: int) -> None:
        self._scenario = scenario
        self._rigs = rigs
        self._seed = seed
        self._tiles: dict[str, list[tuple[Tile, ...]]] = {}
        self._last: tuple[int, Stage] | None = None

    def of_run(self, run: int) -> Stage:
        """The stage of one run; see `Scenario.locate`.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A mesh or a trajectory cannot be used, or a sensor is mounted inside the ego's body.
        """
        if self._last is None or self._last[0] != run:
            self._last = None  # there is not always memory for two
            self._last = run, self._built(run)
        return self._last[1]

    def _built(self, run: int) -> Stage:
        scene = Scene(self._scenario.world(self._seed, run))
        self._check_mounts(scene)
        if not self._tiles:
            self._tiles = {
                name: [into_tiles(sensor.directions()) for sensor in rig.sensors] for name, rig in self._rigs.items()
            }
        return Stage(scene, {name: self._mount(name, scene) for name in self._rigs})

    def _mount(self, name: str, scene: Scene) -> list[MountedSensor]:
        sensors = zip(self._rigs[name].sensors, self._tiles[name], strict=True)
        return [MountedSensor(sensor, tiles, scene) for sensor, tiles in sensors]

    def _check_mounts(self, scene: Scene) -> None:
        for name, rig in self._rigs.items():
            for sensor in rig.sensors:
                place = sensor.mount.matrix()[:3, 3]
                if scene.encloses(place):
                    raise ValueError(
                        f"rig {name!r}: sensor {sensor.name!r} at {place.round(3).tolist()} m lies inside the ego of "
                        f"{self._scenario.name!r}, so that all its rays start blocked; move its mount"
                    )

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last": None, "_tiles": {}}
