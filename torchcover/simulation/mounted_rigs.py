"""Rigs mounted on the ego vehicle in the scenes of a scenario, and stores that build and cache them."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from torch.utils.data import get_worker_info

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.bodies import describe_windows
from torchcover.simulation.local_ground import ROUNDING_M
from torchcover.simulation.memory import find_memory_limit_bytes
from torchcover.simulation.mounted_sensor import MountedSensor
from torchcover.simulation.moving_bodies import BodyGeometryCache
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene_cache import SceneCache
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SceneSnapshot
from torchcover.simulation.shapes import Mesh


@dataclass(eq=False)
class RigMounts:
    """Sensors of each rig on the ego vehicle of a scene.

    Args:
        sensors_by_rig: Mounted sensors by the name of the rig.
        is_checked: True if the mounting positions were checked and need no further check.
    """

    sensors_by_rig: Mapping[str, Sequence[MountedSensor]]
    is_checked: bool = False


@dataclass(frozen=True, eq=False)
class MountedRigs:
    """Geometry of one scene, and the sensors of each rig on its ego vehicle.

    Args:
        scene_geometry: Geometry of the scene.
        mounts: Sensors of the rigs.
    """

    scene_geometry: SceneGeometry
    mounts: RigMounts

    @property
    def sensors_by_rig(self) -> Mapping[str, Sequence[MountedSensor]]:
        """Mounted sensors by the name of the rig."""
        return self.mounts.sensors_by_rig

    def check_mounts(self, snapshot: SceneSnapshot) -> None:
        """Check that no sensor is inside a body or below the ground; only once in a scene without motion.

        Args:
            snapshot: Scene at the time of the frame.

        Raises:
            ValueError: A sensor is inside a body or below the ground.
        """
        if self.mounts.is_checked:
            return
        for rig_name, sensors in self.sensors_by_rig.items():
            for mounted in sensors:
                position_m = mounted.vehicle_T_sensor[:3, 3]
                _check_position(f"rig {rig_name!r}: sensor {mounted.sensor.name!r}", position_m, snapshot)
        self.mounts.is_checked = not self.scene_geometry.has_motion


def _check_position(sensor_text: str, position_m: Float64, snapshot: SceneSnapshot) -> None:
    """Raise ValueError for a sensor inside a body or below the ground; warn if it lies exactly on a surface."""
    sensor_text = f"{sensor_text} at {position_m.round(3).tolist()} m"
    is_on_surface = snapshot.is_on_surface(position_m)
    # On a surface, a position slightly above decides whether the sensor is inside another body.
    lift_m = np.array([0.0, 0.0, 0.01 if is_on_surface else 0.0])
    if snapshot.is_occupied(position_m + lift_m):
        raise ValueError(
            f"{sensor_text} lies below the ground, or inside a wall or another body, so that its points are wrong; "
            "is the sign of z_m right, does the ego stand on the ground, and do faces point outwards?"
        )
    if is_on_surface:
        warnings.warn(
            f"{sensor_text} lies exactly on the ground or on a wall, and sees nothing of it; move its mount away "
            "from it",
            stacklevel=2,
        )


@dataclass(frozen=True)
class SceneStoreParams:
    """Limits of the memory for cached scenes. One scene is cached in any case, however large.

    Args:
        max_bytes: Limit per process: four cities of a minute each, or more of anything smaller.
        max_memory_share: Limit of all workers of a DataLoader together, as a share of the memory of the machine.
    """

    max_bytes: float = 160e6
    max_memory_share: float = 1 / 16


class SceneStore:
    """Geometry of the scenes of a scenario: built on first use, with the last ones cached.

    Each process has a store of its own, since Embree scenes cannot be pickled. All scenes share the geometry of each
    kind of moving body.

    Args:
        scenario: Scenario.
        seed: Seed of traffic.
        max_cached_bytes: Memory for cached scenes; None for the limits of `params`.
        no_cache: True to disable the scene cache on disk.
        device: Warp device for static bodies, see `RayCaster`.
        params: Limits of the memory.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        max_cached_bytes: float | None = None,
        *,
        no_cache: bool = False,
        device: str | None = None,
        params: SceneStoreParams = SceneStoreParams(),
    ) -> None:
        self.scenario = scenario
        self._device = device
        self._disk_cache = SceneCache(scenario, seed, no_cache=no_cache)
        self._max_cached_bytes = max_cached_bytes
        self._params = params
        self._scenes: dict[int, SceneGeometry] = {}  # the least recently used first
        self._geometry_cache = BodyGeometryCache()
        self._ego_mesh: Mesh | None = None

    def get_scene(self, run_index: int) -> SceneGeometry:
        """Get the geometry of the scene of one run through the scenario, see `Scenario.locate`."""
        # A scene that is used moves to the end, so that the first one is dropped first.
        if run_index in self._scenes:
            geometry = self._scenes.pop(run_index)
        else:
            self._release_scenes()
            if self._ego_mesh is None and self.scenario.traffic is not None:
                self._ego_mesh = self.scenario.build_ego_mesh()
            scene = self._disk_cache.build(run_index, self._ego_mesh)
            geometry = SceneGeometry(scene, self._geometry_cache, self._device)
        self._scenes[run_index] = geometry
        return geometry

    def _release_scenes(self) -> None:
        """Drop scenes until another one of the largest size fits."""
        max_bytes = self._max_cached_bytes
        if max_bytes is None:
            worker = get_worker_info()
            num_workers = worker.num_workers if worker else 1
            memory_share_bytes = self._params.max_memory_share * find_memory_limit_bytes()
            max_bytes = min(self._params.max_bytes, memory_share_bytes / num_workers)
        sizes = [geometry.num_bytes for geometry in self._scenes.values()]
        while sizes and sum(sizes) + max(sizes) > max_bytes:
            self._scenes.pop(next(iter(self._scenes))).clear_snapshots()
            del sizes[0]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_scenes": {}, "_geometry_cache": BodyGeometryCache(), "_ego_mesh": None}


