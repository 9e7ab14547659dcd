"""Exact traversal of a voxel grid by many rays at once.

A ray enters each voxel after the first through a plane between two voxels, which is normal to one of the three axes.
The planes that a ray crosses are enumerated for each axis; at each plane, the other two coordinates determine the
entered voxel. The result is that of Amanatides and Woo (1987), without sequential steps per ray.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from torchcover.frames import Frame
from torchcover.geometry import BoundingBox
from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation import Sensor
from torchcover.simulation.memory import check_memory_fits

# Distance in voxels within which a ray passes through an edge or a corner; a shorter piece in the adjacent voxel is
# rounding. At coordinates of 10,000 voxels, float64 is a thousand times finer.
TOUCH_VOXELS = 1e-9
# Rays processed at once, so that work arrays stay in the cache of the CPU.
RAYS_PER_CHUNK = 8192
# 60 x 40 x 4 m around the vehicle, as in Hu et al. 2022 and later publications.
REGION = BoundingBox((-30.0, -20.0, -0.5), (30.0, 20.0, 3.5))


@dataclass(frozen=True)
class VoxelGrid:
    """Cubes that fill a box in the vehicle frame, half-open, [lower, upper), on every axis.

    The index of a voxel is `(x * Y + y) * Z + z`; arrays over the grid have the shape (X, Y, Z).

    Args:
        region: Box; its extents must be multiples of `voxel_m`.
        voxel_m: Side length of a voxel in meters.

    Raises:
        ValueError: Bounds are infinite, or `voxel_m` is not positive or does not divide an extent.

    Example:
        >>> VoxelGrid(BoundingBox((-30.0, -20.0, -0.5), (30.0, 20.0, 3.5)), 0.2).shape
        (300, 200, 20)
    """

    region: BoundingBox
    voxel_m: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.voxel_m) and self.voxel_m > 0):
            raise ValueError(f"voxel_m: a positive length in meters is needed; got {self.voxel_m}")
        for axis, extent_m in zip("xyz", self.region.size_m, strict=True):
            voxels = extent_m / self.voxel_m
            if not math.isfinite(voxels):
                raise ValueError(f"the region: finite bounds are needed; its extent along {axis} is {extent_m} m")
            # Extents are written in decimals, so that multiples are exact up to rounding.
            if round(voxels) == 0 or abs(voxels - round(voxels)) > 1e-6 * max(1.0, voxels):
                fitting_m = extent_m / max(1, round(voxels))
                raise ValueError(
                    f"voxel_m: the region's extent along {axis} of {extent_m:.10g} m is not a multiple of the voxel of "
                    f"{self.voxel_m:.10g} m ({voxels:.10g} voxels); one of {fitting_m:.10g} m would fit"
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        x_m, y_m, z_m = self.region.size_m
        return round(x_m / self.voxel_m), round(y_m / self.voxel_m), round(z_m / self.voxel_m)

    @property
    def num_voxels(self) -> int:
        """Number of all voxels."""
        return math.prod(self.shape)

    def compute_centers_m(self) -> tuple[Float64, Float64, Float64]:
        """Compute the (X,), (Y,) and (Z,) coordinates of the voxel centers in meters."""
        x_m, y_m, z_m = map(_compute_axis_centers_m, self.region.lower_m, self.region.upper_m, self.shape)
        return x_m, y_m, z_m

    def to_voxel_units(self, points_m: ArrayLike) -> Float64:
        """Convert coordinates to voxels from the lower corner of the region.

        Args:
            points_m: (..., 3) points in meters.
        """
        return (np.asarray(points_m, dtype=np.float64) - self.region.lower_m) * self._voxels_per_m

    def find_voxels(self, points_m: ArrayLike) -> Int64:
        """Find the voxel of each point.

        Args:
            points_m: (N, 3) points in meters.

        Returns:
            (N,) indices, -1 outside of the region.

        Example:
            >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (2.0, 2.0, 1.0)), 1.0)
            >>> grid.find_voxels([[0.5, 0.5, 0.5], [1.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
            array([ 0,  3, -1])
        """
        voxels = np.floor(self.to_voxel_units(points_m))
        is_inside = np.asarray(((voxels >= 0) & (voxels < self.shape)).all(axis=1))
        indices = np.where(is_inside[:, None], voxels, 0).astype(np.int64) @ self._strides.astype(np.int64)
        return np.where(is_inside, indices, -1)

    @property
    def _voxels_per_m(self) -> Float64:
        return np.divide(self.shape, self.region.size_m)

    @property
    def _strides(self) -> Float64:
        return np.array([self.shape[1] * self.shape[2], self.shape[2], 1.0])


def find_crossed_voxels(
    grid: VoxelGrid,
    origins_m: ArrayLike,
    directions: ArrayLike,
    ray_ends: ArrayLike = math.inf,
    *,
    output: Bools | None = None,
) -> Bools:
    """Find the voxels that any ray crosses.

    A voxel is crossed if it contains a piece of a ray of positive length: a ray through a corner or an edge does not
    cross the voxels that it only touches there. A ray along a face is in the voxel on the upper side of the face. A
    piece shorter than 1e-9 voxels may or may not count.

    Args:
        grid: Voxels.
        origins_m: (3,) common origin of all rays, or (N, 3) origins, inside or outside of the region, in meters.
        directions: (N, 3) directions of any length; NaN where there is no ray.
        ray_ends: End of each ray in multiples of its direction (meters for unit vectors); (N,), or one number for all.
            By default infinite: rays end at the border of the region.
        output: Result of another call that is updated in place.

    Returns:
        (X, Y, Z) bool, one byte per voxel. Work memory is a few megabytes, whatever the number of rays.

    Raises:
        ValueError: Shapes do not match, origins are not finite, a direction is infinite or of length 0, or an end is
            negative or NaN.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> crossed = find_crossed_voxels(grid, [0.5, 0.5, 0.5], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [3.0, 1.0])
        >>> crossed[:, :, 0].astype(int)
        array([[1, 1, 0, 0],
               [1, 0, 0, 0],
               [1, 0, 0, 0],
               [1, 0, 0, 0]])
    """
    vectors = np.asarray(directions, dtype=np.float64)
    starts_m, ends = np.asarray(origins_m, dtype=np.float64), np.asarray(ray_ends, dtype=np.float64)
    _check_rays(starts_m, vectors, ends)
    is_ray = ~np.isnan(vectors).any(axis=1)
    starts_m = np.broadcast_to(starts_m, vectors.shape)[is_ray]
    ends = np.broadcast_to(ends, len(vectors))[is_ray]
    vectors = vectors[is_ray]
    if output is None:
        output = np.zeros(grid.shape, dtype=bool)
    elif output.shape != grid.shape or output.dtype != bool or not output.flags.c_contiguous:
        raise ValueError(f"crossed: a contiguous bool array of shape {grid.shape} is needed; got {output.shape}")
    for first_ray in range(0, len(vectors), RAYS_PER_CHUNK):
        chunk = slice(first_ray, first_ray + RAYS_PER_CHUNK)
        rays = _clip_rays(grid, starts_m[chunk], vectors[chunk], ends[chunk])
        first_indices: Float64 = rays.index_offsets + (rays.first_voxels * rays.strides).sum(axis=0)
        output.reshape(-1)[first_indices.astype(np.int64)] = True
        for axis in range(3):
            _mark_crossed_planes(rays, axis, output.reshape(-1))
    return output


@dataclass(frozen=True, eq=False)
class _ClippedRays:
    """Rays inside the region, mirrored so that each moves upwards along every axis, in voxel units.

    Args:
        origins: (3, n) origins.
        directions: (3, n) directions, nowhere negative.
        first_voxels: (3, n) voxels of the start of each ray.
        last_voxels: (3, n) voxels of the end of each ray.
        strides: (3, n) change of the index of a voxel per voxel along the mirrored axes.
        index_offsets: (n,) index of the voxel 0, 0, 0 in mirrored coordinates.
    """

    origins: Float64
    directions: Float64
    first_voxels: Float64
    last_voxels: Float64
    strides: Float64
    index_offsets: Float64


def _clip_rays(grid: VoxelGrid, origins_m: Float64, directions: Float64, ray_ends: Float64) -> _ClippedRays:
    """Clip rays to the region; rays outside are removed."""
    shape, strides = np.array(grid.shape, dtype=np.float64)[:, None], grid._strides[:, None]
    origins, directions = grid.to_voxel_units(origins_m).T, (directions * grid._voxels_per_m).T
    # Along an axis on which a ray moves less than the tolerance within the region, it counts as parallel to the faces.
    reach = np.maximum(np.abs(origins), np.abs(shape - origins)).max(axis=0)
    is_parallel = np.abs(directions) * reach <= TOUCH_VOXELS * np.abs(directions).max(axis=0)
    is_mirrored = (directions < 0) & ~is_parallel
    origins = np.where(is_mirrored, shape - origins, origins)
    directions = np.where(is_parallel, 0.0, np.abs(directions))
    index_offsets = np.where(is_mirrored, (shape - 1) * strides, 0.0).sum(axis=0)
    strides = np.where(is_mirrored, -strides, strides)

    # A ray that is parallel to the faces of an axis is between them everywhere or nowhere.
    is_between = (origins + TOUCH_VOXELS >= 0) & (origins + TOUCH_VOXELS < shape)
    divisors = np.where(is_parallel, 1.0, directions)
    entry = np.where(is_parallel, np.where(is_between, -np.inf, np.inf), -origins / divisors).max(axis=0)
    exit_ = np.where(is_parallel, np.where(is_between, np.inf, -np.inf), (shape - origins) / divisors).min(axis=0)
    start, stop = np.maximum(entry, 0.0), np.minimum(exit_, ray_ends)
    is_inside = (stop - start) * directions.max(axis=0) > TOUCH_VOXELS
    origins, directions = origins[:, is_inside], directions[:, is_inside]
    start, stop = start[is_inside], stop[is_inside]
    first_voxels = np.clip(np.floor(origins + start * directions + TOUCH_VOXELS), 0, shape - 1)
    last_voxels = np.clip(np.ceil(origins + stop * directions - TOUCH_VOXELS) - 1, first_voxels, shape - 1)
    return _ClippedRays(origins, directions, first_voxels, last_voxels, strides[:, is_inside], index_offsets[is_inside])


def _mark_crossed_planes(rays: _ClippedRays, axis: int, crossed: Bools) -> None:
    """Mark the voxels that rays enter through planes normal to an axis, plane by plane."""
    plane_counts = (rays.last_voxels[axis] - rays.first_voxels[axis]).astype(np.int64)
    # Rays are sorted by decreasing number of planes, so that the rays with a k-th plane are the first ones.
    order = np.argsort(-plane_counts, kind="stable")[: np.count_nonzero(plane_counts)]
    plane_counts = plane_counts[order]
    planes = np.arange(plane_counts.max(initial=0))
    ray_counts = len(order) - np.searchsorted(plane_counts[::-1], planes, side="right")
    origins, directions, strides = rays.origins[:, order], rays.directions[:, order], rays.strides[:, order]
    first_voxels, last_voxels = rays.first_voxels[:, order], rays.last_voxels[:, order]
    slope = directions / directions[axis]
    # Coordinates at the first plane, shifted by the tolerance: a ray that reaches a plane of another axis there is
    # beyond it.
    first_crossing = origins + (first_voxels[axis] + 1 - origins[axis]) * slope + TOUCH_VOXELS
    last_voxels = last_voxels + 0.5
    first_indices = rays.index_offsets[order] + (first_voxels[axis] + 1) * strides[axis]
    indices, coordinates = np.empty(len(order)), np.empty(len(order))
    for plane, ray_count in enumerate(ray_counts.tolist()):
        index, coordinate = indices[:ray_count], coordinates[:ray_count]
        np.multiply(strides[axis, :ray_count], plane, out=index)
        index += first_indices[:ray_count]
        for other_axis in range(3):
            if other_axis == axis:
                continue
            np.multiply(slope[other_axis, :ray_count], plane, out=coordinate)
            coordinate += first_crossing[other_axis, :ray_count]
            np.minimum(coordinate, last_voxels[other_axis, :ray_count], out=coordinate)
            np.floor(coordinate, out=coordinate)
            coordinate *= strides[other_axis, :ray_count]
            index += coordinate
        crossed[index.astype(np.int64)] = True


def _compute_axis_centers_m(low_m: float, high_m: float, count: int) -> Float64:
    """Compute (count,) centers of voxels along one axis."""
    odd = 2 * np.arange(count, dtype=np.float64) + 1
    return (low_m * (2 * count - odd) + high_m * odd) / (2 * count)


def _check_rays(origins_m: Float64, directions: Float64, ray_ends: Float64) -> None:
    """Check shapes and values of rays."""
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions: shape (N, 3) is needed; got {directions.shape}")
    count = len(directions)
    if origins_m.shape not in {(3,), (count, 3)}:
        raise ValueError(f"origins_m: shape (3,) or ({count}, 3) is needed; got {origins_m.shape}")
    if not np.isfinite(origins_m).all():
        raise ValueError("origins_m: finite coordinates in meters are needed; got NaN or infinite ones")
    if ray_ends.shape not in {(), (count,)}:
        raise ValueError(f"ray_ends: one number or shape ({count},) is needed; got {ray_ends.shape}")
    if not (ray_ends >= 0).all():
        raise ValueError("ray_ends: lengths >= 0 are needed; got negative ones or NaN")
    if np.isinf(directions).any() or not (directions != 0).any(axis=1).all():
        raise ValueError("directions: finite vectors that are not 0 are needed, or NaN where there is no ray")


def create_voxel_grid(region: BoundingBox, voxel_m: float, bytes_per_voxel: int) -> VoxelGrid:
    """Create a voxel grid if the machine has enough memory for it.

    Args:
        region: Region of the voxels.
        voxel_m: Side length of a voxel in meters.
        bytes_per_voxel: Memory of all arrays over the grid, per voxel.

    Raises:
        ValueError: There is not enough memory, or as in `VoxelGrid`.
    """
    grid = VoxelGrid(region, float(voxel_m))
    size = " x ".join(f"{extent_m:g}" for extent_m in region.size_m)
    content = f"{grid.num_voxels:,} voxels of {voxel_m:g} m in {size} m"
    check_memory_fits(content, bytes_per_voxel * grid.num_voxels, "take larger voxels, or a smaller region")
    return grid


def check_sensors(sensors: Sequence[Sensor]) -> None:
    """Check that a rig has sensors, since some metrics prefer rigs without rays.

    Args:
        sensors: Sensors of the rig.

    Raises:
        ValueError: There is no sensor.
    """
    if not sensors:
        raise ValueError("sensors: the sensors of the rig, with their mounts and rays, are needed; got none")


def count_rays(sensors: Sequence[Sensor]) -> int:
    """Count the rays of sensors; pixels without a ray do not count.

    Args:
        sensors: Sensors of the rig.
    """
    return sum(int((~np.isnan(sensor.compute_directions()[0])).sum()) for sensor in sensors)


def mark_crossed_by_rays(sensors: Sequence[Sensor], grid: VoxelGrid) -> Bools:
    """Mark the voxels that rays cross up to the border of the region or their maximum range, without occlusion.

    Args:
        sensors: Sensors of the rig, with mounts and rays.
        grid: Voxels.

    Returns:
        (X, Y, Z) bool.
    """
    crossed = np.zeros(grid.shape, dtype=bool)
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions().reshape(3, -1).T @ vehicle_T_sensor[:3, :3].T
        find_crossed_voxels(grid, vehicle_T_sensor[:3, 3], directions, sensor.max_range_m, output=crossed)
    return crossed


def mark_crossed_before_hits(sensors: Sequence[Sensor], frame: Frame, rig_name: str | None, grid: VoxelGrid) -> Bools:
    """Mark the voxels between sensors and their measured points.

    Rays without a point, into the sky or by drop-out, are not recorded in a frame and cross nothing.

    Args:
        sensors: Sensors of the rig, with mounts.
        frame: Frame with points by sensor.
        rig_name: Name of the rig in the frame; may be None if there is only one.
        grid: Voxels.

    Returns:
        (X, Y, Z) bool.

    Raises:
        ValueError: The sensor of each point is unknown, or is not among the sensors.
    """
    origins_m = {sensor.name: sensor.mount.to_matrix()[:3, 3] for sensor in sensors}
    crossed = np.zeros(grid.shape, dtype=bool)
    for name, points in frame.get_clouds_by_sensor(rig_name).items():
        if name not in origins_m:
            raise ValueError(
                f"frame {frame.name!r} has points of a sensor {name!r}; the rig has {', '.join(origins_m)}: give the "
                "sensors that made the frame"
            )
        rays_m = points.cpu().numpy().astype(np.float64) - origins_m[name]
        find_crossed_voxels(grid, origins_m[name], rays_m[rays_m.any(axis=1)], 1.0, output=crossed)
    return crossed
