"""How a LiDAR scans, from what it saw: rows, columns, ranges."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Float64, Int64

# Elevations are counted in bins of this width and blurred with one width after the other.
BIN_DEG, FINEST_DEG, COARSEST_DEG, GROWTH = 0.005, 0.01, 1.0, 1.15
# As long as a blur is wider than a row and narrower than the space between two, the number of peaks is that of rows; it
# has to stay through so many widths, which is a factor of 1.75.
SAME_THROUGH = 5
# A peak is at least of so many points, and of such a share of all: where something moved, some lie together by chance.
# There are no more rows in a LiDAR than MAX_ROWS.
PEAK_POINTS, PEAK_SHARE, MAX_ROWS = 1.5, 5e-4, 1000
# What is seen nowhere over a wider angle is beyond the field of view; over a smaller one, something is in the way.
BLIND_DEG = 40.0
# Clouds that are stored laser by laser, each in a turn: so many, of so many points at least, with so much larger steps
# of elevation from one laser to the next.
LASERS, LASER_POINTS = (8, 256), 100
STEPS = 3.0
# How closely it is looked at how far points lie from rows.
SPREAD_DEG = 0.05
# Lasers leave from one height, within so much or so, as far as their points do not say it to so many degrees; not from
# farther above or below the origin, and only if points lie so much closer to what they say then.
ORIGIN_M, LINE_DEG, HIGHEST_M, CLOSER = 0.05, 0.01, 0.3, 0.5

# The number of the laser of each point, scan by scan; None if unknown.
Lasers = list[NDArray[np.integer]] | None


class ScanEstimate(NamedTuple):
    """A scan pattern: (R,) elevations of the rows that returned anything, the highest first, and how many columns.

    `horizontal_fov_deg` is 360 for a full turn, `centre_deg` the azimuth of its middle; the range is that of
    the farthest return. `origin_m` is the height above the origin of the frame that the rays leave from, on average; 0
    if they need no other.
    """

    elevations_deg: Float64
    columns: int
    horizontal_fov_deg: float
    centre_deg: float
    max_range_m: float
    origin_m: float


def estimate_scan(scans: Sequence[Float64], lasers: Lasers = None) -> ScanEstimate | None:
    """Estimate a LiDAR's pattern from (N, 3) points of scans in its frame; None if they do not lie in rows.

    The LiDAR turns about z. A row whose rays all miss everything is not found. `lasers` says which laser each point is
    of; they are found by elevation if unknown.
    """
    points_m = np.concatenate([np.empty((0, 3)), *scans])
    if len(points_m) < 2:
        return None
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    origin_m = 0.0
    if lasers is None:
        rows_deg = rows_of(elevation_deg)
        if rows_deg is None:
            return None
        row = np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)
    else:
        _, row = np.unique(np.concatenate(lasers), return_inverse=True)
    found_deg = np.array([np.median(elevation_deg[row == number]) for number in range(int(row.max()) + 1)])
    if lasers is not None:
        lines_deg, origins_m, off_deg = _lines(points_m, row)
        closer = np.median(np.abs(off_deg)) < CLOSER * np.median(np.abs(elevation_deg - found_deg[row]))
        if closer and np.abs(origins_m).max() < HIGHEST_M:  # on flat ground a tilt looks like an origin far below
            found_deg, origin_m = lines_deg, float(np.average(origins_m, weights=np.bincount(row)))
    scan = np.repeat(np.arange(len(scans)), [len(one) for one in scans])
    step_deg = _column_step_deg(azimuth_deg, scan * len(found_deg) + row)
    if step_deg is None:
        return None
    fov_deg, centre_deg = _field_of_view(azimuth_deg, step_deg)
    range_m = np.linalg.norm(points_m, axis=1)
    return ScanEstimate(
        np.sort(found_deg)[::-1], max(1, round(fov_deg / step_deg)), fov_deg, centre_deg, float(range_m.max()), origin_m
    )


def lasers_in_order(points_m: Float64) -> NDArray[np.integer] | None:
    """(N,) the laser of each point of a cloud that is stored laser by laser, as KITTI's; None if it is not."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    jump = np.diff(azimuth, prepend=azimuth[:1])
    jump = np.where(np.abs(jump) > np.pi, 0.0, jump)  # across the back
    sense = np.sign(jump.sum())
    turned = np.mod(sense * azimuth, 2 * np.pi)
    laser = np.cumsum(np.diff(turned, prepend=turned[:1]) < -np.pi)
    sizes = np.bincount(laser)
    if not LASERS[0] <= len(sizes) <= LASERS[1] or np.median(sizes) < LASER_POINTS:
        return None
    slope = points_m[:, 2] / np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    steps = np.abs(np.diff(slope))
    return laser if np.median(steps[np.diff(laser) > 0]) > STEPS * np.median(steps) else None


