"""Scans in the vehicle frame, without missing returns and points of the ego vehicle."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, transform_points
from torchcover.geometry.arrays import Bools, Float32
from torchcover.geometry.rigid import iterate_blocks
from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.recording import NO_RETURN_M, Scan


class VehicleCloud(NamedTuple):
    """Point cloud in the vehicle frame.

    Args:
        points_m: (N, 3) points.
        excluded_counts: Number of excluded points by reason: `nonfinite`, `no_return`, `ego_vehicle`; for an
            accumulated reference also `unlabeled`, points of moving objects without a label in the frame.
        weights: (N,) area weights; None if all points count the same.
        heights_m: (N,) heights above the local ground, NaN where there is no ground; None if unknown.
    """

    points_m: Float32
    excluded_counts: Counter[str]
    weights: Float32 | None = None
    heights_m: Float32 | None = None


def transform_to_vehicle(scan: Scan, ego_box: BoundingBox | None = None) -> VehicleCloud:
    """Transform a scan into the vehicle frame and exclude missing returns and points of the ego vehicle.

    Args:
        scan: Scan as stored.
        ego_box: Bounding box of the ego vehicle; None keeps its points.

    Returns:
        The remaining points and the number of excluded ones.

    Raises:
        ValueError: A coordinate exceeds 1e5 m, as in a world frame.
    """
    points_m, weights, heights_m = scan.points_m, scan.weights, scan.heights_m
    is_finite = _mask_finite(points_m)
    is_return = _mask_returns(points_m)
    if scan.min_range_m:
        is_return &= ~(np.linalg.norm(points_m, axis=1) < scan.min_range_m)
    remaining = np.flatnonzero(is_finite & is_return)
    excluded = Counter({"nonfinite": int((~is_finite).sum()), "no_return": int((is_finite & ~is_return).sum())})
    if len(remaining) < len(points_m):
        points_m = points_m[remaining]
        weights = None if weights is None else weights[remaining]
        heights_m = None if heights_m is None else heights_m[remaining]
    cloud_m, count = np.empty(points_m.shape, np.float32), 0
    max_coordinate_m = 0.0
    ego_rows = [np.empty(0, np.intp)]
    for rows in iterate_blocks(len(points_m)):
        block_m = points_m[rows]
        if scan.vehicle_T_sensor is not None:
            block_m = transform_points(scan.vehicle_T_sensor, block_m)
        max_coordinate_m = max(max_coordinate_m, float(block_m.max()), -float(block_m.min()))
        if ego_box is not None:
            inside = find_points_in_box(block_m, ego_box)
            block_m = np.delete(block_m, inside, axis=0) if len(inside) else block_m
            ego_rows.append(rows.start + inside)
        with np.errstate(over="ignore"):  # such coordinates are refused below
            cloud_m[count : count + len(block_m)] = block_m
        count += len(block_m)
    limit_m = 1e5  # float32 resolves 8 mm here; clouds in world coordinates lie far beyond and would lose digits
    if max_coordinate_m > limit_m:
        raise ValueError(
            f"{scan.source}: a coordinate of {max_coordinate_m:.6g} m in the vehicle frame, at most {limit_m:g} m is "
            "allowed; if it is in millimeters, say so (--set recording.units=mm); for world coordinates give the pose "
            "of the sensor (vehicle_T_sensor in frames.yaml)"
        )
    if ego_box is not None:
        excluded["ego_vehicle"] = len(points_m) - count
    excluded_rows = np.concatenate(ego_rows)
    return VehicleCloud(
        cloud_m[:count],
        excluded,
        None if weights is None else np.delete(weights, excluded_rows).astype(np.float32),
        None if heights_m is None else np.delete(heights_m, excluded_rows).astype(np.float32),
    )


def join_clouds(clouds: Sequence[VehicleCloud]) -> VehicleCloud:
    """Concatenate clouds and add their counts.

    Args:
        clouds: Clouds of one frame; all of them have weights and heights, or none has.

    Returns:
        One cloud; empty if there are no clouds.
    """
    if len(clouds) == 1:
        return clouds[0]
    excluded = sum((cloud.excluded_counts for cloud in clouds), Counter[str]())
    weights = [cloud.weights for cloud in clouds if cloud.weights is not None]
    heights_m = [cloud.heights_m for cloud in clouds if cloud.heights_m is not None]
    return VehicleCloud(
        np.concatenate([np.empty((0, 3), np.float32), *(cloud.points_m for cloud in clouds)]),
        excluded,
        np.concatenate(weights) if weights else None,
        np.concatenate(heights_m) if heights_m else None,
    )


def _mask_finite(points_m: Points) -> Bools:
    """Mask points with three finite coordinates; the slow combination by point is rarely needed."""
    is_finite: Bools = np.isfinite(points_m)
    return np.ones(len(points_m), np.bool_) if is_finite.all() else np.logical_and.reduce(is_finite, axis=1)


def _mask_returns(points_m: Points) -> Bools:
    """Mask points away from the origin; NaN is no return."""
    is_return = np.abs(points_m[:, 0]) > NO_RETURN_M
    undecided = np.flatnonzero(~is_return)
    is_return[undecided] = (np.abs(points_m[undecided]) > NO_RETURN_M).any(axis=1)
    return is_return


def find_points_in_box(points_m: Points, box: BoundingBox) -> NDArray[np.intp]:
    """Find the points inside of an axis-aligned box.

    Args:
        points_m: (N, 3) points in the frame of the box.
        box: Bounding box; points on its surface are outside.

    Returns:
        Ascending indices of the points inside.
    """
    x, y, z = points_m.T
    # The lateral extent of a vehicle excludes most points, so this axis is tested first.
    inside = np.flatnonzero((box.lower_m[1] < y) & (y < box.upper_m[1]))
    for axis, coordinates_m in ((0, x), (2, z)):
        candidates_m = coordinates_m[inside]
        inside = inside[(box.lower_m[axis] < candidates_m) & (candidates_m < box.upper_m[axis])]
    return inside
