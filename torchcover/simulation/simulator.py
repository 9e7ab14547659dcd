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
from torchcover.simulation.instant import Instant, SensorScan
from torchcover.simulation.memory import BYTES_PER_RAY, check_fits
from torchcover.simulation.rays import Balls
from torchcover.simulation.reference_sensor import ReferenceScan, ReferenceSensor, Surroundings
from torchcover.simulation.rig import Rig, with_ego
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import Scene
from torchcover.simulation.sensor import Draws
from torchcover.simulation.stage import Scenes, Stage, Stages, warn_of_floating
from torchcover.simulation.world import Label, labels


@dataclass(frozen=True, eq=False)
class Observation:
    """The clouds of one step in the vehicle frame (x forward, y left, z up, metres), without points of the ego itself.

    Args:
        scans: Name of each rig -> what each of its sensors saw.
        reference: (M, 3) float32 points of the reference sensor.
        reference_weights: (M,) float32 square metres that each of them stands for; None if they count the same.
        reference_heights_m: (M,) float32 heights of the reference points above the local ground, from `ReferenceScan`.
        drawn: (objects,) how many points the reference drew on each of `World.objects`, from `ReferenceScan`.
        counts: How many rays there were, how many of them the ego took, and what was left out, by name.
    """

    scans: Mapping[str, Sequence[SensorScan]]
    reference: Float32
    reference_weights: Float32 | None
    reference_heights_m: Float32 | None
    drawn: Int64 | None
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
        scenario: The world; `with_ego` gives it its ego. Beyond its end the same plays again, or another one; see
            `Scenario.repeats`.
        rigs: The sensors, by the name under which `Observation.clouds` has their points.
        reference_sensor: The reference sensor.
        seed: Seed of the traffic, of the reference sensor, and of noise and drop-out.
        frame_interval_s: Time between one step and the next, a multiple of the scenario's time step; that step if not given.
        kept_bytes: What the worlds that are kept, in case they are needed again, may take; a small share of the
            machine's memory if not given.
        within_m: Only points of the rigs that lie so near to one of the reference are asked for, as detections up to
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
        >>> seen = simulator.step(0)
        >>> seen.counts["sensor_rays"], seen.clouds["roof"].dtype
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
        kept_bytes: float | None = None,
        within_m: float | None = None,
        no_cache: bool = False,
        device: str | None = None,
    ) -> None:
        if seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
        self.scenario = scenario = with_ego(scenario, rigs)
        self.rigs = rigs
        self.reference_sensor = reference_sensor
        self.seed = seed
        self.within_m = within_m
        self._every_steps = 1 if frame_interval_s is None else scenario.steps_in(frame_interval_s)
        self._stages = Stages(Scenes(scenario, seed, kept_bytes, no_cache=no_cache, device=device), rigs)
        self._check_size()

    @property
    def frame_interval_s(self) -> float:
        """Time between one step and the next."""
        return self._every_steps * self.scenario.step_s

    @property
    def distinct_steps(self) -> int | None:
        """How many steps show an instant for the first time; all later ones repeat them. None: no step ever does."""
        instants = self.scenario.instants
        return None if instants is None else instants // math.gcd(instants, self._every_steps)

    def block_index(self, index: int) -> int:
        """The number by which standard errors tell a step from others; steps that share it are alike.

        Where each run has a world of its own, that is the number of the run: its steps share a city. In a scenario that
        repeats it is the instant, be it seen for the first time or again. Where there is a single instant only the
        reference sensor's draw differs, and every step has a number of its own.
        """
        if self.scenario.instants == 1:
            return index
        run, step = self.scenario.locate(index * self._every_steps)
        return step if self.scenario.repeats else run

    def with_reference_sensor(self, reference_sensor: ReferenceSensor) -> Self:
        """The same instants as another reference sensor sees them; the geometry is built once for both."""
        other = copy.copy(self)
        other.reference_sensor = reference_sensor
        other._check_size()
        return other

    def with_rigs(self, rigs: Mapping[str, Rig]) -> Self:
        """The same instants as other rigs see them, on the same ego; the geometry is built once for both.

        Args:
            rigs: The sensors, by the name under which `scans` has what they see. What vehicle they name says nothing.
        """
        other = copy.copy(self)
        other.rigs = rigs
        other._stages = self._stages.with_rigs(rigs)
        other._check_size()
        return other

    def scans(self, index: int, within: Balls | None = None) -> Mapping[str, Sequence[SensorScan]]:
        """What the sensors see at one step, as in `step`, bit for bit; the reference is not cast.

        Args:
            index: Number of the step, from 0.
            within: What is asked about, as in `MountedSensor.scan`; everything if not given.

        Returns:
            Name of each rig -> what each of its sensors saw.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: As for `step`.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> empty = Simulator(Scenario.load("courtyard"), {}, PaperReference(rows=16, columns=16))
            >>> [roof] = empty.with_rigs({"candidate": Rig.load("front_roof_128")}).scans(0)["candidate"]
            >>> roof.rays, roof.points.dtype
            (230400, dtype('float32'))
        """
        stage, instant = self.placed(index)
        return self._scans(stage, instant, index, within)

    def step(self, index: int) -> Observation:
        """What is seen at one step.

        Args:
            index: Number of the step, from 0.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A negative index, a sensor inside a body or below the ground, an actor that overlaps the ego, an
                ego below the ground.
        """
        stage, instant = self.placed(index)
        generator, name = np.random.default_rng([self.seed, index]), f"{self.scenario.name} step {index}"
        around = Surroundings(stage.scene, instant, generator, name, threads=torch.get_num_threads())
        reference = self.reference_sensor.scan(around)
        within = None if self.within_m is None else Balls.around(reference.points, self.within_m)
        scans = self._scans(stage, instant, index, within)
        of_all_rigs = [scan for of_rig in scans.values() for scan in of_rig]
        return Observation(
            scans=scans,
            reference=reference.points,
            reference_weights=reference.weights,
            reference_heights_m=reference.heights_m,
            drawn=reference.drawn,
            counts={
                **_counts_of(stage.scene, instant, of_all_rigs, reference),
                "repeated_frames": int(self.distinct_steps is not None and index >= self.distinct_steps),
            },
        )

    def check_run(self, steps: int) -> None:
        """Refuse before its first step what a run through a world that repeats would end with; others come as they are.

        Args:
            steps: How many steps the run has.

        Raises:
            ValueError: A sensor that is where none can be at the first step, an actor that overlaps the ego at any.
            ImportError: What makes the traffic is not installed.

        Warns:
            UserWarning: Those that move do not stand on the ground.
        """
        if self.scenario.traffic is not None:
            self.scenario.traffic.check()
        if self.scenario.repeats:
            stage, _ = self._stage(0)
            world_steps = stage.scene.world.steps
            indices = np.arange(min(steps, world_steps), dtype=np.int64)  # then they repeat themselves
            seen = np.unique(indices * self._every_steps % world_steps)
            stage.scene.check_apart(seen)
            stage.check_mounts(stage.scene.at(0))
            warn_of_floating(self.scenario.name, stage.scene, seen)

    @property
    def ground_words(self) -> str:
        """What is taken for the ground of a scenario that does not say it; no words if it does.

        Example:
            >>> from torchcover.simulation import PaperReference
            >>> Simulator(Scenario.load("urban"), {}, PaperReference(rows=16, columns=16)).ground_words
            ''
        """
        if self.scenario.says_ground:
            return ""
        names = [body.name for body in self.scenario.bodies for _ in body.poses]
        found = zip(names, self.scene_of(0)[0].is_ground, strict=True)
        taken = dict.fromkeys(repr(name) for name, is_ground in found if is_ground.any())
        if not taken:
            return (
                "Ground: none was found under the ego, so that no point has a height above it; mark bodies as ground."
            )
        what = "level faces under the ego, and what is level and connected with them"
        return f"Ground: {what}, of {', '.join(taken)}; bodies with `ground: true` say it otherwise."

    def labels(self, index: int) -> list[Label]:
        """The objects within the reference sensor's range at one step; names are an object's own within a run."""
        scene, step = self.scene_of(index)
        return labels(scene.world, step, self.reference_sensor.max_range_m)

    def bottom_heights_m(self, index: int, found: Sequence[Label]) -> Float32:
        """(K,) height of the bottom of each label's box at a step above the highest ground below its centre."""
        scene, step = self.scene_of(index)
        world_T_vehicle = scene.world.ego.trajectory.interpolate(step * scene.world.time_step_s)
        centres_m = np.array([label.centre_m for label in found]).reshape(-1, 3)
        halves_m = np.array([label.size_m[2] / 2 for label in found], dtype=np.float32)
        return scene.ground.heights_m(centres_m, world_T_vehicle) - halves_m

    def scene_of(self, index: int) -> tuple[Scene, int]:
        """The geometry of the world in which a step plays, and the time step in it.

        It is built when first needed, once in each process for each run through the scenario.
        """
        stage, step = self._stage(index)
        return stage.scene, step

    def run_of(self, index: int) -> int:
        """Which run through the scenario a step belongs to: each is a world of its own, unless it repeats."""
        return self.scenario.locate(index * self._every_steps)[0]

    def _check_size(self) -> None:
        of_rigs = sum(sensor.rays for rig in self.rigs.values() for sensor in rig.sensors)
        rays = of_rigs + self.reference_sensor.rays
        check_fits(
            f"{rays:,} rays a step ({of_rigs:,} of the rig's sensors, {self.reference_sensor.rays:,} of the reference)",
            BYTES_PER_RAY * rays,
            "use fewer rays, rows or columns",
        )

    def _stage(self, index: int) -> tuple[Stage, int]:
        if index < 0:
            raise ValueError(f"index: a number >= 0 is needed; got {index}")
        run, step = self.scenario.locate(index * self._every_steps)
        return self._stages.of_run(run), step

    def placed(self, index: int) -> tuple[Stage, Instant]:
        """The stage of a step, and all of it at its time, with no sensor where none can be.

        Args:
            index: Number of the step, from 0.

        Raises:
            FileNotFoundError, ValueError: As for `step`.
        """
        stage, step = self._stage(index)
        instant = stage.scene.at(step, within_m=self._reach_m(stage.scene.ego_box))
        stage.check_mounts(instant)
        return stage, instant

    def _reach_m(self, ego: BoundingBox) -> float:
        """How far from the origin of the vehicle frame a sensor can see: its range starts where it is mounted."""
        farthest_m = np.abs(ego.corners_m).max(axis=0) + self.reference_sensor.shell_m
        reaches = [
            float(np.linalg.norm(sensor.mount.matrix()[:3, 3])) + self.scenario.reach_m(sensor)
            for rig in self.rigs.values()
            for sensor in rig.sensors
        ]
        return max([float(np.linalg.norm(farthest_m)) + self.reference_sensor.max_range_m, *reaches])

    def _scans(self, stage: Stage, instant: Instant, index: int, within: Balls | None) -> dict[str, list[SensorScan]]:
        scans: dict[str, list[SensorScan]] = {name: [] for name in stage.mounted}
        for name, sensors in stage.mounted.items():
            for k, mounted in enumerate(sensors, 1):
                draws = Draws(np.random.default_rng([self.seed, index, k]), rays=len(mounted.pixel_of_ray))
                scans[name].append(mounted.scan(instant, draws, threads=torch.get_num_threads(), within=within))
        return scans


def _counts_of(scene: Scene, instant: Instant, scans: Sequence[SensorScan], reference: ReferenceScan) -> dict[str, int]:
    """What the rays of all sensors and of the reference met, and what was left out, next to all that there was."""
    rays, self_hits = sum(scan.rays for scan in scans), sum(scan.self_hits for scan in scans)
    pairs = (rays + reference.rays) * len(instant.moving)
    return {
        "sensor_rays": rays,
        "sensor_self_hits": self_hits,
        "reference_rays": reference.rays,
        "reference_self_hits": reference.self_hits,
        "reference_poses": reference.places + reference.redrawn,
        "reference_poses_resampled": reference.redrawn,
        "moving_bodies": len(instant.moving) + instant.out_of_range,
        "moving_bodies_out_of_range": instant.out_of_range,
        "road_users_omitted": scene.world.left_out,
        "ray_body_pairs": pairs,
        "ray_body_pairs_omitted": pairs - reference.body_casts - sum(scan.body_casts for scan in scans),
        "sensor_rays_reused": 0 if scene.moves else rays,
        "sensor_rays_omitted": sum(scan.rays_spared for scan in scans),
        "sensor_self_hits_reused": self_hits if scene.knows_self_hits else 0,
    }
