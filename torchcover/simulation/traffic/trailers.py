"""Trailers that are towed at a hitch, and the tractrix that towed axles follow."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Float64


class Hitch(NamedTuple):
    """Geometry of a tractor and its trailer, whose axles never slip sideways.

    Args:
        trailer_kind: Kind of the towed body.
        center_offset_m: Center of the tractor ahead of the center of the whole vehicle, on a straight.
        hitch_offset_m: Hitch ahead of the center of the tractor; negative behind it.
        hitch_to_axle_m: Distance from the hitch back to the axles of the trailer.
        hitch_to_center_m: Distance from the hitch back to the center of the trailer.
    """

    trailer_kind: str
    center_offset_m: float
    hitch_offset_m: float
    hitch_to_axle_m: float
    hitch_to_center_m: float

    def compute_hitch_positions_m(self, poses: Float64) -> Float64:
        """Compute positions (T, 2) of the hitch at poses (T, 3) of the tractor: x, y, heading in radians."""
        return move_forward(poses, self.hitch_offset_m)[:, :2]


# At the limits of EU Directive 96/53/EC the kingpin is 12 m before the rear end, and the front of the trailer turns
# 2.04 m around it.
HITCHES: Mapping[str, Hitch] = {"truck": Hitch("trailer", 4.925, -1.175, 8.41, 5.2)}


def compute_trailer_poses(
    kinds: Sequence[str], front_poses: Sequence[Float64], initial_yaw_rad: Sequence[float] | None = None
) -> list[Float64]:
    """Compute the poses of the trailers of N tractors.

    Args:
        kinds: N keys of `HITCHES`.
        front_poses: N arrays (T, 3) of x, y and heading in radians of the tractors; T may differ.
        initial_yaw_rad: N headings of the trailers at the start; straight behind the tractors if None.

    Returns:
        N arrays (T, 3) of x, y and heading in radians.
    """
    if not kinds:
        return []
    hitches = [HITCHES[kind] for kind in kinds]
    pairs = zip(hitches, front_poses, strict=True)
    hitch_paths_m = [hitch.compute_hitch_positions_m(poses) for hitch, poses in pairs]
    if initial_yaw_rad is None:
        initial_yaw_rad = [poses[0, 2] for poses in front_poses]
    axle_distances_m = np.array([hitch.hitch_to_axle_m for hitch in hitches])
    yaws_rad = compute_tractrix_yaw_rad(stack_paths(hitch_paths_m), axle_distances_m, np.array(initial_yaw_rad)).T
    trailer_poses = []
    for hitch, path_m, yaw_rad in zip(hitches, hitch_paths_m, yaws_rad, strict=True):
        hitch_poses = np.column_stack([path_m, yaw_rad[: len(path_m)]])
        trailer_poses.append(move_forward(hitch_poses, -hitch.hitch_to_center_m))
    return trailer_poses


def stack_paths(paths_m: Sequence[Float64]) -> Float64:
    """Stack N paths (K, 2) of different lengths into (T, N, 2); shorter paths repeat their last position."""
    num_positions = max(len(path_m) for path_m in paths_m)
    return np.stack([np.pad(path_m, ((0, num_positions - len(path_m)), (0, 0)), "edge") for path_m in paths_m], axis=1)


def compute_tractrix_yaw_rad(lead_positions_m: Float64, rod_lengths_m: Float64, initial_yaw_rad: Float64) -> Float64:
    """Compute headings of N rods that are pulled at their front ends while their rear ends never slip sideways.

    The result is exact for paths of straight segments: with the angle a between rod and path, tan(a / 2) decays by
    exp(-distance / rod length).

    Args:
        lead_positions_m: (T, N, 2) positions of the front ends.
        rod_lengths_m: (N,) lengths.
        initial_yaw_rad: (N,) headings at the start.

    Returns:
        (T, N) unwrapped headings in radians.
    """
    steps_m = np.diff(lead_positions_m, axis=0)
    directions_rad = np.arctan2(steps_m[..., 1], steps_m[..., 0])
    decays = np.exp(-np.hypot(steps_m[..., 0], steps_m[..., 1]) / rod_lengths_m)
    # Headings are integrated, so that they never jump by a full turn.
    yaw_rad = np.empty(lead_positions_m.shape[:2])
    yaw_rad[0] = initial_yaw_rad
    for index, (direction_rad, decay) in enumerate(zip(directions_rad, decays, strict=True)):
        half_tangent = np.tan((direction_rad - yaw_rad[index]) / 2)
        yaw_rad[index + 1] = yaw_rad[index] + 2 * (np.arctan(half_tangent) - np.arctan(half_tangent * decay))
    return yaw_rad


def move_forward(poses: Float64, distance_m: float) -> Float64:
    """Move poses forward along their headings.

    Args:
        poses: (T, 3) x, y and heading in radians.
        distance_m: Distance; negative for backwards.

    Returns:
        (T, 3) poses.
    """
    yaw_rad = poses[:, 2]
    return poses + distance_m * np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros(len(yaw_rad))], axis=1)
