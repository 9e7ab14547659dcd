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
from torchcover.simulation.instant import SceneSnapshot
from torchcover.simulation.local_ground import ROUNDING_M
from torchcover.simulation.memory import find_memory_limit_bytes
from torchcover.simulation.moving import BodyGeometryCache
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import SceneGeometry
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
class RigMounts:
    """The sensors of each rig on the ego of a scene, and whether their places are known to be free for good."""

    sensors_by_rig: Mapping[str, Sequence[MountedSensor]]
    is_checked: bool = False


@dataclass(frozen=True, eq=False)
class MountedRigs:
    """One run's geometry, and the sensors of each rig on its ego."""

    scene_geometry: SceneGeometry
    mounts: RigMounts

    @property
    def sensors_by_rig(self) -> Mapping[str, Sequence[MountedSensor]]:
        """The sensors of each rig."""
        return self.mounts.sensors_by_rig

    def check_mounts(self, snapshot: SceneSnapshot) -> None:
        """Refuse a sensor that is where none can be; where nothing moves, the first answer holds."""
        if self.mounts.is_checked:
            return
        for rig, sensors in self.sensors_by_rig.items():
            for mounted in sensors:
                place_m = mounted.vehicle_T_sensor[:3, 3]
                _check_place(f"rig {rig!r}: sensor {mounted.sensor.name!r}", place_m, snapshot)
        self.mounts.is_checked = not self.scene_geometry.has_motion


def _check_place(sensor: str, place_m: Float64, instant: SceneSnapshot) -> None:
    where = f"{sensor} at {place_m.round(3).tolist()} m"
    on_a_face = instant.is_on_surface(place_m)
    if instant.is_occupied(place_m + LIFT_M if on_a_face else place_m):
        raise ValueError(
            f"{where} lies below the ground, or inside a wall or another body, so that it sees what is none; "
            "is the sign of z_m right, does the ego stand on the ground, and do faces point outwards?"
        )
    if on_a_face:
        warnings.warn(
            f"{where} lies exactly on the ground or on a wall, and sees nothing of it; move its mount away from it",
            stacklevel=2,
        )


class SceneStore:
    """The geometry of a scenario's runs: each is built when first needed, and a few are kept, in case they are again.

    In each process, that is: Embree's scenes cannot be pickled, so that a DataLoader worker builds its own. The bodies
    of each kind, which runs have in common, are made once. All that are kept may take `max_cached_bytes`; a small share of
    the machine's memory if not given. `device` is that of `RayCaster`, for what never moves.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        max_cached_bytes: float | None = None,
        *,
        no_cache: bool = False,
        device: str | None = None,
    ) -> None:
        self.scenario = scenario
        self._device = device
        self._cache = SceneCache(scenario, seed, no_cache=no_cache)
        self._kept_bytes = max_cached_bytes
        self._kept: dict[int, SceneGeometry] = {}
        self._solids = BodyGeometryCache()
        self._ego: Mesh | None = None

    def get_scene(self, run_index: int) -> SceneGeometry:
        """That of one run; see `Scenario.locate`."""
        if run_index in self._kept:
            scene = self._kept.pop(run_index)
        else:
            self._make_room()
            if self._ego is None and self.scenario.traffic is not None:
                self._ego = self.scenario.build_ego_mesh()
            scene = SceneGeometry(self._cache.build(run_index, self._ego), self._solids, self._device)
        self._kept[run_index] = scene  # at the end: the first is the one that was asked for longest ago
        return scene

    def _make_room(self) -> None:
        """Before a scene is built, about as large as the others: there is not always memory for one more."""
        most_bytes = self._kept_bytes
        if most_bytes is None:
            workers = get_worker_info()
            most_bytes = min(
                KEPT_BYTES, KEPT_SHARE * find_memory_limit_bytes() / (workers.num_workers if workers else 1)
            )
        sizes = [scene.num_bytes for scene in self._kept.values()]
        while sizes and sum(sizes) + max(sizes) > most_bytes:
            self._kept.pop(next(iter(self._kept))).clear_snapshots()
            del sizes[0]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": {}, "_solids": BodyGeometryCache(), "_ego": None}


class MountedRigStore:
    """The stages of a scenario's runs: rigs in its scenes. In traffic the sensors on the ego are the same in all."""

    def __init__(self, scene_store: SceneStore, rigs: Mapping[str, Rig]) -> None:
        self._put(scene_store, rigs)

    def _put(self, scenes: SceneStore, rigs: Mapping[str, Rig]) -> None:
        self._scenes = scenes
        self._rigs = rigs
        # None of them outlives its scene, which may be dropped to make room.
        self._mounts: WeakKeyDictionary[SceneGeometry, RigMounts] = WeakKeyDictionary()
        self._on_moving_ego: Mapping[str, Sequence[MountedSensor]] | None = None

    def replace_rigs(self, rigs: Mapping[str, Rig]) -> "MountedRigStore":
        """Other rigs in the same scenes, none of which is built again."""
        other = copy.copy(self)
        other._put(self._scenes, rigs)
        return other

    def get_mounted_rigs(self, run_index: int) -> MountedRigs:
        """The stage of one run; see `Scenario.locate`."""
        scene = self._scenes.get_scene(run_index)
        if scene not in self._mounts:
            self._mounts[scene] = RigMounts(self._sensors(scene))
        return MountedRigs(scene, self._mounts[scene])

    def _sensors(self, scene: SceneGeometry) -> Mapping[str, Sequence[MountedSensor]]:
        if self._scenes.scenario.traffic is None or not scene.scene.ego.trajectory.is_moving:
            return self._on(scene)
        # What a sensor on an ego that moves sees of it is the same in all runs.
        self._on_moving_ego = self._on_moving_ego or self._on(scene)
        return self._on_moving_ego

    def _on(self, scene: SceneGeometry) -> Mapping[str, Sequence[MountedSensor]]:
        return {name: mount_sensors(scene, self._scenes.scenario, name, rig) for name, rig in self._rigs.items()}

    def __getstate__(self) -> dict[str, Any]:
        return {"_scenes": self._scenes, "_rigs": self._rigs}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._put(state["_scenes"], state["_rigs"])


