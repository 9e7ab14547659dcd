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
# A peak is at least of so many points. There are no more rows in a LiDAR than MAX_ROWS.
PEAK_POINTS, MAX_ROWS = 1.5, 1000
# What is seen nowhere over a wider angle is beyond the field of view; over a smaller one, something is in the way.
BLIND_DEG = 30.0


class ScanEstimate(NamedTuple):
    """A scan pattern: (R,) elevations of the rows that returned anything, the highest first, and how many columns.

    `horizontal_fov_deg` is 360 for a full turn, `centre_deg` the azimuth of its middle; ranges are of the nearest and
    the farthest return.
    """

    elevations_deg: Float64
    columns: int
    horizontal_fov_deg: float
    centre_deg: float
    min_range_m: float
    max_range_m: float


def estimate_scan(scans: Sequence[Float64]) -> ScanEstimate | None:
    """Estimate a LiDAR's pattern from (N, 3) points of scans in its frame; None if they do not lie in rows.

    The LiDAR turns about z. A row whose rays all miss everything is not found.

    Example:
        >>> azimuth, elevation = np.meshgrid(np.deg2rad(np.arange(0.0, 360.0)), np.deg2rad([-20.0, -10.0, -7.0]))
        >>> around = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=2).reshape(-1, 3)
        >>> found = estimate_scan([8.0 * around])
        >>> found.elevations_deg.round(2), found.columns
        (array([ -7., -10., -20.]), 360)
    """
    points_m = np.concatenate([np.empty((0, 3)), *scans])
    if len(points_m) < 2:
        return None
    elevation_deg = np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])))
    azimuth_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    rows_deg = rows_of(elevation_deg)
    if rows_deg is None:
        return None
    row = np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)
    scan = np.repeat(np.arange(len(scans)), [len(one) for one in scans])
    step_deg = _column_step_deg(azimuth_deg, scan * len(rows_deg) + row)
    if step_deg is None:
        return None
    fov_deg, centre_deg = _field_of_view(azimuth_deg, step_deg)
    range_m = np.linalg.norm(points_m, axis=1)
    return ScanEstimate(
        np.array([np.median(elevation_deg[row == number]) for number in reversed(range(len(rows_deg)))]),
        max(1, round(fov_deg / step_deg)),
        fov_deg,
        centre_deg,
        float(range_m.min()),
        float(range_m.max()),
    )


def rows_of(elevation_deg: Float64) -> Float64 | None:
    """(R,) the elevations that points gather at, ascending, to a bin; None if that depends on how closely one looks."""
    lowest = float(elevation_deg.min()) - 4 * COARSEST_DEG
    number = ((elevation_deg - lowest) / BIN_DEG).astype(np.int64)
    size = int(number.max() + 4 * COARSEST_DEG / BIN_DEG)
    spectrum = np.fft.rfft(np.bincount(number, minlength=size).astype(np.float64))
    frequency = np.fft.rfftfreq(size)
    found: list[NDArray[np.intp]] = []
    widths = np.arange(np.log(FINEST_DEG), np.log(COARSEST_DEG), np.log(GROWTH))
    for width in np.exp(widths) / BIN_DEG:
        density = np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * width) ** 2), size)
        peak = (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])
        peak &= density[1:-1] > PEAK_POINTS / (width * np.sqrt(2 * np.pi))
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
