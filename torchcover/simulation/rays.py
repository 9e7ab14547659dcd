"""The directions of a sensor's rays in tiles, each a narrow cone; and which of them may hit which of the bodies around.

That is a test that is cheaper than casting. Seen from one place, a box fills a pyramid: four planes through that place
bound it. A ray on the outer side of one of them misses the box, and so does a whole cone of rays that lies there.
Nothing is left out that could be hit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float32, Float64, Int64

# Rows and columns in a tile. A constant, so that the order of points depends on the sensor alone.
TILE_ROWS = 128
TILE_COLUMNS = 256
# Rows and columns in a block of a tile: what is cast at a body is first looked for by the block.
BLOCK = 8
# Angles between float32 directions are off by less than this, in radians.
ROUNDING = 1e-5
# A box whose corners are not all this far in front of the sensor has no pyramid, in metres.
CLOSEST_M = 0.05
# Of a box.
CORNERS = 8
# By how much boxes are grown for their bodies' float32 coordinates: in metres, and as a share of their coordinates.
SLACK_M = 1e-3
SLACK_SHARE = 1e-6
# Ranges are compared with this much to spare, in metres: a grazing ray's range is not exact.
RANGE_SLACK_M = 0.01
# A cosine between two float32 directions is off by less.
COSINE_ROUNDING = 5e-7
# So many pairs of a ball and a block are looked at together.
PAIRS_AT_ONCE = 1 << 20
# Of so many places or less it is found out of each which rays may meet it; of more, those within such an angle of each
# other, as seen from the vehicle, are looked at together.
FEW = 800
TOGETHER_RAD = 0.2


AnyFloat = TypeVar("AnyFloat", np.float32, np.float64)


@dataclass(frozen=True, eq=False)
class Tile:
    """Rays that point to about the same place, cut into blocks that are narrower still.

    Args:
        directions: (3, n) float32 unit directions in the sensor's frame.
        axis: (3,) float64 middle of the cone that holds them.
        half_angle_rad: Half the opening of that cone in radians.
        block_rays: (B, m) numbers of the rays in each block; one with fewer rays than others repeats one of them.
        min_block_directions: (3, B) float64 smallest x, y, z among the directions of each block.
        max_block_directions: (3, B) largest.
    """

    directions: Float32
    axis: Float64
    half_angle_rad: float
    block_rays: Int64
    min_block_directions: Float64
    max_block_directions: Float64

    def select(self, mask: Bools) -> "Tile":
        """The tile of those of its rays for which (n,) is true, in the same cone."""
        filled = mask[self.block_rays]
        kept = filled.any(axis=1)
        # The others repeat the first one of their block.
        blocks, filled = self.block_rays[kept], filled[kept]
        first = np.take_along_axis(blocks, filled.argmax(axis=1)[:, None], axis=1)
        numbers = (np.cumsum(mask) - 1)[np.where(filled, blocks, first)]
        lower, upper = self.min_block_directions[:, kept], self.max_block_directions[:, kept]
        return Tile(self.directions[:, mask], self.axis, self.half_angle_rad, numbers, lower, upper)


class SearchSpheres(NamedTuple):
    """Balls in the vehicle frame: (K, 3) `centers_m`, and one `radius_m` of all or (K,) of each, if each holds many."""

    centers_m: NDArray[np.floating]
    radius_m: float | Float64

    @classmethod
    def from_points(cls, points_m: NDArray[np.floating], radius_m: float) -> Self:
        """One around each of (N, 3) points; of more than a few, larger ones that hold those of neighbours."""
        if len(points_m) <= FEW:
            return cls(points_m, radius_m)
        points = points_m.astype(np.float64)
        away_m = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1.0)
        # About as wide as they are high and deep, seen from the vehicle.
        shells, towards = np.log(away_m) / TOGETHER_RAD, np.arctan2(points[:, 1], points[:, 0]) / TOGETHER_RAD
        cells = np.floor([shells, towards, points[:, 2] / (away_m * TOGETHER_RAD)]).astype(np.int64)
        cells -= cells.min(axis=1, keepdims=True)
        key = np.ravel_multi_index(tuple(cells), tuple(cells.max(axis=1) + 1))
        order = np.argsort(key, kind="stable")
        first, points = np.flatnonzero(np.diff(key[order], prepend=-1)), points[order]
        centres_m = (np.minimum.reduceat(points, first) + np.maximum.reduceat(points, first)) / 2
        of_each = np.repeat(centres_m, np.diff(first, append=len(points)), axis=0)
        return cls(centres_m, np.maximum.reduceat(np.linalg.norm(points - of_each, axis=1), first) + radius_m)

    def find_rays_through(self, tile: Tile, vehicle_T_sensor: Float64) -> Bools:
        """(n,) whether each ray of a tile may pass through one of them, and of the others some."""
        ways_m = (self.centers_m - vehicle_T_sensor[:3, 3]) @ vehicle_T_sensor[:3, :3]
        distance_m = np.linalg.norm(ways_m, axis=1)
        radius_m = self.radius_m + SLACK_M + SLACK_SHARE * distance_m
        if (distance_m <= radius_m).any():
            return np.ones(tile.directions.shape[1], dtype=bool)
        towards, angle = ways_m / distance_m[:, None], np.arcsin(radius_m / distance_m) + ROUNDING
        off_axis = np.arccos(np.clip(towards @ tile.axis, -1.0, 1.0))
        near = np.flatnonzero(off_axis <= angle + tile.half_angle_rad + ROUNDING)
        met = np.zeros(tile.directions.shape[1], dtype=bool)
        middle, half = (
            (tile.min_block_directions + tile.max_block_directions) / 2,
            (tile.max_block_directions - tile.min_block_directions) / 2,
        )
        for some in np.array_split(near, len(near) * len(tile.block_rays) // PAIRS_AT_ONCE + 1):
            # By the chords between directions: those of a block are within half of its diagonal of its middle.
            chord = 2 * np.sin(angle[some] / 2)[:, None] + np.linalg.norm(half, axis=0)
            touched = 1 + (middle**2).sum(axis=0) - 2 * towards[some] @ middle <= chord**2 + ROUNDING**2
            if isinstance(self.radius_m, np.ndarray):  # wide ones, next to which a block is small
                met[tile.block_rays[touched.any(axis=0)]] = True
                continue
            ball, block = np.nonzero(touched)
            rays = tile.block_rays[block]
            x, y, z = towards[some].astype(np.float32).T[:, ball, None]
            along = x * tile.directions[0][rays] + y * tile.directions[1][rays] + z * tile.directions[2][rays]
            met[rays[along >= (np.cos(angle[some]) - COSINE_ROUNDING).astype(np.float32)[ball, None]]] = True
        return met


def compute_unit_directions(elevation_deg: Float64, azimuth_deg: Float64) -> Float64:
    """(3, rows, columns) float64 unit vectors, of elevations above x-y and azimuths from x towards y, in degrees."""
    elevation, azimuth = np.broadcast_arrays(np.deg2rad(elevation_deg), np.deg2rad(azimuth_deg))
    horizontal = np.cos(elevation)
    return np.stack([horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.sin(elevation)])


def split_into_tiles(
    directions: Float64, max_rows: int = TILE_ROWS, max_columns: int = TILE_COLUMNS
) -> tuple[Tile, ...]:
    """Cut a sensor's rows and columns into tiles.

    Args:
        directions: (3, rows, columns) unit vectors; NaN for a pixel that has no ray.
        max_rows: Most rows in a tile.
        max_columns: Most columns in a tile.

    Returns:
        The tiles, row by row; together they hold every ray once; a pixel without one is left out.
    """
    return tuple(_tile(directions[:, *cut]) for cut in _cuts(directions.shape, max_rows, max_columns))


def compute_ray_pixel_indices(directions: Float64) -> Int64:
    """(rays,) where each ray, counted over the tiles of `split_into_tiles`, stands in (3, rows, columns), row by row."""
    has_ray = ~np.isnan(directions[0])
    pixel = np.arange(has_ray.size).reshape(has_ray.shape)
    return np.concatenate([pixel[cut][has_ray[cut]] for cut in _cuts(directions.shape, TILE_ROWS, TILE_COLUMNS)])


def _cuts(shape: tuple[int, ...], tile_rows: int, tile_columns: int) -> Iterator[tuple[slice, slice]]:
    _, rows, columns = shape
    for top in range(0, rows, tile_rows):
        for left in range(0, columns, tile_columns):
            yield slice(top, top + tile_rows), slice(left, left + tile_columns)


def _tile(directions: Float64) -> Tile:
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


def _blocks(has_ray: Bools) -> Int64:
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
    return np.asarray(has_ray.cumsum()[pixels] - 1)


def rotate(rotation: Float64, directions: Float32) -> Float32:
    """Turn (3, n) directions. What becomes of one does not depend on the others."""
    if np.array_equal(rotation, np.eye(3)):
        return directions
    return rotate_each(rotation.astype(np.float32)[None], directions)


def rotate_each(rotations: NDArray[AnyFloat], directions: NDArray[AnyFloat]) -> NDArray[AnyFloat]:
    """Turn each of (3, n) directions by its own of (n, 3, 3) rotations, to the bits of `rotate`."""
    # No matrix product: BLAS rounds a single column differently, and wakes threads of its own for many.
    (x, y, z), rows = directions, rotations.swapaxes(0, 1)
    return np.stack([row[:, 0] * x + row[:, 1] * y + row[:, 2] * z for row in rows])


class BoxOutlines(NamedTuple):
    """P boxes as one place sees them.

    `normals` (P, 4, 3) of planes through the place with the box on the inner side, zeros where there is none;
    `min_distance_m` (P,) is a distance that no point of the box falls below.
    """

    normals: Float64
    min_distance_m: Float64

    def select(self, box_indices: NDArray[np.intp]) -> "BoxOutlines":
        """Some of them."""
        return BoxOutlines(self.normals[box_indices], self.min_distance_m[box_indices])


def compute_outlines(corners_m: Float64, origin_m: Float64) -> BoxOutlines:
    """How boxes with (P, 8, 3) corners, or (P, C, 3) at several times, look from a (3,) place in their frame."""
    ways_m = corners_m - origin_m
    forward = _unit(ways_m.mean(axis=1))
    # Upright bodies fill a pyramid whose sides are upright.
    x, y, z = forward.T
    steep = np.abs(z) > 0.99
    left = _unit(np.where(steep, [np.zeros_like(x), -z, y], [-y, x, np.zeros_like(x)]).T)
    up = _cross(forward, left)
    # (P, 8) of each: how far ahead, to the left, and up the corners are.
    depth_m, left_m, up_m = np.moveaxis(ways_m @ np.stack([forward, left, up], axis=2), 2, 0)
    nearest_m = depth_m.min(axis=1)
    too_close = nearest_m < CLOSEST_M
    depth_m[too_close] = 1.0
    normals = []
    for side, aside_m in ((left, left_m), (up, up_m)):
        slope = aside_m / depth_m
        normals += [side - slope.max(axis=1, keepdims=True) * forward]
        normals += [slope.min(axis=1, keepdims=True) * forward - side]
    planes = _unit(np.stack(normals, axis=1))
    planes[too_close] = _faces_towards(ways_m[too_close]) if corners_m.shape[1] == CORNERS else 0.0
    return BoxOutlines(planes, np.where(too_close, 0.0, nearest_m) - RANGE_SLACK_M)


def _faces_towards(ways_m: Float64) -> Float64:
    """(P, 4, 3) normals of the faces of boxes whose outer side the place is on: no ray that leaves it turns back.

    `ways_m` (P, 8, 3) lead from the place to the corners, in the order of `Box.corners_m`.
    """
    normals = np.zeros((len(ways_m), 4, 3))
    for axis, across in enumerate((4, 2, 1)):
        along = _unit(ways_m[:, across] - ways_m[:, 0])
        behind = np.einsum("pc,pc->p", along, ways_m[:, 0]) > 0
        beyond = np.einsum("pc,pc->p", along, ways_m[:, across]) < 0
        normals[:, axis] = along * (beyond.astype(np.float64) - behind)[:, None]
    return normals


def find_boxes_in_cone(outlines: BoxOutlines, axis: Float64, half_angle_rad: float, range_m: float) -> NDArray[np.intp]:
    """Numbers of the boxes that a ray of a cone, `half_angle_rad` radians about its axis, may meet before it ends.

    The boxes are seen from its tip, in whose frame the axis is.
    """
    wider = half_angle_rad + ROUNDING
    # Beyond a right angle no plane has a cone on one side of it.
    outside = (outlines.normals @ axis).max(axis=1) > (np.sin(wider) if wider < np.pi / 2 else np.inf)
    return np.flatnonzero(~outside & (outlines.min_distance_m <= range_m))


def find_blocks_towards_boxes(outlines: BoxOutlines, tile: Tile, vehicle_R_sensor: Float64, range_m: Float32) -> Bools:
    """(P, B) whether a ray of each block of a tile may meet each box, seen from the sensor, before its (n,) range."""
    ends_m = range_m.take(tile.block_rays).max(axis=1)
    normals = (outlines.normals @ vehicle_R_sensor).reshape(-1, 3)
    # No direction between the lower and the upper bounds of a block has a smaller product with a normal.
    bounds = np.vstack([tile.min_block_directions, tile.max_block_directions]).astype(np.float32)
    towards = np.hstack([np.maximum(normals, 0.0), np.minimum(normals, 0.0)]).astype(np.float32)
    least = (towards @ bounds).reshape(len(outlines.normals), 4, bounds.shape[1])
    return np.asarray((least.max(axis=1) <= ROUNDING) & (outlines.min_distance_m[:, None] <= ends_m))


def find_rays_towards_boxes(
    outlines: BoxOutlines, box_indices: NDArray[np.intp], block_rays: Int64, directions: Float32, range_m: Float32
) -> tuple[NDArray[np.intp], Int64]:
    """Which rays of some blocks may meet a box before they end: (L,) boxes and (L,) rays, in the order of the blocks.

    `box_indices` (K,) is the box of each block, `block_rays` (K, m) those in it; `directions` (3, n) of all are in the frame of the
    boxes, and `range_m` (n,) is where they end.
    """
    normals, nearest_m = outlines.normals.astype(np.float32), outlines.min_distance_m.astype(np.float32)
    across = normals[box_indices] @ directions.take(block_rays, axis=1).swapaxes(0, 1)
    within = (across.max(axis=1) <= ROUNDING) & (range_m.take(block_rays) >= nearest_m[box_indices][:, None])
    return box_indices.repeat(within.sum(axis=1)), block_rays[within]


def _cross(a: Float64, b: Float64) -> Float64:
    """(P, 3) cross products; NumPy's own takes several times as long for so few."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _unit(vectors: Float64) -> Float64:
    # A vector of length 0 has no direction; it is left as it is.
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))
