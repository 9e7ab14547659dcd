"""The simulator: what rigs and a reference sensor see of a scenario, step by step."""

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
from torchcover.simulation.instant import SceneSnapshot, SensorScan
from torchcover.simulation.memory import BYTES_PER_RAY, check_memory_fits
from torchcover.simulation.rays import SearchSpheres
from torchcover.simulation.reference_sensor import ReferenceContext, ReferenceScan, ReferenceSensor
from torchcover.simulation.rig import Rig, set_ego
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import SceneGeometry
from torchcover.simulation.sensor import SensorNoise
from torchcover.simulation.stage import MountedRigs, MountedRigStore, SceneStore, warn_about_missing_ground
from torchcover.simulation.world import ObjectLabel, compute_labels


@dataclass(frozen=True, eq=False)
class Observation:
    """The clouds of one step in the vehicle frame (x forward, y left, z up, metres), without points of the ego itself.

    Args:
        scans: Name of each rig -> what each of its sensors saw.
        reference: (M, 3) float32 points of the reference sensor.
        reference_weights: (M,) float32 square metres that each of them stands for; None if they count the same.
        reference_heights_m: (M,) float32 heights of the reference points above the local ground, from `ReferenceScan`.
        sampled_point_counts: (objects,) how many points the reference drew on each of `World.objects`, from `ReferenceScan`.
        counts: How many rays there were, how many of them the ego took, and what was left out, by name.
    """

    scans: Mapping[str, Sequence[SensorScan]]
    reference: Float32
    reference_weights: Float32 | None
    reference_heights_m: Float32 | None
    sampled_point_counts: Int64 | None
    counts: Mapping[str, int]

    @cached_property
    def clouds(self) -> Mapping[str, Float32]:
        """Name of each rig -> (N, 3) float32 points of all its sensors, in their order, where they truly are."""
        return {name: np.concatenate([scan.points for scan in scans]) for name, scans in self.scans.items()}


