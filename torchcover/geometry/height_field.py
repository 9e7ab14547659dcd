"""Height fields: heights on a raster, also fitted to scattered positions with outliers."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64

# Weight of a position for corners that are one cell farther away than the corners of its cell. It only matters at
# corners without any closer position, such as those at the verges of a street.
VERGE_WEIGHT = 1e-3


class HeightField(NamedTuple):
    """Heights at the corners of a raster, interpolated over two triangles per cell.

    Args:
        origin_m: (2,) x, y of the first corner in meters.
        corner_heights_m: (rows, columns) heights in meters, rows along y.
        cell_m: Side length of a cell in meters.

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
        """(rows * columns, 2) positions of the corners."""
        rows, columns = self.corner_heights_m.shape
        y, x = np.indices((rows, columns)).reshape(2, -1)
        return self.origin_m + self.cell_m * np.stack([x, y], axis=1)

    def add_base(self, base_height_m: Callable[[Float64], Float64]) -> "HeightField":
        """Add a base surface to the heights.

        Args:
            base_height_m: Function from (N, 2) positions to (N,) heights of the base in meters.
        """
        base_m = base_height_m(self.corner_positions_m).reshape(self.corner_heights_m.shape)
        return self._replace(corner_heights_m=self.corner_heights_m + base_m)

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """Interpolate heights.

        Args:
            positions_m: (N, 2) positions in meters; positions outside have the height of the nearest border.

        Returns:
            (N,) heights in meters.
        """
        cells = (positions_m - self.origin_m) / self.cell_m
        rows, columns = self.corner_heights_m.shape
        low = np.clip(cells.astype(np.int64), 0, [columns - 2, rows - 2])
        x, y = np.clip(cells - low, 0.0, 1.0).T
        heights_m, corner = self.corner_heights_m.ravel(), low[:, 1] * columns + low[:, 0]
        first_m, opposite_m = heights_m[corner], heights_m[corner + columns + 1]
        # The triangles share the diagonal from the first corner to the opposite one; the right triangle is below it.
        is_right = x >= y
        side_m = heights_m[np.where(is_right, corner + 1, corner + columns)]
        return np.asarray(first_m + np.maximum(x, y) * (side_m - first_m) + np.minimum(x, y) * (opposite_m - side_m))


def accumulate_heights(
    cell_positions: Float64, heights_m: Float64, num_rows: int, num_columns: int, weights: Float64 | float = 1.0
) -> tuple[Float64, Float64]:
    """Accumulate weighted heights at the corners around each position.

    Weights are bilinear within a cell. Corners one cell farther away get `VERGE_WEIGHT` times as much.

    Args:
        cell_positions: (N, 2) positions x, y in cells from the first corner.
        heights_m: (N,) heights in meters.
        num_rows: Number of corners along y.
        num_columns: Number of corners along x.
        weights: (N,) weight of each position, or one weight of all.

    Returns:
        (rows, columns) sums of weighted heights, and (rows, columns) sums of weights.
    """
    low = np.floor(cell_positions).astype(np.int64)
    is_inside = ((low >= 0) & (low < [num_columns - 1, num_rows - 1])).all(axis=1)
    weights = np.broadcast_to(weights, len(cell_positions))[is_inside]
    low, (x, y), heights_m = low[is_inside], (cell_positions[is_inside] - low[is_inside]).T, heights_m[is_inside]
    sums = np.zeros((2, num_rows * num_columns))
    for column_offset, x_weight in ((0, 1 - x), (1, x)):
        for row_offset, y_weight in ((0, 1 - y), (1, y)):
            corner_weights = x_weight * y_weight * weights
            corner = (low[:, 1] + row_offset) * num_columns + low[:, 0] + column_offset
            sums[0] += np.bincount(corner, corner_weights * heights_m, num_rows * num_columns)
            sums[1] += np.bincount(corner, corner_weights, num_rows * num_columns)
    padded = np.pad(sums.reshape(2, num_rows, num_columns), ((0, 0), (1, 1), (1, 1)))
    row_sums = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
    neighborhood_sums = row_sums[..., :-2] + row_sums[..., 1:-1] + row_sums[..., 2:]
    height_sums, weight_sums = padded[:, 1:-1, 1:-1] + VERGE_WEIGHT * neighborhood_sums
    return height_sums, weight_sums


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
    """Fit a height field to scattered positions of which some are outliers.

    The result is the sum of a plane, level outside of the positions, and of one raster per scale, from coarse to fine,
    which averages the residuals of the scale before. All are reweighted iteratively with Tukey's biweight. A scale adds
    nothing where there are no positions.

    Args:
        positions_m: (N, 2) positions x, y in meters.
        heights_m: (N,) heights in meters.
        extent_m: (2,) largest x, y of the raster in meters.
        cell_sizes_m: Cell size of each scale in meters; each is half of the one before.
        trusted_mask: (N,) positions that are no outliers; by default none.
        above_weight: Weight of positions above the surface; those below weigh 1 minus this. With less than 0.5 the
            surface follows the lowest positions.
        base_field: Surface instead of a plane; its cells are twice as large as those of the first scale.

    Returns:
        Heights on the raster of the last scale, which begins two cells before 0.
    """
    trusted_mask = np.zeros(len(heights_m), dtype=np.bool_) if trusted_mask is None else trusted_mask
    num_rounds = 4
    compute_base_m: Callable[[Float64], Float64]
    if base_field is not None:
        compute_base_m = base_field.compute_heights_m
    else:
        compute_base_m = _fit_plane(positions_m, heights_m, np.ones(len(heights_m)))
        for _ in range(num_rounds):
            residuals_m = heights_m - compute_base_m(positions_m)
            weights = _compute_weights(residuals_m, trusted_mask, 2 * cell_sizes_m[0], above_weight)
            compute_base_m = _fit_plane(positions_m, heights_m, weights)
    residuals_m = heights_m - compute_base_m(positions_m)
    total = HeightField(np.zeros(2), np.zeros((2, 2)), 1.0)
    for cell_m in cell_sizes_m:
        weights = _compute_weights(residuals_m, trusted_mask, cell_m, above_weight)
        for _ in range(num_rounds):
            layer = _fit_layer(positions_m, residuals_m, weights, cell_m, extent_m)
            layer_residuals_m = residuals_m - layer.compute_heights_m(positions_m)
            weights = _compute_weights(layer_residuals_m, trusted_mask, cell_m, above_weight)
        residuals_m = layer_residuals_m
        # Each triangle of a scale lies within one triangle of the scale before, so that the sum is exact.
        total = layer.add_base(total.compute_heights_m)
    return total.add_base(compute_base_m)


