"""Calibration of the range of LiDARs by the rays that returned from a road in a recording."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float32, Float64
from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.returns import MAX_RETURN_PROBABILITY, Material, compute_log_excess
from torchcover.simulation.rig import Rig
from torchcover.simulation.road_returns import GroundRays, RoadParams, assign_rows, count_ground_rays, fit_road_profile


@dataclass(frozen=True)
class CalibrationParams:
    """Parameters of the calibration of a LiDAR by a recording.

    Args:
        prior_std: Most likely standard deviation of ln range without a recording.
        prior_log_error: Standard deviation of its logarithm.
        min_log_likelihood_drop: The range is observable if twice the range reduces the log-likelihood by this much:
            two standard errors.
        derivative_step: Step of the numerical second derivative of the log-likelihood.
        min_rays: Smallest number of rays to a road, and of differences for the noise.
        min_displacement_m: Smallest motion of the vehicle in a recording of several sweeps.
        max_noise_range_m: Range up to which the noise of ranges is measured.
        road: Parameters of the search for rays.
    """

    prior_std: float = 0.3
    prior_log_error: float = 0.7
    min_log_likelihood_drop: float = 2.0
    derivative_step: float = 0.05
    min_rays: int = 200
    min_displacement_m: float = 2.0
    max_noise_range_m: float = 12.0
    road: RoadParams = RoadParams()


class ReturnFit(NamedTuple):
    """Maximum-likelihood estimate of the range of a LiDAR.

    Args:
        range_at_10_percent_m: Range at 10 % reflectivity.
        log_range_std: Standard deviation of ln range.
        log_range_error: Standard error of ln `range_at_10_percent_m`.
        log_std_error: Standard error of ln `log_range_std`.
        is_range_observable: Whether the recording determines the range: twice the range would cause other returns.
    """

    range_at_10_percent_m: float
    log_range_std: float
    log_range_error: float
    log_std_error: float
    is_range_observable: bool


def fit_returns(
    rays: GroundRays, road_material: Material, params: CalibrationParams = CalibrationParams()
) -> ReturnFit:
    """Fit the range and its spread to the returns from a road; all rays of a cell hit one spot and count as one.

    Args:
        rays: Rays towards the road.
        road_material: Material of the road.
        params: Prior of the spread.

    Returns:
        The estimate.
    """
    from scipy.optimize import minimize, minimize_scalar
    from scipy.special import log_ndtr

    excess_at_1_m = compute_log_excess(
        rays.range_m, rays.cos_incidence, road_material.numeric_reflectivity, road_material.incidence_exponent, 1.0
    )
    return_share = rays.return_counts / rays.ray_counts

    def compute_loss(parameters: Float64) -> float:
        """Compute the negative log-likelihood of ln range and ln spread."""
        log_range, log_std = parameters
        excess = (excess_at_1_m + 2 * log_range) / np.hypot(2 * np.exp(log_std), road_material.log_reflectivity_std)
        log_return = np.log(MAX_RETURN_PROBABILITY) + log_ndtr(excess)
        prior = ((log_std - np.log(params.prior_std)) / params.prior_log_error) ** 2 / 2
        log_likelihood = return_share * log_return + (1 - return_share) * np.log1p(-np.exp(log_return))
        return float(prior - log_likelihood.sum())

    # If all rays return, any range that is long enough is as likely: the search begins at a short range.
    best = minimize(compute_loss, np.log([rays.range_m.max(), params.prior_std]), method="Nelder-Mead")

    def compute_loss_of_twice_the_range(log_std: float) -> float:
        return compute_loss(np.array([best.x[0] + np.log(2.0), log_std]))

    twice = minimize_scalar(compute_loss_of_twice_the_range, (-3.0, -1.0))
    step = params.derivative_step
    hessian = np.empty((2, 2))
    for row, first in enumerate(np.eye(2) * step):
        for column, second in enumerate(np.eye(2) * step):
            low_low, low_high = compute_loss(best.x - first - second), compute_loss(best.x - first + second)
            high_low, high_high = compute_loss(best.x + first - second), compute_loss(best.x + first + second)
            hessian[row, column] = (low_low - low_high - high_low + high_high) / (4 * step**2)
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(hessian, hermitian=True)), 0.0))
    range_m, log_range_std = np.exp(best.x).tolist()
    log_range_error, log_std_error = errors.tolist()
    is_observable = bool(twice.fun - best.fun > params.min_log_likelihood_drop)
    return ReturnFit(range_m, log_range_std, log_range_error, log_std_error, is_observable)


class LidarCalibration(NamedTuple):
    """Calibration of one LiDAR by a recording.

    Args:
        name: Name in the rig.
        num_rays: Number of rays towards the road.
        max_range_m: Range of the farthest of them.
        fit: Estimate of the range.
        range_noise_m: Standard deviation of ranges to the road; NaN without near road.
    """

    name: str
    num_rays: float
    max_range_m: float
    fit: ReturnFit
    range_noise_m: float

    @property
    def text(self) -> str:
        """Result in one line."""
        fit, rays = self.fit, f"{self.num_rays:,.0f} rays to a road up to {self.max_range_m:.0f} m away"
        noise = f"; noise {1e3 * self.range_noise_m:.1f} mm" if np.isfinite(self.range_noise_m) else ""
        if not fit.is_range_observable:
            return (
                f"{self.name}: {rays} cannot tell the range, because nearly all of them return; a distant open road is "
                f"needed{noise}"
            )
        low_m, high_m = fit.range_at_10_percent_m * np.exp([-fit.log_range_error, fit.log_range_error])
        return (
            f"{self.name}: {fit.range_at_10_percent_m:.0f} m at 10 % ({low_m:.0f} to {high_m:.0f}), spread "
            f"{fit.log_range_std:.2f} (within a factor of {np.exp(fit.log_std_error):.1f}), from {rays}{noise}"
        )


def calibrate(
    recording: Recording, rig: Rig, params: CalibrationParams = CalibrationParams()
) -> tuple[Rig, list[LidarCalibration]]:
    """Calibrate the LiDARs of a rig: range at 10 % reflectivity, its spread, and noise.

    The road is assumed to be dry asphalt, `datasets/materials/road.yaml`.

    Args:
        recording: Recording of the LiDARs, on a straight road if possible.
        rig: Rig with mounts and scan patterns; names are ignored if rig and recording have one LiDAR each.
        params: Parameters of the calibration.

    Returns:
        The calibrated rig, and the calibration of each LiDAR; keys of ranges that are not observable are unchanged.

    Raises:
        ValueError: The recording has no LiDAR of the rig or no ray towards a road, the vehicle does not move, or a
            sweep occurs twice.
        OSError: A file is missing.
    """
    recorded_names = match_sensor_names(recording, rig)
    check_motion(recording, params)
    road_material, calibrations, sensors = Material.load("road"), [], []
    for sensor in rig.sensors:
        if not isinstance(sensor, Lidar) or sensor.name not in recorded_names:
            sensors.append(sensor)
            continue
        sweeps = []
        for index in recording.key_frames:
            scan = recording.read_scan(recorded_names[sensor.name], index)
            sweeps.append(transform_to_vehicle(scan, recording.ego_box).points_m)
        check_sweeps_differ(sweeps, f"{recording.path}: {sensor.name}")
        calibration = calibrate_lidar(sensor, sweeps, road_material, str(recording.path), params)
        keys = sensor.model_dump(exclude_unset=True)
        if calibration.fit.is_range_observable:
            keys["range_at_10_percent_m"] = round(calibration.fit.range_at_10_percent_m, 1)
            keys["log_range_std"] = round(calibration.fit.log_range_std, 3)
        if np.isfinite(calibration.range_noise_m):
            keys["range_noise_m"] = round(calibration.range_noise_m, 4)
        sensors.append(Lidar.model_validate(keys))
        calibrations.append(calibration)
    return rig.model_copy(update={"sensors": tuple(sensors)}), calibrations


def match_sensor_names(recording: Recording, rig: Rig) -> dict[str, str]:
    """Match the LiDARs of a rig and of a recording.

    Args:
        recording: The recording.
        rig: The rig.

    Returns:
        Name in the recording by name in the rig.

    Raises:
        ValueError: They have no LiDAR in common.
    """
    lidars = [sensor.name for sensor in rig.sensors if isinstance(sensor, Lidar)]
    common_names = {name: name for name in lidars if name in recording.sensors}
    if not common_names and len(lidars) == len(recording.sensors) == 1:
        return {lidars[0]: recording.sensors[0]}
    if not common_names:
        raise ValueError(
            f"{recording.path}: no LiDAR of the rig {rig.name!r} is in it; the rig has {', '.join(lidars) or 'none'}, "
            f"the recording {', '.join(recording.sensors)}"
        )
    return common_names


def check_motion(recording: Recording, params: CalibrationParams) -> None:
    """Check that the vehicle moves: sweeps from one position show the same road, which would understate the errors.

    Args:
        recording: The recording.
        params: Smallest displacement.

    Raises:
        ValueError: The recording has no sweep, or the vehicle does not move.
    """
    if not recording.key_frames:
        raise ValueError(f"{recording.path}: no sweep in it")
    poses = [recording.get_world_T_vehicle(index) for index in recording.key_frames]
    positions_m = [pose[:3, 3] for pose in poses if pose is not None]
    if len(positions_m) > 1:
        displacement_m = float(np.ptp(positions_m, axis=0).max())
        if displacement_m < params.min_displacement_m:
            raise ValueError(
                f"{recording.path}: the vehicle does not move, {len(positions_m)} sweeps within {displacement_m:.2f} m "
                f"show the same road: use one sweep, or a drive of at least {params.min_displacement_m:g} m"
            )


def check_sweeps_differ(sweeps: Sequence[Float32], source: str) -> None:
    """Check that no sweep occurs twice, as is possible in recordings without poses.

    Args:
        sweeps: (N, 3) points of each sweep.
        source: Recording and sensor, for messages.

    Raises:
        ValueError: Two sweeps are equal.
    """
    index_by_content: dict[bytes, int] = {}
    for index, sweep in enumerate(sweeps):
        first_index = index_by_content.setdefault(sweep.tobytes(), index)
        if first_index != index and len(sweep):
            raise ValueError(
                f"{source}: sweeps {first_index} and {index} are the same cloud; use each sweep once, as copies "
                "understate the errors"
            )


def calibrate_lidar(
    lidar: Lidar, sweeps: Sequence[Float32], road_material: Material, source: str, params: CalibrationParams
) -> LidarCalibration:
    """Calibrate one LiDAR.

    Args:
        lidar: LiDAR with its mount and scan pattern.
        sweeps: (N, 3) points of each sweep in the vehicle frame.
        road_material: Material of the road.
        source: Recording, for messages.
        params: Parameters of the calibration.

    Returns:
        The calibration.

    Raises:
        ValueError: Too few rays point at a road.
    """
    rays = count_ground_rays(sweeps, lidar, params.road)
    num_rays = float(rays.ray_counts.sum())
    if num_rays < params.min_rays:
        raise ValueError(
            f"{source}: {lidar.name} has {num_rays:.0f} rays to an open road {params.road.min_range_m:g} to "
            f"{params.road.max_range_m:g} m away; {params.min_rays} are needed: a drive on a straight, level road, and "
            "a rig with correct mounts"
        )
    fit = fit_returns(rays, road_material, params)
    range_noise_m = estimate_range_noise_m(sweeps, lidar, params)
    return LidarCalibration(lidar.name, num_rays, float(rays.range_m.max()), fit, range_noise_m)


def estimate_range_noise_m(sweeps: Sequence[Float32], lidar: Lidar, params: CalibrationParams) -> float:
    """Estimate the noise of ranges to near road from second differences of three neighbors in a row.

    Args:
        sweeps: (N, 3) points of each sweep in the vehicle frame.
        lidar: LiDAR with its mount and scan pattern.
        params: Largest range, and smallest number of differences.

    Returns:
        Standard deviation in meters; NaN with too few differences.
    """
    differences_m, column_deg = [np.empty(0)], lidar.horizontal_fov_deg / lidar.columns
    for sweep in sweeps:
        points_m = sweep.astype(np.float64)
        height_m = points_m[:, 2] - fit_road_profile(points_m, params.road).compute_heights_m(points_m)
        is_road = np.abs(height_m) < params.road.max_ground_offset_m
        is_road &= np.abs(points_m[:, 1]) < params.road.half_lanes_m
        row, azimuth_deg, range_m = assign_rows(points_m[is_road], lidar)
        order = np.lexsort((azimuth_deg, row))
        row, azimuth_deg, range_m = row[order], azimuth_deg[order], range_m[order]
        are_neighbors = (row[2:] == row[:-2]) & (azimuth_deg[2:] - azimuth_deg[:-2] < 2.5 * column_deg)
        are_neighbors &= range_m[1:-1] < params.max_noise_range_m
        second_differences_m = range_m[:-2] - 2 * range_m[1:-1] + range_m[2:]
        differences_m.append(second_differences_m[are_neighbors])
    all_differences_m = np.concatenate(differences_m)
    if len(all_differences_m) < params.min_rays:
        return float("nan")
    # A second difference has sqrt(6) times the noise; 0.6745 is the median of the absolute normal distribution.
    return float(np.median(np.abs(all_differences_m)) / 0.6745 / np.sqrt(6.0))
