"""Bodies in free places beside the vehicle of a simulation, one at a time: nothing waits for traffic to come near."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import NEAR_FIELD_M, BevGrid, Region, TargetSums
from torchcover.coverage.target_sums import COLUMNS, FREE, SEEN, TRIED
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.metrics import BlockedSums
from torchcover.simulation.reference_sensor import ReferenceContext
from torchcover.simulation.regions_of_interest import build_near_field
from torchcover.simulation.simulator import Simulator
from torchcover.targets.counting import (
    SensorFrame,
    TargetFrame,
    count_target_points,
    find_free_positions,
    sample_reference_pose,
)
from torchcover.targets.placing import Raster, build_poses, compute_yaws_rad, is_point_inside, set_pose_heights
from torchcover.targets.surface import Target, TargetSurface
from torchcover.targets.survey import HITS, THRESHOLD_M

# Steps from one at which bodies are put to the next, and places of each in each region then: a tenth of a run's time.
EVERY, PLACES = 4, 3
# Side of the cells of maps, each of 25 places.
MAP_CELL_M = 1.0
# Of its own random numbers: those of sensors have smaller ones.
STREAM = 2**31
# So far along one side follows a place from another, as a share of it: any number of them lies evenly.
GOLDEN = (5**0.5 - 1) / 2


class NearFieldTarget(NamedTuple):
    """A body and the N places where it may stand: cells of the usual raster of targets whose middles are in a region.

    `region_indices` (N,) number of that of each; `has_room` (N,) whether the vehicle leaves it any; `vehicle_T_target` (N, 4, 4),
    but for the height of the ground; `cell_indices` (N,) of the map.
    """

    target: Target
    surface: TargetSurface
    region_indices: Int64
    has_room: Bools
    vehicle_T_target: Float64
    cell_indices: Int64

    @classmethod
    def from_target(cls, target: Target, vehicle_box: BoundingBox, regions: Sequence[Region], grid: BevGrid) -> Self:
        """A body that is put beside a vehicle."""
        at_m = Raster.from_vehicle(vehicle_box, NEAR_FIELD_M).positions_m
        inside = np.stack([region.mask_points(*torch.from_numpy(at_m).T).numpy() for region in regions])
        region, place = inside.nonzero()
        vehicle_T_body = build_poses(
            at_m[place], compute_yaws_rad("narrow", target.solid.bounding_box, vehicle_box, at_m[place])
        )
        room = ~find_overlaps(target.solid.bounding_box, vehicle_T_body, vehicle_box.corners_m)
        cell = grid.find_cells(torch.from_numpy(vehicle_T_body[:, :3, 3].copy())).numpy()
        return cls(target, TargetSurface.from_target(target), region, room, vehicle_T_body, cell)

    def sample_positions(self, positions_per_region: int, generator: np.random.Generator) -> Int64:
        """So many in each region, any as likely as the others there, and spread evenly; all if there are no more."""
        found = []
        for region in range(self.region_indices.max() + 1):
            there = np.flatnonzero(self.region_indices == region)
            if positions_per_region < len(there):
                # Rows of cells, for its sides are straight.
                rows = len(np.unique(self.vehicle_T_target[there, 1, 3]))
                down, along = generator.random(2)
                row = (np.arange(positions_per_region) + down) / positions_per_region * rows
                column = (np.arange(positions_per_region) * GOLDEN + along) % 1 * (len(there) // rows)
                there = there.reshape(rows, -1)[row.astype(np.int64), column.astype(np.int64)]
            found.append(there)
        return np.concatenate(found)


class NearFieldFrameSums(NamedTuple):
    """What one step adds, of each rig to `TargetSums`; it is small, and travels between processes."""

    block_index: int
    sums: Tensor
    position_counts: Tensor


class NearFieldObserver(BlockedSums):
    """What the rigs of a simulation see of bodies beside the vehicle: an observer that measures where frames are made.

    Args:
        simulator: The simulation.
        bodies: What is put there, one at a time and seen by nothing else.
        blocks: As in `CoverageMetric`.
        positions_per_region: Of each body in each region at a step: more of them make errors smaller, and move no number.
        frame_stride: Steps from one at which they are put to the next; likewise.
    """

    sums: Tensor
    position_counts: Tensor

    def __init__(
        self,
        simulator: Simulator,
        targets: Sequence[Target],
        num_blocks: int = 1,
        positions_per_region: int = PLACES,
        frame_stride: int = EVERY,
    ) -> None:
        vehicle = simulator.scenario.compute_ego_box()
        regions, around = build_near_field(vehicle.outline_m), Raster.from_vehicle(vehicle, NEAR_FIELD_M, MAP_CELL_M)
        names, rigs = tuple(body.name for body in targets), tuple(simulator.rigs)
        super().__init__(num_blocks, {"bodies": names, "regions": regions, "rigs": rigs, "blocks": num_blocks})
        self.simulator, self.positions_per_region, self.frame_stride, self.regions = (
            simulator,
            positions_per_region,
            frame_stride,
            regions,
        )
        self.grid = BevGrid(around.x_bounds_m, around.y_bounds_m, MAP_CELL_M)
        self.near_field_targets = [NearFieldTarget.from_target(body, vehicle, regions, self.grid) for body in targets]
        each = len(rigs), len(targets)
        self.define_block_sum("sums", (*each, len(regions), len(COLUMNS)), is_fine=True)
        self.define_sum("position_counts", (*each, self.grid.num_cells // len(self.grid.heights), 2))

    def update(self, frame: Frame) -> None:
        """Put them beside the vehicle at the time of a frame of the simulation."""
        self.add_sums(self.compute_sums(frame))

    def compute_sums(self, frame: Frame) -> NearFieldFrameSums | None:
        """What such a frame is to `add`, the same in every process; None where no body is put at its step."""
        if frame.index % self.frame_stride:
            return None
        simulator, index, seed = self.simulator, frame.index, self.simulator.seed
        generator = np.random.default_rng([seed, index, STREAM])
        stage, instant = simulator.prepare_frame(index)
        place_m = ReferenceContext(stage.scene_geometry, instant, generator, frame.name).sample_free_pose(
            sample_reference_pose
        )[0][:3, 3]
        sums, cells = np.zeros(self.sums.shape[1:]), np.zeros(self.position_counts.shape)
        ends = [[one.compute_ray_ends(instant) for one in mounted] for mounted in stage.sensors_by_rig.values()]
        for number, probe in enumerate(self.near_field_targets):
            some, box = probe.sample_positions(self.positions_per_region, generator), probe.target.solid.bounding_box
            vehicle_T_body = probe.vehicle_T_target[some]
            z_m, free = find_free_positions(instant, probe.target, probe.surface, vehicle_T_body)
            np.add.at(sums[:, number, :, TRIED].T, probe.region_indices[some], 1.0)
            some = some[room := free & probe.has_room[some]]
            vehicle_T_body, z_m = vehicle_T_body[room], z_m[room]
            visible = probe.surface.find_visible_samples(
                place_m, probe.target, set_pose_heights(vehicle_T_body, z_m), instant
            )
            for rig, mounted in enumerate(stage.sensors_by_rig.values()):
                held = np.any(
                    [is_point_inside(box, vehicle_T_body, one.vehicle_T_sensor[:3, 3]) for one in mounted], axis=0
                )
                step = TargetFrame(SensorFrame.from_ray_ends(ends[rig], seed, index), z_m, ~held, visible[None])
                seen = count_target_points(
                    probe.target,
                    probe.surface,
                    vehicle_T_body,
                    mounted,
                    [step],
                    detection_points=HITS,
                    threshold_m=THRESHOLD_M,
                )
                m2 = np.multiply(probe.surface.sample_area_m2, (seen.visible_samples, seen.detected_samples))
                each = np.stack([np.zeros(len(some)), seen.free_frames, seen.detected_frames, *m2], axis=1)
                np.add.at(sums[rig, number], probe.region_indices[some], each)
                np.add.at(cells[rig, number], probe.cell_indices[some], each[:, [FREE, SEEN]])
        return NearFieldFrameSums(simulator.get_block_index(index), torch.from_numpy(sums), torch.from_numpy(cells))

    def add_sums(self, frame_sums: NearFieldFrameSums | None) -> None:
        """Add what `sums_of` gives."""
        if frame_sums is not None:
            self._assign_block(frame_sums.block_index)
            self.sums[self._get_fine_block(frame_sums.block_index)] += frame_sums.sums
            self.position_counts += frame_sums.position_counts
            self.num_frames += 1
            self._handle_added_frames()

    def compute(self) -> Tensor:
        """(rigs, bodies, regions, 5) the sums so far, as those of a block of `TargetSums`."""
        return self.sums.sum(dim=0)

    def get_target_sums(self, rig_name: str) -> TargetSums:
        """What a rig saw of them so far."""
        bodies, at = (
            tuple(probe.target.name for probe in self.near_field_targets),
            list(self.simulator.rigs).index(rig_name),
        )
        cells = self.position_counts[at].view(len(bodies), *self.grid.shape[1:], 2).clone()
        told = bodies, self.regions, HITS, THRESHOLD_M, self.grid
        return TargetSums(*told, self.fine_block_frame_counts.clone(), self.sums[:, at].clone(), cells)
