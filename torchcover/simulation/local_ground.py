"""Local ground of a scene: heights above ground, and bounds of ground heights over areas."""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh, iterate_mesh_parts

# Ground up to this much above a point counts as ground below it, for rounding, and where wheels sink in.
TOLERANCE_M = 0.05
# Points and heights are rounded to float32: a point within this distance of the ground lies on the ground.
ROUNDING_M = 5e-4
# Margin of height bounds, on either side.
SLACK_M = 1e-3
# Ground that reaches less than this share into a cell is outside the cell.
RELATIVE_ROUNDING = 1e-6


class LocalGround:
    """Ground of a scene. The local ground of a point is the highest ground surface at or below the point.

    Heights are measured along the vertical of the world frame, not along the z axis of a vehicle that pitches.

    Args:
        meshes: Meshes of ground only, in the world frame.
        origin_m: (3,) position that is subtracted from all coordinates in float64 before they become float32.
    """

    def __init__(self, meshes: Sequence[Mesh], origin_m: Float64) -> None:
        self.origin_m = origin_m
        self._meshes = [Mesh(mesh.vertices_m - origin_m, mesh.faces) for mesh in meshes if len(mesh.faces)]

    @property
    def num_faces(self) -> int:
        """Number of ground faces."""
        return sum(len(mesh.faces) for mesh in self._meshes)

    def compute_heights_m(self, points_m: NDArray[np.floating], world_T_points: Float64 | None = None) -> Float32:
        """Compute heights above the local ground.

        Args:
            points_m: (N, 3) points.
            world_T_points: (4, 4) pose of their frame in the world frame; None for points in the world frame.

        Returns:
            (N,) float32 heights in meters, at least -0.05, exactly 0 within rounding; NaN without ground at or below.
        """
        local_m = self._to_local(points_m, world_T_points)
        local_m[:, 2] += TOLERANCE_M
        heights_m = self._cast(local_m, -1.0)
        heights_m -= np.float32(TOLERANCE_M)
        heights_m[np.abs(heights_m) < ROUNDING_M] = 0.0
        return heights_m

    def is_below_ground(self, position_m: Float64, world_T_position: Float64 | None = None) -> bool:
        """Return True for a position that has ground above it and none at or below it.

        Args:
            position_m: (3,) position.
            world_T_position: (4, 4) pose of its frame in the world frame; None for a position in the world frame.
        """
        (local_m,) = self._to_local(position_m[None], world_T_position)
        margin_m = 1e-4  # a position this close to the ground lies on it
        starts_m = local_m + np.array([[0.0, 0.0, margin_m], [0.0, 0.0, -margin_m]])
        return bool(np.isnan(self._cast(starts_m[:1], -1.0)[0]) and np.isfinite(self._cast(starts_m[1:], 1.0)[0]))

    def _to_local(self, points_m: NDArray[np.floating], world_T_points: Float64 | None) -> Float64:
        """Transform points to the frame of the meshes."""
        local_T_points = np.eye(4) if world_T_points is None else world_T_points.copy()
        local_T_points[:3, 3] -= self.origin_m
        return transform_points(local_T_points, points_m)

    def _cast(self, local_m: Float64, z_sign: float) -> Float32:
        """Compute the (N,) distance of the ground above (1) or below (-1) points; NaN without ground."""
        num_points = len(local_m)
        if not self._meshes:
            return np.full(num_points, np.nan, dtype=np.float32)
        limit_m = np.full(num_points, np.inf, dtype=np.float32)
        directions = build_vertical_directions(num_points, z_sign)
        hits = self._caster.cast_from_each(local_m.astype(np.float32), directions, limit_m)
        hits.range_m[hits.body_indices < 0] = np.nan
        return hits.range_m

    @cached_property
    def _caster(self) -> RayCaster:
        """Ray caster of the meshes; built on first use, since many runs need no heights."""
        return RayCaster(self._meshes)

    @cached_property
    def height_pyramid(self) -> "GroundHeightPyramid":
        """Bounds of the ground heights, in the frame of the meshes: the world frame minus `origin_m`."""
        return GroundHeightPyramid.from_meshes(self._meshes, self.origin_m)


