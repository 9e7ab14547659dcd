"""Lines that bodies follow: polylines, and streets with straights and curves that begin and end gently."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64, Int64


@dataclass(frozen=True, eq=False)
class Polyline:
    """A polyline through (K, 2) corners on the ground that goes on straight beyond its ends, or a loop.

    Curves need corners close to each other. The seam of a loop, whose last corner equals the first, lies on a straight
    part.
    """

    points_m: Float64
    is_closed: bool = False

    @cached_property
    def arc_lengths_m(self) -> Float64:
        """(K,) way along the line at each corner."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points_m, axis=0), axis=1))])

    @property
    def length_m(self) -> float:
        """Length, of a loop once around."""
        return float(self.arc_lengths_m[-1])

    def compute_poses(self, distances_m: ArrayLike) -> Float64:
        """(..., 3) x and y in metres, and yaw in degrees, after (...) ways along the line; on a loop of any size."""
        place = np.asarray(distances_m, dtype=np.float64)
        place = np.mod(place, self.length_m) if self.is_closed else place
        segment = np.clip(np.searchsorted(self.arc_lengths_m, place, side="right") - 1, 0, len(self.arc_lengths_m) - 2)
        along = (place - self.arc_lengths_m[segment])[..., None]
        position = self.points_m[segment] + along * self._directions[segment]
        yaw = np.rad2deg(np.interp(place, self.arc_lengths_m, self.headings_rad))
        return np.concatenate([position, yaw[..., None]], axis=-1)

    @cached_property
    def _directions(self) -> Float64:
        steps = np.diff(self.points_m, axis=0)
        return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))

    @cached_property
    def headings_rad(self) -> Float64:
        """(K,) heading at each corner in radians, halfway between the pieces that meet there, without jumps."""
        pieces = np.unwrap(np.arctan2(self._directions[:, 1], self._directions[:, 0]))
        return np.concatenate([pieces[:1], (pieces[:-1] + pieces[1:]) / 2, pieces[-1:]])


def build_rounded_rectangle(length_m: float, width_m: float, corner_radius_m: float) -> Polyline:
    """A rounded rectangle about the origin, run counter-clockwise from the middle of its lower side."""
    across, up = length_m / 2 - corner_radius_m, width_m / 2 - corner_radius_m
    points = [np.array([[0.0, -width_m / 2]])]
    for quarter, (x, y) in enumerate([(across, -up), (across, up), (-across, up), (-across, -up)]):
        angle = np.linspace(quarter - 1, quarter, 17) * np.pi / 2
        points.append(np.array([x, y]) + corner_radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return Polyline(np.concatenate([*points, points[0]]), is_closed=True)


KNOT_EVERY_M = 1.0
# Gauss's rule with three places: over a metre of the tightest curve it errs by less than a nanometre.
GAUSS_PLACES = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)
# Between places of a street to which others are compared.
SAMPLE_EVERY_M = 8.0
# Halvings of what is a hundred metres.
HALVINGS = 5


