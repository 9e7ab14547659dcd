"""The directions of a sensor's rays, in tiles: neighbours together, so that a tile is a narrow cone."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

# Rows and columns in a tile. A constant, so that the order of points depends on the sensor alone.
TILE_ROWS = 128
TILE_COLUMNS = 256


# Rows and columns in a block of a tile: what is cast at a body is first looked for by the block.
BLOCK = 8

AnyFloat = TypeVar("AnyFloat", np.float32, np.float64)


@dataclass(frozen=True, eq=False)
class Tile:
    """Rays that point to about the same place, cut into blocks that are narrower still.

    Args:
        directions: (3, n) float32 unit directions in the sensor's frame.
        axis: (3,) float64 middle of the cone that holds them.
        half_angle: Half the opening of that cone in radians.
        blocks: (B, m) numbers of the rays in each block; one with fewer rays than others repeats one of them.
        block_lower: (3, B) float64 smallest x, y, z among the directions of each block.
        block_upper: (3, B) largest.
    """

    directions: NDArray[np.float32]
    axis: NDArray[np.float64]
    half_angle: float
    blocks: NDArray[np.int64]
    block_lower: NDArray[np.float64]
    block_upper: NDArray[np.float64]


def unit_directions(elevation_deg: NDArray[np.float64], azimuth_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions from angles.

    Args:
        elevation_deg: Angle above the x-y plane, of a shape that broadcasts to (rows, columns).
        azimuth_deg: Angle from x towards y, likewise.

    Returns:
        (3, rows, columns) float64 unit vectors.
    """
    elevation, azimuth = np.broadcast_arrays(np.deg2rad(elevation_deg), np.deg2rad(azimuth_deg))
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])


def into_tiles(
    directions: NDArray[np.float64], tile_rows: int = TILE_ROWS, tile_columns: int = TILE_COLUMNS
) -> tuple[Tile, ...]:
    """Cut a sensor's rows and columns into tiles.

    Args:
        directions: (3, rows, columns) unit vectors; NaN for a pixel that has no ray.
        tile_rows: Most rows in a tile.
        tile_columns: Most columns in a tile.

    Returns:
        The tiles, row by row; together they hold every ray once; a pixel without one is left out.
    """
    return tuple(_tile(directions[:, *cut]) for cut in _cuts(directions.shape, tile_rows, tile_columns))


def pixels_in_tiles(directions: NDArray[np.float64]) -> NDArray[np.int64]:
    """(rays,) where each ray, counted over the tiles of `into_tiles`, stands in (3, rows, columns), row by row."""
    has_ray = ~np.isnan(directions[0])
    pixel = np.arange(has_ray.size).reshape(has_ray.shape)
    return np.concatenate([pixel[cut][has_ray[cut]] for cut in _cuts(directions.shape, TILE_ROWS, TILE_COLUMNS)])


def _cuts(shape: tuple[int, ...], tile_rows: int, tile_columns: int) -> Iterator[tuple[slice, slice]]:
    """The rows and the columns of each tile."""
    _, rows, columns = shape
    for top in range(0, rows, tile_rows):
        for left in range(0, columns, tile_columns):
            yield slice(top, top + tile_rows), slice(left, left + tile_columns)


def _tile(directions: NDArray[np.float64]) -> Tile:
    has_ray = ~np.isnan(directions[0])
    rays = directions.reshape(3, -1) if has_ray.all() else directions[:, has_ray]
    rounded = np.ascontiguousarray(rays, dtype=np.float32)
    if rays.shape[1] == 0:
        blocks, none = np.empty((0, 1), dtype=np.int64), np.empty((3, 0))
        return Tile(rounded, np.array([1.0, 0.0, 0.0]), 0.0, blocks, none, none)
    middle = rays.mean(axis=1)
    length = float(np.linalg.norm(middle))
    # Directions that cancel have no middle; any axis will do, for the cone is then the whole sphere.
    axis = middle / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    # From the longest chord: the arc cosine would lose angles below 1e-8.
    chord = np.linalg.norm(rays - axis[:, None], axis=0).max()
    half_angle = float(2.0 * np.arcsin(min(chord / 2.0, 1.0)))
    blocks = _blocks(has_ray)
    in_blocks = rounded.take(blocks, axis=1)
    lower, upper = in_blocks.min(axis=2).astype(np.float64), in_blocks.max(axis=2).astype(np.float64)
    return Tile(rounded, axis, half_angle, blocks, lower, upper)


def _blocks(has_ray: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(B, m) numbers of the rays in each block of the pixels of a tile, where (rows, columns) pixels have a ray."""
    rows, columns = has_ray.shape
    high, wide = min(BLOCK, rows), min(BLOCK, columns)
    # Blocks at the lower and right border repeat the last row and column.
    row = np.minimum(np.arange(-(-rows // high) * high), rows - 1).reshape(-1, 1, high, 1)
    column = np.minimum(np.arange(-(-columns // wide) * wide), columns - 1).reshape(1, -1, 1, wide)
    pixels = (row * columns + column).reshape(-1, high * wide)
    filled = has_ray.ravel()[pixels]
    # Pixels without a ray repeat the first one of their block that has one.
    first = np.take_along_axis(pixels, filled.argmax(axis=1)[:, None], axis=1)
    pixels = np.where(filled, pixels, first)[filled.any(axis=1)]
    numbers: NDArray[np.int64] = has_ray.cumsum()[pixels] - 1
    return numbers


def rotate(rotation: NDArray[np.float64], directions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn (3, n) directions. What becomes of one does not depend on the others."""
    if np.array_equal(rotation, np.eye(3)):
        return directions
    return rotate_each(rotation.astype(np.float32)[None], directions)


def rotate_each(rotations: NDArray[AnyFloat], directions: NDArray[AnyFloat]) -> NDArray[AnyFloat]:
    """Turn each of (3, n) directions by its own of (n, 3, 3) rotations, to the bits of `rotate`."""
    # No matrix product: BLAS rounds a single column differently, and wakes threads of its own for many.
    (x, y, z), rows = directions, rotations.swapaxes(0, 1)
    return np.stack([row[:, 0] * x + row[:, 1] * y + row[:, 2] * z for row in rows])