class GroundHeightPyramid(NamedTuple):
    """Lowest and highest ground per cell of a grid, and of coarser grids whose cells are twice as large per level.

    Args:
        origin_m: (2,) lower corner of the grid.
        cell_m: Size of a cell on the finest level; inf for a single cell.
        levels: For each level (2, columns, rows) float32 lowest and highest ground; inf and -inf without ground.
    """

    origin_m: Float64
    cell_m: float
    levels: Sequence[Float32]

    @classmethod
    def from_meshes(cls, meshes: Sequence[Mesh], origin_m: Float64) -> "GroundHeightPyramid":
        """Build the pyramid of ground meshes.

        Args:
            meshes: Meshes in the local frame.
            origin_m: (3,) origin of the local frame in the world frame; cells are aligned to the world frame.
        """
        bounds_m = [
            (corners_m.min(axis=(0, 2)), corners_m.max(axis=(0, 2))) for _, corners_m in iterate_mesh_parts(meshes)
        ]
        if not bounds_m:
            return cls(np.zeros(2), math.inf, [np.array([[[np.inf]], [[-np.inf]]], dtype=np.float32)])
        lower_m = np.min([lower for lower, _ in bounds_m], axis=0)
        upper_m = np.max([upper for _, upper in bounds_m], axis=0)
        lowest_m, highest_m = float(lower_m[2]), float(upper_m[2])
        max_flat_m = 0.3  # ground with at most this height difference is one cell
        if highest_m - lowest_m <= max_flat_m:
            single_cell = np.array([lowest_m - SLACK_M, highest_m + SLACK_M], dtype=np.float32)
            return cls(np.zeros(2), math.inf, [single_cell.reshape(2, 1, 1)])
        size_m = (upper_m - lower_m)[:2]
        min_cell_m = 10.0  # generated streets have their ground in squares of 10 m at multiples of 10 m
        max_cells = 65_536
        cell_m = max(min_cell_m, float(np.sqrt(size_m.prod() / max_cells)), float(size_m.max()) / max_cells)
        corner_m = np.floor((lower_m[:2] + origin_m[:2]) / cell_m) * cell_m - origin_m[:2]
        columns, rows = np.floor((upper_m[:2] - corner_m) / cell_m + RELATIVE_ROUNDING).astype(np.int64) + 1
        levels = [_rasterize_heights(meshes, corner_m, cell_m, int(columns), int(rows))]
        while max(levels[-1].shape) > 2:
            levels.append(_merge_cells(levels[-1]))
        return cls(corner_m, cell_m, levels)

    def compute_ground_bounds_m(
        self, lower_m: NDArray[np.floating], upper_m: NDArray[np.floating]
    ) -> tuple[Float32, Float32]:
        """Compute bounds of the ground heights in rectangles.

        Args:
            lower_m: (2, N) lower corners x, y.
            upper_m: (2, N) upper corners.

        Returns:
            (N,) lower bounds and (N,) upper bounds; inf and -inf without ground.
        """
        if math.isinf(self.cell_m):
            min_height_m, max_height_m = self.levels[0].ravel()
            return np.full(lower_m.shape[1], min_height_m), np.full(lower_m.shape[1], max_height_m)
        extent = np.max(upper_m - lower_m, axis=0) / self.cell_m
        # On this level a rectangle touches at most 2 x 2 cells.
        level = np.clip(np.ceil(np.log2(np.maximum(extent, 1.0))), 0, len(self.levels) - 1).astype(np.int64)
        lowest_m = np.full(len(level), np.inf, np.float32)
        highest_m = np.full(len(level), -np.inf, np.float32)
        for level_index in np.unique(level).tolist():
            grid, selected = self.levels[level_index], np.flatnonzero(level == level_index)
            sides = np.array(grid.shape[1:])[:, None]
            level_cell_m = self.cell_m * 2**level_index
            lower = (lower_m.take(selected, axis=1) - self.origin_m[:, None]) / level_cell_m
            upper = (upper_m.take(selected, axis=1) - self.origin_m[:, None]) / level_cell_m
            is_outside = ((upper < 0) | (lower >= sides)).any(axis=0)
            first_x, first_y = np.clip(lower, 0, sides - 1).astype(np.int64)
            last_x, last_y = np.clip(upper, 0, sides - 1).astype(np.int64)
            cells, rows = grid.reshape(2, -1), grid.shape[2]
            corner_cells = [
                cells.take(first_x * rows + first_y, axis=1),
                cells.take(first_x * rows + last_y, axis=1),
                cells.take(last_x * rows + first_y, axis=1),
                cells.take(last_x * rows + last_y, axis=1),
            ]
            min_height_m = np.min([heights_m[0] for heights_m in corner_cells], axis=0)
            max_height_m = np.max([heights_m[1] for heights_m in corner_cells], axis=0)
            lowest_m[selected] = np.where(is_outside, np.inf, min_height_m)
            highest_m[selected] = np.where(is_outside, -np.inf, max_height_m)
        return lowest_m, highest_m

    def compute_height_bounds_m(self, triangles_m: NDArray[np.floating]) -> Float32:
        """Compute bounds of the heights above ground of triangles.

        Args:
            triangles_m: (3, 3, N) corners (corner, coordinate, triangle) in the local frame.

        Returns:
            (2, N) lower and upper bounds for points that have ground below; inf and -inf without ground.
        """
        lower_m, upper_m = triangles_m.min(axis=0), triangles_m.max(axis=0)
        lowest_m, highest_m = self.compute_ground_bounds_m(lower_m[:2], upper_m[:2])
        return round_height_bounds_m(lower_m[2] - highest_m, upper_m[2] - lowest_m)


