"""Simulator: sensor and reference points of rigs in a scenario, frame by frame."""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch

from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Float32, Int64
from torchcover.simulation.culling import SearchSpheres
from torchcover.simulation.memory import BYTES_PER_RAY, check_memory_fits
from torchcover.simulation.mounted_rigs import MountedRigs, MountedRigStore, SceneStore, warn_about_missing_ground
from torchcover.simulation.reference_sensor import ReferenceContext, ReferenceScan, ReferenceSensor
from torchcover.simulation.rig import Rig, set_ego
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import ObjectLabel, compute_labels
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SceneSnapshot, SensorScan
from torchcover.simulation.sensor import SensorNoise


@dataclass(frozen=True, eq=False)
class Observation:
    """Points of one frame in the vehicle frame (x forward, y left, z up, meters), without points on the ego vehicle.

    Args:
        scans: Rig name -> scan of each of its sensors.
        reference: (M, 3) float32 reference points.
        reference_weights: (M,) float32 area in m² that each reference point represents; None if all count equally.
        reference_heights_m: (M,) float32 heights above the local ground, see `ReferenceScan`; None without heights.
        sampled_point_counts: (objects,) number of points that the reference sampled on each of `Scene.objects`, see
            `ReferenceScan`; None without object sampling.
        counts: Numbers of rays, self hits, omitted work and others by name.
    """

    scans: Mapping[str, Sequence[SensorScan]]
    reference: Float32
    reference_weights: Float32 | None
    reference_heights_m: Float32 | None
    sampled_point_counts: Int64 | None
    counts: Mapping[str, int]

    @cached_property
    def clouds(self) -> Mapping[str, Float32]:
        """Rig name -> (N, 3) float32 ground-truth hit points of all its sensors, in the order of the sensors."""
        return {name: np.concatenate([scan.points for scan in scans]) for name, scans in self.scans.items()}


