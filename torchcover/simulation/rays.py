"""Rays of sensors: directions, rotations, and tiles of neighboring rays that are cast together."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float32, Float64, Int64

# Rows and columns of a tile. They are fixed, so that the order of points depends on the sensor alone.
TILE_ROWS = 128
TILE_COLUMNS = 256
# Rows and columns of a block of a tile, the unit of the first culling test.
BLOCK_SIZE = 8


AnyFloat = TypeVar("AnyFloat", np.float32, np.float64)


@dataclass(frozen=True, eq=False)
class Tile:
    """Rays of a sensor in similar directions, divided into blocks of even closer rays.

    Args:
        directions: (3, n) float32 unit directions in the sensor frame.
        axis: (3,) float64 axis of the cone around all rays.
        half_angle_rad: Half the opening angle of that cone.
        block_rays: (B, m) ray indices of each block; a block with fewer rays repeats one of its rays.
        min_block_directions: (3, B) float64 smallest x, y, z of the directions of each block.
        max_block_directions: (3, B) float64 largest x, y, z.
    """

    directions: Float32
    axis: Float64
    half_angle_rad: float
    block_rays: Int64
    min_block_directions: Float64
    max_block_directions: Float64

    def select(self, mask: Bools) -> "Tile":
        """Select the rays of a (n,) mask; the cone and the bounds of the blocks stay."""
        is_selected = mask[self.block_rays]
        has_rays = is_selected.any(axis=1)
        blocks, is_selected = self.block_rays[has_rays], is_selected[has_rays]
        # Rays that were removed are replaced by the first selected ray of their block.
        first_rays = np.take_along_axis(blocks, is_selected.argmax(axis=1)[:, None], axis=1)
        ray_indices = (np.cumsum(mask) - 1)[np.where(is_selected, blocks, first_rays)]
        lower, upper = self.min_block_directions[:, has_rays], self.max_block_directions[:, has_rays]
        return Tile(self.directions[:, mask], self.axis, self.half_angle_rad, ray_indices, lower, upper)


def compute_unit_directions(elevation_deg: Float64, azimuth_deg: Float64) -> Float64:
    """Compute unit vectors from elevations above the x-y plane and azimuths from x towards y.

    Args:
        elevation_deg: Elevations in degrees, broadcast with the azimuths to (rows, columns).
        azimuth_deg: Azimuths in degrees.

    Returns:
        (3, rows, columns) float64 unit vectors.
    """
    elevation, azimuth = np.broadcast_arrays(np.deg2rad(elevation_deg), np.deg2rad(azimuth_deg))
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])


def split_into_tiles(
    directions: Float64, max_rows: int = TILE_ROWS, max_columns: int = TILE_COLUMNS
) -> tuple[Tile, ...]:
    """Split the rays of a sensor into tiles.

    Args:
        directions: (3, rows, columns) unit vectors; NaN for a pixel without a ray.
        max_rows: Largest number of rows of a tile.
        max_columns: Largest number of columns of a tile.

    Returns:
        Tiles, row by row; together they have each ray once.
    """
    slices = _iterate_tile_slices(directions.shape, max_rows, max_columns)
    return tuple(_build_tile(directions[:, *tile_slice]) for tile_slice in slices)


def compute_ray_pixel_indices(directions: Float64) -> Int64:
    """Compute the pixel of each ray in the order of the tiles of `split_into_tiles`.

    Args:
        directions: (3, rows, columns) unit vectors; NaN for a pixel without a ray.

    Returns:
        (rays,) pixel indices, row by row.
    """
    has_ray = ~np.isnan(directions[0])
    pixels = np.arange(has_ray.size).reshape(has_ray.shape)
    tile_pixels = []
    for tile_slice in _iterate_tile_slices(directions.shape, TILE_ROWS, TILE_COLUMNS):
        tile_pixels.append(pixels[tile_slice][has_ray[tile_slice]])
    return np.concatenate(tile_pixels)


def _iterate_tile_slices(shape: tuple[int, ...], max_rows: int, max_columns: int) -> Iterator[tuple[slice, slice]]:
    """Iterate over the row and column slices of the tiles."""
    _, rows, columns = shape
    for top in range(0, rows, max_rows):
        for left in range(0, columns, max_columns):
            yield slice(top, top + max_rows), slice(left, left + max_columns)


def _build_tile(directions: Float64) -> Tile:
    """Build a tile of neighboring rays of a sensor from (3, rows, columns) unit directions; NaN marks a missing ray."""
    has_ray = ~np.isnan(directions[0])
    rays = directions.reshape(3, -1) if has_ray.all() else directions[:, has_ray]
    float_rays = np.ascontiguousarray(rays, dtype=np.float32)
    if rays.shape[1] == 0:
        no_blocks, no_bounds = np.empty((0, 1), dtype=np.int64), np.empty((3, 0))
        return Tile(float_rays, np.array([1.0, 0.0, 0.0]), 0.0, no_blocks, no_bounds, no_bounds)
    mean = rays.mean(axis=1)
    length = float(np.linalg.norm(mean))
    # Directions that cancel have no mean direction; any axis will do, since the cone is then the whole sphere.
    axis = mean / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    # The angle follows from the longest chord, since the arc cosine loses angles below 1e-8.
    chord = np.linalg.norm(rays - axis[:, None], axis=0).max()
    half_angle_rad = float(2.0 * np.arcsin(min(chord / 2.0, 1.0)))
    block_rays = _build_blocks(has_ray)
    block_directions = float_rays.take(block_rays, axis=1)
    lower = block_directions.min(axis=2).astype(np.float64)
    upper = block_directions.max(axis=2).astype(np.float64)
    return Tile(float_rays, axis, half_angle_rad, block_rays, lower, upper)


def _build_blocks(has_ray: Bools) -> Int64:
    """Divide a tile into square blocks of pixels; (B, m) ray indices of the blocks that have rays."""
    rows, columns = has_ray.shape
    height, width = min(BLOCK_SIZE, rows), min(BLOCK_SIZE, columns)
    # Blocks at the lower and right border repeat the last row and column.
    row = np.minimum(np.arange(-(-rows // height) * height), rows - 1).reshape(-1, 1, height, 1)
    column = np.minimum(np.arange(-(-columns // width) * width), columns - 1).reshape(1, -1, 1, width)
    pixels = (row * columns + column).reshape(-1, height * width)
    is_filled = has_ray.ravel()[pixels]
    # Pixels without a ray repeat the first pixel of their block that has one.
    first_pixels = np.take_along_axis(pixels, is_filled.argmax(axis=1)[:, None], axis=1)
    pixels = np.where(is_filled, pixels, first_pixels)[is_filled.any(axis=1)]
    return np.asarray(has_ray.cumsum()[pixels] - 1)


def rotate(rotation: Float64, directions: Float32) -> Float32:
    """Rotate directions; the result of one direction does not depend on the others.

    Args:
        rotation: (3, 3) rotation.
        directions: (3, n) float32 directions.
    """
    if np.array_equal(rotation, np.eye(3)):
        return directions
    return rotate_each(rotation.astype(np.float32)[None], directions)


def rotate_each(rotations: NDArray[AnyFloat], directions: NDArray[AnyFloat]) -> NDArray[AnyFloat]:
    """Rotate each direction by a rotation of its own, with the same rounding as `rotate`.

    Args:
        rotations: (n, 3, 3) rotations, or (1, 3, 3) for all directions.
        directions: (3, n) directions.
    """
    # Not a matrix product: BLAS rounds a single column differently, and starts threads for many.
    (x, y, z), rows = directions, rotations.swapaxes(0, 1)
    return np.stack([row[:, 0] * x + row[:, 1] * y + row[:, 2] * z for row in rows])
