"""Which rays of a real LiDAR returned from the road, and which should have: how a rig is calibrated by a recording."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int64
from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import transform_to_vehicle
from torchcover.simulation.lidar import Lidar
from torchcover.simulation.returns import MAX_RETURN_PROBABILITY, Material, compute_log_excess
from torchcover.simulation.rig import Rig

# Of a road that is straight ahead; beside it there are kerbs and grass. Its height is fitted to the inner part.
HALF_ROAD_M, HALF_LANES_M = 10.0, 7.0
# Rays to nearer ground always return, or the vehicle hides them.
NEAREST_M, FARTHEST_M = 10.0, 125.0
SECTOR_DEG = 0.5
# Higher than this above the road, or lower than what no road hides, is in nobody's way.
OVERHEAD_M = 2.5
# How far a return from the ground may lie off it, and how much of that is an error of the ground.
OFF_GROUND_M, OFF_GROUND_SHARE = 0.12, 0.005
# Shares of the range to the ground: a ray is free that meets nothing before it, and returned if it ended about there.
CLEAR, ABOUT = 0.97, (0.85, 1.2)
# A sector in which fewer of the nearest rays return is blocked by the vehicle or by the housing of another sensor.
OPEN_SHARE = 0.6
# What is known before anything was seen: the spread of ln range.
USUAL_SPREAD, SPREAD_IS_SURE_TO = 0.3, 0.7
# Twice the range is refused where ln of the likelihood falls by so much: two standard errors.
LESS_LIKELY = 2.0
CURVATURE_OVER = 0.05
FEWEST_RAYS = 200
# A drive of less sees one road.
LEAST_WAY_M = 2.0
NOISE_WITHIN_M = 12.0


class GroundRays(NamedTuple):
    """Rays that point at the road, nothing being in their way, by (C,) cells: one row in one sector of one sweep.

    How far the ground is there and how the rays meet it, how many rays there are, and how many of them returned from
    there: too many where a row is taken for its neighbour. `azimuth_deg` is the middle of the sector in the sensor's
    frame.
    """

    range_m: Float64
    cos_incidence: Float64
    ray_counts: Float64
    return_counts: Float64
    azimuth_deg: Float64
    sweep_indices: Int64

    def select(self, mask: Bools) -> "GroundRays":
        """Those of some cells."""
        return GroundRays._make(column[mask] for column in self)


class RoadProfile(NamedTuple):
    """The road as z of the vehicle frame: `level_m` + two slopes, and a curvature ahead and one behind."""

    coefficients: Float64

    def compute_heights_m(self, points_m: Float64) -> Float64:
        """(N,) z of the road below N points."""
        return np.asarray(_terms(points_m) @ self.coefficients)


def _terms(points_m: Float64) -> Float64:
    x, y = points_m[:, 0], points_m[:, 1]
    squared = (x / 40.0) ** 2
    return np.column_stack([np.ones(len(x)), x, y, squared * (x > 0), squared * (x < 0)])


def fit_road_profile(points_m: Float64) -> RoadProfile:
    """Fit the road under a sweep, (N, 3) points in the vehicle frame, from near to far."""
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    chosen = (np.abs(points_m[:, 1]) < HALF_LANES_M) & (range_m < 90.0) & (range_m > 3.5)
    points_m, range_m = points_m[chosen], range_m[chosen]
    low = (range_m < 15.0) & (np.abs(points_m[:, 2]) < 0.6)
    terms, coefficients = _terms(points_m), np.zeros(5)
    if low.any():
        coefficients[0] = np.median(points_m[low, 2])
    # A curvature has to be shown: without far points it is none.
    shrink = np.diag([0.0, 0.0, 0.0, 2000.0, 2000.0])
    for farthest_m in (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 80):
        off_m = np.abs(points_m[:, 2] - terms @ coefficients)
        near = (off_m < OFF_GROUND_M + 0.004 * range_m) & (range_m < farthest_m)
        if np.count_nonzero(near) < 50:
            continue
        weighted = terms[near].T * range_m[near] ** 2  # a square metre counts alike, wherever it is
        coefficients = np.linalg.solve(weighted @ terms[near] + shrink, weighted @ points_m[near, 2])
    return RoadProfile(coefficients)


def count_ground_rays(sweeps: Sequence[NDArray[np.floating]], lidar: Lidar) -> GroundRays:
    """The rays of a LiDAR that point at the road, and how many of them returned.

    Which rays there were is known from its scan pattern: the row of a return is the nearest one, and each row has
    `columns` rays to a turn.
    """
    found = [_of_sweep(np.asarray(points_m, dtype=np.float64), lidar, number) for number, points_m in enumerate(sweeps)]
    return GroundRays._make(np.concatenate(columns) for columns in zip(*found, strict=True))


def _of_sweep(points_m: Float64, lidar: Lidar, number: int) -> GroundRays:
    vehicle_T_sensor, rows_deg = lidar.mount.to_matrix(), np.sort(lidar.compute_elevations_deg())
    road, sectors = fit_road_profile(points_m), round(360.0 / SECTOR_DEG)
    row, azimuth_deg, range_m = _in_rows(points_m, lidar)
    sector = np.floor((azimuth_deg + 180.0) / SECTOR_DEG).astype(np.int64) % sectors
    above_m = points_m[:, 2] - road.compute_heights_m(points_m)
    middle_deg: Float64 = (np.arange(sectors, dtype=np.float64) + 0.5) * SECTOR_DEG - 180.0
    expected_m, place_m = _expected(vehicle_T_sensor, rows_deg, middle_deg, road)
    height_m = vehicle_T_sensor[2, 3] - road.compute_heights_m(vehicle_T_sensor[None, :3, 3])[0]
    stands = (above_m > OFF_GROUND_M + OFF_GROUND_SHARE * range_m) & (above_m < OVERHEAD_M) & (range_m > 2.0)
    order = np.flatnonzero(stands)[np.argsort(sector[stands], kind="stable")]
    of_sector = np.split(order, np.searchsorted(sector[order], np.arange(1, sectors)))
    blocked = np.empty(expected_m.shape, dtype=np.bool_)
    for k in range(sectors):
        there = np.concatenate([of_sector[beside % sectors] for beside in (k - 1, k, k + 1)])
        blocked[:, k] = _blocked(expected_m[:, k], height_m, range_m[there], above_m[there])
    cell = row * sectors + sector
    share = range_m / expected_m.reshape(-1)[cell]

    def counted(which: Bools) -> Float64:
        return np.bincount(cell[which], minlength=expected_m.size).reshape(expected_m.shape).astype(np.float64)

    returned, beyond = counted((share > ABOUT[0]) & (share < ABOUT[1])), counted(share >= ABOUT[1])
    rays = np.maximum(lidar.columns * SECTOR_DEG / lidar.horizontal_fov_deg - beyond, 0.0)
    free = ~blocked & (np.abs(place_m[..., 1]) < HALF_ROAD_M) & (rays > 0)
    free &= (expected_m > NEAREST_M) & (expected_m < FARTHEST_M)
    near = free & (expected_m < 2 * NEAREST_M)
    opened = (returned * near).sum(axis=0) >= OPEN_SHARE * (rays * near).sum(axis=0)
    free &= opened & near.any(axis=0)
    azimuths_deg = np.broadcast_to(middle_deg, expected_m.shape)
    return GroundRays(
        expected_m[free],
        height_m / expected_m[free],
        rays[free],
        returned[free],
        azimuths_deg[free],
        np.full(np.count_nonzero(free), number, dtype=np.int64),
    )


def _in_rows(points_m: Float64, lidar: Lidar) -> tuple[NDArray[np.intp], Float64, Float64]:
    """(N,) row of a LiDAR that each point is nearest to, its azimuth in degrees and its range."""
    in_sensor_m = transform_points(invert(lidar.mount.to_matrix()), points_m)
    x, y, z = in_sensor_m.T
    rows_deg, elevation_deg = np.sort(lidar.compute_elevations_deg()), np.rad2deg(np.arctan2(z, np.hypot(x, y)))
    row = np.searchsorted((rows_deg[1:] + rows_deg[:-1]) / 2, elevation_deg)
    return row, np.rad2deg(np.arctan2(y, x)), np.linalg.norm(in_sensor_m, axis=1)


def _blocked(expected_m: Float64, height_m: float, range_m: Float64, above_m: Float64) -> Bools:
    """(rows,) whether what stands in a sector, (K,) points of it, is in the way of rays to the road.

    A ray passes over what is lower than the ray is there. Two points are needed, for one may be rain or dust.
    """
    ray_m = height_m * (1.0 - range_m[None] / expected_m[:, None])
    in_the_way = (range_m[None] * CLEAR < expected_m[:, None]) & (above_m[None] > ray_m - OFF_GROUND_M)
    return np.asarray(np.count_nonzero(in_the_way, axis=1) > 1)


def _expected(
    vehicle_T_sensor: Float64, rows_deg: Float64, azimuths_deg: Float64, road: RoadProfile
) -> tuple[Float64, Float64]:
    """(rows, sectors) range to the road along each ray, infinite where it meets none, and (rows, sectors, 3) where."""
    elevation, azimuth = np.deg2rad(rows_deg)[:, None], np.deg2rad(azimuths_deg)[None]
    flat = np.cos(elevation)
    towards = np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1)
    shape, towards = towards.shape, towards.reshape(-1, 3) @ vehicle_T_sensor[:3, :3].T
    origin_m = vehicle_T_sensor[:3, 3]

    def above_m(range_m: Float64) -> Float64:
        points_m = origin_m + towards * range_m[:, None]
        return np.asarray(points_m[:, 2] - road.compute_heights_m(points_m))

    # The road bends little: the first crossing is looked for in steps, then halved down to a millimetre.
    near_m, far_m = np.full(len(towards), 1.0), np.full(len(towards), np.inf)
    for range_m in np.geomspace(2.0, 2 * FARTHEST_M, 60):
        below = np.isinf(far_m) & (above_m(np.full(len(towards), range_m)) <= 0)
        far_m[below] = range_m
        near_m[np.isinf(far_m)] = range_m
    met = np.isfinite(far_m)
    for _ in range(20):
        middle_m = np.where(met, (near_m + np.where(met, far_m, 0.0)) / 2, 1.0)
        is_below = above_m(middle_m) <= 0
        far_m = np.where(met & is_below, middle_m, far_m)
        near_m = np.where(met & ~is_below, middle_m, near_m)
    places_m = origin_m + towards * np.where(met, far_m, 0.0)[:, None]
    return far_m.reshape(shape[:2]), places_m.reshape(*shape[:2], 3)


class ReturnFit(NamedTuple):
    """Range at 10 % and spread of ln range of a LiDAR, the likeliest from rays to a road, and errors of ln of both.

    `is_range_observable` says whether the recording tells: twice the range would have left other returns.
    """

    range_at_10_percent_m: float
    log_range_std: float
    log_range_error: float
    log_std_error: float
    is_range_observable: bool


def fit_returns(rays: GroundRays, road_material: Material) -> ReturnFit:
    """The likeliest range at 10 % and spread. The rays of a cell meet one spot, and count as one."""
    from scipy.optimize import minimize, minimize_scalar
    from scipy.special import log_ndtr

    at_one_metre = compute_log_excess(
        rays.range_m, rays.cos_incidence, road_material.numeric_reflectivity, road_material.incidence_exponent, 1.0
    )
    returned = rays.return_counts / rays.ray_counts

    def surprise(logs: Float64) -> float:
        """Of logarithms of both."""
        excess = (at_one_metre + 2 * logs[0]) / np.hypot(2 * np.exp(logs[1]), road_material.log_reflectivity_std)
        log_seen = np.log(MAX_RETURN_PROBABILITY) + log_ndtr(excess)
        prior = ((logs[1] - np.log(USUAL_SPREAD)) / SPREAD_IS_SURE_TO) ** 2 / 2
        return float(prior - (returned * log_seen + (1 - returned) * np.log1p(-np.exp(log_seen))).sum())

    # Of rays that all return, any long enough range is as likely: the search begins at a short one.
    best = minimize(surprise, np.log([rays.range_m.max(), USUAL_SPREAD]), method="Nelder-Mead")
    twice = minimize_scalar(lambda log_spread: surprise(np.array([best.x[0] + np.log(2.0), log_spread])), (-3.0, -1.0))
    width = np.eye(2) * CURVATURE_OVER
    around = [
        [surprise(best.x + i * one + j * two) for i in (-1, 1) for j in (-1, 1)] for one in width for two in width
    ]
    curvature = np.reshape([(a - b - c + d) for a, b, c, d in around], (2, 2)) / (4 * CURVATURE_OVER**2)
    errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(curvature, hermitian=True)), 0.0))
    range_m, spread = np.exp(best.x).tolist()
    range_error, spread_error = errors.tolist()
    return ReturnFit(range_m, spread, range_error, spread_error, bool(twice.fun - best.fun > LESS_LIKELY))


class LidarCalibration(NamedTuple):
    """What a recording says of one LiDAR.

    Args:
        name: Its name in the rig.
        num_rays: How many rays pointed at the road.
        max_range_m: So far away it was seen, at most.
        fit: What fits best.
        range_noise_m: Standard deviation of ranges about the road; NaN where none was seen closely.
    """

    name: str
    num_rays: float
    max_range_m: float
    fit: ReturnFit
    range_noise_m: float

    @property
    def text(self) -> str:
        """It in a line."""
        fit, seen = self.fit, f"{self.num_rays:,.0f} rays to a road up to {self.max_range_m:.0f} m away"
        noise = f"; noise {1e3 * self.range_noise_m:.1f} mm" if np.isfinite(self.range_noise_m) else ""
        if not fit.is_range_observable:
            return (
                f"{self.name}: {seen} cannot tell how far it sees, for the road hardly fades in them; it takes far "
                f"road in the open{noise}"
            )
        low_m, high_m = fit.range_at_10_percent_m * np.exp([-fit.log_range_error, fit.log_range_error])
        return (
            f"{self.name}: {fit.range_at_10_percent_m:.0f} m at 10 % ({low_m:.0f} to {high_m:.0f}), spread "
            f"{fit.log_range_std:.2f} (within a factor of {np.exp(fit.log_std_error):.1f}), from {seen}{noise}"
        )


def calibrate(recording: Recording, rig: Rig) -> tuple[Rig, list[LidarCalibration]]:
    """Fit the LiDARs of a rig to a recording: the range at 10 % and the spread to how the road fades, and the noise.

    The road is taken for dry asphalt, `datasets/materials/road.yaml`.

    Args:
        recording: What they recorded, on a straight road as far as can be.
        rig: Where they are mounted and how they scan; sensors of a recording with one LiDAR may be called otherwise.

    Returns:
        The rig with what was found, and what that is for each LiDAR; where the road never fades, its keys stay.

    Raises:
        ValueError: No LiDAR of the rig is in the recording, no ray points at a road, the recording stands still, or a
            sweep is in it twice.
        OSError: A file is missing.
    """
    names = _paired(recording, rig)
    _check_drive(recording)
    road, found, sensors = Material.load("road"), [], []
    for sensor in rig.sensors:
        if not isinstance(sensor, Lidar) or sensor.name not in names:
            sensors.append(sensor)
            continue
        sweeps = [
            transform_to_vehicle(recording.read_scan(names[sensor.name], index), recording.ego_box).points_m
            for index in recording.key_frames
        ]
        _check_different(sweeps, f"{recording.path}: {sensor.name}")
        told = _calibration(sensor, sweeps, road, str(recording.path))
        keys = sensor.model_dump(exclude_unset=True)
        if told.fit.is_range_observable:
            keys |= {
                "range_at_10_percent_m": round(told.fit.range_at_10_percent_m, 1),
                "log_range_std": round(told.fit.log_range_std, 3),
            }
        if np.isfinite(told.range_noise_m):
            keys["range_noise_m"] = round(told.range_noise_m, 4)
        sensors.append(Lidar.model_validate(keys))
        found.append(told)
    return rig.model_copy(update={"sensors": tuple(sensors)}), found


def _paired(recording: Recording, rig: Rig) -> dict[str, str]:
    """Name of a LiDAR of the rig -> what the recording calls it."""
    lidars = [sensor.name for sensor in rig.sensors if isinstance(sensor, Lidar)]
    same = {name: name for name in lidars if name in recording.sensors}
    if not same and len(lidars) == len(recording.sensors) == 1:
        return {lidars[0]: recording.sensors[0]}
    if not same:
        raise ValueError(
            f"{recording.path}: no LiDAR of the rig {rig.name!r} is in it; the rig has {', '.join(lidars) or 'none'}, "
            f"the recording {', '.join(recording.sensors)}"
        )
    return same


def _check_drive(recording: Recording) -> None:
    """Refuse several sweeps from one place: they see the same road, and would seem to know more than one does."""
    frames = list(recording.key_frames)
    if not frames:
        raise ValueError(f"{recording.path}: no sweep in it")
    poses = [pose for index in frames if (pose := recording.get_world_T_vehicle(index)) is not None]
    if len(poses) > 1:
        way_m = float(np.ptp([pose[:3, 3] for pose in poses], axis=0).max())
        if way_m < LEAST_WAY_M:
            raise ValueError(
                f"{recording.path}: the vehicle stands, {len(poses)} sweeps within {way_m:.2f} m, which see the same "
                f"road: give one sweep, or a drive of {LEAST_WAY_M:g} m at least"
            )


def _check_different(sweeps: Sequence[Float32], source: str) -> None:
    """Refuse a sweep that is there again, as it may be where no poses tell that the vehicle stands."""
    first: dict[bytes, int] = {}
    for number, sweep in enumerate(sweeps):
        same = first.setdefault(sweep.tobytes(), number)
        if same != number and len(sweep):
            raise ValueError(
                f"{source}: sweeps {same} and {number} are the same cloud, so that both know what one does; give each "
                "sweep once"
            )


def _calibration(lidar: Lidar, sweeps: Sequence[Float32], road: Material, source: str) -> LidarCalibration:
    rays = count_ground_rays(sweeps, lidar)
    if rays.ray_counts.sum() < FEWEST_RAYS:
        raise ValueError(
            f"{source}: {lidar.name} has {rays.ray_counts.sum():.0f} rays to an open road {NEAREST_M:g} to {FARTHEST_M:g} m "
            f"away; {FEWEST_RAYS} are needed: a drive on a straight, level road, and a rig whose mounts are right"
        )
    fit = fit_returns(rays, road)
    noise_m = _noise_m(sweeps, lidar)
    return LidarCalibration(lidar.name, float(rays.ray_counts.sum()), float(rays.range_m.max()), fit, noise_m)


def _noise_m(sweeps: Sequence[Float32], lidar: Lidar) -> float:
    """Noise of ranges to near road: second differences of three neighbours in a row are sqrt(6) of it."""
    off_m, step_deg = [np.empty(0)], lidar.horizontal_fov_deg / lidar.columns
    for sweep in sweeps:
        points_m = sweep.astype(np.float64)
        on_road = np.abs(points_m[:, 2] - fit_road_profile(points_m).compute_heights_m(points_m)) < OFF_GROUND_M
        row, azimuth_deg, range_m = _in_rows(points_m[on_road & (np.abs(points_m[:, 1]) < HALF_LANES_M)], lidar)
        order = np.lexsort((azimuth_deg, row))
        row, azimuth_deg, range_m = row[order], azimuth_deg[order], range_m[order]
        together = (row[2:] == row[:-2]) & (azimuth_deg[2:] - azimuth_deg[:-2] < 2.5 * step_deg)
        together &= range_m[1:-1] < NOISE_WITHIN_M
        off_m.append((range_m[:-2] - 2 * range_m[1:-1] + range_m[2:])[together])
    off = np.concatenate(off_m)
    return float(np.median(np.abs(off)) / 0.6745 / np.sqrt(6.0)) if len(off) >= FEWEST_RAYS else float("nan")