def _compute_weights(residuals_m: Float64, trusted_mask: Bools, cell_m: float, above_weight: float) -> Float64:
    """Compute (N,) weights by Tukey's biweight: 1 without residual, 0 for outliers."""
    # Steeper than any street over one cell: bridges, roofs, stairs or wrong heights.
    cutoff_m = 0.15 * cell_m
    weights = np.clip(1.0 - (residuals_m / cutoff_m) ** 2, 0.0, 1.0) ** 2
    weights *= np.where(residuals_m > 0, 2 * above_weight, 2 * (1 - above_weight))
    weights[trusted_mask] = 1.0
    return weights


def _fit_plane(positions_m: Float64, heights_m: Float64, weights: Float64) -> Callable[[Float64], Float64]:
    """Fit a plane by weighted least squares; it is level outside of the bounds of the positions."""
    center_m = np.average(positions_m, axis=0, weights=weights)
    center_height_m = float(np.average(heights_m, weights=weights))
    offsets_m = positions_m - center_m
    # Regularization for positions along a line: over a width of a few meters the slope across is not determined.
    regularization_m2 = 3.0**2 * np.eye(2)
    covariance_m2 = (weights[:, None] * offsets_m).T @ offsets_m / weights.sum() + regularization_m2
    slope = np.linalg.solve(covariance_m2, (weights * (heights_m - center_height_m)) @ offsets_m / weights.sum())
    lower_m, upper_m = positions_m.min(axis=0), positions_m.max(axis=0)

    def compute_plane_heights_m(query_m: Float64) -> Float64:
        return np.asarray(center_height_m + (np.clip(query_m, lower_m, upper_m) - center_m) @ slope)

    return compute_plane_heights_m


def _fit_layer(
    positions_m: Float64, residuals_m: Float64, weights: Float64, cell_m: float, extent_m: Float64
) -> HeightField:
    """Fit the raster of one scale; its heights are 0 at corners without positions."""
    origin_m = np.full(2, -2 * cell_m)
    columns, rows = (np.ceil(extent_m / cell_m).astype(np.int64) + 5).tolist()
    cell_positions = (positions_m - origin_m) / cell_m
    height_sums, weight_sums = accumulate_heights(cell_positions, residuals_m, rows, columns, weights)
    prior_weight = 0.01  # weight of positions at which a corner takes half of their mean height
    return HeightField(origin_m, height_sums / (weight_sums + prior_weight), cell_m)
