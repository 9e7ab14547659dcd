"""What a sensor hits that takes time for its rays, while the vehicle and the bodies around it move.

In the vehicle's own frame the rays stay what they are, and all else moves: what rests by the vehicle's motion undone,
each body by its own pose as the vehicle sees it. Poses are looked up at three times and interpolated for each ray: that
costs hardly more than to cast all rays at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.moving import BodyHits, MovingBodies
from torchcover.simulation.raycaster import Hits, RayCaster, cast_from_vehicle
from torchcover.simulation.rays import SLACK_M, BoxOutlines, Tile, compute_outlines, rotate, rotate_each

# Poses at the begin, in the middle and at the end: parabolas, off by the cube of what a body turns in the meantime.
SAMPLES = 3


class RayTimes(NamedTuple):
    """When the rays of a tile are cast, after the frame's time: `times_s` (g,) ascending, `time_indices` (n,) which of these."""

    times_s: Float64
    time_indices: Int64


class BodyPoses(NamedTuple):
    """Where everything is: `static_T_vehicle` (4, 4), and `vehicle_T_part` (P, 4, 4) of the bodies that move."""

    static_T_vehicle: Float64
    vehicle_T_part: Float64


# From a time before or after an instant to another, in seconds -> (3,) such times about there, and what is where then.
MotionSampler = Callable[[float, float], tuple[Float64, Sequence[BodyPoses]]]


def sample_no_motion(*_: float) -> tuple[Float64, Sequence[BodyPoses]]:
    """That of an instant of which no other is known."""
    return np.zeros(SAMPLES), ()


class SweptHits(NamedTuple):
    """What n rays of a tile hit, and at how many pairs of a ray and a moving body they were cast.

    `directions` (3, n) and `starts_m` (3, n), or (3, 1) if all start there, are in the vehicle frame at the frame's
    time. `moving_ray_indices` (K,) are the rays that hit a body that moves, and is not the ego; `moving_points_m` (K, 3) where these points
    are at the frame's time: they have travelled with their body.
    """

    hits: Hits
    directions: Float32
    starts_m: Float32
    moving_ray_indices: Int64
    moving_points_m: Float32
    num_body_casts: int


