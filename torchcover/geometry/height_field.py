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
        origin_m: (2,) the first corner.
        corner_heights_m: (rows, columns) heights, rows along y.
        cell_m: Side of a square.

    Example:
        >>> field = HeightField(np.zeros(2), np.array([[0.0, 1.0], [2.0, 3.0]]), 10.0)
        >>> field.compute_heights_m(np.array([[5.0, 0.0], [0.0, 5.0], [10.0, 10.0]]))
        array([0.5, 1. , 3. ])
    """

    origin_m: Float64
    corner_heights_m: Float64
    cell_m: float

    @property
    def corner_positions_m(self) -> Float64:
        """(rows x columns, 2) of the corners."""
        rows, columns = self.corner_heights_m.shape
        y, x = np.indices((rows, columns)).reshape(2, -1)
        return self.origin_m + self.cell_m * np.stack([x, y], axis=1)

    def add_base(self, base_height_m: Callable[[Float64], Float64]) -> "HeightField":
        """The same above heights that are not 0."""
        return self._replace(
            corner_heights_m=self.corner_heights_m
            + base_height_m(self.corner_positions_m).reshape(self.corner_heights_m.shape)
        )

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """(N,) at (N, 2) places; beyond its border those of the border."""
        cells = (positions_m - self.origin_m) / self.cell_m
        rows, columns = self.corner_heights_m.shape
        low = np.clip(cells.astype(np.int64), 0, [columns - 2, rows - 2])
        x, y = np.clip(cells - low, 0.0, 1.0).T
        corners_m, here = self.corner_heights_m.ravel(), low[:, 1] * columns + low[:, 0]
        first, across = corners_m[here], corners_m[here + columns + 1]
        # The triangles share the diagonal from the first to the one across: below it lies the right corner.
        right = x >= y
        side = corners_m[np.where(right, here + 1, here + columns)]
        far, near = np.maximum(x, y), np.minimum(x, y)
        return np.asarray(first + far * (side - first) + near * (across - side))


def accumulate_heights(
    cell_positions: Float64, heights_m: Float64, num_rows: int, num_columns: int, weights: Float64 | float = 1.0
) -> tuple[Float64, Float64]:
    """(rows, columns) sums of weighted heights, and of weights, of (N, 2) places for the corners around each.

    The next but one have a share, too, that counts for nothing where anything else does: the verges of a street.

    Args:
        cell_positions: (N, 2) the places, counted in squares from the first corner.
        heights_m: (N,) their heights.
        num_rows: Of the raster's corners.
        num_columns: Likewise.
        weights: (N,) of each place, or of all.
    """
    low = np.floor(cell_positions).astype(np.int64)
    inside = ((low >= 0) & (low < [num_columns - 1, num_rows - 1])).all(axis=1)
    weights = np.broadcast_to(weights, len(cell_positions))[inside]
    low, (x, y), heights_m = low[inside], (cell_positions[inside] - low[inside]).T, heights_m[inside]
    sums = np.zeros((2, num_rows * num_columns))
    for right, along in ((0, 1 - x), (1, x)):
        for above, across in ((0, 1 - y), (1, y)):
            share = along * across * weights
            corner = (low[:, 1] + above) * num_columns + low[:, 0] + right
            sums[0] += np.bincount(corner, share * heights_m, num_rows * num_columns)
            sums[1] += np.bincount(corner, share, num_rows * num_columns)
    around = np.pad(sums.reshape(2, num_rows, num_columns), ((0, 0), (1, 1), (1, 1)))
    beside = around[:, :-2] + around[:, 1:-1] + around[:, 2:]
    total, weight = around[:, 1:-1, 1:-1] + VERGE_SHARE * (beside[..., :-2] + beside[..., 1:-1] + beside[..., 2:])
    return total, weight


def fit_height_field(
    positions_m: Float64,
    heights_m: Float64,
    extent_m: Float64,
    cell_sizes_m: Sequence[float],
    *,
    trusted_mask: Bools | None = None,
    above_weight: float = 0.5,
    base_field: HeightField | None = None,
) -> HeightField:
    """Heights everywhere, through most of (N, 2) places.

    A plane that goes on level beyond the places, and on it, from coarse to fine, what is left over: at each scale a
    raster of its means, weighted by Tukey's biweight (`STEEPEST`), some rounds. Where nobody stands a scale adds
    nothing.

    Args:
        positions_m: The places.
        heights_m: (N,) their heights.
        extent_m: (2,) how far the raster reaches from 0.
        cell_sizes_m: Sides of the rasters' squares; each is half of the one before.
        trusted_mask: (N,) which ones are right for sure; none if not given.
        above_weight: What a place counts that lies too high; one that lies too low counts the rest of 1. With less than a
            half, the heights are those of the lowest.
        base_field: Instead of a plane; its squares are twice as large as the first.

    Returns:
        The heights on the raster of the last scale, which begins two squares before 0.
    """
    trusted_mask = np.zeros(len(heights_m), dtype=np.bool_) if trusted_mask is None else trusted_mask
    weights = np.ones(len(heights_m))
    base = _plane(positions_m, heights_m, weights) if base_field is None else base_field.compute_heights_m
    for _ in range(ROUNDS if base_field is None else 0):
        weights = _weights(heights_m - base(positions_m), trusted_mask, 2 * cell_sizes_m[0], above_weight)
        base = _plane(positions_m, heights_m, weights)
    left_m, layers = heights_m - base(positions_m), HeightField(np.zeros(2), np.zeros((2, 2)), 1.0)
    for scale_m in cell_sizes_m:
        weights = _weights(left_m, trusted_mask, scale_m, above_weight)
        for _ in range(ROUNDS):
            layer = _layer(positions_m, left_m, weights, scale_m, extent_m)
            over_m = left_m - layer.compute_heights_m(positions_m)
            weights = _weights(over_m, trusted_mask, scale_m, above_weight)
        left_m = over_m
        # The triangles of a scale lie within those of the one before: nothing is lost.
        layers = layer.add_base(layers.compute_heights_m)
    return layers.add_base(base)


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
    total, weight = accumulate_heights((across_m - first_m) / scale_m, left_m, rows, columns, weights)
    return HeightField(first_m, total / (weight + DOUBT), scale_m)
