"""The directions of a sensor's rays, in tiles: neighbours together, so that a tile is a narrow cone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Rows and columns in a tile. A constant, so that the order of points depends on the sensor alone.
TILE_ROWS = 128
TILE_COLUMNS = 256


@dataclass(frozen=True, eq=False)
class Tile:
    """Rays that point to about the same place.

    Args:
        directions: (3, n) float32 unit directions in the sensor's frame.
        axis: (3,) float64 middle of the cone that holds them.
        half_angle: Half the opening of that cone in radians.
    """

    directions: NDArray[np.float32]
    axis: NDArray[np.float64]
    half_angle: float


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
    _, rows, columns = directions.shape
    return tuple(
        _tile(directions[:, top : top + tile_rows, left : left + tile_columns].reshape(3, -1))
        for top in range(0, rows, tile_rows)
        for left in range(0, columns, tile_columns)
    )


def _tile(directions: NDArray[np.float64]) -> Tile:
    directions = directions[:, ~np.isnan(directions[0])]
    if directions.shape[1] == 0:
        return Tile(directions.astype(np.float32), np.array([1.0, 0.0, 0.0]), 0.0)
    middle = directions.mean(axis=1)
    length = float(np.linalg.norm(middle))
    # Directions that cancel have no middle; any axis will do, for the cone is then the whole sphere.
    axis = middle / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    half_angle = float(np.arccos(np.clip(axis @ directions, -1.0, 1.0)).max())
    return Tile(np.ascontiguousarray(directions, dtype=np.float32), axis, half_angle)
