"""What one step has for every place: where rays end without a target, where there is room, what is visible."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, rigid
from torchcover.simulation.instant import Instant
from torchcover.simulation.reference_sensor import Surroundings, position_in_shell
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene import Scene
from torchcover.simulation.sensor import Draws
from torchcover.simulation.sight import Ends, MountedSensor
from torchcover.simulation.stage import Scenes, Stages
from torchcover.targets.placing import blocked, ground_under, standing
from torchcover.targets.surface import SAMPLES, Surface
from torchcover.targets.target import Target

Bools = NDArray[np.bool_]
Float64 = NDArray[np.float64]

# From so many random places in all the visible surface is looked at, and from one at each step at least.
PLACES = 8
# The shell of the reference sensors.
SHELL_M = 0.5
POSITIONS_AT_ONCE = 4096
RIG = "rig"


class SensorStep(NamedTuple):
    """One sensor at one step: where its rays end without a target, and the random numbers of each."""

    ends: Ends
    draws: Draws

    @classmethod
    def of_rig(cls, ends: Sequence[Ends], seed: int, step: int) -> "list[SensorStep]":
        """The sensors of a rig, with the numbers of each ray: all places see the same rays err and drop out."""
        return [
            cls(one, Draws(np.random.default_rng([seed, step, k]), rays=len(one.range_m)))
            for k, one in enumerate(ends, 1)
        ]


class Step(NamedTuple):
    """One step.

    `sensors` of the rig; `ground_z_m` (P,) where the target stands, in the vehicle frame; `free` (P,) where there is
    ground, and room; `visible` (places, P, bytes) as `seen_from`.
    """

    sensors: Sequence[SensorStep]
    ground_z_m: Float64
    free: Bools
    visible: NDArray[np.uint8]


class Steps:
    """The steps of a run, `every_steps` time steps of the scenario apart.

    `vehicle_T_target` (P, 4, 4) is where the target stands, but for the height of the ground there.
    """

    def __init__(
        self,
        rig: Rig,
        scenario: Scenario,
        target: Target,
        surface: Surface,
        vehicle_T_target: Float64,
        *,
        steps: int,
        every_steps: int,
        seed: int,
    ) -> None:
        self._scenario, self._target, self._surface, self._poses = scenario, target, surface, vehicle_T_target
        self._steps, self._every_steps, self._seed = steps, every_steps, seed
        self.places = max(1, -(-PLACES // steps))
        self._stages = Stages(Scenes(scenario, seed), {RIG: rig})
        sensor_reach_m = [float(np.linalg.norm(s.mount.matrix()[:3, 3])) + scenario.reach_m(s) for s in rig.sensors]
        raster_reach_m = float(np.linalg.norm(vehicle_T_target[:, :3, 3], axis=1).max(initial=0.0))
        self._within_m = max([raster_reach_m + target.solid.reach_m, *sensor_reach_m])

    @property
    def mounted(self) -> Sequence[MountedSensor]:
        """The sensors; their rays are the same at every step."""
        return self._stages.of_run(self._scenario.locate(0)[0]).mounted[RIG]

    def __iter__(self) -> Iterator[Step]:
        """One after the other.

        FileNotFoundError: a mesh, vehicle or trajectory file is missing. ValueError: a sensor or an actor that is where
        none can be.
        """
        resting: tuple[list[Ends], Float64, Bools] | None = None
        for index in range(self._steps):
            run, step = self._scenario.locate(index * self._every_steps)
            stage = self._stages.of_run(run)
            instant = stage.scene.at(step, within_m=self._within_m)
            stage.check_mounts(instant)
            # Where nothing moves, the first answer holds.
            ends, ground_z_m, free = resting or (
                [m.ends(instant) for m in stage.mounted[RIG]],
                *free_places(instant, self._target, self._surface, self._poses),
            )
            if not stage.scene.moves and self._scenario.repeats:
                resting = ends, ground_z_m, free
            visible = self._visible(stage.scene, instant, standing(self._poses, ground_z_m), index)
            yield Step(SensorStep.of_rig(ends, self._seed, index), ground_z_m, free, visible)

    def _visible(self, scene: Scene, instant: Instant, vehicle_T_target: Float64, index: int) -> NDArray[np.uint8]:
        generator = np.random.default_rng([self._seed, index])
        surroundings = Surroundings(
            scene, instant, generator, f"{self._scenario.name} step {index}", torch.get_num_threads()
        )
        seen = []
        for _ in range(self.places):
            pose, _ = surroundings.free_pose(pose_in_shell)
            seen.append(
                [
                    self._surface.seen_from(pose[:3, 3], self._target, poses, instant, threads=surroundings.threads)
                    for poses in _chunks(vehicle_T_target)
                ]
            )
        # Some of none, where the vehicle is everywhere.
        none = np.empty((0, SAMPLES // 8), dtype=np.uint8)
        return np.stack([np.concatenate([none, *of_place]) for of_place in seen])


def free_places(instant: Instant, target: Target, surface: Surface, vehicle_T_target: Float64) -> tuple[Float64, Bools]:
    """Where the ground is, 0 where there is none, and where there is some, with room for a target on it: (P,) each."""
    z_m = ground_under(instant, vehicle_T_target[:, :2, 3])
    there, z_m = np.isfinite(z_m), np.nan_to_num(z_m)
    upright = _chunks(standing(vehicle_T_target, z_m))
    taken = [blocked(instant, target.solid.box, surface.points_m, some) for some in upright]
    return z_m, there & ~np.concatenate([np.empty(0, dtype=bool), *taken])


def pose_in_shell(ego: BoundingBox, generator: np.random.Generator) -> Float64:
    """A (4, 4) random place of a reference sensor."""
    return rigid(np.eye(3), position_in_shell(ego, SHELL_M, generator))


def _chunks(poses: Float64) -> list[Float64]:
    return [poses[first : first + POSITIONS_AT_ONCE] for first in range(0, len(poses), POSITIONS_AT_ONCE)]