class MountedRigStore:
    """Rigs in the scenes of a scenario; in generated traffic all scenes share the sensors on the ego vehicle.

    Args:
        scene_store: Scenes.
        rigs: Rigs by name.
    """

    def __init__(self, scene_store: SceneStore, rigs: Mapping[str, Rig]) -> None:
        self._scene_store = scene_store
        self._rigs = rigs
        # The weak keys drop the sensors of a scene together with the scene.
        self._mounts: WeakKeyDictionary[SceneGeometry, RigMounts] = WeakKeyDictionary()
        self._sensors_on_moving_ego: Mapping[str, Sequence[MountedSensor]] | None = None

    def replace_rigs(self, rigs: Mapping[str, Rig]) -> "MountedRigStore":
        """Create a store for other rigs that shares the scenes."""
        return MountedRigStore(self._scene_store, rigs)

    def get_mounted_rigs(self, run_index: int) -> MountedRigs:
        """Get the rigs in the scene of one run through the scenario, see `Scenario.locate`.

        Raises:
            ValueError: A sensor is inside the body of the ego vehicle, or far from it.
        """
        geometry = self._scene_store.get_scene(run_index)
        if geometry not in self._mounts:
            self._mounts[geometry] = RigMounts(self._get_sensors(geometry))
        return MountedRigs(geometry, self._mounts[geometry])

    def _get_sensors(self, geometry: SceneGeometry) -> Mapping[str, Sequence[MountedSensor]]:
        """Get the sensors of all rigs; their hits on a moving ego vehicle are the same in all scenes of traffic."""
        if self._scene_store.scenario.traffic is None or not geometry.scene.ego.trajectory.is_moving:
            return self._mount_rigs(geometry)
        self._sensors_on_moving_ego = self._sensors_on_moving_ego or self._mount_rigs(geometry)
        return self._sensors_on_moving_ego

    def _mount_rigs(self, geometry: SceneGeometry) -> Mapping[str, Sequence[MountedSensor]]:
        """Mount the sensors of all rigs."""
        scenario = self._scene_store.scenario
        return {name: mount_sensors(geometry, scenario, name, rig) for name, rig in self._rigs.items()}

    def __reduce__(self) -> tuple[type, tuple[SceneStore, Mapping[str, Rig]]]:
        # Mounted sensors belong to scenes, which are not pickled.
        return MountedRigStore, (self._scene_store, self._rigs)


