"""Heights over a plane: a raster of them, and one that is fitted to scattered places of which some are wrong."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64

# The next but one corner has this share of a place, which counts for nothing where any other has one.
VERGE_SHARE = 1e-3
ROUNDS = 4
# A place farther above what is all about it than this share of a scale's square, or below, counts for nothing: it is on
# a bridge, a roof or stairs, or wrong. No street is so steep.
STEEPEST = 0.15
# What a corner of the raster needs, in places that lie there, to be believed by half.
DOUBT = 0.01
# A plane through places that are hardly wider than this may not lean to their side.
NARROW_M = 3.0


class HeightField(NamedTuple):
    """Heights at the corners of a raster; two triangles are between four of them.

    Args:
        lower_m: (2,) the first corner.
        corners_m: (rows, columns) heights, rows along y.
        cell_m: Side of a square.

    Example:
        >>> field = HeightField(np.zeros(2), np.array([[0.0, 1.0], [2.0, 3.0]]), 10.0)
        >>> field.heights_m(np.array([[5.0, 0.0], [0.0, 5.0], [10.0, 10.0]]))
        array([0.5, 1. , 3. ])
    """

    lower_m: Float64
    corners_m: Float64
    cell_m: float

    @property
    def places_m(self) -> Float64:
        """(rows x columns, 2) of the corners."""
        rows, columns = self.corners_m.shape
        y, x = np.indices((rows, columns)).reshape(2, -1)
        return self.lower_m + self.cell_m * np.stack([x, y], axis=1)

    def above(self, base: Callable[[Float64], Float64]) -> "HeightField":
        """The same above heights that are not 0."""
        return self._replace(corners_m=self.corners_m + base(self.places_m).reshape(self.corners_m.shape))

    def heights_m(self, places_m: Float64) -> Float64:
        """(N,) at (N, 2) places; beyond its border those of the border."""
        cells = (places_m - self.lower_m) / self.cell_m
        rows, columns = self.corners_m.shape
        low = np.clip(cells.astype(np.int64), 0, [columns - 2, rows - 2])
        x, y = np.clip(cells - low, 0.0, 1.0).T
        corners_m, here = self.corners_m.ravel(), low[:, 1] * columns + low[:, 0]
        first, across = corners_m[here], corners_m[here + columns + 1]
        # The triangles share the diagonal from the first to the one across: below it lies the right corner.
        right = x >= y
        side = corners_m[np.where(right, here + 1, here + columns)]
        far, near = np.maximum(x, y), np.minimum(x, y)
        return np.asarray(first + far * (side - first) + near * (across - side))


def spread(
    cells: Float64, heights_m: Float64, rows: int, columns: int, weights: Float64 | float = 1.0
) -> tuple[Float64, Float64]:
    """(rows, columns) sums of weighted heights, and of weights, of (N, 2) places for the corners around each.

    The next but one have a share, too, that counts for nothing where anything else does: the verges of a street.

    Args:
        cells: (N, 2) the places, counted in squares from the first corner.
        heights_m: (N,) their heights.
        rows: Of the raster's corners.
        columns: Likewise.
        weights: (N,) of each place, or of all.
    """
    low = np.floor(cells).astype(np.int64)
    inside = ((low >= 0) & (low < [columns - 1, rows - 1])).all(axis=1)
    weights = np.broadcast_to(weights, len(cells))[inside]
    low, (x, y), heights_m = low[inside], (cells[inside] - low[inside]).T, heights_m[inside]
    sums = np.zeros((2, rows * columns))
    for right, along in ((0, 1 - x), (1, x)):
        for above, across in ((0, 1 - y), (1, y)):
            share = along * across * weights
            corner = (low[:, 1] + above) * columns + low[:, 0] + right
            sums[0] += np.bincount(corner, share * heights_m, rows * columns)
            sums[1] += np.bincount(corner, share, rows * columns)
    around = np.pad(sums.reshape(2, rows, columns), ((0, 0), (1, 1), (1, 1)))
    beside = around[:, :-2] + around[:, 1:-1] + around[:, 2:]
    total, weight = around[:, 1:-1, 1:-1] + VERGE_SHARE * (beside[..., :-2] + beside[..., 1:-1] + beside[..., 2:])
    return total, weight


def fitted(
    across_m: Float64,
    heights_m: Float64,
    size_m: Float64,
    scales_m: Sequence[float],
    *,
    trusted: Bools | None = None,
    beneath: float = 0.5,
    on: HeightField | None = None,
) -> HeightField:
    """Heights everywhere, through most of (N, 2) places.

    A plane that goes on level beyond the places, and on it, from coarse to fine, what is left over: at each scale a
    raster of its means, weighted by Tukey's biweight (`STEEPEST`), some rounds. Where nobody stands a scale adds
    nothing.

    Args:
        across_m: The places.
        heights_m: (N,) their heights.
        size_m: (2,) how far the raster reaches from 0.
        scales_m: Sides of the rasters' squares; each is half of the one before.
        trusted: (N,) which ones are right for sure; none if not given.
        beneath: What a place counts that lies too high; one that lies too low counts the rest of 1. With less than a
            half, the heights are those of the lowest.
        on: Instead of a plane; its squares are twice as large as the first.

    Returns:
        The heights on the raster of the last scale, which begins two squares before 0.
    """
    trusted = np.zeros(len(heights_m), dtype=np.bool_) if trusted is None else trusted
    weights = np.ones(len(heights_m))
    base = _plane(across_m, heights_m, weights) if on is None else on.heights_m
    for _ in range(ROUNDS if on is None else 0):
        weights = _weights(heights_m - base(across_m), trusted, 2 * scales_m[0], beneath)
        base = _plane(across_m, heights_m, weights)
    left_m, layers = heights_m - base(across_m), HeightField(np.zeros(2), np.zeros((2, 2)), 1.0)
    for scale_m in scales_m:
        weights = _weights(left_m, trusted, scale_m, beneath)
        for _ in range(ROUNDS):
            layer = _layer(across_m, left_m, weights, scale_m, size_m)
            over_m = left_m - layer.heights_m(across_m)
            weights = _weights(over_m, trusted, scale_m, beneath)
        left_m = over_m
        # The triangles of a scale lie within those of the one before: nothing is lost.
        layers = layer.above(layers.heights_m)
    return layers.above(base)


def _weights(left_m: Float64, trusted: Bools, scale_m: float, beneath: float) -> Float64:
    """Tukey's: (N,) 1 for whom nothing is left over, 0 for whom it is too much; fewer for those above if so asked."""
    weights = np.clip(1.0 - (left_m / (STEEPEST * scale_m)) ** 2, 0.0, 1.0) ** 2
    weights *= np.where(left_m > 0, 2 * beneath, 2 * (1 - beneath))
    weights[trusted] = 1.0
    return weights


def _plane(across_m: Float64, heights_m: Float64, weights: Float64) -> Callable[[Float64], Float64]:
    """Least squares; level beyond the places."""
    middle_m = np.average(across_m, axis=0, weights=weights)
    height_m = float(np.average(heights_m, weights=weights))
    apart_m = across_m - middle_m
    spread_m2 = (weights[:, None] * apart_m).T @ apart_m / weights.sum() + NARROW_M**2 * np.eye(2)
    slope = np.linalg.solve(spread_m2, (weights * (heights_m - height_m)) @ apart_m / weights.sum())
    lower_m, upper_m = across_m.min(axis=0), across_m.max(axis=0)
    return lambda places_m: height_m + (np.clip(places_m, lower_m, upper_m) - middle_m) @ slope


def _layer(across_m: Float64, left_m: Float64, weights: Float64, scale_m: float, size_m: Float64) -> HeightField:
    """The raster of one scale: 0 where nobody stands."""
    first_m = np.full(2, -2 * scale_m)
    columns, rows = (np.ceil(size_m / scale_m).astype(np.int64) + 5).tolist()
    total, weight = spread((across_m - first_m) / scale_m, left_m, rows, columns, weights)
    return HeightField(first_m, total / (weight + DOUBT), scale_m)