class Alignment:
    """A line whose curvature is given: linear between stations, 0 before the first and after the last.

    A station is the way along the line, on the level. A place beside it is a station and how far to the left it lies.

    `stations_m`: (K,) ascending; `curvatures_per_m`: (K,) at the stations, positive to the left; 0 at both ends;
    `start`: x and y in metres and heading in radians at the first station.
    """

    def __init__(
        self, stations_m: ArrayLike, curvatures_per_m: ArrayLike, start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        given, curvatures = np.asarray(stations_m, np.float64), np.asarray(curvatures_per_m, np.float64)
        curved = (curvatures[:-1] != 0.0) | (curvatures[1:] != 0.0)
        pieces = [
            np.linspace(low, high, int(np.ceil((high - low) / KNOT_EVERY_M)) if bends else 1, endpoint=False)
            for low, high, bends in zip(given[:-1], given[1:], curved, strict=True)
        ]
        # The first twice: what lies before it goes straight on.
        self.stations_m: Float64 = np.concatenate([given[:1], *pieces, given[-1:]])
        self.curvatures_per_m: Float64 = np.interp(self.stations_m, given, curvatures)
        step = np.diff(self.stations_m)
        grows = np.diff(self.curvatures_per_m)
        self._rates: Float64 = np.append(np.divide(grows, step, out=np.zeros_like(step), where=step > 0), 0.0)
        turned = (self.curvatures_per_m[:-1] + self.curvatures_per_m[1:]) / 2 * step
        self._headings: Float64 = start[2] + np.concatenate([[0.0], np.cumsum(turned)])
        self._places_m: Float64 = np.zeros((len(self.stations_m), 2))
        ways_m = self._ways(np.arange(len(step)), step)
        self._places_m[:] = np.array(start[:2]) + np.concatenate([[[0.0, 0.0]], np.cumsum(ways_m, axis=0)])

    @cached_property
    def is_straight(self) -> bool:
        """Whether it never turns."""
        return not self.curvatures_per_m.any()

    def compute_headings_rad(self, stations_m: ArrayLike) -> Float64:
        """(...) headings in radians, without jumps."""
        return self._heading(*self._knot(np.asarray(stations_m, dtype=np.float64)))

    def compute_curvatures_per_m(self, stations_m: ArrayLike) -> Float64:
        """(...) curvatures in 1/m."""
        return np.asarray(np.interp(np.asarray(stations_m, dtype=np.float64), self.stations_m, self.curvatures_per_m))

    def compute_poses(self, stations_m: ArrayLike, left_m: ArrayLike) -> Float64:
        """(..., 3) x and y in metres and yaw in degrees of places beside the line."""
        stations, left = np.broadcast_arrays(np.asarray(stations_m, dtype=np.float64), left_m)
        knot, beyond_m = self._knot(stations)
        heading = self._heading(knot, beyond_m)
        poses = np.empty((*stations.shape, 3))
        poses[..., :2] = self._places_m[knot] + self._ways(knot, beyond_m)
        poses[..., 0] -= left * np.sin(heading)
        poses[..., 1] += left * np.cos(heading)
        poses[..., 2] = np.rad2deg(heading)
        return poses

    def compute_offset_lengths_m(self, stations_m: ArrayLike, left_m: ArrayLike) -> Float64:
        """(...) ways from station 0 along the line that keeps to the left by so much; exact."""
        turned = self.compute_headings_rad(stations_m) - self.compute_headings_rad(0.0)
        return np.asarray(stations_m, dtype=np.float64) - np.asarray(left_m, dtype=np.float64) * turned

    def _knot(self, stations_m: Float64) -> tuple[Int64, Float64]:
        """(...) numbers of the last knots before stations, and how far beyond these they are."""
        knot = np.maximum(np.searchsorted(self.stations_m, stations_m, side="right") - 1, 0)
        return knot, stations_m - self.stations_m[knot]

    def _heading(self, knot: Int64, beyond_m: Float64) -> Float64:
        """(...) headings so far beyond knots."""
        heading: Float64 = self.curvatures_per_m[knot] + beyond_m / 2 * self._rates[knot]
        heading *= beyond_m
        heading += self._headings[knot]
        return heading

    def _ways(self, knot: Int64, beyond_m: Float64) -> Float64:
        """(..., 2) from knots to places beyond them."""
        first, middle, last = (self._heading(knot, share * beyond_m) for share in GAUSS_PLACES)
        mean = [(5 * turn(first) + 8 * turn(middle) + 5 * turn(last)) / 18 for turn in (np.cos, np.sin)]
        return np.asarray(np.stack(mean, axis=-1) * beyond_m[..., None])


def compute_squared_distances_m2(points_m: Float64, other_points_m: Float64) -> Float64:
    """(N, M) squared distances between (N, 2) and (M, 2) places."""
    squares: Float64 = (points_m**2).sum(axis=1)[:, None] + (other_points_m**2).sum(axis=1)
    squares -= 2 * points_m @ other_points_m.T
    np.maximum(squares, 0.0, out=squares)
    return squares


class OffsetPath:
    """A line `left_m` to the left of the middle of a street, that follows it (`direction` 1) or runs against it (-1).

    It begins `reach_m` before station 0, and ends as far behind.
    """

    is_closed = False

    def __init__(self, street: Alignment, left_m: float, direction: int, half_length_m: float) -> None:
        self.street = street
        self.left_m = left_m
        self.direction = direction
        self._reach_m = half_length_m

    @cached_property
    def _knots_m(self) -> Float64:
        return self.street.compute_offset_lengths_m(self.street.stations_m, self.left_m)

    @cached_property
    def _cubics(self) -> Float64:
        steps_m = np.where(np.diff(self.street.stations_m) > 0, np.diff(self._knots_m), np.inf)
        return _cubics(self.street.compute_poses(self.street.stations_m, self.left_m), steps_m)

    @cached_property
    def _stations_per_m(self) -> Float64:
        steps_m, stations_m = np.diff(self._knots_m), np.diff(self.street.stations_m)
        return np.append(np.divide(stations_m, steps_m, out=np.ones_like(steps_m), where=stations_m > 0), 1.0)

    @property
    def length_m(self) -> float:
        """From its beginning to its end."""
        return 2 * self._reach_m

    def convert_stations_to_distances_m(self, stations_m: ArrayLike) -> Float64:
        """(...) ways along the line at stations of the street."""
        return self.direction * self.street.compute_offset_lengths_m(stations_m, self.left_m) + self._reach_m

    def convert_distances_to_stations_m(self, distances_m: ArrayLike) -> Float64:
        """(...) stations of the street after ways along the line."""
        knot, beyond_m = self._knot(np.asarray(distances_m, dtype=np.float64))
        return np.asarray(self.street.stations_m[knot] + beyond_m * self._stations_per_m[knot])

    def compute_poses(self, distances_m: ArrayLike) -> Float64:
        """(..., 3) x and y in metres, and yaw in degrees, after ways along the line; to a hundredth of a millimetre."""
        distances_m = np.asarray(distances_m, dtype=np.float64)
        if self.street.is_straight:
            return self._poses_on_a_straight(distances_m)
        knot, beyond_m = self._knot(distances_m)
        beyond_m = beyond_m[..., None]
        poses: Float64 = self._cubics[3].take(knot, axis=0)
        for power in (2, 1, 0):
            poses *= beyond_m
            poses += self._cubics[power].take(knot, axis=0)
        if self.direction < 0:
            poses[..., 2] += 180.0
        return poses

    def _poses_on_a_straight(self, place_m: Float64) -> Float64:
        x, y, yaw_deg = self.street.compute_poses(0.0, self.left_m)
        along_m, yaw = self.direction * (place_m - self._reach_m), np.deg2rad(yaw_deg)
        poses = np.empty((*place_m.shape, 3))
        poses[..., 0] = x + np.cos(yaw) * along_m
        poses[..., 1] = y + np.sin(yaw) * along_m
        poses[..., 2] = yaw_deg if self.direction > 0 else yaw_deg + 180.0
        return poses

    def _knot(self, place_m: Float64) -> tuple[Int64, Float64]:
        """(...) numbers of the last knots before places, and how far along the line these are beyond them."""
        length_m = self.direction * (place_m - self._reach_m)
        # One body after the other: the search is fast where the next place is near the last.
        knot = np.searchsorted(self._knots_m, np.ascontiguousarray(length_m.T), side="right").T - 1
        knot = np.maximum(knot, 0)
        return knot, length_m - self._knots_m[knot]


def _cubics(poses: Float64, steps_m: Float64) -> Float64:
    """(4, K, 3) the cubics between K poses that leave and reach each with its heading; straight on where no step is.

    Yaw, which comes third, is linear.
    """
    yaw = np.deg2rad(poses[:, 2])
    slopes = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    steps = steps_m[:, None]
    mean, here, there = np.diff(poses, axis=0) / steps, slopes[:-1], slopes[1:]
    linear, square, cube = here, (3 * mean - 2 * here - there) / steps, (here + there - 2 * mean) / steps**2
    linear, square[:, 2], cube[:, 2] = linear.copy(), 0.0, 0.0
    linear[:, 2] = mean[:, 2]
    none = np.zeros((1, 3))
    return np.stack(
        [poses, *(np.concatenate([part, last]) for part, last in ((linear, slopes[-1:]), (square, none), (cube, none)))]
    )


class StreetCorridor:
    """The places that are nearest to the stretch of the street that they were measured from.

    No two stretches share any of it: what is built within cannot lie on another street, nor on what belongs to it.
    """

    def __init__(self, street: Alignment, span_m: tuple[float, float]) -> None:
        self._street = street
        self._span_m = span_m
        self._samples_m = np.arange(*span_m, SAMPLE_EVERY_M)
        self._places_m = street.compute_poses(self._samples_m, 0.0)[:, :2]

    def sample_stations_m(self, spacing_m: float) -> Float64:
        """(N,) stations of its street, at even distances."""
        return np.arange(*self._span_m, spacing_m)

    def is_inside(self, stations_m: Float64, left_m: Float64) -> Bools:
        """(N,) whether places beside the street are their own stretch's."""
        if self._street.is_straight:
            return np.ones(len(stations_m), dtype=bool)
        nearest = self.find_nearest_stations_m(self._street.compute_poses(stations_m, left_m)[:, :2])
        return np.asarray(np.abs(nearest - stations_m) <= SAMPLE_EVERY_M)

    def find_nearest_stations_m(self, positions_m: Float64) -> Float64:
        """(N,) stations of the nearest samples."""
        return np.asarray(self._samples_m[compute_squared_distances_m2(positions_m, self._places_m).argmin(axis=1)])

    def find_half_widths_m(self, stations_m: Float64, side: int, min_m: float, max_m: float) -> Float64:
        """(N,) how far from the middle it goes, on the left (1) or on the right (-1), from near to far."""
        least, most = np.full(len(stations_m), min_m), np.full(len(stations_m), max_m)
        if self._street.is_straight:
            return most
        least[self.is_inside(stations_m, side * most)] = max_m
        for _ in range(HALVINGS):
            middle = (least + most) / 2
            owned = self.is_inside(stations_m, side * middle)
            least, most = np.where(owned, np.maximum(least, middle), least), np.where(owned, most, middle)
        return least
