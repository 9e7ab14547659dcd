"""Where a run through a scenario plays: its geometry, and the rigs' sensors in it."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from torchcover.simulation.instant import Instant
from torchcover.simulation.memory import machine_bytes
from torchcover.simulation.mounted import MountedSensor
from torchcover.simulation.rays import into_tiles
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import Scene
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.solids import Solids

# A sensor on the ground is asked about a place this far above it: whether it is inside of something else.
LIFT_M = np.array([0.0, 0.0, 0.01])
# What all stages that are kept may take: in a process, four cities of a minute or more of anything smaller; and of the
# machine's memory in all workers of a DataLoader together. One stage is kept anyway, however large.
KEPT_BYTES = 160e6
KEPT_SHARE = 1 / 16


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
    """The stages of a scenario's runs: each is built when first needed, and a few are kept, in case they are again.

    In each process, that is: Embree's scenes cannot be pickled, so that a DataLoader worker builds its own. What runs
    have in common is made once: the bodies of each kind, and in traffic the sensors on the ego.

    Args:
        scenario: What plays.
        rigs: Whose sensors are mounted.
        seed: Seed of procedural traffic.
    """

    def __init__(self, scenario: Scenario, rigs: Mapping[str, Rig], seed: int) -> None:
        self._scenario = scenario
        self._rigs = rigs
        self._seed = seed
        self._forget()

    def _forget(self) -> None:
        self._kept: dict[int, Stage] = {}
        self._solids = Solids()
        self._ego: Mesh | None = None
        self._mounted: Mapping[str, Sequence[MountedSensor]] | None = None

    def of_run(self, run: int) -> Stage:
        """The stage of one run; see `Scenario.locate`.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A mesh or a trajectory cannot be used, or a sensor is mounted inside the ego's body.
        """
        if run in self._kept:
            stage = self._kept.pop(run)
        else:
            self._make_room()
            stage = self._built(run)
        self._kept[run] = stage  # at the end: the first is the one that was asked for longest ago
        return stage

    def _make_room(self) -> None:
        """Before a stage is built, about as large as the others: there is not always memory for one more."""
        workers = get_worker_info()
        most_bytes = min(KEPT_BYTES, KEPT_SHARE * machine_bytes() / (workers.num_workers if workers else 1))
        sizes = [stage.scene.bytes for stage in self._kept.values()]
        while sizes and sum(sizes) + max(sizes) > most_bytes:
            del self._kept[next(iter(self._kept))], sizes[0]

    def _built(self, run: int) -> Stage:
        if self._ego is None and self._scenario.traffic is not None:
            self._ego = self._scenario.ego_mesh()
        scene = Scene(self._scenario.world(self._seed, run, self._ego), self._solids)
        if self._ego is None or not scene.world.ego.trajectory.moves:
            return Stage(scene, self._on(scene))
        # What a sensor on an ego that moves sees of it is the same in all runs.
        self._mounted = self._mounted or self._on(scene)
        return Stage(scene, self._mounted)

    def _on(self, scene: Scene) -> Mapping[str, Sequence[MountedSensor]]:
        """The rigs' sensors on the ego of a scene."""
        self._check_mounts(scene)
        return {
            name: [MountedSensor(sensor, into_tiles(sensor.directions()), scene) for sensor in rig.sensors]
            for name, rig in self._rigs.items()
        }

    def _check_mounts(self, scene: Scene) -> None:
        for name, rig in self._rigs.items():
            for sensor in rig.sensors:
                place = sensor.mount.matrix()[:3, 3]
                if scene.encloses(place):
                    other = f", or use its own vehicle (--vehicle {rig.vehicle})" if rig.vehicle else ""
                    raise ValueError(
                        f"rig {name!r}: sensor {sensor.name!r} at {place.round(3).tolist()} m lies inside the ego of "
                        f"{self._scenario.name!r}, {self._scenario.ego_name}, so that all its rays start blocked; move "
                        f"its mount{other}"
                    )

    def __getstate__(self) -> dict[str, Any]:
        return Stages(self._scenario, self._rigs, self._seed).__dict__
