"""Test targets at free positions in the near field of a simulated vehicle, evaluated while frames are simulated."""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage import NEAR_FIELD_M, BevGrid, Region, TargetSums
from torchcover.coverage.target_sums import TargetColumn
from torchcover.frames import Frame
from torchcover.geometry import BoundingBox, find_overlaps
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.metrics import BlockedSums
from torchcover.simulation.reference_sensor import ReferenceContext
from torchcover.simulation.regions_of_interest import build_near_field
from torchcover.simulation.simulator import Simulator
from torchcover.targets.counting import count_target_points
from torchcover.targets.placing import Raster, build_poses, compute_yaws_rad, is_point_inside, set_pose_heights
from torchcover.targets.surface import Target, TargetSurface
from torchcover.targets.target_frames import SensorFrame, TargetFrame, find_free_positions, sample_reference_pose
from torchcover.targets.visibility import DETECTION_POINTS, THRESHOLD_M


class NearFieldTarget(NamedTuple):
    """A test target and its N candidate positions: cells of the default raster whose centers are in a region.

    Args:
        target: The test target.
        surface: Sample points of its surface.
        region_indices: (N,) region of each position.
        has_room: (N,) False where the target would overlap the ego vehicle.
        vehicle_T_target: (N, 4, 4) poses; their heights are replaced by that of the ground.
        cell_indices: (N,) cell of the map of each position.
    """

    target: Target
    surface: TargetSurface
    region_indices: Int64
    has_room: Bools
    vehicle_T_target: Float64
    cell_indices: Int64

    @classmethod
    def from_target(cls, target: Target, vehicle_box: BoundingBox, regions: Sequence[Region], grid: BevGrid) -> Self:
        """Find the candidate positions of a target around a vehicle.

        Args:
            target: The test target; its narrow side faces the vehicle.
            vehicle_box: Bounding box of the vehicle in the vehicle frame.
            regions: Regions of the near field.
            grid: Cells of the map.

        Returns:
            The target and its positions.
        """
        positions_m = Raster.from_vehicle(vehicle_box, NEAR_FIELD_M).positions_m
        masks = [region.mask_points(*torch.from_numpy(positions_m).T).numpy() for region in regions]
        region_indices, position = np.stack(masks).nonzero()
        box = target.solid.bounding_box
        yaws_rad = compute_yaws_rad("narrow", box, vehicle_box, positions_m[position])
        vehicle_T_target = build_poses(positions_m[position], yaws_rad)
        has_room = ~find_overlaps(box, vehicle_T_target, vehicle_box.corners_m)
        cell_indices = grid.find_cells(torch.from_numpy(vehicle_T_target[:, :3, 3].copy())).numpy()
        surface = TargetSurface.from_target(target)
        return cls(target, surface, region_indices, has_room, vehicle_T_target, cell_indices)

    def sample_positions(self, positions_per_region: int, generator: np.random.Generator) -> Int64:
        """Sample positions uniformly and spread evenly over each region.

        Args:
            positions_per_region: Number of positions in each region; smaller regions are taken completely.
            generator: Source of the random numbers.

        Returns:
            Indices of the positions, region by region.
        """
        # Multiples of the golden ratio, modulo 1, are spread evenly for any number of positions.
        golden_ratio = (5**0.5 - 1) / 2
        samples = []
        for region in range(self.region_indices.max() + 1):
            candidates = np.flatnonzero(self.region_indices == region)
            if positions_per_region < len(candidates):
                # A region is a rectangle, and its candidates are sorted by row.
                num_rows = len(np.unique(self.vehicle_T_target[candidates, 1, 3]))
                row_offset, column_offset = generator.random(2)
                index = np.arange(positions_per_region)
                row = (index + row_offset) / positions_per_region * num_rows
                column = (index * golden_ratio + column_offset) % 1 * (len(candidates) // num_rows)
                candidates = candidates.reshape(num_rows, -1)[row.astype(np.int64), column.astype(np.int64)]
            samples.append(candidates)
        return np.concatenate(samples)


class NearFieldFrameSums(NamedTuple):
    """Contribution of one frame to the sums, small enough to be sent between processes.

    Args:
        block_index: Temporal block of the frame.
        sums: (rigs, targets, regions, 5) float64 as in `TargetSums.sums`.
        position_counts: (rigs, targets, cells, 2) float64 as in `TargetSums.position_counts`.
    """

    block_index: int
    sums: Tensor
    position_counts: Tensor


class NearFieldObserver(BlockedSums):
    """Observer that measures the visibility of test targets in the near field while frames are simulated.

    Args:
        simulator: The simulation.
        targets: Test targets; each is evaluated alone.
        num_blocks: Number of temporal blocks, as in `CoverageMetric`.
        positions_per_region: Positions of each target in each region per evaluated frame. More positions reduce the
            standard errors and do not change the expected result; 3 take about a tenth of the time of a run.
        frame_stride: Frames from one evaluated frame to the next; likewise.
    """

    sums: Tensor
    position_counts: Tensor

    def __init__(
        self,
        simulator: Simulator,
        targets: Sequence[Target],
        num_blocks: int = 1,
        positions_per_region: int = 3,
        frame_stride: int = 4,
    ) -> None:
        vehicle_box = simulator.scenario.compute_ego_box()
        regions = build_near_field(vehicle_box.outline_m)
        target_names, rig_names = tuple(target.name for target in targets), tuple(simulator.rigs)
        settings = {"targets": target_names, "regions": regions, "rigs": rig_names, "blocks": num_blocks}
        super().__init__(num_blocks, settings)
        self.simulator, self.regions = simulator, regions
        self.positions_per_region, self.frame_stride = positions_per_region, frame_stride
        map_cell_m = 1.0  # a cell has 25 positions of the default raster
        map_raster = Raster.from_vehicle(vehicle_box, NEAR_FIELD_M, map_cell_m)
        self.grid = BevGrid(map_raster.x_bounds_m, map_raster.y_bounds_m, map_cell_m)
        self.near_field_targets = [
            NearFieldTarget.from_target(target, vehicle_box, regions, self.grid) for target in targets
        ]
        sums_shape = len(rig_names), len(targets), len(regions), len(TargetColumn)
        self.define_block_sum("sums", sums_shape, is_fine=True)
        num_map_cells = self.grid.num_cells // len(self.grid.heights)
        self.define_sum("position_counts", (len(rig_names), len(targets), num_map_cells, 2))

    def update(self, frame: Frame) -> None:
        """Evaluate the targets at the time of a frame of the simulation.

        Args:
            frame: The frame.
        """
        self.add_sums(self.compute_sums(frame))

    def compute_sums(self, frame: Frame) -> NearFieldFrameSums | None:
        """Compute the contribution of a frame, which is the same in every process.

        Args:
            frame: Frame of the simulation.

        Returns:
            The sums; None for frames between the evaluated ones.
        """
        if frame.index % self.frame_stride:
            return None
        simulator, index, seed = self.simulator, frame.index, self.simulator.seed
        # A separate stream of random numbers: the streams of the sensors have smaller numbers.
        generator = np.random.default_rng([seed, index, 2**31])
        stage, snapshot = simulator.prepare_frame(index)
        context = ReferenceContext(stage.scene_geometry, snapshot, generator, frame.name)
        viewpoint_pose, _ = context.sample_free_pose(sample_reference_pose)
        sums, position_counts = np.zeros(self.sums.shape[1:]), np.zeros(self.position_counts.shape)
        rig_sensor_frames = []
        for mounted_sensors in stage.sensors_by_rig.values():
            ray_ends = [mounted.compute_ray_ends(snapshot) for mounted in mounted_sensors]
            rig_sensor_frames.append(SensorFrame.from_ray_ends(ray_ends, seed, index))
        for target_index, near_field in enumerate(self.near_field_targets):
            target, surface = near_field.target, near_field.surface
            samples = near_field.sample_positions(self.positions_per_region, generator)
            poses = near_field.vehicle_T_target[samples]
            z_m, is_free = find_free_positions(snapshot, target, surface, poses)
            np.add.at(sums[:, target_index, :, TargetColumn.TRIED].T, near_field.region_indices[samples], 1.0)
            is_free &= near_field.has_room[samples]
            samples, poses, z_m = samples[is_free], poses[is_free], z_m[is_free]
            visible_bits = surface.find_visible_samples(
                viewpoint_pose[:3, 3], target, set_pose_heights(poses, z_m), snapshot
            )
            for rig_index, mounted_sensors in enumerate(stage.sensors_by_rig.values()):
                has_sensor_inside = np.zeros(len(poses), dtype=bool)
                for mounted in mounted_sensors:
                    sensor_position_m = mounted.vehicle_T_sensor[:3, 3]
                    has_sensor_inside |= is_point_inside(target.solid.bounding_box, poses, sensor_position_m)
                target_frame = TargetFrame(rig_sensor_frames[rig_index], z_m, ~has_sensor_inside, visible_bits[None])
                target_sums = count_target_points(
                    target, surface, poses, mounted_sensors, [target_frame],
                    detection_points=DETECTION_POINTS, threshold_m=THRESHOLD_M,
                )  # fmt: skip
                visible_m2 = surface.sample_area_m2 * target_sums.visible_samples
                detected_m2 = surface.sample_area_m2 * target_sums.detected_samples
                tried = np.zeros(len(samples))  # counted above, for all rigs
                columns = [tried, target_sums.free_frames, target_sums.detected_frames, visible_m2, detected_m2]
                rows = np.stack(columns, axis=1)
                np.add.at(sums[rig_index, target_index], near_field.region_indices[samples], rows)
                cells = near_field.cell_indices[samples]
                np.add.at(
                    position_counts[rig_index, target_index], cells, rows[:, [TargetColumn.FREE, TargetColumn.DETECTED]]
                )
        block_index = simulator.get_block_index(index)
        return NearFieldFrameSums(block_index, torch.from_numpy(sums), torch.from_numpy(position_counts))

    def add_sums(self, frame_sums: NearFieldFrameSums | None) -> None:
        """Add the contribution of a frame.

        Args:
            frame_sums: Result of `compute_sums`; None adds nothing.
        """
        if frame_sums is not None:
            self._assign_block(frame_sums.block_index)
            self.sums[self._get_fine_block(frame_sums.block_index)] += frame_sums.sums
            self.position_counts += frame_sums.position_counts
            self.num_frames += 1
            self._handle_added_frames()

    def compute(self) -> Tensor:
        """Compute the sums over all blocks: (rigs, targets, regions, 5) float64, as in `TargetSums.sums`."""
        return self.sums.sum(dim=0)

    def get_target_sums(self, rig_name: str) -> TargetSums:
        """Get the sums of one rig.

        Args:
            rig_name: Name of the rig in the simulation.

        Returns:
            The sums in fine blocks, and the counts on the map.
        """
        target_names = tuple(near_field.target.name for near_field in self.near_field_targets)
        rig_index = list(self.simulator.rigs).index(rig_name)
        map_shape = len(target_names), *self.grid.shape[1:], 2
        return TargetSums(
            target_names,
            self.regions,
            DETECTION_POINTS,
            THRESHOLD_M,
            self.grid,
            self.fine_block_frame_counts.clone(),
            self.sums[:, rig_index].clone(),
            self.position_counts[rig_index].view(map_shape).clone(),
        )
