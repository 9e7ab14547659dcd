"""Bodies in free places beside the vehicle of a simulation, one at a time: nothing waits for traffic to come near."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import NEAR_FIELD_M, BevGrid, Region, TargetSums
from torchcover.coverage.bodies import COLUMNS, FREE, SEEN, TRIED
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.metrics import BlockedSums
from torchcover.simulation.reference_sensor import ReferenceContext
from torchcover.simulation.regions_of_interest import build_near_field
from torchcover.simulation.simulator import Simulator
from torchcover.targets.counting import SensorStep, Step, count, free_places, pose_in_shell
from torchcover.targets.placing import Raster, holding, poses, standing, yaws
from torchcover.targets.surface import Surface, Target
from torchcover.targets.survey import HITS, THRESHOLD_M

# Steps from one at which bodies are put to the next, and places of each in each region then: a tenth of a run's time.
EVERY, PLACES = 4, 3
# Side of the cells of maps, each of 25 places.
MAP_CELL_M = 1.0
# Of its own random numbers: those of sensors have smaller ones.
STREAM = 2**31
# So far along one side follows a place from another, as a share of it: any number of them lies evenly.
GOLDEN = (5**0.5 - 1) / 2


class Probe(NamedTuple):
    """A body and the N places where it may stand: cells of the usual raster of targets whose middles are in a region.

    `region` (N,) number of that of each; `room` (N,) whether the vehicle leaves it any; `vehicle_T_body` (N, 4, 4),
    but for the height of the ground; `cell` (N,) of the map.
    """

    body: Target
    surface: Surface
    region: Int64
    room: Bools
    vehicle_T_body: Float64
    cell: Int64

    @classmethod
    def of(cls, body: Target, vehicle: BoundingBox, regions: Sequence[Region], grid: BevGrid) -> Self:
        """A body that is put beside a vehicle."""
        at_m = Raster.around(vehicle, NEAR_FIELD_M).positions_m
        inside = np.stack([region.mask_points(*torch.from_numpy(at_m).T).numpy() for region in regions])
        region, place = inside.nonzero()
        vehicle_T_body = poses(at_m[place], yaws("narrow", body.solid.bounding_box, vehicle, at_m[place]))
        room = ~find_overlaps(body.solid.bounding_box, vehicle_T_body, vehicle.corners_m)
        cell = grid.find_cells(torch.from_numpy(vehicle_T_body[:, :3, 3].copy())).numpy()
        return cls(body, Surface.of(body), region, room, vehicle_T_body, cell)

    def some(self, places: int, generator: np.random.Generator) -> Int64:
        """So many in each region, any as likely as the others there, and spread evenly; all if there are no more."""
        found = []
        for region in range(self.region.max() + 1):
            there = np.flatnonzero(self.region == region)
            if places < len(there):
                # Rows of cells, for its sides are straight.
                rows = len(np.unique(self.vehicle_T_body[there, 1, 3]))
                down, along = generator.random(2)
                row = (np.arange(places) + down) / places * rows
                column = (np.arange(places) * GOLDEN + along) % 1 * (len(there) // rows)
                there = there.reshape(rows, -1)[row.astype(np.int64), column.astype(np.int64)]
            found.append(there)
        return np.concatenate(found)


class StepProbes(NamedTuple):
    """What one step adds, of each rig to `TargetSums`; it is small, and travels between processes."""

    block_index: int
    sums: Tensor
    cells: Tensor


class Probes(BlockedSums):
    """What the rigs of a simulation see of bodies beside the vehicle: an observer that measures where frames are made.

    Args:
        simulator: The simulation.
        bodies: What is put there, one at a time and seen by nothing else.
        blocks: As in `CoverageMetric`.
        places: Of each body in each region at a step: more of them make errors smaller, and move no number.
        every: Steps from one at which they are put to the next; likewise.
    """

    sums: Tensor
    cells: Tensor

    def __init__(
        self, simulator: Simulator, bodies: Sequence[Target], blocks: int = 1, places: int = PLACES, every: int = EVERY
    ) -> None:
        vehicle = simulator.scenario.compute_ego_box()
        regions, around = build_near_field(vehicle.outline_m), Raster.around(vehicle, NEAR_FIELD_M, MAP_CELL_M)
        names, rigs = tuple(body.name for body in bodies), tuple(simulator.rigs)
        super().__init__(blocks, {"bodies": names, "regions": regions, "rigs": rigs, "blocks": blocks})
        self.simulator, self.places, self.every, self.regions = simulator, places, every, regions
        self.grid = BevGrid(around.x, around.y, MAP_CELL_M)
        self.probes = [Probe.of(body, vehicle, regions, self.grid) for body in bodies]
        each = len(rigs), len(bodies)
        self.define_block_sum("sums", (*each, len(regions), len(COLUMNS)), is_fine=True)
        self.define_sum("cells", (*each, self.grid.num_cells // len(self.grid.heights), 2))

    def update(self, frame: Frame) -> None:
        """Put them beside the vehicle at the time of a frame of the simulation."""
        self.add_sums(self.compute_sums(frame))

    def compute_sums(self, frame: Frame) -> StepProbes | None:
        """What such a frame is to `add`, the same in every process; None where no body is put at its step."""
        if frame.index % self.every:
            return None
        simulator, index, seed = self.simulator, frame.index, self.simulator.seed
        generator = np.random.default_rng([seed, index, STREAM])
        stage, instant = simulator.prepare_frame(index)
        place_m = ReferenceContext(stage.scene_geometry, instant, generator, frame.name).sample_free_pose(
            pose_in_shell
        )[0][:3, 3]
        sums, cells = np.zeros(self.sums.shape[1:]), np.zeros(self.cells.shape)
        ends = [[one.compute_ray_ends(instant) for one in mounted] for mounted in stage.sensors_by_rig.values()]
        for number, probe in enumerate(self.probes):
            some, box = probe.some(self.places, generator), probe.body.solid.bounding_box
            vehicle_T_body = probe.vehicle_T_body[some]
            z_m, free = free_places(instant, probe.body, probe.surface, vehicle_T_body)
            np.add.at(sums[:, number, :, TRIED].T, probe.region[some], 1.0)
            some = some[room := free & probe.room[some]]
            vehicle_T_body, z_m = vehicle_T_body[room], z_m[room]
            visible = probe.surface.seen_from(place_m, probe.body, standing(vehicle_T_body, z_m), instant)
            for rig, mounted in enumerate(stage.sensors_by_rig.values()):
                held = np.any([holding(box, vehicle_T_body, one.vehicle_T_sensor[:3, 3]) for one in mounted], axis=0)
                step = Step(SensorStep.of_rig(ends[rig], seed, index), z_m, ~held, visible[None])
                seen = count(
                    probe.body, probe.surface, vehicle_T_body, mounted, [step], hits=HITS, threshold_m=THRESHOLD_M
                )
                m2 = np.multiply(probe.surface.m2_each, (seen.visible, seen.near))
                each = np.stack([np.zeros(len(some)), seen.steps, seen.seen, *m2], axis=1)
                np.add.at(sums[rig, number], probe.region[some], each)
                np.add.at(cells[rig, number], probe.cell[some], each[:, [FREE, SEEN]])
        return StepProbes(simulator.get_block_index(index), torch.from_numpy(sums), torch.from_numpy(cells))

    def add_sums(self, step: StepProbes | None) -> None:
        """Add what `sums_of` gives."""
        if step is not None:
            self._block_of(step.block_index)
            self.sums[self._fine_block_of(step.block_index)] += step.sums
            self.cells += step.cells
            self.num_frames += 1
            self._follow_steps()

    def compute(self) -> Tensor:
        """(rigs, bodies, regions, 5) the sums so far, as those of a block of `TargetSums`."""
        return self.sums.sum(dim=0)

    def seen_by(self, rig: str) -> TargetSums:
        """What a rig saw of them so far."""
        bodies, at = tuple(probe.body.name for probe in self.probes), list(self.simulator.rigs).index(rig)
        cells = self.cells[at].view(len(bodies), *self.grid.shape[1:], 2).clone()
        told = bodies, self.regions, HITS, THRESHOLD_M, self.grid
        return TargetSums(*told, self.fine_block_frame_counts.clone(), self.sums[:, at].clone(), cells)
