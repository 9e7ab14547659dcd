"""Where a run through a scenario plays: its geometry, and the rigs' sensors in it."""

import copy
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from torch.utils.data import get_worker_info

from torchcover.geometry.arrays import Float64, Int64
from torchcover.simulation.bodies import describe_windows
from torchcover.simulation.instant import Instant
from torchcover.simulation.local_ground import ROUNDING_M
from torchcover.simulation.memory import machine_bytes
from torchcover.simulation.moving import Solids
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import Scene
from torchcover.simulation.scene_cache import SceneCache
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sight import MountedSensor

# Nearer than this is near enough, above or below.
NEAR_M = 1.0
# Instants that are looked at, and how far about the ego.
LOOKS = 8
WITHIN_M = 100.0
# A sensor on the ground is asked about a place this far above it: whether it is inside of something else.
LIFT_M = np.array([0.0, 0.0, 0.01])
# Farther from the vehicle nobody mounts a sensor on it: such a place is in millimetres, or of another frame.
FARTHEST_MOUNT_M = 20.0
# What all scenes that are kept may take: in a process, four cities of a minute or more of anything smaller; and of the
# machine's memory in all workers of a DataLoader together. One scene is kept anyway, however large.
KEPT_BYTES = 160e6
KEPT_SHARE = 1 / 16


@dataclass(eq=False)
class Mounts:
    """The sensors of each rig on the ego of a scene, and whether their places are known to be free for good."""

    sensors: Mapping[str, Sequence[MountedSensor]]
    free_for_good: bool = False


@dataclass(frozen=True, eq=False)
class Stage:
    """One run's geometry, and the sensors of each rig on its ego."""

    scene: Scene
    mounts: Mounts

    @property
    def mounted(self) -> Mapping[str, Sequence[MountedSensor]]:
        """The sensors of each rig."""
        return self.mounts.sensors

    def check_mounts(self, instant: Instant) -> None:
        """Refuse a sensor that is where none can be; where nothing moves, the first answer holds."""
        if self.mounts.free_for_good:
            return
        for rig, sensors in self.mounted.items():
            for mounted in sensors:
                place_m = mounted.vehicle_T_sensor[:3, 3]
                _check_place(f"rig {rig!r}: sensor {mounted.sensor.name!r}", place_m, instant)
        self.mounts.free_for_good = not self.scene.moves


def _check_place(sensor: str, place_m: Float64, instant: Instant) -> None:
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


class Scenes:
    """The geometry of a scenario's runs: each is built when first needed, and a few are kept, in case they are again.

    In each process, that is: Embree's scenes cannot be pickled, so that a DataLoader worker builds its own. The bodies
    of each kind, which runs have in common, are made once. All that are kept may take `kept_bytes`; a small share of
    the machine's memory if not given. `device` is that of `RayCaster`, for what never moves.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        kept_bytes: float | None = None,
        *,
        no_cache: bool = False,
        device: str | None = None,
    ) -> None:
        self.scenario = scenario
        self._device = device
        self._cache = SceneCache(scenario, seed, no_cache=no_cache)
        self._kept_bytes = kept_bytes
        self._kept: dict[int, Scene] = {}
        self._solids = Solids()
        self._ego: Mesh | None = None

    def of_run(self, run: int) -> Scene:
        """That of one run; see `Scenario.locate`."""
        if run in self._kept:
            scene = self._kept.pop(run)
        else:
            self._make_room()
            if self._ego is None and self.scenario.traffic is not None:
                self._ego = self.scenario.ego_mesh()
            scene = Scene(self._cache.build(run, self._ego), self._solids, self._device)
        self._kept[run] = scene  # at the end: the first is the one that was asked for longest ago
        return scene

    def _make_room(self) -> None:
        """Before a scene is built, about as large as the others: there is not always memory for one more."""
        most_bytes = self._kept_bytes
        if most_bytes is None:
            workers = get_worker_info()
            most_bytes = min(KEPT_BYTES, KEPT_SHARE * machine_bytes() / (workers.num_workers if workers else 1))
        sizes = [scene.bytes for scene in self._kept.values()]
        while sizes and sum(sizes) + max(sizes) > most_bytes:
            self._kept.pop(next(iter(self._kept))).forget_instants()
            del sizes[0]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": {}, "_solids": Solids(), "_ego": None}


class Stages:
    """The stages of a scenario's runs: rigs in its scenes. In traffic the sensors on the ego are the same in all."""

    def __init__(self, scenes: Scenes, rigs: Mapping[str, Rig]) -> None:
        self._put(scenes, rigs)

    def _put(self, scenes: Scenes, rigs: Mapping[str, Rig]) -> None:
        self._scenes = scenes
        self._rigs = rigs
        # None of them outlives its scene, which may be dropped to make room.
        self._mounts: WeakKeyDictionary[Scene, Mounts] = WeakKeyDictionary()
        self._on_moving_ego: Mapping[str, Sequence[MountedSensor]] | None = None

    def with_rigs(self, rigs: Mapping[str, Rig]) -> "Stages":
        """Other rigs in the same scenes, none of which is built again."""
        other = copy.copy(self)
        other._put(self._scenes, rigs)
        return other

    def of_run(self, run: int) -> Stage:
        """The stage of one run; see `Scenario.locate`."""
        scene = self._scenes.of_run(run)
        if scene not in self._mounts:
            self._mounts[scene] = Mounts(self._sensors(scene))
        return Stage(scene, self._mounts[scene])

    def _sensors(self, scene: Scene) -> Mapping[str, Sequence[MountedSensor]]:
        if self._scenes.scenario.traffic is None or not scene.world.ego.trajectory.is_moving:
            return self._on(scene)
        # What a sensor on an ego that moves sees of it is the same in all runs.
        self._on_moving_ego = self._on_moving_ego or self._on(scene)
        return self._on_moving_ego

    def _on(self, scene: Scene) -> Mapping[str, Sequence[MountedSensor]]:
        return {name: mounted_on(scene, self._scenes.scenario, name, rig) for name, rig in self._rigs.items()}

    def __getstate__(self) -> dict[str, Any]:
        return {"_scenes": self._scenes, "_rigs": self._rigs}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._put(state["_scenes"], state["_rigs"])