class Simulator:
    """Simulator of rigs and a reference sensor in a scenario.

    A frame depends only on the scenario, the rigs, the seed and its index, not on threads, processes or the order of
    frames. All rigs observe the same scene and share the reference points, so that their differences are paired. Rays
    are cast on as many threads as torch uses (`torch.set_num_threads`).

    Args:
        scenario: Scenario; `set_ego` chooses its ego vehicle. Beyond its end it repeats, or continues in another scene,
            see `Scenario.is_repeating`.
        rigs: Rigs by the name that `Observation.clouds` uses.
        reference_sensor: Reference sensor.
        seed: Seed of traffic, reference sensor and sensor noise.
        frame_interval_s: Time between two frames, a multiple of the time step of the scenario; None for one time step.
        max_cached_bytes: Memory for scenes that are cached for later frames; None for a small share of the memory.
        search_radius_m: Only sensor points within this distance of a reference point are needed, as for detection rates
            up to this threshold; rays that cannot give such points are not cast. The needed points do not change.
        no_cache: True to neither read nor write the scene cache on disk; frames do not change.
        device: Warp device (`torchcover[warp]`), such as `cuda:0`, for static bodies in a single process; None for
            Embree. Both agree up to the last bits.

    Raises:
        ValueError: Rigs that name different vehicles, a negative seed, an interval that is no multiple of the time
            step, or more rays than the memory can hold.

    Example:
        >>> from torchcover.simulation import PaperReference
        >>> rigs = {"roof": Rig.load("front_roof_128")}
        >>> simulator = Simulator(Scenario.load("courtyard"), rigs, PaperReference(rows=16, columns=16))
        >>> observation = simulator.simulate_frame(0)
        >>> observation.counts["sensor_rays"], observation.clouds["roof"].dtype
        (230400, dtype('float32'))
    """

    def __init__(
        self,
        scenario: Scenario,
        rigs: Mapping[str, Rig],
        reference_sensor: ReferenceSensor,
        *,
        seed: int = 0,
        frame_interval_s: float | None = None,
        max_cached_bytes: float | None = None,
        search_radius_m: float | None = None,
        no_cache: bool = False,
        device: str | None = None,
    ) -> None:
        if seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
        self.scenario = scenario = set_ego(scenario, rigs)
        self.rigs = rigs
        self.reference_sensor = reference_sensor
        self.seed = seed
        self.search_radius_m = search_radius_m
        self._time_steps_per_frame = 1 if frame_interval_s is None else scenario.count_time_steps(frame_interval_s)
        scene_store = SceneStore(scenario, seed, max_cached_bytes, no_cache=no_cache, device=device)
        self._rig_store = MountedRigStore(scene_store, rigs)
        self._check_memory()

    @property
    def frame_interval_s(self) -> float:
        """Time between two frames."""
        return self._time_steps_per_frame * self.scenario.effective_time_step_s

    @property
    def num_distinct_frames(self) -> int | None:
        """Number of frames before the scenario repeats; None if it never does."""
        num_time_steps = self.scenario.num_distinct_time_steps
        return (
            None if num_time_steps is None else num_time_steps // math.gcd(num_time_steps, self._time_steps_per_frame)
        )

    def get_block_index(self, index: int) -> int:
        """Get the block of a frame for standard errors: frames with the same block are correlated.

        It is the index of the run if each run has a separate scene, or the time step in a scenario that repeats. In a
        scenario of a single time step each frame is a block, since only the random reference sensor differs.

        Args:
            index: Index of the frame.
        """
        if self.scenario.num_distinct_time_steps == 1:
            return index
        run_index, time_step_index = self.scenario.locate(index * self._time_steps_per_frame)
        return time_step_index if self.scenario.is_repeating else run_index

    def replace_reference_sensor(self, reference_sensor: ReferenceSensor) -> Self:
        """Create a simulator of the same frames with another reference sensor; both share the geometry of the scenes.

        Args:
            reference_sensor: Reference sensor.
        """
        simulator = copy.copy(self)
        simulator.reference_sensor = reference_sensor
        simulator._check_memory()
        return simulator

    def replace_rigs(self, rigs: Mapping[str, Rig]) -> Self:
        """Create a simulator of the same frames with other rigs; both share the geometry of the scenes.

        Args:
            rigs: Rigs by name. The ego vehicle stays, whatever vehicle they name.
        """
        simulator = copy.copy(self)
        simulator.rigs = rigs
        simulator._rig_store = self._rig_store.replace_rigs(rigs)
        simulator._check_memory()
        return simulator

    def simulate_scans(
        self, index: int, search_spheres: SearchSpheres | None = None
    ) -> Mapping[str, Sequence[SensorScan]]:
        """Simulate the sensors in one frame as `simulate_frame` does, without the reference sensor.

        Args:
            index: Index of the frame, from 0.
            search_spheres: Spheres outside of which no points are needed, see `MountedSensor.scan`; None for all.

        Returns:
            Rig name -> scan of each of its sensors.

        Raises:
            FileNotFoundError, ValueError: See `simulate_frame`.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> simulator = Simulator(Scenario.load("courtyard"), {}, PaperReference(rows=16, columns=16))
            >>> simulator = simulator.replace_rigs({"candidate": Rig.load("front_roof_128")})
            >>> [roof] = simulator.simulate_scans(0)["candidate"]
            >>> roof.num_rays, roof.points.dtype
            (230400, dtype('float32'))
        """
        mounted_rigs, snapshot = self.prepare_frame(index)
        return self._scan(mounted_rigs, snapshot, index, search_spheres)

    def simulate_frame(self, index: int) -> Observation:
        """Simulate the reference sensor and all rigs in one frame.

        Args:
            index: Index of the frame, from 0.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A negative index, a sensor inside a body or below the ground, an actor that overlaps the ego
                vehicle, or an ego vehicle below the ground.
        """
        mounted_rigs, snapshot = self.prepare_frame(index)
        geometry = mounted_rigs.scene_geometry
        rng, frame_name = np.random.default_rng([self.seed, index]), f"{self.scenario.name} step {index}"
        context = ReferenceContext(geometry, snapshot, rng, frame_name, num_threads=torch.get_num_threads())
        reference = self.reference_sensor.scan(context)
        # Rays that cannot give points near a reference point are not cast.
        search_spheres = None
        if self.search_radius_m is not None:
            search_spheres = SearchSpheres.from_points(reference.points, self.search_radius_m)
        scans = self._scan(mounted_rigs, snapshot, index, search_spheres)
        return Observation(
            scans=scans,
            reference=reference.points,
            reference_weights=reference.weights,
            reference_heights_m=reference.heights_m,
            sampled_point_counts=reference.sampled_point_counts,
            counts={
                **_count_rays(geometry, snapshot, scans, reference),
                "repeated_frames": int(self.num_distinct_frames is not None and index >= self.num_distinct_frames),
            },
        )

    def check_run(self, num_frames: int) -> None:
        """Check a run before its first frame, for errors that would end it later.

        Only a scenario that repeats is checked completely; other scenes are checked when they are built.

        Args:
            num_frames: Number of frames of the run.

        Raises:
            ValueError: A sensor inside a body or below the ground in the first frame, or an actor that overlaps the ego
                vehicle in any frame.
            ImportError: A package that generates the traffic is not installed.

        Warns:
            UserWarning: Moving bodies do not stand on the ground.
        """
        if self.scenario.traffic is not None:
            self.scenario.traffic.check()
        if self.scenario.is_repeating:
            mounted_rigs, _ = self._get_mounted_rigs(0)
            geometry = mounted_rigs.scene_geometry
            num_time_steps = geometry.scene.num_time_steps
            indices = np.arange(min(num_frames, num_time_steps), dtype=np.int64)  # later frames repeat
            time_step_indices = np.unique(indices * self._time_steps_per_frame % num_time_steps)
            geometry.check_overlaps(time_step_indices)
            mounted_rigs.check_mounts(geometry.get_snapshot(0))
            warn_about_missing_ground(self.scenario.name, geometry, time_step_indices)

    @property
    def ground_note(self) -> str:
        """Note on the ground of a scenario that does not mark its ground; empty if it does.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> Simulator(Scenario.load("urban"), {}, PaperReference(rows=16, columns=16)).ground_note
            ''
        """
        if self.scenario.has_ground:
            return ""
        body_names = [body.name for body in self.scenario.bodies for _ in body.poses]
        ground_names: list[str] = []
        for name, mask in zip(body_names, self.get_scene_geometry(0)[0].ground_masks, strict=True):
            if mask.any() and repr(name) not in ground_names:
                ground_names.append(repr(name))
        if not ground_names:
            return "Ground: none was found under the ego, so that no point has a height; mark bodies as ground."
        faces = "level faces under the ego and level faces that are connected with them"
        return f"Ground: {faces}, of {', '.join(ground_names)}; bodies with `ground: true` replace this choice."

    def compute_labels(self, index: int) -> list[ObjectLabel]:
        """Compute the labels of all objects in range of the reference sensor; names are unique within a run.

        Args:
            index: Index of the frame.
        """
        geometry, time_step_index = self.get_scene_geometry(index)
        return compute_labels(geometry.scene, time_step_index, self.reference_sensor.max_range_m)

    def compute_bottom_heights_m(self, index: int, labels: Sequence[ObjectLabel]) -> Float32:
        """Compute the heights of the bottoms of boxes above the highest ground below their centers.

        Args:
            index: Index of the frame.
            labels: K labels of that frame.

        Returns:
            (K,) float32 heights in meters; NaN without ground.
        """
        geometry, time_step_index = self.get_scene_geometry(index)
        world_T_vehicle = geometry.scene.ego.trajectory.interpolate(time_step_index * geometry.scene.time_step_s)
        centers_m = np.array([label.center_m for label in labels]).reshape(-1, 3)
        half_heights_m = np.array([label.size_m[2] / 2 for label in labels], dtype=np.float32)
        return geometry.ground.compute_heights_m(centers_m, world_T_vehicle) - half_heights_m

    def get_scene_geometry(self, index: int) -> tuple[SceneGeometry, int]:
        """Get the geometry of the scene of a frame, and the time step in it; built on first use in each process.

        Args:
            index: Index of the frame.
        """
        mounted_rigs, time_step_index = self._get_mounted_rigs(index)
        return mounted_rigs.scene_geometry, time_step_index

    def get_run_index(self, index: int) -> int:
        """Get the index of the run through the scenario; each run has a scene of its own unless the scenario repeats.

        Args:
            index: Index of the frame.
        """
        return self.scenario.locate(index * self._time_steps_per_frame)[0]

    def _check_memory(self) -> None:
        """Raise ValueError if the rays of one frame do not fit into the memory."""
        rig_rays = sum(sensor.num_rays for rig in self.rigs.values() for sensor in rig.sensors)
        reference_rays = self.reference_sensor.num_rays
        num_rays = rig_rays + reference_rays
        check_memory_fits(
            f"{num_rays:,} rays per frame ({rig_rays:,} of the rig's sensors, {reference_rays:,} of the reference)",
            BYTES_PER_RAY * num_rays,
            "use fewer rays, rows or columns",
        )

    def _get_mounted_rigs(self, index: int) -> tuple[MountedRigs, int]:
        """Get the mounted rigs in the scene of a frame, and the time step in it."""
        if index < 0:
            raise ValueError(f"index: a number >= 0 is needed; got {index}")
        run_index, time_step_index = self.scenario.locate(index * self._time_steps_per_frame)
        return self._rig_store.get_mounted_rigs(run_index), time_step_index

    def prepare_frame(self, index: int) -> tuple[MountedRigs, SceneSnapshot]:
        """Prepare the scene of a frame and check the mounting positions.

        Args:
            index: Index of the frame, from 0.

        Returns:
            Mounted rigs, and the scene at the time of the frame.

        Raises:
            FileNotFoundError, ValueError: See `simulate_frame`.
        """
        mounted_rigs, time_step_index = self._get_mounted_rigs(index)
        geometry = mounted_rigs.scene_geometry
        max_distance_m = self._compute_reach_m(geometry.ego_box)
        snapshot = geometry.get_snapshot(time_step_index, max_distance_m=max_distance_m)
        mounted_rigs.check_mounts(snapshot)
        return mounted_rigs, snapshot

    def _compute_reach_m(self, ego_box: BoundingBox) -> float:
        """Compute the largest distance of a visible point from the origin of the vehicle frame."""
        corner_m = np.abs(ego_box.corners_m).max(axis=0) + self.reference_sensor.shell_m
        reach_m = float(np.linalg.norm(corner_m)) + self.reference_sensor.max_range_m
        for sensor in [sensor for rig in self.rigs.values() for sensor in rig.sensors]:
            # The range of a sensor begins at its mounting position.
            mount_distance_m = float(np.linalg.norm(sensor.mount.to_matrix()[:3, 3]))
            reach_m = max(reach_m, mount_distance_m + self.scenario.compute_max_range_m(sensor))
        return reach_m

    def _scan(
        self, mounted_rigs: MountedRigs, snapshot: SceneSnapshot, index: int, search_spheres: SearchSpheres | None
    ) -> dict[str, list[SensorScan]]:
        """Simulate all sensors of all rigs; sensors at the same position of different rigs share random numbers."""
        scans: dict[str, list[SensorScan]] = {}
        for name, sensors in mounted_rigs.sensors_by_rig.items():
            scans[name] = []
            # The seed has the number of the sensor, so that noise does not depend on other sensors.
            for sensor_number, mounted in enumerate(sensors, 1):
                rng = np.random.default_rng([self.seed, index, sensor_number])
                noise, num_threads = SensorNoise(rng, len(mounted.ray_pixel_indices)), torch.get_num_threads()
                scan = mounted.scan(snapshot, noise, num_threads=num_threads, search_spheres=search_spheres)
                scans[name].append(scan)
        return scans