class Simulator:
    """What rigs and a reference sensor see of a scenario, at any step.

    A step depends on the scenario, the rigs, the seed and its index, and on nothing else: not on threads, processes or
    the order of steps. The reference is cast once, and every rig sees the same instant: comparisons are paired. Rays
    are cast on as many threads as torch uses (`torch.set_num_threads`).

    Args:
        scenario: The world; `set_ego` gives it its ego. Beyond its end the same plays again, or another one; see
            `Scenario.repeats`.
        rigs: The sensors, by the name under which `Observation.clouds` has their points.
        reference_sensor: The reference sensor.
        seed: Seed of the traffic, of the reference sensor, and of noise and drop-out.
        frame_interval_s: Time between one step and the next, a multiple of the scenario's time step; that step if not given.
        max_cached_bytes: What the worlds that are kept, in case they are needed again, may take; a small share of the
            machine's memory if not given.
        search_radius_m: Only points of the rigs that lie so near to one of the reference are asked for, as detections up to
            this threshold do: rays that hit nothing there are not cast. Those points are the same to the bit.
        no_cache: Whether worlds that are drawn are built though they lie on disk from an earlier run, and are not kept
            there either; frames are the same to the bit.
        device: Of Warp (`torchcover[warp]`), such as `cuda:0`, where rays are cast at what never moves, in one process;
            by Embree, which agrees but for the last bits, if not given.

    Raises:
        ValueError: Rigs that name different vehicles, a negative seed, a time that is no multiple of the time step,
            more rays than there is memory for.

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
        self._every_steps = 1 if frame_interval_s is None else scenario.count_time_steps(frame_interval_s)
        self._stages = MountedRigStore(
            SceneStore(scenario, seed, max_cached_bytes, no_cache=no_cache, device=device), rigs
        )
        self._check_size()

    @property
    def frame_interval_s(self) -> float:
        """Time between one step and the next."""
        return self._every_steps * self.scenario.effective_time_step_s

    @property
    def num_distinct_frames(self) -> int | None:
        """How many steps show an instant for the first time; all later ones repeat them. None: no step ever does."""
        instants = self.scenario.num_distinct_time_steps
        return None if instants is None else instants // math.gcd(instants, self._every_steps)

    def get_block_index(self, index: int) -> int:
        """The number by which standard errors tell a step from others; steps that share it are alike.

        Where each run has a world of its own, that is the number of the run: its steps share a city. In a scenario that
        repeats it is the instant, be it seen for the first time or again. Where there is a single instant only the
        reference sensor's draw differs, and every step has a number of its own.
        """
        if self.scenario.num_distinct_time_steps == 1:
            return index
        run, step = self.scenario.locate(index * self._every_steps)
        return step if self.scenario.is_repeating else run

    def replace_reference_sensor(self, reference_sensor: ReferenceSensor) -> Self:
        """The same instants as another reference sensor sees them; the geometry is built once for both."""
        other = copy.copy(self)
        other.reference_sensor = reference_sensor
        other._check_size()
        return other

    def replace_rigs(self, rigs: Mapping[str, Rig]) -> Self:
        """The same instants as other rigs see them, on the same ego; the geometry is built once for both.

        Args:
            rigs: The sensors, by the name under which `scans` has what they see. What vehicle they name says nothing.
        """
        other = copy.copy(self)
        other.rigs = rigs
        other._stages = self._stages.replace_rigs(rigs)
        other._check_size()
        return other

    def simulate_scans(
        self, index: int, search_spheres: SearchSpheres | None = None
    ) -> Mapping[str, Sequence[SensorScan]]:
        """What the sensors see at one step, as in `step`, bit for bit; the reference is not cast.

        Args:
            index: Number of the step, from 0.
            search_spheres: What is asked about, as in `MountedSensor.scan`; everything if not given.

        Returns:
            Name of each rig -> what each of its sensors saw.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: As for `step`.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> empty = Simulator(Scenario.load("courtyard"), {}, PaperReference(rows=16, columns=16))
            >>> [roof] = empty.replace_rigs({"rig": Rig.load("front_roof_128")}).simulate_scans(0)["rig"]
            >>> roof.num_rays, roof.points.dtype
            (230400, dtype('float32'))
        """
        stage, instant = self.prepare_frame(index)
        return self._scans(stage, instant, index, search_spheres)

    def simulate_frame(self, index: int) -> Observation:
        """What is seen at one step.

        Args:
            index: Number of the step, from 0.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A negative index, a sensor inside a body or below the ground, an actor that overlaps the ego, an
                ego below the ground.
        """
        stage, instant = self.prepare_frame(index)
        generator, name = np.random.default_rng([self.seed, index]), f"{self.scenario.name} step {index}"
        around = ReferenceContext(stage.scene_geometry, instant, generator, name, num_threads=torch.get_num_threads())
        reference = self.reference_sensor.scan(around)
        within = (
            None if self.search_radius_m is None else SearchSpheres.from_points(reference.points, self.search_radius_m)
        )
        scans = self._scans(stage, instant, index, within)
        of_all_rigs = [scan for of_rig in scans.values() for scan in of_rig]
        return Observation(
            scans=scans,
            reference=reference.points,
            reference_weights=reference.weights,
            reference_heights_m=reference.heights_m,
            sampled_point_counts=reference.sampled_point_counts,
            counts={
                **_counts_of(stage.scene_geometry, instant, of_all_rigs, reference),
                "repeated_frames": int(self.num_distinct_frames is not None and index >= self.num_distinct_frames),
            },
        )

    def check_run(self, num_frames: int) -> None:
        """Refuse before its first step what a run through a world that repeats would end with; others come as they are.

        Args:
            num_frames: How many steps the run has.

        Raises:
            ValueError: A sensor that is where none can be at the first step, an actor that overlaps the ego at any.
            ImportError: What makes the traffic is not installed.

        Warns:
            UserWarning: Those that move do not stand on the ground.
        """
        if self.scenario.traffic is not None:
            self.scenario.traffic.check()
        if self.scenario.is_repeating:
            stage, _ = self._stage(0)
            world_steps = stage.scene_geometry.scene.num_time_steps
            indices = np.arange(min(num_frames, world_steps), dtype=np.int64)  # then they repeat themselves
            seen = np.unique(indices * self._every_steps % world_steps)
            stage.scene_geometry.check_overlaps(seen)
            stage.check_mounts(stage.scene_geometry.get_snapshot(0))
            warn_about_missing_ground(self.scenario.name, stage.scene_geometry, seen)

    @property
    def ground_note(self) -> str:
        """What is taken for the ground of a scenario that does not say it; no words if it does.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> Simulator(Scenario.load("urban"), {}, PaperReference(rows=16, columns=16)).ground_note
            ''
        """
        if self.scenario.has_ground:
            return ""
        names = [body.name for body in self.scenario.bodies for _ in body.poses]
        found = zip(names, self.get_scene_geometry(0)[0].ground_masks, strict=True)
        taken = dict.fromkeys(repr(name) for name, is_ground in found if is_ground.any())
        if not taken:
            return (
                "Ground: none was found under the ego, so that no point has a height above it; mark bodies as ground."
            )
        what = "level faces under the ego, and what is level and connected with them"
        return f"Ground: {what}, of {', '.join(taken)}; bodies with `ground: true` say it otherwise."

    def compute_labels(self, index: int) -> list[ObjectLabel]:
        """The objects within the reference sensor's range at one step; names are an object's own within a run."""
        scene, step = self.get_scene_geometry(index)
        return compute_labels(scene.scene, step, self.reference_sensor.max_range_m)

    def compute_bottom_heights_m(self, index: int, labels: Sequence[ObjectLabel]) -> Float32:
        """(K,) height of the bottom of each label's box at a step above the highest ground below its centre."""
        scene, step = self.get_scene_geometry(index)
        world_T_vehicle = scene.scene.ego.trajectory.interpolate(step * scene.scene.time_step_s)
        centres_m = np.array([label.center_m for label in labels]).reshape(-1, 3)
        halves_m = np.array([label.size_m[2] / 2 for label in labels], dtype=np.float32)
        return scene.ground.compute_heights_m(centres_m, world_T_vehicle) - halves_m

    def get_scene_geometry(self, index: int) -> tuple[SceneGeometry, int]:
        """The geometry of the world in which a step plays, and the time step in it.

        It is built when first needed, once in each process for each run through the scenario.
        """
        stage, step = self._stage(index)
        return stage.scene_geometry, step

    def get_run_index(self, index: int) -> int:
        """Which run through the scenario a step belongs to: each is a world of its own, unless it repeats."""
        return self.scenario.locate(index * self._every_steps)[0]

    def _check_size(self) -> None:
        of_rigs = sum(sensor.num_rays for rig in self.rigs.values() for sensor in rig.sensors)
        rays = of_rigs + self.reference_sensor.num_rays
        check_memory_fits(
            f"{rays:,} rays a step ({of_rigs:,} of the rig's sensors, {self.reference_sensor.num_rays:,} of the reference)",
            BYTES_PER_RAY * rays,
            "use fewer rays, rows or columns",
        )

    def _stage(self, index: int) -> tuple[MountedRigs, int]:
        if index < 0:
            raise ValueError(f"index: a number >= 0 is needed; got {index}")
        run, step = self.scenario.locate(index * self._every_steps)
        return self._stages.get_mounted_rigs(run), step

    def prepare_frame(self, index: int) -> tuple[MountedRigs, SceneSnapshot]:
        """The stage of a step, and all of it at its time, with no sensor where none can be.

        Args:
            index: Number of the step, from 0.

        Raises:
            FileNotFoundError, ValueError: As for `step`.
        """
        stage, step = self._stage(index)
        instant = stage.scene_geometry.get_snapshot(step, max_distance_m=self._reach_m(stage.scene_geometry.ego_box))
        stage.check_mounts(instant)
        return stage, instant

    def _reach_m(self, ego: BoundingBox) -> float:
        """How far from the origin of the vehicle frame a sensor can see: its range starts where it is mounted."""
        farthest_m = np.abs(ego.corners_m).max(axis=0) + self.reference_sensor.shell_m
        reaches = [
            float(np.linalg.norm(sensor.mount.to_matrix()[:3, 3])) + self.scenario.compute_max_range_m(sensor)
            for rig in self.rigs.values()
            for sensor in rig.sensors
        ]
        return max([float(np.linalg.norm(farthest_m)) + self.reference_sensor.max_range_m, *reaches])

    def _scans(
        self, stage: MountedRigs, instant: SceneSnapshot, index: int, within: SearchSpheres | None
    ) -> dict[str, list[SensorScan]]:
        scans: dict[str, list[SensorScan]] = {name: [] for name in stage.sensors_by_rig}
        for name, sensors in stage.sensors_by_rig.items():
            for k, mounted in enumerate(sensors, 1):
                draws = SensorNoise(
                    np.random.default_rng([self.seed, index, k]), num_rays=len(mounted.ray_pixel_indices)
                )
                scans[name].append(
                    mounted.scan(instant, draws, num_threads=torch.get_num_threads(), search_spheres=within)
                )
        return scans