def mount_sensors(scene: SceneGeometry, scenario: Scenario, rig_name: str, rig: Rig) -> list[MountedSensor]:
    """The sensors of a rig on the ego of a scene. ValueError: one is inside the ego's body."""
    for sensor in rig.sensors:
        place = sensor.mount.to_matrix()[:3, 3]
        where = f"rig {rig_name!r}: sensor {sensor.name!r} at {place.round(3).tolist()} m lies"
        off_m = np.linalg.norm(place - place.clip(scene.ego_box.lower_m, scene.ego_box.upper_m))
        if off_m > FARTHEST_MOUNT_M:
            raise ValueError(
                f"{where} {off_m:.0f} m away from the ego of {scenario.name!r}, {scenario.ego_name}; mounts are in "
                "metres, from the ground under the ego's middle: are these millimetres?"
            )
        if scene.is_inside_ego(place):
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
            scenario.compute_max_range_m(one, rig.weather),
            rig.weather or scenario.weather,
            [other for other in rig.sensors if other is not one],
            rig.bodies,
        )
        for one in rig.sensors
    ]


def warn_about_missing_ground(scenario_name: str, scene: SceneGeometry, time_step_indices: Int64) -> None:
    """Warn if the ego, or more than half of the others that move, have no ground near the bottoms of their bodies."""
    found = np.concatenate(
        [_grounded(scene, step) for step in time_step_indices[:: -(-len(time_step_indices) // LOOKS)].tolist()]
    )
    of_ego, of_others = found[found[:, 0] > 0, 1], found[found[:, 0] == 0, 1]
    for who, grounded, share in (("the ego", of_ego, 0.0), ("others that move", of_others, 0.5)):
        missing = int((grounded == 0).sum())
        if missing > share * len(grounded):
            warnings.warn(
                f"{scenario_name}: {missing} of {len(grounded)} times that were looked at, {who} had no ground within "
                f"{NEAR_M:g} m below or above the wheels, so that little of it will be known; is the ground a mesh in "
                "the same frame, and z that of the bottom? Traffic of type 'tracks' without `ground` makes ground that "
                "follows the tracks",
                stacklevel=4,
            )


def _grounded(scene: SceneGeometry, step: int) -> Int64:
    """(bodies, 2) whether each that is there at a step is the ego, and whether it has ground."""
    instant = scene.get_snapshot(step, max_distance_m=WITHIN_M)
    up = scene.scene.ego.trajectory.interpolate(step * scene.scene.time_step_s)[2, :3]
    others = instant.moving_bodies.vehicle_T_part[instant.moving_bodies.body_indices != instant.ego_index, :3, 3]
    places_m = np.concatenate([np.zeros((1, 3)), others])
    is_ego = np.arange(len(places_m)) == 0
    heights_m = instant.compute_heights_m((places_m + NEAR_M * up).astype(np.float32))
    return np.column_stack([is_ego, heights_m <= 2 * NEAR_M + ROUNDING_M]).astype(np.int64)
