"""Rays of a real LiDAR towards a road: how many there were, and how many of them returned."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import invert, transform_points
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.lidar import Lidar


@dataclass(frozen=True)
class RoadParams:
    """Parameters of the search for rays towards a road.

    Args:
        half_road_m: Half of the width in which rays count; curbs and grass are farther to the side.
        half_lanes_m: Half of the width in which the height of the road is fitted.
        min_range_m: Rays to nearer ground always return, or the vehicle occludes them.
        max_range_m: Rays to farther ground are not counted.
        sector_deg: Width of the sectors of azimuth in which rays are counted.
        max_obstacle_m: Points higher above the road do not occlude it.
        max_ground_offset_m: Distance from the road within which points belong to it,
        max_relative_ground_offset: plus this share of the range, for errors of the road.
        max_occluder_share: Points nearer than this share of the range to the road may occlude it.
        min_range_share: A ray returned from the road if its range is at least this share of the expected range,
        max_range_share: and at most this share.
        min_open_share: A sector in which a smaller share of the near rays returns is occluded by the vehicle or by the
            housing of another sensor.
    """

    half_road_m: float = 10.0
    half_lanes_m: float = 7.0
    min_range_m: float = 10.0
    max_range_m: float = 125.0
    sector_deg: float = 0.5
    max_obstacle_m: float = 2.5
    max_ground_offset_m: float = 0.12
    max_relative_ground_offset: float = 0.005
    max_occluder_share: float = 0.97
    min_range_share: float = 0.85
    max_range_share: float = 1.2
    min_open_share: float = 0.6


class GroundRays(NamedTuple):
    """Rays towards a road without occlusion, in C cells: one row in one sector of one sweep.

    Args:
        range_m: (C,) range to the road.
        cos_incidence: (C,) cosine of the angle of incidence.
        ray_counts: (C,) number of rays.
        return_counts: (C,) number of rays that returned from the road; larger than `ray_counts` where points of a
            neighboring row are assigned to a row.
        azimuth_deg: (C,) center of the sector in the sensor frame.
        sweep_indices: (C,) index of the sweep.
    """

    range_m: Float64
    cos_incidence: Float64
    ray_counts: Float64
    return_counts: Float64
    azimuth_deg: Float64
    sweep_indices: Int64

    def select(self, mask: Bools) -> "GroundRays":
        """Select cells.

        Args:
            mask: (C,) True for selected cells.

        Returns:
            The rays of these cells.
        """
        return GroundRays._make(column[mask] for column in self)


class RoadProfile(NamedTuple):
    """Height of a road in the vehicle frame.

    Args:
        coefficients: (5,) height at the origin, slopes along x and y, curvature ahead and behind.
    """

    coefficients: Float64

    def compute_heights_m(self, points_m: Float64) -> Float64:
        """Compute the z of the road below points.

        Args:
            points_m: (N, 3) points in the vehicle frame.

        Returns:
            (N,) heights in meters.
        """
        return np.asarray(compute_profile_terms(points_m) @ self.coefficients)


def compute_profile_terms(points_m: Float64) -> Float64:
    """Compute the (N, 5) terms of a road profile at (N, 3) points, in the order of its coefficients."""
    x, y = points_m[:, 0], points_m[:, 1]
    squared = (x / 40.0) ** 2
    return np.column_stack([np.ones(len(x)), x, y, squared * (x > 0), squared * (x < 0)])


def fit_road_profile(points_m: Float64, params: RoadParams = RoadParams()) -> RoadProfile:
    """Fit the road below a sweep, from near to far.

    Args:
        points_m: (N, 3) points in the vehicle frame.
        params: Width of the lanes and tolerance of the height.

    Returns:
        The road.
    """
    range_m = np.hypot(points_m[:, 0], points_m[:, 1])
    is_in_lanes = (np.abs(points_m[:, 1]) < params.half_lanes_m) & (range_m < 90.0) & (range_m > 3.5)
    points_m, range_m = points_m[is_in_lanes], range_m[is_in_lanes]
    terms, coefficients = compute_profile_terms(points_m), np.zeros(5)
    is_low = (range_m < 15.0) & (np.abs(points_m[:, 2]) < 0.6)
    if is_low.any():
        coefficients[0] = np.median(points_m[is_low, 2])
    # Without evidence from far points, the curvature is 0.
    regularization = np.diag([0.0, 0.0, 0.0, 2000.0, 2000.0])
    for max_range_m in (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 80):
        offset_m = np.abs(points_m[:, 2] - terms @ coefficients)
        is_road = (offset_m < params.max_ground_offset_m + 0.004 * range_m) & (range_m < max_range_m)
        if np.count_nonzero(is_road) < 50:
            continue
        # The density of points falls with the square of the range: the weight makes all areas count the same.
        weighted_terms = terms[is_road].T * range_m[is_road] ** 2
        normal_matrix = weighted_terms @ terms[is_road] + regularization
        coefficients = np.linalg.solve(normal_matrix, weighted_terms @ points_m[is_road, 2])
    return RoadProfile(coefficients)


def count_ground_rays(
    sweeps: Sequence[NDArray[np.floating]], lidar: Lidar, params: RoadParams = RoadParams()
) -> GroundRays:
    """Count the rays of a LiDAR towards the road, and the rays that returned.

    The scan pattern of the LiDAR tells which rays there were: a return belongs to the nearest row, and each row has
    `columns` rays per revolution.

    Args:
        sweeps: (N, 3) points of each sweep in the vehicle frame.
        lidar: LiDAR with its mount and scan pattern.
        params: Parameters of the search.

    Returns:
        The rays of all sweeps.
    """
    sweep_rays = []
    for index, points_m in enumerate(sweeps):
        sweep_rays.append(count_sweep_rays(np.asarray(points_m, dtype=np.float64), lidar, index, params))
    return GroundRays._make(np.concatenate(columns) for columns in zip(*sweep_rays, strict=True))


def count_sweep_rays(points_m: Float64, lidar: Lidar, sweep_index: int, params: RoadParams) -> GroundRays:
    """Count the rays of one sweep; see `count_ground_rays`.

    Args:
        points_m: (N, 3) points in the vehicle frame.
        lidar: LiDAR with its mount and scan pattern.
        sweep_index: Index of the sweep.
        params: Parameters of the search.

    Returns:
        The rays.
    """
    vehicle_T_sensor, row_elevations_deg = lidar.mount.to_matrix(), np.sort(lidar.compute_elevations_deg())
    road, num_sectors = fit_road_profile(points_m, params), round(360.0 / params.sector_deg)
    row, azimuth_deg, range_m = assign_rows(points_m, lidar)
    sector = np.floor((azimuth_deg + 180.0) / params.sector_deg).astype(np.int64) % num_sectors
    height_m = points_m[:, 2] - road.compute_heights_m(points_m)
    centers_deg: Float64 = (np.arange(num_sectors, dtype=np.float64) + 0.5) * params.sector_deg - 180.0
    expected_m, road_points_m = compute_road_ranges_m(
        vehicle_T_sensor, row_elevations_deg, centers_deg, road, 2 * params.max_range_m
    )
    sensor_height_m = vehicle_T_sensor[2, 3] - road.compute_heights_m(vehicle_T_sensor[None, :3, 3])[0]
    min_height_m = params.max_ground_offset_m + params.max_relative_ground_offset * range_m
    is_obstacle = (height_m > min_height_m) & (height_m < params.max_obstacle_m) & (range_m > 2.0)
    obstacles = np.flatnonzero(is_obstacle)[np.argsort(sector[is_obstacle], kind="stable")]
    sector_obstacles = np.split(obstacles, np.searchsorted(sector[obstacles], np.arange(1, num_sectors)))
    is_occluded = np.empty(expected_m.shape, dtype=np.bool_)
    for index in range(num_sectors):
        neighbors = (index - 1, index, (index + 1) % num_sectors)
        nearby = np.concatenate([sector_obstacles[neighbor] for neighbor in neighbors])
        is_occluded[:, index] = find_occluded_rays(
            expected_m[:, index], sensor_height_m, range_m[nearby], height_m[nearby], params
        )
    cell = row * num_sectors + sector
    range_share = range_m / expected_m.reshape(-1)[cell]

    def count_points(mask: Bools) -> Float64:
        counts = np.bincount(cell[mask], minlength=expected_m.size)
        return counts.reshape(expected_m.shape).astype(np.float64)

    num_returns = count_points((range_share > params.min_range_share) & (range_share < params.max_range_share))
    num_beyond = count_points(range_share >= params.max_range_share)
    rays_per_cell = lidar.columns * params.sector_deg / lidar.horizontal_fov_deg
    num_rays = np.maximum(rays_per_cell - num_beyond, 0.0)
    is_free = ~is_occluded & (np.abs(road_points_m[..., 1]) < params.half_road_m) & (num_rays > 0)
    is_free &= (expected_m > params.min_range_m) & (expected_m < params.max_range_m)
    is_near = is_free & (expected_m < 2 * params.min_range_m)
    is_open = (num_returns * is_near).sum(axis=0) >= params.min_open_share * (num_rays * is_near).sum(axis=0)
    is_free &= is_open & is_near.any(axis=0)
    return GroundRays(
        expected_m[is_free],
        sensor_height_m / expected_m[is_free],
        num_rays[is_free],
        num_returns[is_free],
        np.broadcast_to(centers_deg, expected_m.shape)[is_free],
        np.full(np.count_nonzero(is_free), sweep_index, dtype=np.int64),
    )


def assign_rows(points_m: Float64, lidar: Lidar) -> tuple[NDArray[np.intp], Float64, Float64]:
    """Assign points to the nearest rows of a LiDAR.

    Args:
        points_m: (N, 3) points in the vehicle frame.
        lidar: LiDAR with its mount and scan pattern.

    Returns:
        (N,) row in ascending order of elevation, (N,) azimuth in degrees and (N,) range in the sensor frame.
    """
    sensor_points_m = transform_points(invert(lidar.mount.to_matrix()), points_m)
    x, y, z = sensor_points_m.T
    elevation_deg = np.rad2deg(np.arctan2(z, np.hypot(x, y)))
    row_elevations_deg = np.sort(lidar.compute_elevations_deg())
    row = np.searchsorted((row_elevations_deg[1:] + row_elevations_deg[:-1]) / 2, elevation_deg)
    return row, np.rad2deg(np.arctan2(y, x)), np.linalg.norm(sensor_points_m, axis=1)


def find_occluded_rays(
    expected_m: Float64, sensor_height_m: float, range_m: Float64, height_m: Float64, params: RoadParams
) -> Bools:
    """Find the rays of a sector whose way to the road obstacles occlude.

    A ray passes above obstacles that are lower than the ray. One point may be rain or dust; two points occlude.

    Args:
        expected_m: (R,) range to the road in each row.
        sensor_height_m: Height of the sensor above the road.
        range_m: (K,) range of points on obstacles.
        height_m: (K,) their height above the road.
        params: Tolerances.

    Returns:
        (R,) True for occluded rays.
    """
    ray_height_m = sensor_height_m * (1.0 - range_m[None] / expected_m[:, None])
    is_before_road = range_m[None] * params.max_occluder_share < expected_m[:, None]
    is_occluder = is_before_road & (height_m[None] > ray_height_m - params.max_ground_offset_m)
    return np.asarray(np.count_nonzero(is_occluder, axis=1) > 1)


def compute_road_ranges_m(
    vehicle_T_sensor: Float64, elevations_deg: Float64, azimuths_deg: Float64, road: RoadProfile, max_range_m: float
) -> tuple[Float64, Float64]:
    """Compute where rays hit the road.

    Args:
        vehicle_T_sensor: (4, 4) extrinsics of the sensor.
        elevations_deg: (R,) elevations of rows.
        azimuths_deg: (S,) azimuths of sectors.
        road: The road.
        max_range_m: Range up to which the road is searched.

    Returns:
        (R, S) range, inf without a hit, and (R, S, 3) hit in the vehicle frame.
    """
    elevation, azimuth = np.deg2rad(elevations_deg)[:, None], np.deg2rad(azimuths_deg)[None]
    horizontal = np.cos(elevation)
    components = (horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation))
    directions = np.stack(np.broadcast_arrays(*components), axis=-1)
    shape, directions = directions.shape, directions.reshape(-1, 3) @ vehicle_T_sensor[:3, :3].T
    origin_m = vehicle_T_sensor[:3, 3]

    def compute_height_above_road_m(range_m: Float64) -> Float64:
        points_m = origin_m + directions * range_m[:, None]
        return np.asarray(points_m[:, 2] - road.compute_heights_m(points_m))

    # The curvature of a road is small: find the first crossing in steps, then bisect it to a millimeter.
    near_m, far_m = np.full(len(directions), 1.0), np.full(len(directions), np.inf)
    for range_m in np.geomspace(2.0, max_range_m, 60):
        heights_m = compute_height_above_road_m(np.full(len(directions), range_m))
        far_m[np.isinf(far_m) & (heights_m <= 0)] = range_m
        near_m[np.isinf(far_m)] = range_m
    is_hit = np.isfinite(far_m)
    for _ in range(20):
        middle_m = np.where(is_hit, (near_m + np.where(is_hit, far_m, 0.0)) / 2, 1.0)
        is_below = compute_height_above_road_m(middle_m) <= 0
        far_m = np.where(is_hit & is_below, middle_m, far_m)
        near_m = np.where(is_hit & ~is_below, middle_m, near_m)
    hits_m = origin_m + directions * np.where(is_hit, far_m, 0.0)[:, None]
    return far_m.reshape(shape[:2]), hits_m.reshape(*shape[:2], 3)
