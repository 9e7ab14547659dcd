"""Axis-aligned boxes in the vehicle frame."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Box:
    """An axis-aligned box.

    Args:
        lower_m: Smallest x, y, z in metres.
        upper_m: Largest x, y, z in metres.

    Example:
        >>> Box((-1.0, -1.0, 0.0), (1.0, 1.0, 2.0)).size_m
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
    def around(cls, points_m: NDArray[np.floating]) -> "Box":
        """The smallest box that holds all (N, 3) points."""
        lower, upper = points_m.min(axis=0), points_m.max(axis=0)
        return cls(
            (float(lower[0]), float(lower[1]), float(lower[2])), (float(upper[0]), float(upper[1]), float(upper[2]))
        )

    @property
    def size_m(self) -> tuple[float, float, float]:
        """Extent along x, y, z in metres."""
        (x0, y0, z0), (x1, y1, z1) = self.lower_m, self.upper_m
        return (x1 - x0, y1 - y0, z1 - z0)