def mounted_on(scene: Scene, scenario: Scenario, name: str, rig: Rig) -> list[MountedSensor]:
    """The sensors of a rig on the ego of a scene. ValueError: one is inside the ego's body."""
    for sensor in rig.sensors:
        place = sensor.mount.matrix()[:3, 3]
        where = f"rig {name!r}: sensor {sensor.name!r} at {place.round(3).tolist()} m lies"
        off_m = np.linalg.norm(place - place.clip(scene.ego_box.lower_m, scene.ego_box.upper_m))
        if off_m > FARTHEST_MOUNT_M:
            raise ValueError(
                f"{where} {off_m:.0f} m away from the ego of {scenario.name!r}, {scenario.ego_name}; mounts are in "
                "metres, from the ground under the ego's middle: are these millimetres?"
            )
        if scene.encloses(place):
            carried = rig.vehicle in (None, getattr(scenario.ego and scenario.ego.shape, "vehicle", None))
            other = "" if carried else f", or use its own vehicle (--vehicle {rig.vehicle})"
            windows = describe_windows(scenario.ego.shape if scenario.ego else None)
            raise ValueError(
                f"{where} inside the ego of {scenario.name!r}, {scenario.ego_name}, so that all its rays start "
                f"blocked; move its mount{other}{windows and f'. {windows}'}"
            )
    return [
        MountedSensor(
            one,
            scene,
            scenario.reach_m(one, rig.weather),
            rig.weather or scenario.weather,
            [other for other in rig.sensors if other is not one],
            rig.bodies,
        )
        for one in rig.sensors
    ]


def warn_of_floating(name: str, scene: Scene, steps: Int64) -> None:
    """Warn if the ego, or more than half of the others that move, have no ground near the bottoms of their bodies."""
    found = np.concatenate([_grounded(scene, step) for step in steps[:: -(-len(steps) // LOOKS)].tolist()])
    of_ego, of_others = found[found[:, 0] > 0, 1], found[found[:, 0] == 0, 1]
    for who, grounded, share in (("the ego", of_ego, 0.0), ("others that move", of_others, 0.5)):
        missing = int((grounded == 0).sum())
        if missing > share * len(grounded):
            warnings.warn(
                f"{name}: {missing} of {len(grounded)} times that were looked at, {who} had no ground within "
                f"{NEAR_M:g} m below or above the wheels, so that little of it will be known; is the ground a mesh in "
                "the same frame, and z that of the bottom? Traffic of type 'tracks' without `ground` makes ground that "
                "follows the tracks",
                stacklevel=4,
            )


def _grounded(scene: Scene, step: int) -> Int64:
    """(bodies, 2) whether each that is there at a step is the ego, and whether it has ground."""
    instant = scene.at(step, within_m=WITHIN_M)
    up = scene.world.ego.trajectory.interpolate(step * scene.world.time_step_s)[2, :3]
    others = instant.moving.vehicle_T_part[instant.moving.body != instant.ego, :3, 3]
    places_m = np.concatenate([np.zeros((1, 3)), others])
    is_ego = np.arange(len(places_m)) == 0
    heights_m = instant.heights_m((places_m + NEAR_M * up).astype(np.float32))
    return np.column_stack([is_ego, heights_m <= 2 * NEAR_M + ROUNDING_M]).astype(np.int64)
