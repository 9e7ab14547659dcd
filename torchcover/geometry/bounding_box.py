"""Axis-aligned boxes in the vehicle frame."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray


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
    def around(cls, points_m: NDArray[np.floating]) -> "BoundingBox":
        """The smallest box that holds all (N, 3) points."""
        lower, upper = points_m.min(axis=0), points_m.max(axis=0)
        return cls(
            (float(lower[0]), float(lower[1]), float(lower[2])), (float(upper[0]), float(upper[1]), float(upper[2]))
        )

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """(8, 3) corners."""
        return np.array(list(product(*zip(self.lower_m, self.upper_m, strict=True))))

    @property
    def outline_m(self) -> NDArray[np.float64]:
        """(4, 2) corners x, y seen from above, counter-clockwise."""
        (x0, y0, _), (x1, y1, _) = self.lower_m, self.upper_m
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along x, y, z in metres."""
        (x0, y0, z0), (x1, y1, z1) = self.lower_m, self.upper_m
        return (x1 - x0, y1 - y0, z1 - z0)


def overlap(a: BoundingBox, a_T_b: NDArray[np.float64], b: BoundingBox) -> bool:
    """Whether two boxes that stand on about the same ground share space; touching is not sharing.

    Args:
        a: A box in its frame.
        a_T_b: (4, 4) pose of the other box's frame in that of `a`, turned mainly about z.
        b: The other box, in its own frame.

    Returns:
        True if their heights overlap, and so do their outlines seen from above (separating axes).

    Example:
        >>> car, away = BoundingBox((-2, -1, 0), (2, 1, 1.5)), np.eye(4)
        >>> away[:3, 3] = [3.0, 2.1, 0.0]
        >>> overlap(car, np.eye(4), car), overlap(car, away, car)
        (True, False)
    """
    ours = a.corners_m
    theirs = b.corners_m @ a_T_b[:3, :3].T + a_T_b[:3, 3]
    axes = [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], a_T_b[:3, 0], a_T_b[:3, 1]]
    return all(
        (theirs @ axis).min() < (ours @ axis).max() and (ours @ axis).min() < (theirs @ axis).max() for axis in axes
    )
