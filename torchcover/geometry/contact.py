"""When two outlines that move straight on touch."""

import numpy as np

from torchcover.geometry.arrays import Float64


def outlines_at(outline_m: Float64, poses: Float64) -> Float64:
    """(..., 4, 2) corners x, y of an outline, (4, 2), at (..., 4, 4) poses, seen from above."""
    return np.asarray(outline_m @ poses[..., :2, :2].swapaxes(-1, -2) + poses[..., None, :2, 3])


def contact_s(a_m: Float64, b_m: Float64, velocity_mps: Float64) -> Float64:
    """Time until two rectangles share area, if one passes the other straight on and neither turns.

    By separating axes: along each side of either, both have shadows, which overlap between two times; the rectangles do
    where all shadows do. Touching is not sharing, as for `overlapping`.

    Args:
        a_m: (..., 4, 2) corners, one after the other around it.
        b_m: (..., 4, 2) those of the other.
        velocity_mps: (..., 2) of b as a has it.

    Returns:
        (...) seconds: 0 if they share area already, infinite if they never do.

    Example:
        >>> car_m = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
        >>> contact_s(car_m, car_m + [14.0, 0.5], np.array([[-20.0, 0.0], [-20.0, 5.0], [5.0, 0.0]])).tolist()
        [0.5, inf, inf]
    """
    # Differences first: coordinates may be of UTM size.
    origin_m = a_m[..., :1, :]
    a_m, b_m, velocity_mps = np.broadcast_arrays(a_m - origin_m, b_m - origin_m, velocity_mps[..., None, :])[:3]
    sides_m = np.concatenate([np.diff(a_m[..., :3, :], axis=-2), np.diff(b_m[..., :3, :], axis=-2)], axis=-2)
    ours, theirs = (np.einsum("...ak,...ck->...ac", sides_m, corners_m) for corners_m in (a_m, b_m))
    speed = np.einsum("...ak,...k->...a", sides_m, velocity_mps[..., 0, :])
    before = ours.min(axis=-1) - theirs.max(axis=-1)
    behind = ours.max(axis=-1) - theirs.min(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        first, last = np.where(speed > 0, before, behind) / speed, np.where(speed > 0, behind, before) / speed
    for_good = np.where((before < 0) & (behind > 0), -np.inf, np.inf)
    begin = np.where(speed == 0, for_good, first).max(axis=-1)
    end = np.where(speed == 0, -for_good, last).min(axis=-1)
    return np.asarray(np.where((begin < end) & (end > 0), np.maximum(begin, 0.0), np.inf))
