"""Scans as frames need them: in the vehicle frame, without what is no return from the world."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox, transform_points
from torchcover.geometry.rigid import iterate_blocks
from torchcover.recordings.clouds.arrays import Points
from torchcover.recordings.recording import NO_RETURN_M, Scan

# float32 resolves 8 mm here; clouds in world coordinates lie far beyond and would lose decimetres without a word.
MAX_COORDINATE_M = 1e5


class VehicleCloud(NamedTuple):
    """A cloud of N points in the vehicle frame: what each counts for, and its height above the local ground, if known.

    A height is NaN where there is no ground at or below. `excluded_counts` says how many points were left out: `nonfinite`,
    `no_return`, `own_vehicle`; of an accumulated reference also `gone`, those of objects that are not labelled then.
    """

    points_m: NDArray[np.float32]
    excluded_counts: Counter[str]
    weights: NDArray[np.float32] | None = None
    heights_m: NDArray[np.float32] | None = None


def transform_to_vehicle(scan: Scan, ego_box: BoundingBox | None = None) -> VehicleCloud:
    """Move a scan into the vehicle frame; leave out what no surface of the world has returned.

    `scan`: what was stored; `ego_box`: the vehicle itself: points in it are its own. None: its size is unknown.
    ValueError: a coordinate beyond 1e5 m, as in a world frame.
    """
    points_m, weights, heights_m = scan.points_m, scan.weights, scan.heights_m
    finite, returned = _finite(points_m), _returned(points_m)
    if scan.min_range_m:
        returned &= ~(np.linalg.norm(points_m, axis=1) < scan.min_range_m)
    kept = np.flatnonzero(finite & returned)
    dropped = Counter({"nonfinite": int((~finite).sum()), "no_return": int((finite & ~returned).sum())})
    if len(kept) < len(points_m):
        points_m, weights = points_m[kept], None if weights is None else weights[kept]
        heights_m = None if heights_m is None else heights_m[kept]
    moved_m, count = np.empty(points_m.shape, np.float32), 0
    farthest_m, own = 0.0, [np.empty(0, np.intp)]
    for rows in iterate_blocks(len(points_m)):
        part_m = points_m[rows]
        if scan.vehicle_T_sensor is not None:
            part_m = transform_points(scan.vehicle_T_sensor, part_m)
        farthest_m = max(farthest_m, float(part_m.max()), -float(part_m.min()))
        if ego_box is not None:
            inside = find_points_in_box(part_m, ego_box)
            part_m = np.delete(part_m, inside, axis=0) if len(inside) else part_m
            own.append(rows.start + inside)
        with np.errstate(over="ignore"):  # see _check_range
            moved_m[count : count + len(part_m)] = part_m
        count += len(part_m)
    _check_range(farthest_m, scan.source)
    if ego_box is not None:
        dropped["own_vehicle"] = len(points_m) - count
    of_points = (
        None if values is None else np.delete(values, np.concatenate(own)).astype(np.float32)
        for values in (weights, heights_m)
    )
    return VehicleCloud(moved_m[:count], dropped, *of_points)


def join_clouds(clouds: Sequence[VehicleCloud]) -> VehicleCloud:
    """Several clouds as one."""
    if len(clouds) == 1:
        return clouds[0]
    dropped = sum((cloud.excluded_counts for cloud in clouds), Counter[str]())
    weights = [cloud.weights for cloud in clouds if cloud.weights is not None]
    heights_m = [cloud.heights_m for cloud in clouds if cloud.heights_m is not None]
    return VehicleCloud(
        np.concatenate([np.empty((0, 3), np.float32), *(cloud.points_m for cloud in clouds)]),
        dropped,
        np.concatenate(weights) if weights else None,
        np.concatenate(heights_m) if heights_m else None,
    )


def _finite(points_m: Points) -> NDArray[np.bool_]:
    """Where all three numbers are; to combine them point by point takes NumPy long, and is seldom needed."""
    finite: NDArray[np.bool_] = np.isfinite(points_m)
    return np.ones(len(points_m), np.bool_) if finite.all() else np.logical_and.reduce(finite, axis=1)


def _returned(points_m: Points) -> NDArray[np.bool_]:
    """Where a point is off its origin; NaN is not."""
    returned = np.abs(points_m[:, 0]) > NO_RETURN_M
    doubtful = np.flatnonzero(~returned)
    returned[doubtful] = (np.abs(points_m[doubtful]) > NO_RETURN_M).any(axis=1)
    return returned


def find_points_in_box(points_m: Points, box: BoundingBox) -> NDArray[np.intp]:
    """Numbers of the (N, 3) points in a box; across a vehicle there are the fewest to look at again."""
    x, y, z = points_m.T
    inside = np.flatnonzero((box.lower_m[1] < y) & (y < box.upper_m[1]))
    for axis, along_m in ((0, x), (2, z)):
        chosen_m = along_m[inside]
        inside = inside[(box.lower_m[axis] < chosen_m) & (chosen_m < box.upper_m[axis])]
    return inside


def _check_range(farthest_m: float, source: str) -> None:
    if farthest_m > MAX_COORDINATE_M:
        raise ValueError(
            f"{source}: a coordinate of {farthest_m:.6g} m in the vehicle frame, at most {MAX_COORDINATE_M:g} m is "
            "allowed; if it is in millimeters, say so (--set recording.units=mm); for world coordinates give the pose "
            "of the sensor (vehicle_T_sensor in frames.yaml)"
        )
