"""Centerlines of roads: polylines, and alignments whose curvature changes linearly (straights, arcs, clothoids)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from torchcover.geometry.arrays import Bools, Float64, Int64


@dataclass(frozen=True, eq=False)
class Polyline:
    """Polyline on the ground that continues straight beyond its ends, or a closed loop.

    Args:
        points_m: (K, 2) vertices; curves need vertices close to each other. The last vertex of a loop equals the first
            and lies on a straight part.
        is_closed: True for a loop.

    Example:
        >>> Polyline(np.array([[0.0, 0.0], [10.0, 0.0]])).compute_poses([4.0])
        array([[4., 0., 0.]])
    """

    points_m: Float64
    is_closed: bool = False

    @cached_property
    def arc_lengths_m(self) -> Float64:
        """(K,) arc length at each vertex."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.points_m, axis=0), axis=1))])

    @property
    def length_m(self) -> float:
        """Length of the line, or of one round of a loop."""
        return float(self.arc_lengths_m[-1])

    def compute_poses(self, distances_m: ArrayLike) -> Float64:
        """Compute poses on the line.

        Args:
            distances_m: (...) arc lengths; any value on a loop.

        Returns:
            (..., 3) x and y in meters and yaw in degrees.
        """
        distances = np.asarray(distances_m, dtype=np.float64)
        distances = np.mod(distances, self.length_m) if self.is_closed else distances
        lengths_m = self.arc_lengths_m
        segment = np.clip(np.searchsorted(lengths_m, distances, side="right") - 1, 0, len(lengths_m) - 2)
        along = (distances - lengths_m[segment])[..., None]
        position = self.points_m[segment] + along * self._directions[segment]
        yaw = np.rad2deg(np.interp(distances, lengths_m, self.headings_rad))
        return np.concatenate([position, yaw[..., None]], axis=-1)

    @cached_property
    def _directions(self) -> Float64:
        steps = np.diff(self.points_m, axis=0)
        return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))

    @cached_property
    def headings_rad(self) -> Float64:
        """(K,) unwrapped heading at each vertex in radians: the mean of the two segments that meet there."""
        headings = np.unwrap(np.arctan2(self._directions[:, 1], self._directions[:, 0]))
        return np.concatenate([headings[:1], (headings[:-1] + headings[1:]) / 2, headings[-1:]])


