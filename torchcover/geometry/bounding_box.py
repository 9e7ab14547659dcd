"""Axis-aligned boxes in the vehicle frame, their overlap, and the contact time of moving outlines."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64


@dataclass(frozen=True)
class BoundingBox:
    """Axis-aligned box.

    Args:
        lower_m: Smallest x, y, z in meters.
        upper_m: Largest x, y, z in meters.

    Raises:
        ValueError: A corner does not have three coordinates, or a lower bound is not below the upper one.

    Example:
        >>> BoundingBox((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0)).size_m
        (2.0, 2.0, 2.0)
    """

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not len(self.lower_m) == len(self.upper_m) == 3:
            raise ValueError(f"a box needs three numbers for each corner; got {self.lower_m} and {self.upper_m}")
        if not all(low < high for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError(f"a box needs lower < upper on every axis; got {self.lower_m} and {self.upper_m}")

    @classmethod
    def from_points(cls, points_m: NDArray[np.floating]) -> "BoundingBox":
        """Compute the smallest box that contains all points.

        Args:
            points_m: (N, 3) points in meters, N >= 1.
        """
        x0, y0, z0 = points_m.min(axis=0).tolist()
        x1, y1, z1 = points_m.max(axis=0).tolist()
        return cls((x0, y0, z0), (x1, y1, z1))

    @property
    def corners_m(self) -> Float64:
        """(8, 3) corners."""
        return np.array(list(product(*zip(self.lower_m, self.upper_m, strict=True))))

    @property
    def outline_m(self) -> Float64:
        """(4, 2) corners x, y in bird's-eye view, counterclockwise."""
        (x0, y0, _), (x1, y1, _) = self.lower_m, self.upper_m
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along x, y, z in meters."""
        (x0, y0, z0), (x1, y1, z1) = self.lower_m, self.upper_m
        return (x1 - x0, y1 - y0, z1 - z0)


def find_overlaps(box: BoundingBox, world_T_box: Float64, other_corners_m: Float64) -> Bools:
    """Find the poses at which a box overlaps another box; both stand on approximately the same ground.

    Uses the separating axis theorem for the outlines in bird's-eye view and for heights; touching is no overlap.

    Args:
        box: Box in its own frame.
        world_T_box: (P, 4, 4) poses of the box, rotated mainly about z.
        other_corners_m: (8, 3) corners of the other box in the world frame, in the order of `BoundingBox.corners_m`.

    Returns:
        (P,) bool.

    Example:
        >>> car, shifted = BoundingBox((-2, -1, 0), (2, 1, 1.5)), np.eye(4)
        >>> shifted[:3, 3] = [3.0, 2.1, 0.0]
        >>> find_overlaps(car, np.stack([np.eye(4), shifted]), car.corners_m).tolist()
        [True, False]
    """
    corners_m = box.corners_m @ world_T_box[:, :3, :3].swapaxes(1, 2) + world_T_box[:, None, :3, 3]
    other_axes = np.stack(
        [other_corners_m[4] - other_corners_m[0], other_corners_m[2] - other_corners_m[0], [0.0, 0.0, 1.0]]
    )
    box_axes = world_T_box[:, :3, :2].swapaxes(1, 2)
    axes = np.concatenate([np.broadcast_to(other_axes, (len(corners_m), 3, 3)), box_axes], 1)
    shadow = np.einsum("pak,pck->pac", axes, corners_m)
    other_shadow = np.einsum("pak,ck->pac", axes, other_corners_m)
    is_below = shadow.max(axis=2) <= other_shadow.min(axis=2)
    is_above = shadow.min(axis=2) >= other_shadow.max(axis=2)
    return np.asarray(~(is_above | is_below).any(axis=1))


def transform_outline(outline_m: Float64, world_T_outline: Float64) -> Float64:
    """Transform an outline to the world frame in bird's-eye view.

    Args:
        outline_m: (4, 2) corners x, y.
        world_T_outline: (..., 4, 4) poses.

    Returns:
        (..., 4, 2) corners x, y.
    """
    return np.asarray(outline_m @ world_T_outline[..., :2, :2].swapaxes(-1, -2) + world_T_outline[..., None, :2, 3])


def compute_contact_time_s(
    first_corners_m: Float64, second_corners_m: Float64, relative_velocity_mps: Float64
) -> Float64:
    """Compute the time until two rectangles overlap, at constant relative velocity and without rotation.

    By the separating axis theorem, the rectangles overlap while their projections onto each side of either rectangle
    overlap; the projections onto one side overlap during one interval of time. Touching is no overlap, as in
    `find_overlaps`.

    Args:
        first_corners_m: (..., 4, 2) corners in order around the rectangle, in meters.
        second_corners_m: (..., 4, 2) corners of the second rectangle.
        relative_velocity_mps: (..., 2) velocity of the second rectangle minus that of the first, in m/s.

    Returns:
        (...) seconds: 0 if they overlap already, infinite if they never do.

    Example:
        >>> car_m = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
        >>> velocities_mps = np.array([[-20.0, 0.0], [-20.0, 5.0], [5.0, 0.0]])
        >>> compute_contact_time_s(car_m, car_m + [14.0, 0.5], velocities_mps).tolist()
        [0.5, inf, inf]
    """
    # Relative coordinates keep precision, since world coordinates may be of UTM size.
    origin_m = first_corners_m[..., :1, :]
    first_m, second_m, velocity_mps = np.broadcast_arrays(
        first_corners_m - origin_m, second_corners_m - origin_m, relative_velocity_mps[..., None, :]
    )[:3]
    axes = np.concatenate([np.diff(first_m[..., :3, :], axis=-2), np.diff(second_m[..., :3, :], axis=-2)], axis=-2)
    first_shadow = np.einsum("...ak,...ck->...ac", axes, first_m)
    second_shadow = np.einsum("...ak,...ck->...ac", axes, second_m)
    speed = np.einsum("...ak,...k->...a", axes, velocity_mps[..., 0, :])
    low = first_shadow.min(axis=-1) - second_shadow.max(axis=-1)
    high = first_shadow.max(axis=-1) - second_shadow.min(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        axis_begin, axis_end = np.where(speed > 0, low, high) / speed, np.where(speed > 0, high, low) / speed
    # Projections that do not move overlap either always or never.
    constant_begin = np.where((low < 0) & (high > 0), -np.inf, np.inf)
    begin = np.where(speed == 0, constant_begin, axis_begin).max(axis=-1)
    end = np.where(speed == 0, -constant_begin, axis_end).min(axis=-1)
    return np.asarray(np.where((begin < end) & (end > 0), np.maximum(begin, 0.0), np.inf))
