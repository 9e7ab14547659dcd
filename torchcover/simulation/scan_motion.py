"""Scans that take time: ray casting while the vehicle and the bodies around it move.

In the vehicle frame the rays stay unchanged and everything else moves: static geometry by the inverse motion of the
vehicle, each body by its pose in the vehicle frame. Poses are sampled at three times and interpolated for each ray,
which costs hardly more than casting all rays at one time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.culling import SLACK_M, BoxOutlines, compute_outlines
from torchcover.simulation.moving_bodies import BodyHits, MovingBodies
from torchcover.simulation.raycaster import Hits, RayCaster, cast_from_vehicle
from torchcover.simulation.rays import Tile, rotate, rotate_each

# Poses at the begin, middle and end of a scan: a parabola, whose error grows with the cube of the rotation in a scan.
NUM_SAMPLES = 3


class RayTimes(NamedTuple):
    """Times at which the rays of a tile are cast, relative to the time of the frame.

    Args:
        times_s: (g,) float64 times, ascending.
        time_indices: (n,) int64 index of the time of each ray.
    """

    times_s: Float64
    time_indices: Int64


class BodyPoses(NamedTuple):
    """Poses of all bodies at one time.

    Args:
        static_T_vehicle: (4, 4) pose of the vehicle in the frame of the static bodies.
        vehicle_T_part: (P, 4, 4) poses of the moving bodies in the vehicle frame.
    """

    static_T_vehicle: Float64
    vehicle_T_part: Float64


# Begin and end relative to the time of a frame in seconds -> (3,) sample times within them, and the poses at each.
MotionSampler = Callable[[float, float], tuple[Float64, Sequence[BodyPoses]]]


def sample_no_motion(*_: float) -> tuple[Float64, Sequence[BodyPoses]]:
    """Return no poses, for a frame without information about motion."""
    return np.zeros(NUM_SAMPLES), ()


class SweptHits(NamedTuple):
    """Hits of the n rays of a tile that are cast at different times.

    Args:
        hits: Hit of each ray.
        directions: (3, n) float32 directions in the vehicle frame at the time of the frame.
        starts_m: (3, n) float32 origins in the same frame, or (3, 1) for one common origin.
        moving_ray_indices: (K,) rays that hit a moving body other than the ego vehicle.
        moving_points_m: (K, 3) float32 positions of these hits at the time of the frame: they move with their body.
        num_body_casts: Number of pairs of a ray and a moving body that were cast.
    """

    hits: Hits
    directions: Float32
    starts_m: Float32
    moving_ray_indices: Int64
    moving_points_m: Float32
    num_body_casts: int


@dataclass(frozen=True, eq=False)
class ScanMotion:
    """Motion of vehicle and bodies during a scan.

    Args:
        static_caster: Static bodies.
        current_poses: Poses at the time of the frame.
        moving_bodies: P moving bodies.
        sample_times_s: (3,) sample times relative to the time of the frame.
        static_T_vehicle: (3, 4, 4) pose of the vehicle at each sample.
        part_T_vehicle: (3, P, 4, 4) vehicle in the frame of each body at each sample.
        box_corners_m: (P, 24, 3) corners of boxes around the bodies in the vehicle frame at all samples.
    """

    static_caster: RayCaster
    current_poses: BodyPoses
    moving_bodies: MovingBodies
    sample_times_s: Float64
    static_T_vehicle: Float64
    part_T_vehicle: Float64
    box_corners_m: Float64

    @classmethod
    def from_poses(
        cls,
        static_caster: RayCaster,
        current_poses: BodyPoses,
        moving_bodies: MovingBodies,
        sample_times_s: Float64,
        poses: Sequence[BodyPoses],
    ) -> Self | None:
        """Build the motion from sampled poses.

        Args:
            static_caster: Static bodies.
            current_poses: Poses at the time of the frame.
            moving_bodies: P moving bodies.
            sample_times_s: (3,) sample times relative to the time of the frame.
            poses: Poses at these times.

        Returns:
            The motion; None if nothing moves during the scan.
        """
        is_static = True
        for sample in poses:
            is_static &= all(np.array_equal(pose, now) for pose, now in zip(sample, current_poses, strict=True))
        if is_static:
            return None
        part_T_vehicle = np.stack([invert(sample.vehicle_T_part) for sample in poses])
        # Boxes of the current time, moved to the vehicle frame of each sample.
        sample_corners_m = []
        for sample in poses:
            motion = sample.vehicle_T_part @ moving_bodies.part_T_vehicle
            rotated_m = moving_bodies.box_corners_m @ motion[:, :3, :3].swapaxes(1, 2)
            sample_corners_m.append(rotated_m + motion[:, None, :3, 3])
        corners_m = np.stack(sample_corners_m)
        # Between the samples a corner deviates from the straight line by at most half its second difference.
        margin_m = SLACK_M + np.abs(np.diff(corners_m, n=2, axis=0)).max(axis=(0, 2, 3), initial=0.0) / 2
        outwards_m = np.sign(moving_bodies.box_corners_m - moving_bodies.center_m[:, None]) * margin_m[:, None, None]
        static_T_vehicle = np.stack([sample.static_T_vehicle for sample in poses])
        return cls(
            static_caster,
            current_poses,
            moving_bodies,
            sample_times_s,
            static_T_vehicle,
            part_T_vehicle,
            np.concatenate(list(corners_m + outwards_m), axis=1),
        )

    def compute_outlines(self, origin_m: Float64) -> BoxOutlines:
        """Compute the bounding planes of the moving bodies during the whole scan, seen from a (3,) sensor position."""
        return compute_outlines(self.box_corners_m, origin_m)

    def cast(
        self,
        vehicle_T_sensor: Float64,
        tile: Tile,
        ray_times: RayTimes,
        limit_m: Float32,
        outlines: BoxOutlines,
        ego_index: int,
        ego_hit_range_m: Float32 | None,
    ) -> SweptHits:
        """Cast each ray of a tile at its time.

        Args:
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.
            tile: n rays.
            ray_times: Time of each ray.
            limit_m: (n,) largest range of each ray, finite.
            outlines: Result of `compute_outlines` for the position of the sensor.
            ego_index: Scene index of the ego vehicle.
            ego_hit_range_m: (n,) range at which each ray hits the ego vehicle; None to cast at the ego vehicle as well.
        """
        origin_m, vehicle_R_sensor = vehicle_T_sensor[:3, 3], vehicle_T_sensor[:3, :3]
        time_indices = ray_times.time_indices
        directions = rotate(vehicle_R_sensor, tile.directions)
        if ego_hit_range_m is not None:
            limit_m = np.minimum(limit_m, ego_hit_range_m)
        weights = compute_parabola_weights(self.sample_times_s, ray_times.times_s)
        hits, current_directions, starts_m = self._cast_at_static(weights, time_indices, origin_m, directions, limit_m)
        if ego_hit_range_m is not None:
            hits.body_indices[(hits.body_indices < 0) & (ego_hit_range_m <= limit_m)] = ego_index
        static_range_m = hits.range_m
        # Known hits on the ego vehicle need no further casts.
        excluded_body = None if ego_hit_range_m is None else ego_index
        parts, rays = self.moving_bodies.find_candidate_pairs(
            vehicle_R_sensor, tile, directions, static_range_m, outlines, excluded_body=excluded_body
        )
        if len(rays):
            pair_T_vehicle = self._interpolate_part_poses(weights[time_indices[rays]], parts)
            pair_starts_m = (pair_T_vehicle[:, :3, :3] @ origin_m + pair_T_vehicle[:, :3, 3]).astype(np.float32)
            pair_directions = rotate_each(pair_T_vehicle[:, :3, :3].astype(np.float32), directions.take(rays, axis=1))
            pair_hits = self.moving_bodies.cast_pairs(parts, pair_starts_m, pair_directions, static_range_m[rays])
            is_hit = pair_hits.body_indices >= 0
            body_hits = BodyHits(
                parts[is_hit], rays[is_hit], pair_hits.range_m[is_hit], pair_hits.triangle_indices[is_hit]
            )
            self.moving_bodies.update_nearest_hits(hits, body_hits)
        # A hit on a moving body is reported where that point of the body is at the time of the frame.
        is_on_body = (hits.body_indices >= self.static_caster.num_bodies) & (hits.body_indices != ego_index)
        moving_rays = np.flatnonzero(is_on_body)
        hit_parts = np.searchsorted(self.moving_bodies.body_indices, hits.body_indices[moving_rays])
        vehicle_points_m = origin_m + (directions[:, moving_rays] * hits.range_m[moving_rays]).T
        part_poses = self._interpolate_part_poses(weights[time_indices[moving_rays]], hit_parts)
        part_points_m = _transform_each(part_poses, vehicle_points_m)
        moving_points_m = _transform_each(self.current_poses.vehicle_T_part[hit_parts], part_points_m)
        return SweptHits(hits, current_directions, starts_m, moving_rays, moving_points_m.astype(np.float32), len(rays))

    def _cast_at_static(
        self, weights: Float64, time_indices: Int64, origin_m: Float64, directions: Float32, limit_m: Float32
    ) -> tuple[Hits, Float32, Float32]:
        """Cast n rays at static bodies; hits, and (3, n) directions and origins in the current vehicle frame."""
        current_T_static = invert(self.current_poses.static_T_vehicle)
        if (self.static_T_vehicle == self.current_poses.static_T_vehicle).all():
            pose = self.current_poses.static_T_vehicle
            hits = cast_from_vehicle(self.static_caster, pose, origin_m, directions, limit_m)
            return hits, directions, origin_m.astype(np.float32)[:, None]
        static_T_vehicle = np.tensordot(weights, self.static_T_vehicle, 1)
        starts_m = static_T_vehicle[:, :3, :3] @ origin_m + static_T_vehicle[:, :3, 3]
        static_directions = _rotate_at_times(static_T_vehicle, time_indices, directions)
        ray_starts_m = starts_m.astype(np.float32).take(time_indices, axis=0)
        hits = self.static_caster.cast_from_each(ray_starts_m, static_directions, limit_m)
        current_starts_m = transform_points(current_T_static, starts_m).T.astype(np.float32)
        current_directions = rotate(current_T_static[:3, :3], static_directions)
        return hits, current_directions, current_starts_m.take(time_indices, axis=1)

    def _interpolate_part_poses(self, weights: Float64, parts: Int64) -> Float64:
        """Interpolate (K, 4, 4) `part_T_vehicle` of (K,) bodies by (K, 3) weights of the samples."""
        return np.asarray(np.einsum("ks,skij->kij", weights, self.part_T_vehicle[:, parts]))


def compute_parabola_weights(samples_s: Float64, times_s: Float64) -> Float64:
    """Compute the weights of samples in a quadratic (Lagrange) interpolation.

    Args:
        samples_s: (3,) sample times, either different or all equal.
        times_s: (T,) times at which values are interpolated.

    Returns:
        (T, 3) weights; only the first sample counts if all sample times are equal.
    """
    a, b, c = samples_s
    # A scan without duration has one sample time.
    if a == c:
        return np.tile([1.0, 0.0, 0.0], (len(times_s), 1))
    from_a, from_b, from_c = times_s - a, times_s - b, times_s - c
    weights = (
        from_b * from_c / ((a - b) * (a - c)),
        from_a * from_c / ((b - a) * (b - c)),
        from_a * from_b / ((c - a) * (c - b)),
    )
    return np.stack(weights, axis=1)


def _transform_each(poses: Float64, points_m: Float64) -> Float64:
    """Transform (K, 3) points by one of (K, 4, 4) poses each."""
    return np.asarray((poses[:, :3, :3] @ points_m[:, :, None])[:, :, 0] + poses[:, :3, 3])


def _rotate_at_times(poses: Float64, time_indices: Int64, directions: Float32) -> Float32:
    """Rotate (3, n) directions by the pose of the time of each ray."""
    rotations, (x, y, z) = poses[:, :3, :3].astype(np.float32), directions
    rows = rotations.transpose(1, 2, 0)
    return np.stack(
        [a.take(time_indices) * x + b.take(time_indices) * y + c.take(time_indices) * z for a, b, c in rows]
    )