def round_height_bounds_m(min_height_m: Float64, max_height_m: Float64) -> Float32:
    """Round bounds of heights to float32, so that they stay bounds.

    Args:
        min_height_m: (N,) lower bounds; less than the smallest height of `LocalGround` is raised to it.
        max_height_m: (N,) upper bounds.

    Returns:
        (2, N) float32 lower and upper bounds.
    """
    return np.asarray(
        np.stack([np.maximum(min_height_m, -TOLERANCE_M) - SLACK_M, max_height_m + SLACK_M]).astype(np.float32)
    )


def build_vertical_directions(num_rays: int, z_sign: float) -> Float32:
    """Build (3, num_rays) float32 directions that all point up (1) or down (-1)."""
    directions = np.zeros((3, num_rays), dtype=np.float32)
    directions[2] = z_sign
    return directions


def _rasterize_heights(meshes: Sequence[Mesh], corner_m: Float64, cell_m: float, columns: int, rows: int) -> Float32:
    """Rasterize the (2, columns, rows) lowest and highest ground per cell, with a margin on either side."""
    lowest_m = np.full(columns * rows, np.inf)
    highest_m = np.full(columns * rows, -np.inf)
    for _, corners_m in iterate_mesh_parts(meshes):
        lower_m, upper_m = corners_m.min(axis=0), corners_m.max(axis=0)
        # Every cell of the bounding box of a triangle counts, so that no cell is missed.
        first_cell = np.floor((lower_m[:2] - corner_m[:, None]) / cell_m + RELATIVE_ROUNDING).astype(np.int64)
        last_cell = np.ceil((upper_m[:2] - corner_m[:, None]) / cell_m - RELATIVE_ROUNDING).astype(np.int64) - 1
        last_cell = np.maximum(last_cell, first_cell)
        slopes, offsets_m = _fit_planes(corners_m - np.append(corner_m, 0.0)[None, :, None])
        # Largest difference between the height of a plane within a cell and at the center of the cell.
        deviation_m = cell_m / 2 * np.abs(slopes).sum(axis=0)
        for triangle, column, row in _iterate_triangle_cells(first_cell, last_cell - first_cell + 1):
            x_slope, y_slope = slopes.take(triangle, axis=1) * cell_m
            center_height_m = offsets_m[triangle] + x_slope * (column + 0.5) + y_slope * (row + 0.5)
            cell, cell_deviation_m = column * rows + row, deviation_m[triangle]
            # The triangle itself bounds the height as well.
            np.minimum.at(lowest_m, cell, np.maximum(center_height_m - cell_deviation_m, lower_m[2].take(triangle)))
            np.maximum.at(highest_m, cell, np.minimum(center_height_m + cell_deviation_m, upper_m[2].take(triangle)))
    return np.stack([lowest_m - SLACK_M, highest_m + SLACK_M]).astype(np.float32).reshape(2, columns, rows)


def _iterate_triangle_cells(
    first_cell: Int64, cell_counts: Int64, pairs_per_chunk: int = 2_000_000
) -> Iterator[tuple[Int64, Int64, Int64]]:
    """Iterate over pairs of a triangle and a cell of its (2, N) range of cells, in chunks that bound the memory.

    Yields:
        (K,) triangles, (K,) columns and (K,) rows.
    """
    pair_counts = cell_counts.prod(axis=0)
    chunk_starts = np.flatnonzero(np.diff(np.cumsum(pair_counts) // pairs_per_chunk)) + 1
    for chunk in np.split(np.arange(len(pair_counts)), chunk_starts):
        counts = pair_counts[chunk]
        triangle = chunk.repeat(counts)
        cell_in_triangle = np.arange(len(triangle)) - (np.cumsum(counts) - counts).repeat(counts)
        column, row = np.divmod(cell_in_triangle, cell_counts[1, triangle])
        yield triangle, first_cell[0, triangle] + column, first_cell[1, triangle] + row


def _fit_planes(triangles_m: Float64) -> tuple[Float64, Float64]:
    """Compute the (2, N) slopes along x and y, and the (N,) heights at the origin, of non-vertical triangles."""
    first, second, third = triangles_m
    normals = np.cross(second - first, third - first, axis=0)
    slopes = -normals[:2] / normals[2]
    return slopes, first[2] - (slopes * first[:2]).sum(axis=0)


def _merge_cells(grid: Float32) -> Float32:
    """Merge 2 x 2 cells of (2, columns, rows) lowest and highest heights."""
    columns, rows = (side + side % 2 for side in grid.shape[1:])
    padded = np.empty((2, columns, rows), dtype=np.float32)
    padded[0], padded[1] = np.inf, -np.inf
    padded[:, : grid.shape[1], : grid.shape[2]] = grid
    blocks = padded.reshape(2, columns // 2, 2, rows // 2, 2)
    return np.stack([blocks[0].min(axis=(1, 3)), blocks[1].max(axis=(1, 3))])
