"""Where a target is put: cells around the vehicle."""

import math
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import BoundingBox

MARGIN_M = 5.0
SIDES = ("front", "rear", "left", "right")
STEP_M = 0.2
# Takes minutes, and less than 1 GB.
MAX_POSITIONS = 1_000_000


@dataclass(frozen=True)
class Raster:
    """Equal cells in the vehicle frame; a target stands in the middle of one.

    Args:
        x: Bounds forward in metres, low and high.
        y: Bounds to the left.
        step_m: Side of a cell; the bounds are a whole number of them apart.

    Raises:
        ValueError: Bounds or a step that are none, or more than a million cells.

    Example:
        >>> raster = Raster((-1.0, 1.0), (0.0, 1.0), 0.5)
        >>> raster.shape, raster.x_m.tolist()
        ((2, 4), [-0.75, -0.25, 0.25, 0.75])
    """

    x: tuple[float, float]
    y: tuple[float, float]
    step_m: float = STEP_M

    def __post_init__(self) -> None:
        if not 0 < self.step_m < math.inf:
            raise ValueError(f"raster: a step above 0 m is needed; got {self.step_m}")
        for name, (low, high) in (("x", self.x), ("y", self.y)):
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"raster: {name} needs finite bounds, low < high; got {low} and {high}")
        if (self.x[1] - self.x[0]) * (self.y[1] - self.y[0]) > (MAX_POSITIONS + 0.5) * self.step_m**2:
            cells = (self.x[1] - self.x[0]) / self.step_m * (self.y[1] - self.y[0]) / self.step_m
            raise ValueError(
                f"raster: {cells:,.0f} cells; at most {MAX_POSITIONS:,} are placed in one run: take a larger step or "
                "a smaller area"
            )
        for name, (low, high) in (("x", self.x), ("y", self.y)):
            cells = (high - low) / self.step_m
            if round(cells) < 1 or abs(cells - round(cells)) > 1e-6:
                raise ValueError(
                    f"raster: {name} from {low:g} to {high:g} m is no whole number of steps of {self.step_m:g} m; "
                    "change the bounds or the step"
                )

    @classmethod
    def around(cls, vehicle: BoundingBox, margin_m: float = MARGIN_M, step_m: float = STEP_M) -> Self:
        """All that is within a margin of a vehicle, in whole steps from its origin.

        Example:
            >>> Raster.around(BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5)), 1.0, 0.5).x
            (-3.0, 3.0)
        """
        (x0, y0, _), (x1, y1, _) = vehicle.lower_m, vehicle.upper_m

        def bounds(low: float, high: float) -> tuple[float, float]:
            first, last = math.floor((low - margin_m) / step_m + 1e-9), math.ceil((high + margin_m) / step_m - 1e-9)
            return first * step_m, last * step_m

        return cls(bounds(x0, x1), bounds(y0, y1), step_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows along y and columns along x."""
        return round((self.y[1] - self.y[0]) / self.step_m), round((self.x[1] - self.x[0]) / self.step_m)

    @property
    def x_m(self) -> NDArray[np.float64]:
        """(X,) middles of the columns."""
        return _middles_m(self.x[0], self.step_m, self.shape[1])

    @property
    def y_m(self) -> NDArray[np.float64]:
        """(Y,) middles of the rows."""
        return _middles_m(self.y[0], self.step_m, self.shape[0])

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """(Y * X, 2) middles of the cells, row by row."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        return np.stack([x.ravel(), y.ravel()], axis=1)


def _middles_m(low_m: float, step_m: float, count: int) -> NDArray[np.float64]:
    middles_m: NDArray[np.float64] = low_m + step_m * (np.arange(count, dtype=np.float64) + 0.5)
    # A cell that was meant to be at 0.1 is not at 0.09999999999999998.
    return middles_m.round(9)


def side_of(box: BoundingBox, positions_m: NDArray[np.float64]) -> NDArray[np.int64]:
    """(P,) number in `SIDES` of the side of a box that each of (P, 2) places is on; -1 within it.

    Sides meet at 45 degrees from the corners.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> [SIDES[k] for k in side_of(box, np.array([[3.0, 1.5], [0.0, -2.0]]))]
        ['front', 'right']
    """
    x, y = from_outline_m(box, positions_m).T
    side = np.where(np.abs(x) >= np.abs(y), np.where(x > 0, 0, 1), np.where(y > 0, 2, 3))
    side[(x == 0) & (y == 0)] = -1
    return side


def from_outline_m(box: BoundingBox, positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 2) how far along x and y each of (P, 2) places is from the nearest point of a box, seen from above.

    Example:
        >>> box = BoundingBox((-2.0, -1.0, 0.0), (2.0, 1.0, 1.5))
        >>> from_outline_m(box, np.array([[3.0, 0.5], [-2.5, -1.25]])).tolist()
        [[1.0, 0.0], [-0.5, -0.25]]
    """
    nearest_m = np.clip(positions_m, box.lower_m[:2], box.upper_m[:2])
    return np.asarray(positions_m - nearest_m)
