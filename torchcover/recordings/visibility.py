"""Visibility of accumulated points from around the vehicle, and the surface area that each of them represents."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox
from torchcover.recordings.free_space import Float64, get_fastest_kernel


@dataclass(frozen=True)
class VisibilityParams:
    """Parameters of the visibility test.

    Args:
        num_viewpoints: Viewpoints around the vehicle, spread evenly: as few random ones would differ too much.
        shell_m: Width of the shell around the vehicle in which they lie, as for reference sensors of simulations.
        bin_sizes_deg: Bins of the range images in which near points occlude far ones; the larger ones close gaps
            between near points only.
        bins_per_voxel: A voxel fills a bin up to the range at which it appears this many times as wide as half a bin.
        margin_m: A point is occluded if it lies farther than `range + margin_m + relative_margin * range` of an
            occluder.
        relative_margin: Part of that margin per meter of range.
        roughness_m: Height above a point that must be occluded too, so that rough ground does not occlude itself.
    """

    num_viewpoints: int = 8
    shell_m: float = 0.5
    bin_sizes_deg: tuple[float, ...] = (0.2, 0.4, 0.8, 1.6)
    bins_per_voxel: float = 1.2
    margin_m: float = 0.4
    relative_margin: float = 0.12
    roughness_m: float = 0.15


def estimate_visible_share(
    points_m: Float64,
    ego_box: BoundingBox,
    voxel_m: float,
    seed: int,
    params: VisibilityParams = VisibilityParams(),
) -> Float64:
    """Estimate from which share of viewpoints around the vehicle each point is visible.

    Args:
        points_m: (N, 3) points in the vehicle frame; they and the vehicle occlude each other.
        ego_box: Box of the vehicle.
        voxel_m: Distance of neighboring points on a surface.
        seed: Seed of the viewpoints.
        params: Viewpoints and margins.

    Returns:
        (N,) shares, 0 to 1.
    """
    mark_hidden = get_fastest_kernel(mark_hidden_by_arrays)
    corners_m = np.array([ego_box.lower_m, ego_box.upper_m])
    bin_sizes_rad = np.deg2rad(params.bin_sizes_deg)
    max_ranges_m = np.append(np.inf, params.bins_per_voxel * voxel_m / (bin_sizes_rad[1:] / 2))
    margins = (params.margin_m, params.relative_margin, params.roughness_m)
    visible_count = np.zeros(len(points_m))
    for viewpoint_m in _spread_viewpoints(ego_box, seed, params):
        hidden = np.zeros(len(points_m), np.bool_)
        mark_hidden(points_m, viewpoint_m, corners_m, bin_sizes_rad, max_ranges_m, *margins, hidden)
        visible_count += ~hidden
    return visible_count / params.num_viewpoints


def estimate_surface_areas_m2(points_m: Float64, *, num_neighbors: int = 8, max_radius_m: float = 3.0) -> Float64:
    """Estimate the surface area that each point represents: the circle up to its last neighbor, shared by all of them.

    Args:
        points_m: (N, 3) points on surfaces.
        num_neighbors: Neighbors of a point in its circle.
        max_radius_m: Largest radius of a circle.

    Returns:
        (N,) areas in square meters.

    Example:
        >>> lattice_m = np.stack([*np.indices((9, 9)).reshape(2, -1), np.zeros(81)], axis=1)
        >>> round(float(estimate_surface_areas_m2(lattice_m)[40]), 2)
        0.79
    """
    from pykdtree.kdtree import KDTree

    if len(points_m) <= num_neighbors:
        return np.full(len(points_m), np.pi * max_radius_m**2 / num_neighbors)
    distances_m, _ = KDTree(points_m).query(points_m, k=num_neighbors + 1)
    return np.asarray(np.pi * np.minimum(distances_m[:, -1], max_radius_m) ** 2 / num_neighbors)


def _spread_viewpoints(ego_box: BoundingBox, seed: int, params: VisibilityParams) -> Float64:
    """Spread (num_viewpoints, 3) viewpoints between the box of the vehicle and that box grown sideways and upwards."""
    steps = 1.2207440846057596 ** -np.arange(1.0, 4.0)  # Roberts' low-discrepancy sequence in three dimensions
    lower_m, upper_m, shell_m = np.array(ego_box.lower_m), np.array(ego_box.upper_m), params.shell_m
    num_candidates = 100 * params.num_viewpoints  # enough that the first viewpoints outside the box are among them
    share = (np.random.default_rng(seed).random(3) + np.arange(num_candidates)[:, None] * steps) % 1
    candidates_m = lower_m - [shell_m, shell_m, 0.0] + share * (upper_m - lower_m + [2 * shell_m, 2 * shell_m, shell_m])
    outside = np.flatnonzero(((candidates_m < lower_m) | (candidates_m > upper_m)).any(axis=1))
    return np.asarray(candidates_m[outside[: params.num_viewpoints]])


def mark_hidden_by_arrays(
    points_m: Float64,
    viewpoint_m: Float64,
    box_corners_m: Float64,
    bin_sizes_rad: Float64,
    max_occluder_ranges_m: Float64,
    margin_m: float,
    relative_margin: float,
    roughness_m: float,
    hidden: NDArray[np.bool_],
) -> None:
    """Mark the points that a box or other points occlude, with NumPy where numba is missing.

    Args:
        points_m: (N, 3) points, which are the occluders too.
        viewpoint_m: (3,) point from which they are viewed.
        box_corners_m: (2, 3) lower and upper corner of the box.
        bin_sizes_rad: (B,) bin sizes of the range images.
        max_occluder_ranges_m: (B,) largest range of an occluder in each image.
        margin_m: See `VisibilityParams`, like the next two.
        relative_margin: Part of the margin per meter of range.
        roughness_m: Height above a point that must be occluded too.
        hidden: (N,) marks, changed in place.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        lower_share, upper_share = (box_corners_m - viewpoint_m)[:, None] / (points_m - viewpoint_m)
    enters, leaves = np.fmin(lower_share, upper_share).max(axis=1), np.fmax(lower_share, upper_share).min(axis=1)
    hidden |= (enters < leaves) & (leaves > 0) & (enters < 1)
    x, y, z = (points_m - viewpoint_m).T
    horizontal_m = np.sqrt(x * x + y * y)
    range_m = np.sqrt(horizontal_m * horizontal_m + z * z)
    elevation_rad = _approximate_angle(z, horizontal_m) + np.pi / 2
    raised_elevation_rad = _approximate_angle(z + roughness_m, horizontal_m) + np.pi / 2
    azimuth_rad = _approximate_angle(y, x) + np.pi
    for bin_rad, max_range_m in zip(bin_sizes_rad, max_occluder_ranges_m, strict=True):
        columns = int(2 * np.pi / bin_rad) + 1
        column = (azimuth_rad / bin_rad).astype(np.int64)
        bins = (elevation_rad / bin_rad).astype(np.int64) * columns + column
        raised_bins = (raised_elevation_rad / bin_rad).astype(np.int64) * columns + column
        nearest_m = np.full((int(np.pi / bin_rad) + 1) * columns, np.inf)
        is_near = range_m < max_range_m
        np.minimum.at(nearest_m, bins[is_near], range_m[is_near])
        hidden |= nearest_m[raised_bins] * (1 + relative_margin) + margin_m < range_m


def _approximate_angle(y: Float64, x: Float64) -> Float64:
    """Approximate `np.arctan2(y, x)` within 0.00002 rad, which alone would take most of the time.

    Abramowitz and Stegun (1964), 4.4.49.
    """
    smaller = np.minimum(np.abs(x), np.abs(y))
    ratio = smaller / np.maximum(np.maximum(np.abs(x), np.abs(y)), 1e-30)
    square = ratio * ratio
    polynomial = -0.3302995 + square * (0.1801410 + square * (-0.0851330 + square * 0.0208351))
    angle = ratio * (0.9998660 + square * polynomial)
    angle = np.where(np.abs(y) > np.abs(x), np.pi / 2 - angle, angle)
    angle = np.where(x < 0, np.pi - angle, angle)
    return np.where(y < 0, -angle, angle)
