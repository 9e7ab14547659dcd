"""Bodies in free places beside the vehicle of a simulation, one at a time: nothing waits for traffic to come near."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import NEAR_FIELD_M, BevGrid, BodySums, Region
from torchcover.coverage.bodies import COLUMNS, FREE, SEEN
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox, overlapping
from torchcover.metrics import SumsInBlocks
from torchcover.simulation.reference_sensor import Surroundings
from torchcover.simulation.regions_of_interest import near_field
from torchcover.simulation.sensor import Draws
from torchcover.simulation.simulator import Simulator
from torchcover.targets.counting import count
from torchcover.targets.placing import holding, poses, standing, yaws
from torchcover.targets.raster import Raster, from_outline_m
from torchcover.targets.steps import SensorStep, Step, free_places, pose_in_shell
from torchcover.targets.surface import Surface
from torchcover.targets.survey import HITS, THRESHOLD_M
from torchcover.targets.target import Target

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]

# Steps from one at which bodies are put to the next, and places of each in each region then: a tenth of a run's time.
EVERY, PLACES = 4, 4
# Side of the cells of maps, each of 25 places.
MAP_CELL_M = 1.0
# Of its own random numbers: those of sensors have smaller ones.
STREAM = 2**31


class Pool(NamedTuple):
    """A body, and the N places where it may stand, region by region, from near to far in each.

    `region` (N,) the number of that of each; `vehicle_T_body` (N, 4, 4), but for the height of the ground.
    """

    body: Target
    surface: Surface
    region: Numbers
    vehicle_T_body: Float64

    @classmethod
    def of(cls, body: Target, vehicle: BoundingBox, regions: Sequence[Region]) -> Self:
        """All cells of the usual raster of targets whose middle is in a region, less those that the vehicle fills."""
        at_m = Raster.around(vehicle, NEAR_FIELD_M).positions_m
        inside = np.stack([region.contains(*torch.from_numpy(at_m).T).numpy() for region in regions])
        vehicle_T_body = poses(at_m, yaws("narrow", body.solid.box, vehicle, at_m))
        kept = inside.any(axis=0) & ~overlapping(body.solid.box, vehicle_T_body, vehicle.corners_m)
        away_m = np.linalg.norm(from_outline_m(vehicle, at_m), axis=1)
        region = inside.argmax(axis=0)
        order = np.lexsort((away_m, region, ~kept))[: np.count_nonzero(kept)]
        return cls(body, Surface.of(body), region[order], vehicle_T_body[order])

    def some(self, places: int, generator: np.random.Generator) -> Numbers:
        """So many of each region, any as likely as the others there, and spread evenly; all if there are no more."""
        some = []
        for region in range(self.region.max(initial=-1) + 1):
            there = np.flatnonzero(self.region == region)
            each = (np.arange(places) + generator.random(places)) / places * len(there)
            some.append(there if len(there) <= places else there[each.astype(np.int64)])
        return np.concatenate([np.empty(0, dtype=np.int64), *some])


class StepProbes(NamedTuple):
    """What one step adds, of each rig to `BodySums`; it is small, and travels between processes."""

    place_in_time: int
    sums: Tensor
    cells: Tensor


class Probes:
    """Puts bodies beside the vehicle at the steps of a simulation.

    Args:
        simulator: The simulation, whose rigs see them.
        bodies: What is put there, one at a time and seen by nothing else.
        places: Of each body in each region at a step: more of them make errors smaller, and move no number.
        every: Steps from one at which they are put to the next; likewise.
    """

    def __init__(
        self,
        simulator: Simulator,
        bodies: Sequence[Target],
        places: int = PLACES,
        every: int = EVERY,
    ) -> None:
        self.simulator, self.places, self.every = simulator, places, every
        vehicle = simulator.scenario.ego_box()
        self.regions = near_field(vehicle.outline_m)
        around = Raster.around(vehicle, NEAR_FIELD_M, MAP_CELL_M)
        self.grid = BevGrid(around.x, around.y, MAP_CELL_M)
        self.pools = [Pool.of(body, vehicle, self.regions) for body in bodies]

    def at(self, index: int) -> StepProbes | None:
        """What the rigs see of them at a step; None of a step at which none is put.

        Args:
            index: Number of the step.

        Raises:
            ValueError: As `Simulator.step`.
        """
        if index % self.every:
            return None
        simulator, generator = self.simulator, np.random.default_rng([self.simulator.seed, index, STREAM])
        stage, instant = simulator.placed(index)
        around = Surroundings(stage.scene, instant, generator, f"{simulator.scenario.name} step {index}")
        place_m = around.free_pose(pose_in_shell)[0][:3, 3]
        ends = {rig: [one.ends(instant) for one in mounted] for rig, mounted in stage.mounted.items()}
        sums = np.zeros((len(ends), len(self.pools), len(self.regions), len(COLUMNS)))
        cells = np.zeros((len(ends), len(self.pools), np.prod(self.grid.shape[1:]), 2))
        for number, pool in enumerate(self.pools):
            body, box, some = pool.body, pool.body.solid.box, pool.some(self.places, generator)
            region, vehicle_T_body = pool.region[some], pool.vehicle_T_body[some]
            z_m, free = free_places(instant, body, pool.surface, vehicle_T_body)
            upright = standing(vehicle_T_body, z_m)
            visible = pool.surface.seen_from(place_m, body, upright, instant)[None]
            for rig, (mounted, of_rig) in enumerate(zip(stage.mounted.values(), ends.values(), strict=True)):
                held = [holding(box, vehicle_T_body, one.vehicle_T_sensor[:3, 3]) for one in mounted]
                sensors = [
                    SensorStep(one, Draws(np.random.default_rng([simulator.seed, index, k]), rays=len(one.range_m)))
                    for k, one in enumerate(of_rig, 1)
                ]
                step = Step(sensors, z_m, free & ~np.any(held, axis=0), visible)
                of = count(body, pool.surface, vehicle_T_body, mounted, [step], hits=HITS, threshold_m=THRESHOLD_M)
                m2 = pool.surface.m2_each
                each = np.stack([np.ones(len(some)), of.steps, of.seen, m2 * of.visible, m2 * of.near], axis=1)
                np.add.at(sums[rig, number], region, each)
                np.add.at(
                    cells[rig, number],
                    self.grid.cell_of(torch.from_numpy(vehicle_T_body[:, :3, 3].copy())).numpy(),
                    each[:, [FREE, SEEN]],
                )
        cells = cells.reshape(*cells.shape[:2], *self.grid.shape[1:], 2)
        return StepProbes(simulator.place_in_time(index), torch.from_numpy(sums), torch.from_numpy(cells))


class ProbeMetric(SumsInBlocks):
    """What rigs see of bodies beside the vehicle: an observer that measures where frames are made.

    Args:
        probes: Who puts them there.
        blocks: As in `CoverageMetric`.
    """

    sums: Tensor
    cells: Tensor

    def __init__(self, probes: Probes, blocks: int) -> None:
        bodies, rigs = tuple(pool.body.name for pool in probes.pools), tuple(probes.simulator.rigs)
        super().__init__(blocks, {"bodies": bodies, "regions": probes.regions, "rigs": rigs, "blocks": blocks})
        self.probes, self.bodies, self.rigs = probes, bodies, rigs
        each = len(rigs), len(bodies)
        self.add_block_sum("sums", (*each, len(probes.regions), len(COLUMNS)), fine=True)
        self.add_sum("cells", (*each, *probes.grid.shape[1:], 2))

    def update(self, frame: Frame) -> None:
        """Put them beside the vehicle at the time of a frame of the simulation."""
        self.add(self.sums_of(frame))

    def sums_of(self, frame: Frame) -> StepProbes | None:
        """What such a frame is to `add`; it is small, and the same in every process."""
        return self.probes.at(frame.index)

    def add(self, step: StepProbes | None) -> None:
        """Add a step; None is one at which no body was put."""
        if step is None:
            return
        self._block_of(step.place_in_time)
        self.sums[self._fine_block_of(step.place_in_time)] += step.sums
        self.cells += step.cells
        self.steps += 1
        self._follow_steps()

    def compute(self) -> Tensor:
        """(rigs, bodies, regions, 5) the sums so far, as those of a block of `BodySums`."""
        return self.sums.sum(dim=0)

    def seen_by(self, rig: str) -> BodySums:
        """What a rig saw of them so far."""
        at, steps, told = self.rigs.index(rig), self.fine_steps.clone(), (HITS, THRESHOLD_M, self.probes.grid)
        sums, cells = self.sums[:, at].clone(), self.cells[at].clone()
        return BodySums(self.bodies, tuple(self.probes.regions), *told, steps, sums, cells)