def _counts_of(
    scene: SceneGeometry, instant: SceneSnapshot, scans: Sequence[SensorScan], reference: ReferenceScan
) -> dict[str, int]:
    """What the rays of all sensors and of the reference met, and what was left out, next to all that there was."""
    rays, self_hits = sum(scan.num_rays for scan in scans), sum(scan.self_hits for scan in scans)
    pairs = (rays + reference.num_rays) * len(instant.moving_bodies)
    return {
        "sensor_rays": rays,
        "sensor_self_hits": self_hits,
        "reference_rays": reference.num_rays,
        "reference_self_hits": reference.self_hits,
        "reference_poses": reference.num_poses + reference.num_resampled_poses,
        "reference_poses_resampled": reference.num_resampled_poses,
        "moving_bodies": len(instant.moving_bodies) + instant.num_out_of_range,
        "moving_bodies_out_of_range": instant.num_out_of_range,
        "road_users_omitted": scene.scene.num_omitted_road_users,
        "ray_body_pairs": pairs,
        "ray_body_pairs_omitted": pairs - reference.num_body_casts - sum(scan.num_body_casts for scan in scans),
        "sensor_rays_reused": 0 if scene.has_motion else rays,
        "sensor_rays_omitted": sum(scan.num_omitted_rays for scan in scans),
        "sensor_self_hits_reused": self_hits if scene.has_constant_self_hits else 0,
    }