def _count_rays(
    scene: SceneGeometry, snapshot: SceneSnapshot, scans: Mapping[str, Sequence[SensorScan]], reference: ReferenceScan
) -> dict[str, int]:
    """Count rays, self hits, and omitted casts of all rigs and of the reference sensor."""
    all_scans = [scan for rig_scans in scans.values() for scan in rig_scans]
    num_rays = sum(scan.num_rays for scan in all_scans)
    self_hits = sum(scan.self_hits for scan in all_scans)
    num_pairs = (num_rays + reference.num_rays) * len(snapshot.moving_bodies)
    num_casts = reference.num_body_casts + sum(scan.num_body_casts for scan in all_scans)
    return {
        "sensor_rays": num_rays,
        "sensor_self_hits": self_hits,
        "reference_rays": reference.num_rays,
        "reference_self_hits": reference.self_hits,
        "reference_poses": reference.num_poses + reference.num_resampled_poses,
        "reference_poses_resampled": reference.num_resampled_poses,
        "moving_bodies": len(snapshot.moving_bodies) + snapshot.num_out_of_range,
        "moving_bodies_out_of_range": snapshot.num_out_of_range,
        "road_users_omitted": scene.scene.num_omitted_road_users,
        "ray_body_pairs": num_pairs,
        "ray_body_pairs_omitted": num_pairs - num_casts,
        "sensor_rays_reused": 0 if scene.has_motion else num_rays,
        "sensor_rays_omitted": sum(scan.num_omitted_rays for scan in all_scans),
        "sensor_self_hits_reused": self_hits if scene.has_constant_self_hits else 0,
    }
