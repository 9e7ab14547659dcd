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
from torchcover.simulation.moving import Meetings, Moving
from torchcover.simulation.raycaster import Hits, RayCaster, cast_from
from torchcover.simulation.rays import SLACK_M, Outlines, Tile, outlines, rotate, rotate_each

# Poses at the begin, in the middle and at the end: parabolas, off by the cube of what a body turns in the meantime.
SAMPLES = 3


class RayTimes(NamedTuple):
    """When the rays of a tile are cast, after the frame's time: `at_s` (g,) ascending, `of_ray` (n,) which of these."""

    at_s: Float64
    of_ray: Int64


class Poses(NamedTuple):
    """Where everything is: `static_T_vehicle` (4, 4), and `vehicle_T_part` (P, 4, 4) of the bodies that move."""

    static_T_vehicle: Float64
    vehicle_T_part: Float64


# From a time before or after an instant to another, in seconds -> (3,) such times about there, and what is where then.
Motion = Callable[[float, float], tuple[Float64, Sequence[Poses]]]


def no_motion(*_: float) -> tuple[Float64, Sequence[Poses]]:
    """That of an instant of which no other is known."""
    return np.zeros(SAMPLES), ()


class SweptHits(NamedTuple):
    """What n rays of a tile hit, and at how many pairs of a ray and a moving body they were cast.

    `directions` (3, n) and `starts_m` (3, n), or (3, 1) if all start there, are in the vehicle frame at the frame's
    time. `on_body` (K,) are the rays that hit a body that moves, and is not the ego; `points` (K, 3) where these points
    are at the frame's time: they have travelled with their body.
    """

    hits: Hits
    directions: Float32
    starts_m: Float32
    on_body: Int64
    points: Float32
    casts: int


@dataclass(frozen=True, eq=False)
class Sweep:
    """How everything moves while rays are cast one after the other.

    `now` says where everything is at the frame's time. At three times after that, `samples_s` (3,), are
    `static_T_vehicle` (3, 4, 4), `part_T_vehicle` (3, P, 4, 4), and `corners_m` (P, 24, 3) of boxes around the bodies
    as the vehicle sees them.
    """

    static: RayCaster
    now: Poses
    moving: Moving
    samples_s: Float64
    static_T_vehicle: Float64
    part_T_vehicle: Float64
    corners_m: Float64

    @classmethod
    def of(
        cls, static: RayCaster, now: Poses, moving: Moving, samples_s: Float64, poses: Sequence[Poses]
    ) -> Self | None:
        """That of a scene; None if nothing moves meanwhile."""
        if all(np.array_equal(one, other) for each in poses for one, other in zip(each, now, strict=True)):
            return None
        # Where the boxes are in the vehicle's frame of each time; those of now, moved.
        part_T_vehicle = np.stack([invert(each.vehicle_T_part) for each in poses])
        moved = [each.vehicle_T_part @ moving.part_T_vehicle for each in poses]
        corners_m = np.stack([moving.corners_m @ one[:, :3, :3].swapaxes(1, 2) + one[:, None, :3, 3] for one in moved])
        bulge_m = SLACK_M + np.abs(np.diff(corners_m, n=2, axis=0)).max(axis=(0, 2, 3), initial=0.0) / 2
        outwards = np.sign(moving.corners_m - moving.centre_m[:, None]) * bulge_m[:, None, None]
        static_T_vehicle = np.stack([each.static_T_vehicle for each in poses])
        return cls(
            static,
            now,
            moving,
            samples_s,
            static_T_vehicle,
            part_T_vehicle,
            np.concatenate(list(corners_m + outwards), axis=1),
        )

    def outlines(self, origin_m: Float64) -> Outlines:
        """The bodies that move, as they look from a place on the vehicle at any of the times."""
        return outlines(self.corners_m, origin_m)

    def cast(
        self,
        vehicle_T_sensor: Float64,
        tile: Tile,
        times: RayTimes,
        limit_m: Float32,
        bodies: Outlines,
        ego: int,
        own_m: Float32 | None,
    ) -> SweptHits:
        """Cast the rays of one tile, each at its time, as `Instant.cast` does."""
        origin_m, vehicle_R_sensor, of_ray = vehicle_T_sensor[:3, 3], vehicle_T_sensor[:3, :3], times.of_ray
        directions = rotate(vehicle_R_sensor, tile.directions)
        if own_m is not None:
            limit_m = np.minimum(limit_m, own_m)
        weights = parabola_weights(self.samples_s, times.at_s)
        hits, turned, from_m = self._cast_at_static(weights, of_ray, origin_m, directions, limit_m)
        if own_m is not None:
            hits.body[(hits.body < 0) & (own_m <= limit_m)] = ego
        leaving_out = ego if own_m is not None else None
        limits_m = hits.range_m
        part, ray = self.moving.pairs(vehicle_R_sensor, tile, directions, limits_m, bodies, leaving_out=leaving_out)
        if len(ray):
            pair_T_vehicle = self._parts(weights[of_ray[ray]], part)
            starts_m = (pair_T_vehicle[:, :3, :3] @ origin_m + pair_T_vehicle[:, :3, 3]).astype(np.float32)
            towards = rotate_each(pair_T_vehicle[:, :3, :3].astype(np.float32), directions.take(ray, axis=1))
            met = self.moving.cast_pairs(part, starts_m, towards, limits_m[ray])
            there = met.body >= 0
            self.moving.nearer(hits, Meetings(part[there], ray[there], met.range_m[there], met.triangle[there]))
        on_body = np.flatnonzero((hits.body >= self.static.bodies) & (hits.body != ego))
        part = np.searchsorted(self.moving.body, hits.body[on_body])
        there_m = origin_m + (directions[:, on_body] * hits.range_m[on_body]).T
        on_part_m = _moved(self._parts(weights[of_ray[on_body]], part), there_m)
        points = _moved(self.now.vehicle_T_part[part], on_part_m).astype(np.float32)
        return SweptHits(hits, turned, from_m, on_body, points, len(ray))

    def _cast_at_static(
        self, weights: Float64, of_ray: Int64, origin_m: Float64, directions: Float32, limit_m: Float32
    ) -> tuple[Hits, Float32, Float32]:
        """What n rays hit of what never moves; their (3, n) directions and starts in the vehicle frame of now."""
        now_T_static = invert(self.now.static_T_vehicle)
        if (self.static_T_vehicle == self.now.static_T_vehicle).all():
            hits = cast_from(self.static, self.now.static_T_vehicle, origin_m, directions, limit_m)
            return hits, directions, origin_m.astype(np.float32)[:, None]
        static_T_vehicle = np.tensordot(weights, self.static_T_vehicle, 1)
        starts_m = static_T_vehicle[:, :3, :3] @ origin_m + static_T_vehicle[:, :3, 3]
        towards = _turned(static_T_vehicle, of_ray, directions)
        hits = self.static.cast_from_each(starts_m.astype(np.float32).take(of_ray, axis=0), towards, limit_m)
        starts_m = transform_points(now_T_static, starts_m).T
        return hits, rotate(now_T_static[:3, :3], towards), starts_m.astype(np.float32).take(of_ray, axis=1)

    def _parts(self, weights: Float64, part: Int64) -> Float64:
        """(K, 4, 4) `part_T_vehicle` of some bodies at times with these weights, (K, 3)."""
        return np.asarray(np.einsum("ks,skij->kij", weights, self.part_T_vehicle[:, part]))


def parabola_weights(samples_s: Float64, times_s: Float64) -> Float64:
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
