"""Scans as frames need them: in the vehicle frame, without what is no return from the world."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.data.formats.arrays import Points
from torchcover.data.recordings.recording import NO_RETURN_M, Scan
from torchcover.geometry import BoundingBox, transform

# float32 resolves 8 mm here; clouds in world coordinates lie far beyond and would lose decimetres without a word.
MAX_COORDINATE_M = 1e5


class InVehicle(NamedTuple):
    """A cloud in the vehicle frame.

    Args:
        points_m: (N, 3) float32.
        dropped: How many points were left out: `nonfinite`, `no_return`, `own_vehicle`; of an accumulated reference
            also `gone`, those of objects that nobody has labelled at the instant.
        weights: (N,) float32 what each point counts for; None if all count the same.
    """

    points_m: NDArray[np.float32]
    dropped: Counter[str]
    weights: NDArray[np.float32] | None = None


def in_vehicle(scan: Scan, body: BoundingBox | None = None) -> InVehicle:
    """Move a scan into the vehicle frame; leave out what no surface of the world has returned.

    Args:
        scan: What was stored.
        body: The vehicle itself: points in it are its own. None: nobody knows how large it is.

    Raises:
        ValueError: A coordinate beyond 1e5 m, as in a world frame.

    Example:
        >>> scan = Scan(np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]), None, "a.npy")
        >>> in_vehicle(scan)
        InVehicle(points_m=array([[5., 0., 0.]], dtype=float32), dropped=Counter({...}), weights=None)
    """
    points_m, weights = scan.points_m, scan.weights
    finite = np.isfinite(points_m).all(axis=1)
    returned = (np.abs(points_m) > NO_RETURN_M).any(axis=1)  # NaN is not larger; it is counted as what it is
    if scan.min_range_m:
        returned &= ~(np.linalg.norm(points_m, axis=1) < scan.min_range_m)
    kept = np.flatnonzero(finite & returned)
    dropped = Counter({"nonfinite": int((~finite).sum()), "no_return": int((finite & ~returned).sum())})
    if len(kept) < len(points_m):
        points_m, weights = points_m[kept], _chosen(weights, kept)
    if scan.vehicle_T_sensor is not None:
        points_m = transform(scan.vehicle_T_sensor, points_m)
    _check_range(points_m, scan.source)
    if body is not None:
        own = ((points_m > body.lower_m) & (points_m < body.upper_m)).all(axis=1)
        dropped["own_vehicle"] = int(own.sum())
        others = np.flatnonzero(~own)
        points_m, weights = points_m[others], _chosen(weights, others)
    return InVehicle(points_m.astype(np.float32), dropped, None if weights is None else weights.astype(np.float32))


def joined(clouds: Sequence[InVehicle]) -> InVehicle:
    """Several clouds as one."""
    if len(clouds) == 1:
        return clouds[0]
    dropped = sum((cloud.dropped for cloud in clouds), Counter[str]())
    weights = [cloud.weights for cloud in clouds if cloud.weights is not None]
    return InVehicle(
        np.concatenate([np.empty((0, 3), np.float32), *(cloud.points_m for cloud in clouds)]),
        dropped,
        np.concatenate(weights) if weights else None,
    )


def _chosen(weights: NDArray[np.float64] | None, which: NDArray[np.intp]) -> NDArray[np.float64] | None:
    return None if weights is None else weights[which]


def _check_range(points_m: Points, source: str) -> None:
    farthest_m = float(np.abs(points_m).max(initial=0.0))
    if farthest_m > MAX_COORDINATE_M:
        raise ValueError(
            f"{source}: a coordinate of {farthest_m:.6g} m in the vehicle frame, at most {MAX_COORDINATE_M:g} m is "
            "allowed; for world coordinates give the pose of the sensor (vehicle_T_sensor in frames.yaml)"
        )