@dataclass(frozen=True, eq=False)
class ScanMotion:
    """How everything moves while rays are cast one after the other.

    `current_poses` says where everything is at the frame's time. At three times after that, `sample_times_s` (3,), are
    `static_T_vehicle` (3, 4, 4), `part_T_vehicle` (3, P, 4, 4), and `box_corners_m` (P, 24, 3) of boxes around the bodies
    as the vehicle sees them.
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
        """That of a scene; None if nothing moves meanwhile."""
        if all(np.array_equal(one, other) for each in poses for one, other in zip(each, current_poses, strict=True)):
            return None
        # Where the boxes are in the vehicle's frame of each time; those of now, moved.
        part_T_vehicle = np.stack([invert(each.vehicle_T_part) for each in poses])
        moved = [each.vehicle_T_part @ moving_bodies.part_T_vehicle for each in poses]
        corners_m = np.stack(
            [moving_bodies.box_corners_m @ one[:, :3, :3].swapaxes(1, 2) + one[:, None, :3, 3] for one in moved]
        )
        bulge_m = SLACK_M + np.abs(np.diff(corners_m, n=2, axis=0)).max(axis=(0, 2, 3), initial=0.0) / 2
        outwards = np.sign(moving_bodies.box_corners_m - moving_bodies.center_m[:, None]) * bulge_m[:, None, None]
        static_T_vehicle = np.stack([each.static_T_vehicle for each in poses])
        return cls(
            static_caster,
            current_poses,
            moving_bodies,
            sample_times_s,
            static_T_vehicle,
            part_T_vehicle,
            np.concatenate(list(corners_m + outwards), axis=1),
        )

    def compute_outlines(self, origin_m: Float64) -> BoxOutlines:
        """The bodies that move, as they look from a place on the vehicle at any of the times."""
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
        """Cast the rays of one tile, each at its time, as `Instant.cast` does."""
        origin_m, vehicle_R_sensor, of_ray = vehicle_T_sensor[:3, 3], vehicle_T_sensor[:3, :3], ray_times.time_indices
        directions = rotate(vehicle_R_sensor, tile.directions)
        if ego_hit_range_m is not None:
            limit_m = np.minimum(limit_m, ego_hit_range_m)
        weights = compute_parabola_weights(self.sample_times_s, ray_times.times_s)
        hits, turned, from_m = self._cast_at_static(weights, of_ray, origin_m, directions, limit_m)
        if ego_hit_range_m is not None:
            hits.body_indices[(hits.body_indices < 0) & (ego_hit_range_m <= limit_m)] = ego_index
        leaving_out = ego_index if ego_hit_range_m is not None else None
        limits_m = hits.range_m
        part, ray = self.moving_bodies.find_candidate_pairs(
            vehicle_R_sensor, tile, directions, limits_m, outlines, excluded_body=leaving_out
        )
        if len(ray):
            pair_T_vehicle = self._parts(weights[of_ray[ray]], part)
            starts_m = (pair_T_vehicle[:, :3, :3] @ origin_m + pair_T_vehicle[:, :3, 3]).astype(np.float32)
            towards = rotate_each(pair_T_vehicle[:, :3, :3].astype(np.float32), directions.take(ray, axis=1))
            met = self.moving_bodies.cast_pairs(part, starts_m, towards, limits_m[ray])
            there = met.body_indices >= 0
            self.moving_bodies.update_nearest_hits(
                hits, BodyHits(part[there], ray[there], met.range_m[there], met.triangle_indices[there])
            )
        on_body = np.flatnonzero(
            (hits.body_indices >= self.static_caster.num_bodies) & (hits.body_indices != ego_index)
        )
        part = np.searchsorted(self.moving_bodies.body_indices, hits.body_indices[on_body])
        there_m = origin_m + (directions[:, on_body] * hits.range_m[on_body]).T
        on_part_m = _moved(self._parts(weights[of_ray[on_body]], part), there_m)
        points = _moved(self.current_poses.vehicle_T_part[part], on_part_m).astype(np.float32)
        return SweptHits(hits, turned, from_m, on_body, points, len(ray))

    def _cast_at_static(
        self, weights: Float64, of_ray: Int64, origin_m: Float64, directions: Float32, limit_m: Float32
    ) -> tuple[Hits, Float32, Float32]:
        """What n rays hit of what never moves; their (3, n) directions and starts in the vehicle frame of now."""
        now_T_static = invert(self.current_poses.static_T_vehicle)
        if (self.static_T_vehicle == self.current_poses.static_T_vehicle).all():
            hits = cast_from_vehicle(
                self.static_caster, self.current_poses.static_T_vehicle, origin_m, directions, limit_m
            )
            return hits, directions, origin_m.astype(np.float32)[:, None]
        static_T_vehicle = np.tensordot(weights, self.static_T_vehicle, 1)
        starts_m = static_T_vehicle[:, :3, :3] @ origin_m + static_T_vehicle[:, :3, 3]
        towards = _turned(static_T_vehicle, of_ray, directions)
        hits = self.static_caster.cast_from_each(starts_m.astype(np.float32).take(of_ray, axis=0), towards, limit_m)
        starts_m = transform_points(now_T_static, starts_m).T
        return hits, rotate(now_T_static[:3, :3], towards), starts_m.astype(np.float32).take(of_ray, axis=1)

    def _parts(self, weights: Float64, part: Int64) -> Float64:
        """(K, 4, 4) `part_T_vehicle` of some bodies at times with these weights, (K, 3)."""
        return np.asarray(np.einsum("ks,skij->kij", weights, self.part_T_vehicle[:, part]))


def compute_parabola_weights(samples_s: Float64, times_s: Float64) -> Float64:
    """(T, 3) how much poses at three times weigh at (T,) others near them: Lagrange's parabola through them."""
    a, b, c = samples_s
    if a == c:
        return np.tile([1.0, 0.0, 0.0], (len(times_s), 1))
    from_a, from_b, from_c = times_s - a, times_s - b, times_s - c
    weights = (
        from_b * from_c / ((a - b) * (a - c)),
        from_a * from_c / ((b - a) * (b - c)),
        from_a * from_b / ((c - a) * (c - b)),
    )
    return np.stack(weights, axis=1)


def _moved(poses: Float64, places_m: Float64) -> Float64:
    """(K, 3) places, each moved by its own of (K, 4, 4) poses."""
    return np.asarray((poses[:, :3, :3] @ places_m[:, :, None])[:, :, 0] + poses[:, :3, 3])


def _turned(poses: Float64, of_ray: Int64, directions: Float32) -> Float32:
    """(3, n) directions, each turned by the pose of its time."""
    rotations, (x, y, z) = poses[:, :3, :3].astype(np.float32), directions
    rows = rotations.transpose(1, 2, 0)
    return np.stack([a.take(of_ray) * x + b.take(of_ray) * y + c.take(of_ray) * z for a, b, c in rows])