def build_rounded_rectangle(length_m: float, width_m: float, corner_radius_m: float) -> Polyline:
    """Build a counterclockwise loop around the origin that starts in the middle of its lower side.

    Args:
        length_m: Extent along x.
        width_m: Extent along y.
        corner_radius_m: Radius of the corners, at most half of the shorter side.
    """
    across, up = length_m / 2 - corner_radius_m, width_m / 2 - corner_radius_m
    points = [np.array([[0.0, -width_m / 2]])]
    for quarter, (x, y) in enumerate([(across, -up), (across, up), (-across, up), (-across, -up)]):
        angle = np.linspace(quarter - 1, quarter, 17) * np.pi / 2
        points.append(np.array([x, y]) + corner_radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return Polyline(np.concatenate([*points, points[0]]), is_closed=True)


# Three-point Gauss-Legendre quadrature on [0, 1]: over one meter of the tightest curve the error is below a nanometer.
GAUSS_NODES = 0.5 + np.array([-0.5, 0.0, 0.5]) * np.sqrt(0.6)


class Alignment:
    """Horizontal alignment of a road: curvature that is linear between stations and 0 outside of them.

    A station is the arc length along the line. Positions are given as a station and an offset to the left.

    Args:
        stations_m: (K,) ascending stations.
        curvatures_per_m: (K,) curvatures in 1/m at the stations, positive to the left; 0 at both ends.
        start: x and y in meters and heading in radians at the first station.
        knot_spacing_m: Largest distance of the knots into which curved sections are divided.

    Example:
        >>> Alignment([0.0, 100.0], [0.0, 0.0]).compute_poses(20.0, 3.0)
        array([20.,  3.,  0.])
    """

    def __init__(
        self,
        stations_m: ArrayLike,
        curvatures_per_m: ArrayLike,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        knot_spacing_m: float = 1.0,
    ) -> None:
        stations, curvatures = np.asarray(stations_m, np.float64), np.asarray(curvatures_per_m, np.float64)
        is_curved = (curvatures[:-1] != 0.0) | (curvatures[1:] != 0.0)
        # The first station appears twice, so that the line continues straight before it.
        knots = [stations[:1]]
        for low, high, curved in zip(stations[:-1], stations[1:], is_curved, strict=True):
            num_knots = int(np.ceil((high - low) / knot_spacing_m)) if curved else 1
            knots.append(np.linspace(low, high, num_knots, endpoint=False))
        self.stations_m: Float64 = np.concatenate([*knots, stations[-1:]])
        self.curvatures_per_m: Float64 = np.interp(self.stations_m, stations, curvatures)
        lengths_m = np.diff(self.stations_m)
        changes = np.diff(self.curvatures_per_m)
        rates = np.divide(changes, lengths_m, out=np.zeros_like(lengths_m), where=lengths_m > 0)
        self._curvature_rates: Float64 = np.append(rates, 0.0)
        turns_rad = (self.curvatures_per_m[:-1] + self.curvatures_per_m[1:]) / 2 * lengths_m
        self._headings_rad: Float64 = start[2] + np.concatenate([[0.0], np.cumsum(turns_rad)])
        self._positions_m: Float64 = np.zeros((len(self.stations_m), 2))
        displacements_m = self._integrate_displacements(np.arange(len(lengths_m)), lengths_m)
        self._positions_m[:] = np.array(start[:2]) + np.concatenate([[[0.0, 0.0]], np.cumsum(displacements_m, axis=0)])

    @cached_property
    def is_straight(self) -> bool:
        """True if the curvature is 0 everywhere."""
        return not self.curvatures_per_m.any()

    def compute_headings_rad(self, stations_m: ArrayLike) -> Float64:
        """Compute the unwrapped headings in radians at (...) stations."""
        return self._compute_headings(*self._find_knots(np.asarray(stations_m, dtype=np.float64)))

    def compute_curvatures_per_m(self, stations_m: ArrayLike) -> Float64:
        """Compute the curvatures in 1/m at (...) stations."""
        return np.asarray(np.interp(np.asarray(stations_m, dtype=np.float64), self.stations_m, self.curvatures_per_m))

    def compute_poses(self, stations_m: ArrayLike, left_m: ArrayLike) -> Float64:
        """Compute poses at an offset from the line.

        Args:
            stations_m: (...) stations.
            left_m: (...) offsets to the left, broadcast with the stations.

        Returns:
            (..., 3) x and y in meters and yaw in degrees.
        """
        stations, left = np.broadcast_arrays(np.asarray(stations_m, dtype=np.float64), left_m)
        knot, beyond_m = self._find_knots(stations)
        heading = self._compute_headings(knot, beyond_m)
        poses = np.empty((*stations.shape, 3))
        poses[..., :2] = self._positions_m[knot] + self._integrate_displacements(knot, beyond_m)
        poses[..., 0] -= left * np.sin(heading)
        poses[..., 1] += left * np.cos(heading)
        poses[..., 2] = np.rad2deg(heading)
        return poses

    def compute_offset_lengths_m(self, stations_m: ArrayLike, left_m: ArrayLike) -> Float64:
        """Compute exact arc lengths of a parallel line, from station 0.

        Args:
            stations_m: (...) stations.
            left_m: (...) offsets of the parallel line to the left.

        Returns:
            (...) arc lengths in meters.
        """
        turned_rad = self.compute_headings_rad(stations_m) - self.compute_headings_rad(0.0)
        return np.asarray(stations_m, dtype=np.float64) - np.asarray(left_m, dtype=np.float64) * turned_rad

    def _find_knots(self, stations_m: Float64) -> tuple[Int64, Float64]:
        """Find the last knot before each station (...), and the distance (...) from it in meters."""
        knot = np.maximum(np.searchsorted(self.stations_m, stations_m, side="right") - 1, 0)
        return knot, stations_m - self.stations_m[knot]

    def _compute_headings(self, knot: Int64, beyond_m: Float64) -> Float64:
        """Compute headings (...) in radians at distances beyond knots."""
        heading: Float64 = self.curvatures_per_m[knot] + beyond_m / 2 * self._curvature_rates[knot]
        heading *= beyond_m
        heading += self._headings_rad[knot]
        return heading

    def _integrate_displacements(self, knot: Int64, beyond_m: Float64) -> Float64:
        """Integrate the displacements (..., 2) in meters from knots to positions beyond them."""
        first, middle, last = (self._compute_headings(knot, node * beyond_m) for node in GAUSS_NODES)
        mean_cos = (5 * np.cos(first) + 8 * np.cos(middle) + 5 * np.cos(last)) / 18
        mean_sin = (5 * np.sin(first) + 8 * np.sin(middle) + 5 * np.sin(last)) / 18
        return np.asarray(np.stack([mean_cos, mean_sin], axis=-1) * beyond_m[..., None])


def compute_squared_distances_m2(points_m: Float64, other_points_m: Float64) -> Float64:
    """Compute the squared distances (N, M) between positions (N, 2) and (M, 2)."""
    squares: Float64 = (points_m**2).sum(axis=1)[:, None] + (other_points_m**2).sum(axis=1)
    squares -= 2 * points_m @ other_points_m.T
    np.maximum(squares, 0.0, out=squares)
    return squares


class OffsetPath:
    """Path parallel to the centerline of a street, such as the middle of a lane.

    Args:
        street: Alignment of the centerline.
        left_m: Offset to the left of the centerline.
        direction: 1 along the street, -1 against it.
        half_length_m: Distance from station 0 to each end of the path.
    """

    is_closed = False

    def __init__(self, street: Alignment, left_m: float, direction: int, half_length_m: float) -> None:
        self.street = street
        self.left_m = left_m
        self.direction = direction
        self._half_length_m = half_length_m

    @cached_property
    def _knots_m(self) -> Float64:
        return self.street.compute_offset_lengths_m(self.street.stations_m, self.left_m)

    @cached_property
    def _cubics(self) -> Float64:
        lengths_m = np.where(np.diff(self.street.stations_m) > 0, np.diff(self._knots_m), np.inf)
        return _fit_cubics(self.street.compute_poses(self.street.stations_m, self.left_m), lengths_m)

    @cached_property
    def _stations_per_m(self) -> Float64:
        lengths_m, stations_m = np.diff(self._knots_m), np.diff(self.street.stations_m)
        return np.append(np.divide(stations_m, lengths_m, out=np.ones_like(lengths_m), where=stations_m > 0), 1.0)

    @property
    def length_m(self) -> float:
        """Length between both ends."""
        return 2 * self._half_length_m

    def convert_stations_to_distances_m(self, stations_m: ArrayLike) -> Float64:
        """Convert stations (...) of the street to arc lengths along the path, in meters from its start."""
        lengths_m = self.street.compute_offset_lengths_m(stations_m, self.left_m)
        return self.direction * lengths_m + self._half_length_m

    def convert_distances_to_stations_m(self, distances_m: ArrayLike) -> Float64:
        """Convert arc lengths (...) along the path to stations of the street, in meters."""
        knot, beyond_m = self._find_knots(np.asarray(distances_m, dtype=np.float64))
        return np.asarray(self.street.stations_m[knot] + beyond_m * self._stations_per_m[knot])

    def compute_poses(self, distances_m: ArrayLike) -> Float64:
        """Compute poses on the path, exact to a hundredth of a millimeter.

        Args:
            distances_m: (...) arc lengths from the start of the path.

        Returns:
            (..., 3) x and y in meters and yaw in degrees.
        """
        distances_m = np.asarray(distances_m, dtype=np.float64)
        if self.street.is_straight:
            return self._compute_straight_poses(distances_m)
        knot, beyond_m = self._find_knots(distances_m)
        beyond_m = beyond_m[..., None]
        poses: Float64 = self._cubics[3].take(knot, axis=0)
        for power in (2, 1, 0):
            poses *= beyond_m
            poses += self._cubics[power].take(knot, axis=0)
        if self.direction < 0:
            poses[..., 2] += 180.0
        return poses

    def _compute_straight_poses(self, distances_m: Float64) -> Float64:
        """Compute poses (..., 3) on a straight street."""
        x, y, yaw_deg = self.street.compute_poses(0.0, self.left_m)
        along_m, yaw = self.direction * (distances_m - self._half_length_m), np.deg2rad(yaw_deg)
        poses = np.empty((*distances_m.shape, 3))
        poses[..., 0] = x + np.cos(yaw) * along_m
        poses[..., 1] = y + np.sin(yaw) * along_m
        poses[..., 2] = yaw_deg if self.direction > 0 else yaw_deg + 180.0
        return poses

    def _find_knots(self, distances_m: Float64) -> tuple[Int64, Float64]:
        """Find the last knot before each position (...), and the distance (...) from it along the path in meters."""
        length_m = self.direction * (distances_m - self._half_length_m)
        # The transposed order puts the positions of one body next to each other: such a search is faster.
        knot = np.searchsorted(self._knots_m, np.ascontiguousarray(length_m.T), side="right").T - 1
        knot = np.maximum(knot, 0)
        return knot, length_m - self._knots_m[knot]


def _fit_cubics(poses: Float64, lengths_m: Float64) -> Float64:
    """Fit cubics (4, K, 3) between K poses that match position and heading at both ends, with linear yaw.

    A segment of infinite length continues straight.
    """
    yaw = np.deg2rad(poses[:, 2])
    slopes = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    lengths = lengths_m[:, None]
    mean, start, end = np.diff(poses, axis=0) / lengths, slopes[:-1], slopes[1:]
    linear = start.copy()
    square = (3 * mean - 2 * start - end) / lengths
    cube = (start + end - 2 * mean) / lengths**2
    linear[:, 2], square[:, 2], cube[:, 2] = mean[:, 2], 0.0, 0.0
    zeros = np.zeros((1, 3))
    return np.stack([
        poses,
        np.concatenate([linear, slopes[-1:]]),
        np.concatenate([square, zeros]),
        np.concatenate([cube, zeros]),
    ])  # fmt: skip


class StreetCorridor:
    """Area around a street in which each position belongs to the stretch of the street that is nearest to it.

    No two stretches share a position: scenery within the corridor of a stretch overlaps no other stretch.

    Args:
        street: Alignment of the street.
        span_m: First and last station.
        sample_spacing_m: Distance between the stations to which positions are compared.
    """

    def __init__(self, street: Alignment, span_m: tuple[float, float], sample_spacing_m: float = 8.0) -> None:
        self._street = street
        self._span_m = span_m
        self.sample_spacing_m = sample_spacing_m
        self._sample_stations_m = np.arange(*span_m, sample_spacing_m)
        self._sample_positions_m = street.compute_poses(self._sample_stations_m, 0.0)[:, :2]

    def sample_stations_m(self, spacing_m: float) -> Float64:
        """Sample stations (N,) of the street at even distances."""
        return np.arange(*self._span_m, spacing_m)

    def is_inside(self, stations_m: Float64, left_m: Float64) -> Bools:
        """Test which positions belong to their own stretch of the street.

        Args:
            stations_m: (N,) stations.
            left_m: (N,) offsets to the left of the street.

        Returns:
            (N,) True where no other stretch is nearer.
        """
        if self._street.is_straight:
            return np.ones(len(stations_m), dtype=bool)
        nearest_m = self.find_nearest_stations_m(self._street.compute_poses(stations_m, left_m)[:, :2])
        return np.asarray(np.abs(nearest_m - stations_m) <= self.sample_spacing_m)

    def find_nearest_stations_m(self, positions_m: Float64) -> Float64:
        """Find the stations (N,) of the samples that are nearest to positions (N, 2)."""
        nearest = compute_squared_distances_m2(positions_m, self._sample_positions_m).argmin(axis=1)
        return np.asarray(self._sample_stations_m[nearest])

    def find_half_widths_m(self, stations_m: Float64, side: int, min_m: float, max_m: float) -> Float64:
        """Find the width of the corridor on one side by bisection.

        Args:
            stations_m: (N,) stations.
            side: 1 for the left side, -1 for the right side.
            min_m: Smallest width.
            max_m: Largest width.

        Returns:
            (N,) widths in meters, measured from the centerline.
        """
        lower, upper = np.full(len(stations_m), min_m), np.full(len(stations_m), max_m)
        if self._street.is_straight:
            return upper
        lower[self.is_inside(stations_m, side * upper)] = max_m
        for _ in range(5):  # bisects a hundred meters to 3 m
            middle = (lower + upper) / 2
            inside = self.is_inside(stations_m, side * middle)
            lower, upper = np.where(inside, np.maximum(lower, middle), lower), np.where(inside, upper, middle)
        return lower