def spread_deg(scans: Sequence[Float64], lasers: Lasers) -> float:
    """How far points lie from rows: from those of their lasers, or how wide an angle all rows together take."""
    points_m = np.concatenate(scans)
    if lasers is not None:
        _, row = np.unique(np.concatenate(lasers), return_inverse=True)
        return float(np.median(np.abs(_lines(points_m, row)[2])))
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
    share = np.bincount(((elevation_deg + 90.0) / SPREAD_DEG).astype(np.int64)) / len(points_m)
    return SPREAD_DEG / float((share**2).sum())


def _lines(points_m: Float64, row: NDArray[np.intp]) -> tuple[Float64, Float64, Float64]:
    """Of each laser the elevation and the height of its origin, and how far off each point lies, in degrees.

    z = tan(elevation) r + origin, least squares of z / r: how far off a point is, is an angle.
    """
    r_m = np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    near, tangent = 1.0 / r_m, points_m[:, 2] / r_m
    off, kept = np.zeros(len(row)), np.ones(len(row), np.bool_)
    for _ in range(3):
        count, of_near, of_tangent, squared, product = (
            np.bincount(row, kept * of, minlength=int(row.max()) + 1)
            for of in (np.ones(len(row)), near, tangent, near**2, near * tangent)
        )
        count = np.maximum(count, 1)
        prior = count * (np.deg2rad(LINE_DEG) / ORIGIN_M) ** 2
        told, weight = product - of_near * of_tangent / count, squared - of_near**2 / count
        common_m = told.sum() / (weight + prior / 100).sum()
        origin_m = common_m + (told - common_m * weight) / (weight + prior)
        slope = (of_tangent - origin_m * of_near) / count
        off = np.rad2deg(tangent - slope[row] - origin_m[row] * near)
        kept = np.abs(off) <= 4 * np.median(np.abs(off)) + 1e-9
    return np.rad2deg(np.arctan(slope)), origin_m, off


def rows_of(elevation_deg: Float64) -> Float64 | None:
    """(R,) the elevations that points gather at, ascending, to a bin; None if that depends on how closely one looks."""
    lowest = float(elevation_deg.min()) - 4 * COARSEST_DEG
    number = ((elevation_deg - lowest) / BIN_DEG).astype(np.int64)
    size = int(number.max() + 4 * COARSEST_DEG / BIN_DEG)
    least = max(PEAK_POINTS, PEAK_SHARE * len(elevation_deg))
    spectrum = np.fft.rfft(np.bincount(number, minlength=size).astype(np.float64))
    frequency = np.fft.rfftfreq(size)
    found: list[NDArray[np.intp]] = []
    widths = np.arange(np.log(FINEST_DEG), np.log(COARSEST_DEG), np.log(GROWTH))
    for width in np.exp(widths) / BIN_DEG:
        density = np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * width) ** 2), size)
        peak = (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])
        peak &= density[1:-1] > least / (width * np.sqrt(2 * np.pi))
        found.append(np.flatnonzero(peak) + 1)
    counts = np.array([len(peaks) for peaks in found])
    starts = np.flatnonzero(np.diff(counts, prepend=-1))
    lengths = np.diff(starts, append=len(counts))
    lengths[(counts[starts] < 1) | (counts[starts] > MAX_ROWS)] = 0
    longest = int(lengths.argmax())
    if lengths[longest] < SAME_THROUGH:
        return None
    return np.asarray(lowest + BIN_DEG * (found[starts[longest] + lengths[longest] // 2] + 0.5))


def _column_step_deg(azimuth_deg: Float64, of_row: Int64) -> float | None:
    """The angle from a column to the next: most points have a neighbour in their row."""
    order = np.lexsort((azimuth_deg, of_row))
    gaps_deg = np.diff(azimuth_deg[order])[np.diff(of_row[order]) == 0]
    gaps_deg = gaps_deg[gaps_deg > 1e-4]  # two returns of one ray
    if not len(gaps_deg):
        return None
    step_deg = float(np.median(gaps_deg))
    for _ in range(3):
        step_deg = float(gaps_deg[np.rint(gaps_deg / step_deg) == 1].mean())
    return step_deg


def _field_of_view(azimuth_deg: Float64, step_deg: float) -> tuple[float, float]:
    """How wide it is and where its middle is; full turns have theirs ahead."""
    ordered = np.sort(azimuth_deg)
    gaps_deg = np.diff(ordered, append=ordered[0] + 360.0)
    widest = int(gaps_deg.argmax())
    if gaps_deg[widest] < BLIND_DEG:
        return 360.0, 0.0
    centre_deg = float(ordered[widest] + gaps_deg[widest] / 2 + 180.0)
    return min(360.0, 360.0 - float(gaps_deg[widest]) + step_deg), (centre_deg + 180.0) % 360.0 - 180.0
