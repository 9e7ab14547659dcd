"""Frames in which a test target is evaluated: ray ends without the target, free positions, and visible surface."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchcover.geometry import BoundingBox, build_transform
from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.mounted_rigs import MountedRigStore, SceneStore
from torchcover.simulation.mounted_sensor import MountedSensor, RayEnds
from torchcover.simulation.reference_sensor import ReferenceContext, sample_position_in_shell
from torchcover.simulation.rig import Rig
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene_geometry import SceneGeometry
from torchcover.simulation.scene_snapshot import SceneSnapshot
from torchcover.simulation.sensor import SensorNoise
from torchcover.targets.placing import compute_ground_heights_m, is_blocked, set_pose_heights
from torchcover.targets.surface import NUM_SAMPLES, PackedBits, Target, TargetSurface

# Viewpoints of a run from which the visible surface of a target is estimated; each frame has at least one.
NUM_VIEWPOINTS = 8


class SensorFrame(NamedTuple):
    """Rays of one sensor in one frame without a target.

    Args:
        ray_ends: Ranges at which the rays end.
        noise: Random numbers of each ray.
    """

    ray_ends: RayEnds
    noise: SensorNoise

    @classmethod
    def from_ray_ends(cls, ray_ends: Sequence[RayEnds], seed: int, frame_index: int) -> "list[SensorFrame]":
        """Create the frames of all sensors of a rig; a ray has the same error and drop-out at all target positions.

        Args:
            ray_ends: Ray ends of each sensor.
            seed: Seed of the run.
            frame_index: Index of the frame.

        Returns:
            One frame for each sensor.
        """
        sensor_frames = []
        for number, ends in enumerate(ray_ends, 1):
            rng = np.random.default_rng([seed, frame_index, number])
            sensor_frames.append(cls(ends, SensorNoise(rng, num_rays=len(ends.range_m))))
        return sensor_frames


class TargetFrame(NamedTuple):
    """Frame without the target, and the P positions at which the target is evaluated in it.

    Args:
        sensor_frames: Rays of each sensor of the rig.
        ground_z_m: (P,) height of the ground in the vehicle frame.
        free_mask: (P,) True where there is ground, and room for the target.
        visible_bits: (V, P, M / 8) packed bits of the sample points that are visible from each of V viewpoints.
    """

    sensor_frames: Sequence[SensorFrame]
    ground_z_m: Float64
    free_mask: Bools
    visible_bits: PackedBits


class TargetFrames:
    """Frames of a run, created one after the other.

    Args:
        rig: The sensors.
        scenario: The scenario without the target.
        target: The test target.
        surface: Sample points of its surface.
        vehicle_T_target: (P, 4, 4) poses of the target, whose heights are replaced by that of the ground.
        num_frames: Number of frames.
        frame_stride: Time steps of the scenario from one frame to the next.
        seed: Seed of traffic, viewpoints, noise and drop-out.
    """

    def __init__(
        self,
        rig: Rig,
        scenario: Scenario,
        target: Target,
        surface: TargetSurface,
        vehicle_T_target: Float64,
        *,
        num_frames: int,
        frame_stride: int,
        seed: int,
    ) -> None:
        self._scenario, self._target, self._surface, self._poses = scenario, target, surface, vehicle_T_target
        self._num_frames, self._frame_stride, self._seed = num_frames, frame_stride, seed
        self.viewpoints_per_frame = max(1, -(-NUM_VIEWPOINTS // num_frames))
        self._rig_name = rig.name
        self._stages = MountedRigStore(SceneStore(scenario, seed), {rig.name: rig})
        max_distances_m = [float(np.linalg.norm(vehicle_T_target[:, :3, 3], axis=1).max(initial=0.0))]
        max_distances_m[0] += target.solid.reach_m
        for sensor in rig.sensors:
            mount_distance_m = float(np.linalg.norm(sensor.mount.to_matrix()[:3, 3]))
            max_distances_m.append(mount_distance_m + scenario.compute_max_range_m(sensor))
        self._max_distance_m = max(max_distances_m)

    @property
    def mounted_sensors(self) -> Sequence[MountedSensor]:
        """Sensors of the rig; their rays are the same in all frames."""
        return self._stages.get_mounted_rigs(self._scenario.locate(0)[0]).sensors_by_rig[self._rig_name]

    def __iter__(self) -> Iterator[TargetFrame]:
        """Iterate over the frames.

        Raises:
            FileNotFoundError: A mesh, vehicle or trajectory file is missing.
            ValueError: A sensor or an actor is at an impossible position.
        """
        static_result: tuple[list[RayEnds], Float64, Bools] | None = None
        for frame_index in range(self._num_frames):
            run, step = self._scenario.locate(frame_index * self._frame_stride)
            stage = self._stages.get_mounted_rigs(run)
            snapshot = stage.scene_geometry.get_snapshot(step, max_distance_m=self._max_distance_m)
            stage.check_mounts(snapshot)
            if static_result is None:
                ray_ends = [mounted.compute_ray_ends(snapshot) for mounted in stage.sensors_by_rig[self._rig_name]]
                ground_z_m, is_free = find_free_positions(snapshot, self._target, self._surface, self._poses)
            else:  # nothing has moved since the first frame
                ray_ends, ground_z_m, is_free = static_result
            if not stage.scene_geometry.has_motion and self._scenario.is_repeating:
                static_result = ray_ends, ground_z_m, is_free
            poses = set_pose_heights(self._poses, ground_z_m)
            visible_bits = self._find_visible_samples(stage.scene_geometry, snapshot, poses, frame_index)
            sensor_frames = SensorFrame.from_ray_ends(ray_ends, self._seed, frame_index)
            yield TargetFrame(sensor_frames, ground_z_m, is_free, visible_bits)

    def _find_visible_samples(
        self, scene: SceneGeometry, snapshot: SceneSnapshot, vehicle_T_target: Float64, frame_index: int
    ) -> PackedBits:
        """Find the surface samples that are visible from each sampled viewpoint: (V, P, M / 8) packed bits."""
        rng = np.random.default_rng([self._seed, frame_index])
        frame_name = f"{self._scenario.name} frame {frame_index}"
        context = ReferenceContext(scene, snapshot, rng, frame_name, torch.get_num_threads())
        visible_bits = np.empty((self.viewpoints_per_frame, len(vehicle_T_target), NUM_SAMPLES // 8), dtype=np.uint8)
        for viewpoint_bits in visible_bits:
            viewpoint, _ = context.sample_free_pose(sample_reference_pose)
            for chunk in split_into_chunks(len(vehicle_T_target)):
                viewpoint_bits[chunk] = self._surface.find_visible_samples(
                    viewpoint[:3, 3], self._target, vehicle_T_target[chunk], snapshot, num_threads=context.num_threads
                )
        return visible_bits


def find_free_positions(
    snapshot: SceneSnapshot, target: Target, surface: TargetSurface, vehicle_T_target: Float64
) -> tuple[Float64, Bools]:
    """Find the ground below target positions, and the positions with room for the target.

    Args:
        snapshot: Scene without the target.
        target: The test target.
        surface: Sample points of its surface.
        vehicle_T_target: (P, 4, 4) poses; their heights are replaced by that of the ground.

    Returns:
        (P,) height of the ground in the vehicle frame, 0 where there is none; (P,) True where there is ground and the
        target has room on it.
    """
    z_m = compute_ground_heights_m(snapshot, vehicle_T_target[:, :2, 3])
    is_free, z_m = np.isfinite(z_m), np.nan_to_num(z_m)
    poses = set_pose_heights(vehicle_T_target, z_m)
    for chunk in split_into_chunks(len(poses)):
        is_free[chunk] &= ~is_blocked(snapshot, target.solid.bounding_box, surface.points_m, poses[chunk])
    return z_m, is_free


def sample_reference_pose(ego_box: BoundingBox, rng: np.random.Generator) -> Float64:
    """Sample the (4, 4) pose of a reference sensor within 0.5 m around the ego vehicle, as `PaperReference` does."""
    return build_transform(np.eye(3), sample_position_in_shell(ego_box, 0.5, rng))


def split_into_chunks(num_positions: int, chunk_size: int = 4096) -> list[slice]:
    """Split positions into chunks whose rays fit into memory."""
    return [slice(first, first + chunk_size) for first in range(0, num_positions, chunk_size)]
