"""Axis-aligned boxes in the vehicle frame, whether they overlap, and when outlines that move touch."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float64


@dataclass(frozen=True)
class BoundingBox:
    """An axis-aligned box.

    Args:
        lower_m: Smallest x, y, z in metres.
        upper_m: Largest x, y, z in metres.

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
        """The smallest box that holds all (N, 3) points."""
        lower, upper = points_m.min(axis=0), points_m.max(axis=0)
        return cls(
            (float(lower[0]), float(lower[1]), float(lower[2])), (float(upper[0]), float(upper[1]), float(upper[2]))
        )

    @property
    def corners_m(self) -> Float64:
        """(8, 3) corners."""
        return np.array(list(product(*zip(self.lower_m, self.upper_m, strict=True))))

    @property
    def outline_m(self) -> Float64:
        """(4, 2) corners x, y seen from above, counter-clockwise."""
        (x0, y0, _), (x1, y1, _) = self.lower_m, self.upper_m
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along x, y, z in metres."""
        (x0, y0, z0), (x1, y1, z1) = self.lower_m, self.upper_m
        return (x1 - x0, y1 - y0, z1 - z0)


def find_overlaps(box: BoundingBox, world_T_box: Float64, other_corners_m: Float64) -> Bools:
    """(P,) whether a box at (P, 4, 4) poses shares space with another one that stands on about the same ground.

    By separating axes, of their outlines from above and of heights; touching is not sharing.

    Args:
        box: In its frame.
        world_T_box: Where it is, turned mainly about z.
        other_corners_m: (8, 3) of the other one there, in the order of `BoundingBox.corners_m`.

    Example:
        >>> car, away = BoundingBox((-2, -1, 0), (2, 1, 1.5)), np.eye(4)
        >>> away[:3, 3] = [3.0, 2.1, 0.0]
        >>> find_overlaps(car, np.stack([np.eye(4), away]), car.corners_m).tolist()
        [True, False]
    """
    ours_m = box.corners_m @ world_T_box[:, :3, :3].swapaxes(1, 2) + world_T_box[:, None, :3, 3]
    sides = np.stack(
        [other_corners_m[4] - other_corners_m[0], other_corners_m[2] - other_corners_m[0], [0.0, 0.0, 1.0]]
    )
    axes = np.concatenate([np.broadcast_to(sides, (len(ours_m), 3, 3)), world_T_box[:, :3, :2].swapaxes(1, 2)], 1)
    ours_m, theirs_m = np.einsum("pak,pck->pac", axes, ours_m), np.einsum("pak,ck->pac", axes, other_corners_m)
    apart = (ours_m.min(axis=2) >= theirs_m.max(axis=2)) | (theirs_m.min(axis=2) >= ours_m.max(axis=2))
    return np.asarray(~apart.any(axis=1))


def transform_outline(outline_m: Float64, world_T_outline: Float64) -> Float64:
    """(..., 4, 2) corners x, y of an outline, (4, 2), at (..., 4, 4) poses, seen from above."""
    return np.asarray(outline_m @ world_T_outline[..., :2, :2].swapaxes(-1, -2) + world_T_outline[..., None, :2, 3])


def compute_contact_time_s(
    first_corners_m: Float64, second_corners_m: Float64, relative_velocity_mps: Float64
) -> Float64:
    """Time until two rectangles share area, if one passes the other straight on and neither turns.

    By separating axes: along each side of either, both have shadows, which overlap between two times; the rectangles do
    where all shadows do. Touching is not sharing, as for `overlapping`.

    Args:
        first_corners_m: (..., 4, 2) corners, one after the other around it.
        second_corners_m: (..., 4, 2) those of the other.
        relative_velocity_mps: (..., 2) of b as a has it.

    Returns:
        (...) seconds: 0 if they share area already, infinite if they never do.

    Example:
        >>> car_m = np.array([[-2.0, -1.0], [2.0, -1.0], [2.0, 1.0], [-2.0, 1.0]])
        >>> compute_contact_time_s(car_m, car_m + [14.0, 0.5], np.array([[-20.0, 0.0], [-20.0, 5.0], [5.0, 0.0]])).tolist()
        [0.5, inf, inf]
    """
    # Differences first: coordinates may be of UTM size.
    origin_m = first_corners_m[..., :1, :]
    first_corners_m, second_corners_m, relative_velocity_mps = np.broadcast_arrays(
        first_corners_m - origin_m, second_corners_m - origin_m, relative_velocity_mps[..., None, :]
    )[:3]
    sides_m = np.concatenate(
        [np.diff(first_corners_m[..., :3, :], axis=-2), np.diff(second_corners_m[..., :3, :], axis=-2)], axis=-2
    )
    ours, theirs = (
        np.einsum("...ak,...ck->...ac", sides_m, corners_m) for corners_m in (first_corners_m, second_corners_m)
    )
    speed = np.einsum("...ak,...k->...a", sides_m, relative_velocity_mps[..., 0, :])
    before = ours.min(axis=-1) - theirs.max(axis=-1)
    behind = ours.max(axis=-1) - theirs.min(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        first, last = np.where(speed > 0, before, behind) / speed, np.where(speed > 0, behind, before) / speed
    for_good = np.where((before < 0) & (behind > 0), -np.inf, np.inf)
    begin = np.where(speed == 0, for_good, first).max(axis=-1)
    end = np.where(speed == 0, -for_good, last).min(axis=-1)
    return np.asarray(np.where((begin < end) & (end > 0), np.maximum(begin, 0.0), np.inf))
