"""Culling: conservative tests of rays against bodies and spheres, which are cheaper than casting.

From one origin a box fills a pyramid that is bounded by four planes through the origin. A ray on the outer side of a
plane misses the box, and so does a cone of rays that lies there. The tests never exclude a ray that could hit.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry.arrays import Bools, Float32, Float64, Int64
from torchcover.simulation.rays import Tile

# Bound on the error of an angle between float32 directions.
ANGLE_ROUNDING_RAD = 1e-5
# Margin around boxes and spheres, since their bodies have float32 coordinates: absolute, and per meter of coordinates.
SLACK_M = 1e-3
RELATIVE_SLACK = 1e-6


class SearchSpheres(NamedTuple):
    """Spheres around query points, outside of which no sensor point matters.

    Args:
        centers_m: (K, 3) centers in the vehicle frame.
        radius_m: One radius of all, or (K,) radii if each sphere stands for several points.
    """

    centers_m: NDArray[np.floating]
    radius_m: float | Float64

    @classmethod
    def from_points(
        cls,
        points_m: NDArray[np.floating],
        radius_m: float,
        *,
        max_separate_points: int = 800,
        cluster_angle_rad: float = 0.2,
    ) -> Self:
        """Build spheres around points.

        Args:
            points_m: (N, 3) points in the vehicle frame.
            radius_m: Search radius around each point.
            max_separate_points: Up to this number each point has a sphere; more points share larger spheres.
            cluster_angle_rad: Size of the clusters that share a sphere, as seen from the vehicle.
        """
        if len(points_m) <= max_separate_points:
            return cls(points_m, radius_m)
        points = points_m.astype(np.float64)
        distance_m = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1.0)
        # Cells of logarithmic polar coordinates are about as deep and high as they are wide.
        radial = np.log(distance_m) / cluster_angle_rad
        angular = np.arctan2(points[:, 1], points[:, 0]) / cluster_angle_rad
        cells = np.floor([radial, angular, points[:, 2] / (distance_m * cluster_angle_rad)]).astype(np.int64)
        cells -= cells.min(axis=1, keepdims=True)
        cell_indices = np.ravel_multi_index(tuple(cells), tuple(cells.max(axis=1) + 1))
        order = np.argsort(cell_indices, kind="stable")
        starts, points = np.flatnonzero(np.diff(cell_indices[order], prepend=-1)), points[order]
        centers_m = (np.minimum.reduceat(points, starts) + np.maximum.reduceat(points, starts)) / 2
        point_centers_m = np.repeat(centers_m, np.diff(starts, append=len(points)), axis=0)
        point_distances_m = np.linalg.norm(points - point_centers_m, axis=1)
        return cls(centers_m, np.maximum.reduceat(point_distances_m, starts) + radius_m)

    def find_rays_through(self, tile: Tile, vehicle_T_sensor: Float64) -> Bools:
        """Find the rays of a tile that may pass through a sphere.

        Args:
            tile: Rays of the sensor.
            vehicle_T_sensor: (4, 4) extrinsics of the sensor.

        Returns:
            (n,) False only where a ray certainly passes through no sphere.
        """
        pairs_per_chunk = 1 << 20  # pairs of a sphere and a block, bounds the memory
        cosine_rounding = 5e-7  # of two float32 directions
        centers_m = (self.centers_m - vehicle_T_sensor[:3, 3]) @ vehicle_T_sensor[:3, :3]
        distance_m = np.linalg.norm(centers_m, axis=1)
        radius_m = self.radius_m + SLACK_M + RELATIVE_SLACK * distance_m
        if (distance_m <= radius_m).any():
            return np.ones(tile.directions.shape[1], dtype=bool)
        towards = centers_m / distance_m[:, None]
        angle = np.arcsin(radius_m / distance_m) + ANGLE_ROUNDING_RAD
        off_axis = np.arccos(np.clip(towards @ tile.axis, -1.0, 1.0))
        in_cone = np.flatnonzero(off_axis <= angle + tile.half_angle_rad + ANGLE_ROUNDING_RAD)
        may_pass = np.zeros(tile.directions.shape[1], dtype=bool)
        block_center = (tile.min_block_directions + tile.max_block_directions) / 2
        block_half_size = (tile.max_block_directions - tile.min_block_directions) / 2
        for chunk in np.array_split(in_cone, len(in_cone) * len(tile.block_rays) // pairs_per_chunk + 1):
            # Compare chords: each unit direction of a block is within half the diagonal of the block of its center.
            chord = 2 * np.sin(angle[chunk] / 2)[:, None] + np.linalg.norm(block_half_size, axis=0)
            squared_distance = 1 + (block_center**2).sum(axis=0) - 2 * towards[chunk] @ block_center
            is_touched = squared_distance <= chord**2 + ANGLE_ROUNDING_RAD**2
            if isinstance(self.radius_m, np.ndarray):  # large spheres, compared with which a block is small
                may_pass[tile.block_rays[is_touched.any(axis=0)]] = True
                continue
            sphere, block = np.nonzero(is_touched)
            rays = tile.block_rays[block]
            x, y, z = towards[chunk].astype(np.float32).T[:, sphere, None]
            cosine = x * tile.directions[0][rays] + y * tile.directions[1][rays] + z * tile.directions[2][rays]
            min_cosine = (np.cos(angle[chunk]) - cosine_rounding).astype(np.float32)[sphere, None]
            may_pass[rays[cosine >= min_cosine]] = True
        return may_pass


class BoxOutlines(NamedTuple):
    """Bounding planes of P boxes as seen from one origin.

    Args:
        normals: (P, 4, 3) normals of planes through the origin with the box on the inner side; zeros for no plane.
        min_distance_m: (P,) lower bound of the distance of all points of the box.
    """

    normals: Float64
    min_distance_m: Float64

    def select(self, box_indices: NDArray[np.intp]) -> "BoxOutlines":
        """Select boxes by their indices."""
        return BoxOutlines(self.normals[box_indices], self.min_distance_m[box_indices])


def compute_outlines(corners_m: Float64, origin_m: Float64) -> BoxOutlines:
    """Compute the bounding planes of boxes as seen from an origin.

    Args:
        corners_m: (P, 8, 3) corners of boxes in the order of `BoundingBox.corners_m`, or (P, C, 3) corners of each box
            at several times.
        origin_m: (3,) origin in the same frame.
    """
    closest_m = 0.05  # a box with a corner less than this in front of the origin has no bounding pyramid
    range_rounding_m = 0.01  # the range of a grazing ray is inexact
    from_origin_m = corners_m - origin_m
    forward = _normalize(from_origin_m.mean(axis=1))
    # Upright bodies fill a pyramid with upright sides.
    x, y, z = forward.T
    is_steep = np.abs(z) > 0.99
    left = _normalize(np.where(is_steep, [np.zeros_like(x), -z, y], [-y, x, np.zeros_like(x)]).T)
    up = _compute_cross_products(forward, left)
    # (P, C) forward, left and up coordinates of the corners.
    depth_m, left_m, up_m = np.moveaxis(from_origin_m @ np.stack([forward, left, up], axis=2), 2, 0)
    min_depth_m = depth_m.min(axis=1)
    is_close = min_depth_m < closest_m
    depth_m[is_close] = 1.0
    normals = []
    for side, side_m in ((left, left_m), (up, up_m)):
        slope = side_m / depth_m
        normals += [side - slope.max(axis=1, keepdims=True) * forward]
        normals += [slope.min(axis=1, keepdims=True) * forward - side]
    planes = _normalize(np.stack(normals, axis=1))
    is_single_box = corners_m.shape[1] == 8
    planes[is_close] = _compute_facing_normals(from_origin_m[is_close]) if is_single_box else 0.0
    return BoxOutlines(planes, np.where(is_close, 0.0, min_depth_m) - range_rounding_m)


def _compute_facing_normals(corners_m: Float64) -> Float64:
    """Compute the normals of the faces of boxes that the origin is in front of: no ray that leaves them comes back.

    Args:
        corners_m: (P, 8, 3) vectors from the origin to the corners, in the order of `BoundingBox.corners_m`.

    Returns:
        (P, 4, 3) normals; zeros for axes along which the origin is within the box.
    """
    normals = np.zeros((len(corners_m), 4, 3))
    for axis, opposite_corner in enumerate((4, 2, 1)):
        edge = _normalize(corners_m[:, opposite_corner] - corners_m[:, 0])
        is_behind = np.einsum("pc,pc->p", edge, corners_m[:, 0]) > 0
        is_beyond = np.einsum("pc,pc->p", edge, corners_m[:, opposite_corner]) < 0
        normals[:, axis] = edge * (is_beyond.astype(np.float64) - is_behind)[:, None]
    return normals


def find_boxes_in_cone(outlines: BoxOutlines, axis: Float64, half_angle_rad: float, range_m: float) -> NDArray[np.intp]:
    """Find the boxes that a ray of a cone may hit.

    Args:
        outlines: Boxes as seen from the apex of the cone.
        axis: (3,) axis of the cone, in the frame of the boxes.
        half_angle_rad: Half the opening angle of the cone.
        range_m: Largest range of the rays.

    Returns:
        Indices of these boxes.
    """
    wider_rad = half_angle_rad + ANGLE_ROUNDING_RAD
    # A cone wider than a half space is on no side of a plane.
    limit = np.sin(wider_rad) if wider_rad < np.pi / 2 else np.inf
    is_outside = (outlines.normals @ axis).max(axis=1) > limit
    return np.flatnonzero(~is_outside & (outlines.min_distance_m <= range_m))


def find_blocks_towards_boxes(outlines: BoxOutlines, tile: Tile, vehicle_R_sensor: Float64, range_m: Float32) -> Bools:
    """Find the blocks of a tile that have a ray that may hit a box.

    Args:
        outlines: P boxes as seen from the sensor, in the vehicle frame.
        tile: Rays with B blocks.
        vehicle_R_sensor: (3, 3) orientation of the sensor.
        range_m: (n,) largest range of each ray.

    Returns:
        (P, B) False only where no ray of the block can hit the box.
    """
    block_range_m = range_m.take(tile.block_rays).max(axis=1)
    normals = (outlines.normals @ vehicle_R_sensor).reshape(-1, 3)
    # These are the smallest products of a normal with any direction within the bounds of a block.
    bounds = np.vstack([tile.min_block_directions, tile.max_block_directions]).astype(np.float32)
    split_normals = np.hstack([np.maximum(normals, 0.0), np.minimum(normals, 0.0)]).astype(np.float32)
    min_products = (split_normals @ bounds).reshape(len(outlines.normals), 4, bounds.shape[1])
    is_inside = min_products.max(axis=1) <= ANGLE_ROUNDING_RAD
    return np.asarray(is_inside & (outlines.min_distance_m[:, None] <= block_range_m))


def find_rays_towards_boxes(
    outlines: BoxOutlines, box_indices: NDArray[np.intp], block_rays: Int64, directions: Float32, range_m: Float32
) -> tuple[NDArray[np.intp], Int64]:
    """Find the rays of blocks that may hit the box of their block.

    Args:
        outlines: Boxes as seen from the sensor.
        box_indices: (K,) box of each block.
        block_rays: (K, m) ray indices of each block.
        directions: (3, n) float32 directions of all rays, in the frame of the boxes.
        range_m: (n,) largest range of each ray.

    Returns:
        (L,) box indices and (L,) ray indices of the pairs, in the order of the blocks.
    """
    normals, min_distance_m = outlines.normals.astype(np.float32), outlines.min_distance_m.astype(np.float32)
    products = normals[box_indices] @ directions.take(block_rays, axis=1).swapaxes(0, 1)
    may_hit = products.max(axis=1) <= ANGLE_ROUNDING_RAD
    may_hit &= range_m.take(block_rays) >= min_distance_m[box_indices][:, None]
    return box_indices.repeat(may_hit.sum(axis=1)), block_rays[may_hit]


def _compute_cross_products(a: Float64, b: Float64) -> Float64:
    """Compute (P, 3) cross products; `np.cross` takes several times as long for few vectors."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _normalize(vectors: Float64) -> Float64:
    """Normalize vectors along the last axis; vectors of length 0 stay 0."""
    length = np.sqrt((vectors * vectors).sum(axis=-1, keepdims=True))
    return np.asarray(vectors / np.maximum(length, np.finfo(np.float64).tiny))