def mount_sensors(scene: SceneGeometry, scenario: Scenario, rig_name: str, rig: Rig) -> list[MountedSensor]:
    """Mount the sensors of a rig on the ego vehicle of a scene.

    Args:
        scene: Geometry of the scene.
        scenario: Scenario of the scene, for weather and names.
        rig_name: Name of the rig in messages.
        rig: Rig.

    Raises:
        ValueError: A sensor is inside the body of the ego vehicle, or more than 20 m away from it.
    """
    max_distance_m = 20.0  # positions farther away are in millimeters, or in another frame
    mounted_sensors = []
    for sensor in rig.sensors:
        position_m = sensor.mount.to_matrix()[:3, 3]
        sensor_text = f"rig {rig_name!r}: sensor {sensor.name!r} at {position_m.round(3).tolist()} m lies"
        ego_box = scene.ego_box
        distance_m = np.linalg.norm(position_m - position_m.clip(ego_box.lower_m, ego_box.upper_m))
        if distance_m > max_distance_m:
            raise ValueError(
                f"{sensor_text} {distance_m:.0f} m away from the ego of {scenario.name!r}, {scenario.ego_name}; mounts "
                "are in meters, from the ground under the center of the ego: are these millimeters?"
            )
        if scene.is_inside_ego(position_m):
            raise ValueError(
                f"{sensor_text} inside the ego of {scenario.name!r}, {scenario.ego_name}, so that all its rays start "
                f"blocked; move its mount{_describe_alternatives(scenario, rig)}"
            )
        mounted_sensors.append(
            MountedSensor(
                sensor,
                scene,
                scenario.compute_max_range_m(sensor, rig.weather),
                rig.weather or scenario.weather,
                [other_sensor for other_sensor in rig.sensors if other_sensor is not sensor],
                rig.bodies,
            )
        )
    return mounted_sensors


def _describe_alternatives(scenario: Scenario, rig: Rig) -> str:
    """Describe other remedies for a sensor inside the ego vehicle: the vehicle of the rig, transparent windows."""
    ego_shape = scenario.ego.shape if scenario.ego else None
    is_on_own_vehicle = rig.vehicle in (None, getattr(ego_shape, "vehicle", None))
    vehicle_text = "" if is_on_own_vehicle else f", or use its own vehicle (--vehicle {rig.vehicle})"
    windows_text = describe_windows(ego_shape)
    return f"{vehicle_text}. {windows_text}" if windows_text else vehicle_text


def warn_about_missing_ground(scenario_name: str, scene: SceneGeometry, time_step_indices: Int64) -> None:
    """Warn if the ego vehicle, or more than half of the moving actors, have no ground near the bottom of their body.

    Args:
        scenario_name: Name of the scenario in the message.
        scene: Geometry of the scene.
        time_step_indices: Time steps of the run; a few of them are checked.

    Warns:
        UserWarning: Ground is missing.
    """
    max_checks = 8
    max_height_m = 1.0  # distance of the ground above or below the bottom of a body
    stride = -(-len(time_step_indices) // max_checks)
    masks = [_find_grounded_bodies(scene, index, max_height_m) for index in time_step_indices[::stride].tolist()]
    is_ego_grounded = np.array([mask[0] for mask in masks])
    is_actor_grounded = np.concatenate([mask[1:] for mask in masks])
    # Actors may be in the air for a part of their way, the ego vehicle may not.
    for name, is_grounded, max_share in (
        ("the ego", is_ego_grounded, 0.0),
        ("other moving actors", is_actor_grounded, 0.5),
    ):
        missing_count = int((~is_grounded).sum())
        if missing_count > max_share * len(is_grounded):
            warnings.warn(
                f"{scenario_name}: {missing_count} of {len(is_grounded)} times that were checked, {name} had no ground "
                f"within {max_height_m:g} m below or above the wheels, so that little of it will be observed; "
                "is the ground a mesh in the same frame, and z that of the bottom? Traffic of type 'tracks' without "
                "`ground` makes ground that follows the tracks",
                stacklevel=4,
            )


def _find_grounded_bodies(scene: SceneGeometry, time_step_index: int, max_height_m: float) -> Bools:
    """Find which bodies have ground near their bottom: the ego vehicle, then moving actors within 100 m."""
    snapshot = scene.get_snapshot(time_step_index, max_distance_m=100.0)
    bodies = snapshot.moving_bodies
    actor_positions_m = bodies.vehicle_T_part[bodies.body_indices != snapshot.ego_index, :3, 3]
    positions_m = np.concatenate([np.zeros((1, 3)), actor_positions_m])
    time_s = time_step_index * scene.scene.time_step_s
    up = scene.scene.ego.trajectory.interpolate(time_s)[2, :3]
    heights_m = snapshot.compute_heights_m((positions_m + max_height_m * up).astype(np.float32))
    return np.asarray(heights_m <= 2 * max_height_m + ROUNDING_M)
