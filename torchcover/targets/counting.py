"""Points that a rig measures on a test target at each target position.

The rays are cast at the target alone; the ranges at which they end in the scene without the target decide which of them
reach it.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import torch

from torchcover.geometry.arrays import Float32, Float64, Int32, Int64
from torchcover.simulation.culling import compute_outlines
from torchcover.simulation.mounted_sensor import MountedSensor, RayEnds
from torchcover.simulation.moving_bodies import MovingBodies
from torchcover.simulation.rays import rotate
from torchcover.simulation.scene_snapshot import run_in_threads
from torchcover.simulation.sensor import RayHits
from torchcover.targets.placing import set_pose_heights
from torchcover.targets.surface import PackedBits, Target, TargetSurface
from torchcover.targets.target_frames import SensorFrame, TargetFrame

# Positions that are evaluated together; independent of the number of threads, so that results are, too.
CHUNK_SIZE = 128


class TargetVisibilitySums(NamedTuple):
    """Sums over the frames in which the target has room, for P positions.

    Args:
        sensor_points: (S, P) points of each sensor on the target.
        detecting_sensors: (P,) sensors with enough points, added up over the frames.
        detected_frames: (P,) frames in which all sensors together have enough points.
        free_frames: (P,) frames in which the target has room.
        visible_samples: (P,) pairs of a viewpoint and a sample point that is visible from it.
        detected_samples: (P,) the visible pairs whose sample point is within the threshold of a measured point.
        min_points: (P,) minimum over the frames of the points of all sensors; the largest int64 without a free frame.
        min_sensors: (P,) minimum over the frames of the sensors with enough points; likewise.
    """

    sensor_points: Int64
    detecting_sensors: Int64
    detected_frames: Int64
    free_frames: Int64
    visible_samples: Int64
    detected_samples: Int64
    min_points: Int64
    min_sensors: Int64

    @classmethod
    def create_empty(cls, num_sensors: int, num_positions: int) -> Self:
        """Create the sums over no frames for a number of sensors and positions."""
        zeros = np.zeros((5, num_positions), dtype=np.int64)
        maxima = np.full((2, num_positions), np.iinfo(np.int64).max)
        return cls(np.zeros((num_sensors, num_positions), dtype=np.int64), *zeros, *maxima)

    def add_frame(self, frame: TargetFrame, points: Int64, detected_bits: PackedBits, detection_points: int) -> None:
        """Add one frame in place.

        Args:
            frame: The frame.
            points: (S, P) points of each sensor on the target.
            detected_bits: (P, M / 8) packed bits of the sample points within the threshold of a measured point.
            detection_points: Points that are enough to detect the target.
        """
        is_free, total_points = frame.free_mask, points.sum(axis=0)
        sensors = (points >= detection_points).sum(axis=0)
        self.sensor_points[:] += points * is_free
        self.detecting_sensors[:] += sensors * is_free
        self.detected_frames[:] += (total_points >= detection_points) & is_free
        self.min_points[is_free] = np.minimum(self.min_points, total_points)[is_free]
        self.min_sensors[is_free] = np.minimum(self.min_sensors, sensors)[is_free]
        self.free_frames[:] += is_free
        self.visible_samples[:] += count_bits(frame.visible_bits) * is_free
        self.detected_samples[:] += count_bits(frame.visible_bits & detected_bits) * is_free


class TargetHits(NamedTuple):
    """Hits of the rays of one sensor on a target without occlusion, in the order of positions and rays.

    Args:
        position_indices: (N,) target position of each hit.
        ray_indices: (N,) ray of the sensor.
        ranges_m: (N,) range.
        triangle_indices: (N,) face of the target.
        directions: (N, 3) direction of the ray in the vehicle frame.
    """

    position_indices: Int64
    ray_indices: Int64
    ranges_m: Float32
    triangle_indices: Int32
    directions: Float32

    def compute_points_m(self, vehicle_T_sensor: Float64, vehicle_T_target: Float64) -> Float64:
        """Compute the hit points in the frame of the target.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            vehicle_T_target: (P, 4, 4) poses of the target.

        Returns:
            (N, 3) points in meters.
        """
        points_m = vehicle_T_sensor[:3, 3] + self.directions * self.ranges_m.astype(np.float64)[:, None]
        points_m -= vehicle_T_target[self.position_indices, :3, 3]
        return np.asarray(np.einsum("nji,nj->ni", vehicle_T_target[self.position_indices, :3, :3], points_m))


class SensorBeams(NamedTuple):
    """Groups of rays that a sensor measures together, such as the resolution cells of a radar.

    Args:
        beam_indices: (rays,) beam of each ray.
        rays_by_beam: (rays,) all rays, sorted by beam, then by ray.
        beam_offsets: (beams + 1,) position in `rays_by_beam` at which the rays of each beam begin.
    """

    beam_indices: Int64
    rays_by_beam: Int64
    beam_offsets: Int64

    @classmethod
    def from_sensor(cls, mounted_sensor: MountedSensor) -> Self | None:
        """Group the rays of a sensor; None if it measures each ray on its own."""
        pixel_beams = mounted_sensor.sensor.compute_beam_indices()
        if pixel_beams is None:
            return None
        beam_indices = pixel_beams.ravel()[mounted_sensor.ray_pixel_indices]
        offsets = np.concatenate([[0], np.cumsum(np.bincount(beam_indices))])
        return cls(beam_indices, np.argsort(beam_indices, kind="stable"), offsets)

    def fill_beams(self, hits: RayHits, ray_ends: RayEnds) -> tuple[RayHits, Int64]:
        """Complete hits on a target by the hits of the same beams on the scene behind and next to it.

        Args:
            hits: N hits on the target, sorted by position, then by ray.
            ray_ends: Ray ends without the target.

        Returns:
            M hits, sorted by position, beam and ray; (M,) index of each in the N hits, -1 if it is not on the target.

        Raises:
            ValueError: The hits have no positions.
        """
        if hits.position_indices is None:
            raise ValueError("position_indices of the hits are missing; pass hits of `TargetHits`")
        num_rays, num_beams = len(self.beam_indices), len(self.beam_offsets) - 1
        beam_keys = np.unique(hits.position_indices * num_beams + self.beam_indices[hits.ray_indices])
        position, beam = np.divmod(beam_keys, num_beams)
        # Enumerate all rays of these beams.
        num_beam_rays = np.diff(self.beam_offsets)[beam]
        output_offsets = np.cumsum(num_beam_rays) - num_beam_rays
        shift = (self.beam_offsets[beam] - output_offsets).repeat(num_beam_rays)
        ray = self.rays_by_beam[np.arange(num_beam_rays.sum()) + shift]
        position = position.repeat(num_beam_rays)
        # Find the rays that hit the target.
        target_keys, keys = hits.position_indices * num_rays + hits.ray_indices, position * num_rays + ray
        hit_index = np.minimum(np.searchsorted(target_keys, keys), len(target_keys) - 1)
        hit_index = np.where(target_keys[hit_index] == keys, hit_index, -1)
        is_on_target = hit_index >= 0
        range_m = ray_ends.range_m[ray]
        range_m[is_on_target] = hits.range_m[hit_index[is_on_target]]
        is_hit = np.flatnonzero(is_on_target | ray_ends.is_hit[ray])
        filled = RayHits(ray[is_hit], range_m[is_hit], hits.ray_pixel_indices, position[is_hit])
        return filled, hit_index[is_hit]


class PlacedTarget(NamedTuple):
    """Hits on a target at P positions on the ground; valid for all frames with the same heights of the ground.

    Args:
        bodies: P copies of the target.
        hits: Hits of each sensor.
        nearby_bits: Packed bits of the sample points within the threshold of each hit, for each sensor.
    """

    bodies: MovingBodies
    hits: Sequence[TargetHits]
    nearby_bits: Sequence[PackedBits]


class TargetPointCounter(NamedTuple):
    """Measurement of a test target by a rig.

    Args:
        target: The test target.
        surface: Sample points of its surface.
        mounted_sensors: Sensors of the rig.
        max_ranges_m: For each sensor (rays,) largest range of each ray in any frame.
        beams: Beams of each sensor; None for sensors that measure each ray on its own.
        detection_points: Points that are enough to detect the target.
        threshold_m: Largest distance from a measured point at which a sample point counts as detected, and largest
            range error of a point that counts.
    """

    target: Target
    surface: TargetSurface
    mounted_sensors: Sequence[MountedSensor]
    max_ranges_m: Sequence[Float32]
    beams: Sequence[SensorBeams | None]
    detection_points: int
    threshold_m: float

    def place_target(self, vehicle_T_target: Float64) -> PlacedTarget:
        """Cast the rays of all sensors at the target at (P, 4, 4) poses."""
        geometries = [self.target.solid] * len(vehicle_T_target)
        # -1: the copies are no bodies of the scene.
        bodies = MovingBodies.from_geometries(geometries, vehicle_T_target, np.full(len(geometries), -1))
        sensor_hits, nearby_bits = [], []
        for mounted_sensor, max_ranges_m in zip(self.mounted_sensors, self.max_ranges_m, strict=True):
            hits = find_target_hits(bodies, mounted_sensor, max_ranges_m)
            points_m = hits.compute_points_m(mounted_sensor.vehicle_T_sensor, vehicle_T_target)
            sensor_hits.append(hits)
            nearby_bits.append(self.surface.find_nearby_samples(points_m, self.threshold_m))
        return PlacedTarget(bodies, sensor_hits, nearby_bits)

    def add_frame(self, sums: TargetVisibilitySums, frame: TargetFrame, placed: PlacedTarget) -> None:
        """Add the points of one frame to the sums of the same positions, in place."""
        num_positions = len(placed.bodies)
        points = np.zeros_like(sums.sensor_points)
        detected_bits = np.zeros((num_positions, frame.visible_bits.shape[2]), dtype=np.uint8)
        for index, mounted_sensor in enumerate(self.mounted_sensors):
            hits, sensor_frame = placed.hits[index], frame.sensor_frames[index]
            measured = find_measured_hits(
                mounted_sensor, self.beams[index], hits, sensor_frame, placed.bodies, self.threshold_m
            )
            position = hits.position_indices[measured]
            counts = np.bincount(position, minlength=num_positions)
            points[index] = mounted_sensor.sensor.pixels_per_sample * counts
            first = np.flatnonzero(np.diff(position, prepend=-1))  # positions ascend
            if len(first):
                nearby_bits = placed.nearby_bits[index][measured]
                detected_bits[position[first]] |= np.bitwise_or.reduceat(nearby_bits, first, axis=0)
        sums.add_frame(frame, points, detected_bits, self.detection_points)


def count_bits(bits: PackedBits) -> Int64:
    """Count the set bits of (V, P, bytes) packed bits over viewpoints and bytes: (P,) counts."""
    return np.asarray(np.unpackbits(bits, axis=2).sum(axis=(0, 2), dtype=np.int64))


def count_target_points(
    target: Target,
    surface: TargetSurface,
    vehicle_T_target: Float64,
    mounted_sensors: Sequence[MountedSensor],
    frames: Sequence[TargetFrame],
    *,
    detection_points: int,
    threshold_m: float,
) -> TargetVisibilitySums:
    """Count the points of a rig on a target at P positions.

    Args:
        target: The test target.
        surface: Sample points of its surface.
        vehicle_T_target: (P, 4, 4) poses of the target; their heights are replaced by that of the ground in each frame.
        mounted_sensors: Sensors that count.
        frames: Frames whose `sensor_frames` are those of the sensors.
        detection_points: Points that are enough to detect the target.
        threshold_m: Largest distance from a measured point at which a sample point counts as detected.

    Returns:
        Sums over the frames; they do not depend on the number of threads.
    """
    max_ranges_m = []
    for index in range(len(mounted_sensors)):
        frame_ranges_m = [frame.sensor_frames[index].ray_ends.range_m for frame in frames]
        max_ranges_m.append(np.max(frame_ranges_m, axis=0))
    beams = [SensorBeams.from_sensor(mounted_sensor) for mounted_sensor in mounted_sensors]
    counter = TargetPointCounter(target, surface, mounted_sensors, max_ranges_m, beams, detection_points, threshold_m)

    def count_chunk(first: int) -> TargetVisibilitySums:
        chunk = slice(first, first + CHUNK_SIZE)
        poses = vehicle_T_target[chunk]
        sums = TargetVisibilitySums.create_empty(len(mounted_sensors), len(poses))
        placed: PlacedTarget | None = None
        for frame in frames:
            z_m = frame.ground_z_m[chunk]
            if placed is None or not np.array_equal(placed.bodies.vehicle_T_part[:, 2, 3], z_m):
                placed = counter.place_target(set_pose_heights(poses, z_m))
            chunk_frame = TargetFrame(frame.sensor_frames, z_m, frame.free_mask[chunk], frame.visible_bits[:, chunk])
            counter.add_frame(sums, chunk_frame, placed)
        return sums

    first_positions = range(0, max(len(vehicle_T_target), 1), CHUNK_SIZE)
    chunk_sums = run_in_threads(torch.get_num_threads(), count_chunk, first_positions)
    return TargetVisibilitySums._make(np.concatenate(column, axis=-1) for column in zip(*chunk_sums, strict=True))


def find_target_hits(placed_bodies: MovingBodies, mounted_sensor: MountedSensor, max_ranges_m: Float32) -> TargetHits:
    """Find the hits of the rays of a sensor on bodies, each tested alone.

    Args:
        placed_bodies: The bodies at their positions.
        mounted_sensor: The sensor.
        max_ranges_m: (rays,) largest range of a hit on each ray.

    Returns:
        The hits, sorted by body and ray.
    """
    origin_m, vehicle_R_sensor = mounted_sensor.vehicle_T_sensor[:3, 3], mounted_sensor.vehicle_T_sensor[:3, :3]
    outlines = compute_outlines(placed_bodies.box_corners_m, origin_m)
    first_ray, tile_hits = 0, []
    for tile in mounted_sensor.tiles:
        num_rays = tile.directions.shape[1]
        directions = rotate(vehicle_R_sensor, tile.directions)
        limits_m = max_ranges_m[first_ray : first_ray + num_rays]
        hits, _ = placed_bodies.find_body_hits(origin_m, vehicle_R_sensor, tile, directions, limits_m, outlines)
        hit_directions = directions.take(hits.ray_indices, axis=1).T
        ray_indices = first_ray + hits.ray_indices
        tile_hits.append(
            TargetHits(hits.part_indices, ray_indices, hits.range_m, hits.triangle_indices, hit_directions)
        )
        first_ray += num_rays
    all_hits = TargetHits._make(np.concatenate(column) for column in zip(*tile_hits, strict=True))
    # A ray that pads the block of a tile is cast more than once.
    _, unique = np.unique(all_hits.position_indices * first_ray + all_hits.ray_indices, return_index=True)
    return TargetHits._make(column[unique] for column in all_hits)


def find_measured_hits(
    mounted_sensor: MountedSensor,
    beams: SensorBeams | None,
    target_hits: TargetHits,
    sensor_frame: SensorFrame,
    placed_bodies: MovingBodies,
    max_error_m: float,
) -> Int64:
    """Find the hits on a target that a sensor measures: not occluded, returned, and with a small range error.

    Where the rays of a beam are measured together, the beam may measure the background next to the target instead.

    Args:
        mounted_sensor: The sensor.
        beams: Its beams; None if it measures each ray on its own.
        target_hits: N hits on the target alone.
        sensor_frame: Ray ends without the target, and random numbers.
        placed_bodies: The target at its positions.
        max_error_m: Largest range error.

    Returns:
        Ascending indices of the measured hits.
    """
    reached = np.flatnonzero(target_hits.ranges_m <= sensor_frame.ray_ends.range_m[target_hits.ray_indices])
    hits = RayHits(
        target_hits.ray_indices[reached],
        target_hits.ranges_m[reached],
        mounted_sensor.ray_pixel_indices,
        target_hits.position_indices[reached],
        lambda: placed_bodies.compute_hit_attributes(
            target_hits.position_indices[reached],
            target_hits.triangle_indices[reached],
            target_hits.directions[reached].T,
        ),
        mounted_sensor.weather,
    )
    hit_index = np.arange(len(reached))
    if beams is not None:
        hits, hit_index = beams.fill_beams(hits, sensor_frame.ray_ends)
    returned, error_m = mounted_sensor.sensor.measure(hits, sensor_frame.noise)
    if returned is not None:
        hit_index = hit_index[returned]
    is_measured = hit_index >= 0
    if error_m is not None:
        is_measured &= np.abs(error_m) <= max_error_m
    return reached[hit_index[is_measured]]
