"""Scan pattern of a LiDAR, estimated from its points: rows, columns, field of view and range."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Float64, Int64

# Laser of each point, scan by scan; None if unknown.
LaserIndices = list[NDArray[np.integer]] | None


@dataclass(frozen=True)
class ScanEstimateParams:
    """Parameters of the estimate of a scan pattern.

    Args:
        bin_deg: Bins in which elevations are counted.
        min_blur_deg: Smallest width of the Gaussian that blurs the counts.
        max_blur_deg: Largest width.
        blur_growth: Ratio of two successive widths.
        min_stable_blurs: Successive widths for which the number of peaks must stay the same: a factor of 1.75. A width
            between that of a row and the gap between two rows gives one peak per row.
        min_peak_points: Smallest number of points of a peak.
        min_peak_share: Smallest share of all points in a peak; points on moving objects form peaks by chance.
        max_rows: Largest number of rows of a LiDAR.
        max_gap_deg: A gap in azimuth over a wider angle is outside the field of view, a smaller one is an occlusion.
        min_lasers: Smallest number of lasers of a cloud that is stored laser by laser.
        max_lasers: Largest number.
        min_laser_points: Smallest median number of points of a laser.
        min_step_ratio: Smallest ratio of the elevation steps between lasers to those within a laser.
        spread_bin_deg: Bins in which the spread of elevations is measured.
        origin_std_m: Standard deviation of the heights of the origins of lasers,
        elevation_std_deg: if the residuals have this standard deviation.
        max_origin_m: Largest height of an origin above or below the sensor frame; on flat ground a tilt looks like an
            origin far below.
        max_residual_ratio: Origins are used only if they reduce the residuals to this share.
    """

    bin_deg: float = 0.005
    min_blur_deg: float = 0.01
    max_blur_deg: float = 1.0
    blur_growth: float = 1.15
    min_stable_blurs: int = 5
    min_peak_points: float = 1.5
    min_peak_share: float = 5e-4
    max_rows: int = 1000
    max_gap_deg: float = 40.0
    min_lasers: int = 8
    max_lasers: int = 256
    min_laser_points: int = 100
    min_step_ratio: float = 3.0
    spread_bin_deg: float = 0.05
    origin_std_m: float = 0.05
    elevation_std_deg: float = 0.01
    max_origin_m: float = 0.3
    max_residual_ratio: float = 0.5


class ScanEstimate(NamedTuple):
    """Scan pattern of a LiDAR.

    Args:
        elevations_deg: (R,) elevations of the rows with returns, in descending order.
        num_columns: Number of columns over the horizontal field of view.
        horizontal_fov_deg: Horizontal field of view; 360 for a full revolution.
        center_azimuth_deg: Azimuth of its center.
        max_range_m: Range of the farthest return.
        origin_height_m: Mean height of the origin of the rays above the sensor frame; 0 if it is not needed.
    """

    elevations_deg: Float64
    num_columns: int
    horizontal_fov_deg: float
    center_azimuth_deg: float
    max_range_m: float
    origin_height_m: float


def compute_elevations_deg(points_m: Float64) -> Float64:
    """Compute the (N,) elevations of (N, 3) points."""
    return np.asarray(np.rad2deg(np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1]))))


def estimate_scan(
    scans: Sequence[Float64], laser_indices: LaserIndices = None, params: ScanEstimateParams = ScanEstimateParams()
) -> ScanEstimate | None:
    """Estimate the scan pattern of a LiDAR that rotates about z.

    Rows without any return are not found.

    Args:
        scans: (N, 3) points of each scan in the sensor frame.
        laser_indices: Laser of each point; estimated from the elevations if None.
        params: Parameters of the estimate.

    Returns:
        The pattern; None if the points do not lie in rows.
    """
    points_m = np.concatenate([np.empty((0, 3)), *scans])
    if len(points_m) < 2:
        return None
    elevations_deg = compute_elevations_deg(points_m)
    azimuths_deg = np.rad2deg(np.arctan2(points_m[:, 1], points_m[:, 0]))
    origin_m = 0.0
    if laser_indices is None:
        row_elevations_deg = estimate_row_elevations_deg(elevations_deg, params)
        if row_elevations_deg is None:
            return None
        row = np.searchsorted((row_elevations_deg[1:] + row_elevations_deg[:-1]) / 2, elevations_deg)
    else:
        _, row = np.unique(np.concatenate(laser_indices), return_inverse=True)
    medians_deg = np.array([np.median(elevations_deg[row == index]) for index in range(int(row.max()) + 1)])
    if laser_indices is not None:
        lines = fit_laser_lines(points_m, row, params)
        residual_deg = np.median(np.abs(elevations_deg - medians_deg[row]))
        is_better = np.median(np.abs(lines.residuals_deg)) < params.max_residual_ratio * residual_deg
        if is_better and np.abs(lines.origins_m).max() < params.max_origin_m:
            medians_deg = lines.elevations_deg
            origin_m = float(np.average(lines.origins_m, weights=np.bincount(row)))
    scan_index = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    column_deg = estimate_column_angle_deg(azimuths_deg, scan_index * len(medians_deg) + row)
    if column_deg is None:
        return None
    fov_deg, center_deg = estimate_field_of_view_deg(azimuths_deg, column_deg, params)
    max_range_m = float(np.linalg.norm(points_m, axis=1).max())
    num_columns = max(1, round(fov_deg / column_deg))
    return ScanEstimate(np.sort(medians_deg)[::-1], num_columns, fov_deg, center_deg, max_range_m, origin_m)


def infer_laser_indices(
    points_m: Float64, params: ScanEstimateParams = ScanEstimateParams()
) -> NDArray[np.integer] | None:
    """Infer the laser of each point of a cloud that is stored laser by laser, as in KITTI.

    Args:
        points_m: (N, 3) points in the sensor frame.
        params: Numbers of lasers and points.

    Returns:
        (N,) laser of each point; None if the cloud is not stored laser by laser.
    """
    azimuth_rad = np.arctan2(points_m[:, 1], points_m[:, 0])
    steps_rad = np.diff(azimuth_rad, prepend=azimuth_rad[:1])
    steps_rad = np.where(np.abs(steps_rad) > np.pi, 0.0, steps_rad)  # from -180 to 180 degrees
    direction = np.sign(steps_rad.sum())
    turned_rad = np.mod(direction * azimuth_rad, 2 * np.pi)
    laser = np.cumsum(np.diff(turned_rad, prepend=turned_rad[:1]) < -np.pi)
    num_points = np.bincount(laser)
    has_lasers = params.min_lasers <= len(num_points) <= params.max_lasers
    if not has_lasers or np.median(num_points) < params.min_laser_points:
        return None
    slope = points_m[:, 2] / np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    slope_steps = np.abs(np.diff(slope))
    laser_step = np.median(slope_steps[np.diff(laser) > 0])
    return laser if laser_step > params.min_step_ratio * np.median(slope_steps) else None


def compute_row_spread_deg(
    scans: Sequence[Float64], laser_indices: LaserIndices, params: ScanEstimateParams = ScanEstimateParams()
) -> float:
    """Compute how far points are spread around rows.

    Args:
        scans: (N, 3) points of each scan in the sensor frame.
        laser_indices: Laser of each point; None if unknown.
        params: Bins of elevations.

    Returns:
        Median distance from the lines of the lasers; without lasers, the angle that all rows together occupy.
    """
    points_m = np.concatenate(scans)
    if laser_indices is not None:
        _, row = np.unique(np.concatenate(laser_indices), return_inverse=True)
        return float(np.median(np.abs(fit_laser_lines(points_m, row, params).residuals_deg)))
    bins = ((compute_elevations_deg(points_m) + 90.0) / params.spread_bin_deg).astype(np.int64)
    share = np.bincount(bins) / len(points_m)
    return params.spread_bin_deg / float((share**2).sum())


class LaserLines(NamedTuple):
    """Lines in which lasers measure, as height over horizontal distance.

    Args:
        elevations_deg: (R,) elevation of each laser.
        origins_m: (R,) height of its origin.
        residuals_deg: (N,) angle between each point and the line of its laser.
    """

    elevations_deg: Float64
    origins_m: Float64
    residuals_deg: Float64


def fit_laser_lines(points_m: Float64, row: NDArray[np.intp], params: ScanEstimateParams) -> LaserLines:
    """Fit z = tan(elevation) r + origin for each laser, by least squares of the angle z / r without outliers.

    Args:
        points_m: (N, 3) points in the sensor frame.
        row: (N,) laser of each point.
        params: Prior of the origins.

    Returns:
        The lines.
    """
    distance_m = np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 1e-6)
    inverse, tangent = 1.0 / distance_m, points_m[:, 2] / distance_m
    residuals_deg, is_inlier = np.zeros(len(row)), np.ones(len(row), np.bool_)
    num_lasers = int(row.max()) + 1

    def sum_inliers(values: Float64) -> Float64:
        """Sum values over the inliers of each laser."""
        return np.bincount(row, is_inlier * values, minlength=num_lasers).astype(np.float64)

    for _ in range(3):
        count = np.maximum(sum_inliers(np.ones(len(row))), 1)
        sum_inverse, sum_tangent = sum_inliers(inverse), sum_inliers(tangent)
        prior = count * (np.deg2rad(params.elevation_std_deg) / params.origin_std_m) ** 2
        covariance = sum_inliers(inverse * tangent) - sum_inverse * sum_tangent / count
        variance = sum_inliers(inverse**2) - sum_inverse**2 / count
        # Lasers without information have the common origin.
        common_m = covariance.sum() / (variance + prior / 100).sum()
        origins_m = common_m + (covariance - common_m * variance) / (variance + prior)
        slope = (sum_tangent - origins_m * sum_inverse) / count
        residuals_deg = np.rad2deg(tangent - slope[row] - origins_m[row] * inverse)
        is_inlier = np.abs(residuals_deg) <= 4 * np.median(np.abs(residuals_deg)) + 1e-9
    return LaserLines(np.rad2deg(np.arctan(slope)), origins_m, residuals_deg)


def estimate_row_elevations_deg(
    elevations_deg: Float64, params: ScanEstimateParams = ScanEstimateParams()
) -> Float64 | None:
    """Estimate the elevations of rows as the peaks of a density whose number is stable over many widths of the blur.

    Args:
        elevations_deg: (N,) elevations of points.
        params: Bins, blurs and peaks.

    Returns:
        (R,) elevations in ascending order, accurate to a bin; None if no number of peaks is stable.
    """
    lowest_deg = float(elevations_deg.min()) - 4 * params.max_blur_deg
    bins = ((elevations_deg - lowest_deg) / params.bin_deg).astype(np.int64)
    num_bins = int(bins.max() + 4 * params.max_blur_deg / params.bin_deg)
    min_points = max(params.min_peak_points, params.min_peak_share * len(elevations_deg))
    spectrum = np.fft.rfft(np.bincount(bins, minlength=num_bins).astype(np.float64))
    frequency = np.fft.rfftfreq(num_bins)
    peaks: list[NDArray[np.intp]] = []
    log_blurs = np.arange(np.log(params.min_blur_deg), np.log(params.max_blur_deg), np.log(params.blur_growth))
    for blur in np.exp(log_blurs) / params.bin_deg:
        density = np.fft.irfft(spectrum * np.exp(-2 * (np.pi * frequency * blur) ** 2), num_bins)
        is_peak = (density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])
        is_peak &= density[1:-1] > min_points / (blur * np.sqrt(2 * np.pi))
        peaks.append(np.flatnonzero(is_peak) + 1)
    counts = np.array([len(blur_peaks) for blur_peaks in peaks])
    run_begins = np.flatnonzero(np.diff(counts, prepend=-1))
    run_lengths = np.diff(run_begins, append=len(counts))
    run_lengths[(counts[run_begins] < 1) | (counts[run_begins] > params.max_rows)] = 0
    longest = int(run_lengths.argmax())
    if run_lengths[longest] < params.min_stable_blurs:
        return None
    middle = run_begins[longest] + run_lengths[longest] // 2
    return np.asarray(lowest_deg + params.bin_deg * (peaks[middle] + 0.5))


def estimate_column_angle_deg(azimuths_deg: Float64, rows: Int64) -> float | None:
    """Estimate the angle between two columns as the mean of the gaps between neighbors in a row.

    Args:
        azimuths_deg: (N,) azimuths of points.
        rows: (N,) row of each point, different for each scan.

    Returns:
        Angle in degrees; None without neighbors.
    """
    order = np.lexsort((azimuths_deg, rows))
    gaps_deg = np.diff(azimuths_deg[order])[np.diff(rows[order]) == 0]
    gaps_deg = gaps_deg[gaps_deg > 1e-4]  # smaller gaps are two returns of one ray
    if not len(gaps_deg):
        return None
    column_deg = float(np.median(gaps_deg))
    for _ in range(3):
        column_deg = float(gaps_deg[np.rint(gaps_deg / column_deg) == 1].mean())
    return column_deg


def estimate_field_of_view_deg(
    azimuths_deg: Float64, column_deg: float, params: ScanEstimateParams
) -> tuple[float, float]:
    """Estimate the horizontal field of view from the widest gap in azimuth.

    Args:
        azimuths_deg: (N,) azimuths of points.
        column_deg: Angle between two columns.
        params: Widest gap of a full revolution.

    Returns:
        Field of view, and azimuth of its center: 360 and 0 for a full revolution.
    """
    ordered_deg = np.sort(azimuths_deg)
    gaps_deg = np.diff(ordered_deg, append=ordered_deg[0] + 360.0)
    widest = int(gaps_deg.argmax())
    if gaps_deg[widest] < params.max_gap_deg:
        return 360.0, 0.0
    center_deg = float(ordered_deg[widest] + gaps_deg[widest] / 2 + 180.0)
    fov_deg = min(360.0, 360.0 - float(gaps_deg[widest]) + column_deg)
    return fov_deg, (center_deg + 180.0) % 360.0 - 180.0
