"""Which voxels of a regular grid rays cross: exact, for many rays at once.

A ray enters every voxel on its way, but the first, through a plane between two voxels of one of the three axes. So the
planes that it crosses are counted off, axis by axis, and where it crosses one, the other two coordinates say which
voxel it enters: what Amanatides and Woo (1987) find by stepping, without the steps waiting for each other.
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

# In voxels. A ray that passes an edge or a corner this closely goes through it: what it has of the voxel beside it is
# rounding. At 10,000 voxels a coordinate of float64 is a thousand times finer.
TOUCH = 1e-9
# Extents are written in decimals; a multiple of the voxel is one up to their rounding.
MULTIPLE_TOLERANCE_VOXELS = 1e-6
# Rays at once, so that what is stepped stays in the processor's cache.
RAYS_AT_ONCE = 8192


@dataclass(frozen=True)
class VoxelGrid:
    """Cubes that fill a box in the vehicle frame, each half-open, [lower, upper), on every axis.

    A voxel's number is `(x * Y + y) * Z + z`; arrays over the grid have the shape (X, Y, Z).

    Args:
        region: What they fill. Its extents must be multiples of the side.
        voxel_m: Side of a voxel in metres.

    Raises:
        ValueError: Infinite bounds, a side that is not positive, or does not divide an extent.

    Example:
        >>> VoxelGrid(BoundingBox((-30.0, -20.0, -0.5), (30.0, 20.0, 3.5)), 0.2).shape
        (300, 200, 20)
    """

    region: BoundingBox
    voxel_m: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.voxel_m) and self.voxel_m > 0):
            raise ValueError(f"voxel_m: a positive length in metres is needed; got {self.voxel_m}")
        for axis, extent in zip("xyz", self.region.size_m, strict=True):
            voxels = extent / self.voxel_m
            if not math.isfinite(voxels):
                raise ValueError(f"the region: finite bounds are needed; its extent along {axis} is {extent} m")
            if round(voxels) == 0 or abs(voxels - round(voxels)) > MULTIPLE_TOLERANCE_VOXELS * max(1.0, voxels):
                fits = extent / max(1, round(voxels))
                raise ValueError(
                    f"voxel_m: the region's extent along {axis} of {extent:.10g} m is not a multiple of the voxel of "
                    f"{self.voxel_m:.10g} m ({voxels:.10g} voxels); one of {fits:.10g} m would fit"
                )

    @property
    def shape(self) -> tuple[int, int, int]:
        """How many voxels there are along x, y and z."""
        x, y, z = (round(extent / self.voxel_m) for extent in self.region.size_m)
        return x, y, z

    @property
    def num_voxels(self) -> int:
        """How many there are in all."""
        return math.prod(self.shape)

    def compute_centers_m(self) -> tuple[Float64, Float64, Float64]:
        """(X,), (Y,) and (Z,) coordinates of the voxels' centres."""
        bounds = zip(self.region.lower_m, self.region.upper_m, self.shape, strict=True)
        x, y, z = (_centres(low, high, count) for low, high, count in bounds)
        return x, y, z

    def to_voxel_units(self, points_m: ArrayLike) -> Float64:
        """Points (..., 3) in voxels from the lower corner of the region."""
        return (np.asarray(points_m, dtype=np.float64) - self.region.lower_m) * self._voxels_per_m

    def find_voxels(self, points_m: ArrayLike) -> Int64:
        """(N,) number of the voxel that each of (N, 3) points is in; -1 if it is in none.

        Example:
            >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (2.0, 2.0, 1.0)), 1.0)
            >>> grid.find_voxels([[0.5, 0.5, 0.5], [1.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
            array([ 0,  3, -1])
        """
        at = np.floor(self.to_voxel_units(points_m))
        inside = np.asarray(((at >= 0) & (at < self.shape)).all(axis=1))
        number = np.where(inside[:, None], at, 0).astype(np.int64) @ self._strides.astype(np.int64)
        return np.where(inside, number, -1)

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
    """Which voxels are crossed by any of a bundle of rays.

    A voxel is crossed if a piece of a ray, and not just a point of it, lies in it: a ray through a corner or an edge
    does not cross the voxels that it touches there. One that runs along a face is in the voxel on the upper side of it.
    A piece that is shorter than 1e-9 voxels may or may not count.

    Args:
        grid: The voxels.
        origins_m: (3,) where all rays start, or (N, 3) where each does; inside the grid's region or outside.
        directions: (N, 3) where they go, of any length; NaN where there is no ray.
        ray_ends: Where each ray ends, in lengths of its direction (metres, if those are unit vectors); (N,), or one number
            for all. Infinite, as if not given: at the wall of the region.
        output: Array to add to, as another call gave it; it is changed.

    Returns:
        (X, Y, Z) bool, a byte for each voxel; beside it some megabytes, whatever the number of rays.

    Raises:
        ValueError: Shapes that do not fit, origins that are not finite, a direction that is infinite or of length 0,
            an end that is negative or NaN.

    Example:
        >>> grid = VoxelGrid(BoundingBox((0.0, 0.0, 0.0), (4.0, 4.0, 1.0)), 1.0)
        >>> find_crossed_voxels(grid, [0.5, 0.5, 0.5], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [3.0, 1.0])[:, :, 0].astype(int)
        array([[1, 1, 0, 0],
               [1, 0, 0, 0],
               [1, 0, 0, 0],
               [1, 0, 0, 0]])
    """
    way = np.asarray(directions, dtype=np.float64)
    start, end = np.asarray(origins_m, dtype=np.float64), np.asarray(ray_ends, dtype=np.float64)
    _check(start, way, end)
    is_ray = ~np.isnan(way).any(axis=1)
    start, end = np.broadcast_to(start, way.shape)[is_ray], np.broadcast_to(end, len(way))[is_ray]
    way = way[is_ray]
    if output is None:
        output = np.zeros(grid.shape, dtype=bool)
    elif output.shape != grid.shape or output.dtype != bool or not output.flags.c_contiguous:
        raise ValueError(f"crossed: a contiguous bool array of shape {grid.shape} is needed; got {output.shape}")
    for first in range(0, len(way), RAYS_AT_ONCE):
        some = slice(first, first + RAYS_AT_ONCE)
        rays = _upwards(grid, start[some], way[some], end[some])
        output.reshape(-1)[rays.numbers(rays.first)] = True
        for axis in range(3):
            _cross_planes(rays, axis, output.reshape(-1))
    return output


@dataclass(frozen=True, eq=False)
class _Upwards:
    """Rays within the region, in voxels, each seen in mirrors in which it moves upwards on every axis.

    `place` and `way`, nowhere below 0, are (3, n) where they start and go, `first` and `last` the voxels at both ends,
    `strides` how a voxel's number grows along the mirrored axes, and `number` (n,) that of the voxel at 0, 0, 0 there.
    """

    place: Float64
    way: Float64
    first: Float64
    last: Float64
    strides: Float64
    number: Float64

    def numbers(self, voxel: Float64) -> Int64:
        """(n,) numbers of the voxels (3, n), one of each ray."""
        numbers: Float64 = self.number + (voxel * self.strides).sum(axis=0)
        return numbers.astype(np.int64)


def _upwards(grid: VoxelGrid, start_m: Float64, way: Float64, end: Float64) -> _Upwards:
    """The rays that have a piece in the region."""
    shape, strides = np.array(grid.shape, dtype=np.float64)[:, None], grid._strides[:, None]
    place, way = grid.to_voxel_units(start_m).T, (way * grid._voxels_per_m).T
    # On an axis along which it moves less than a touch on its way through the region, a ray does not move.
    reach = np.maximum(np.abs(place), np.abs(shape - place)).max(axis=0)
    still = np.abs(way) * reach <= TOUCH * np.abs(way).max(axis=0)
    mirrored = (way < 0) & ~still
    place, way = np.where(mirrored, shape - place, place), np.where(still, 0.0, np.abs(way))
    number = np.where(mirrored, (shape - 1) * strides, 0.0).sum(axis=0)
    strides = np.where(mirrored, -strides, strides)

    # There, it is inside for ever or never.
    inside = (place + TOUCH >= 0) & (place + TOUCH < shape)
    moving = np.where(still, 1.0, way)
    enters = np.where(still, np.where(inside, -np.inf, np.inf), -place / moving).max(axis=0)
    leaves = np.where(still, np.where(inside, np.inf, -np.inf), (shape - place) / moving).min(axis=0)
    begin, stop = np.maximum(enters, 0.0), np.minimum(leaves, end)
    kept = (stop - begin) * way.max(axis=0) > TOUCH
    place, way, begin, stop = place[:, kept], way[:, kept], begin[kept], stop[kept]
    first = np.clip(np.floor(place + begin * way + TOUCH), 0, shape - 1)
    last = np.clip(np.ceil(place + stop * way - TOUCH) - 1, first, shape - 1)
    return _Upwards(place, way, first, last, strides[:, kept], number[kept])


def _cross_planes(rays: _Upwards, axis: int, crossed: Bools) -> None:
    """Mark the voxels that rays enter through planes across one axis: first the first plane of every ray, and so on."""
    planes = (rays.last[axis] - rays.first[axis]).astype(np.int64)
    # Those with many planes to the front: the rays that are still on their way are the first ones.
    order = np.argsort(-planes, kind="stable")[: np.count_nonzero(planes)]
    planes = planes[order]
    most = planes.max(initial=0)
    on_way = len(order) - np.searchsorted(planes[::-1], np.arange(most), side="right")
    place, way, first, last, strides = (
        each[:, order] for each in (rays.place, rays.way, rays.first, rays.last, rays.strides)
    )
    slope = way / way[axis]
    # Where the first plane is crossed, a touch ahead: what reaches a plane of another axis there is beyond it.
    beside = place + (first[axis] + 1 - place[axis]) * slope + TOUCH
    last = last + 0.5
    number = rays.number[order] + (first[axis] + 1) * strides[axis]
    others = [other for other in range(3) if other != axis]
    numbers, coordinate = np.empty(len(order)), np.empty(len(order))
    for plane, count in enumerate(on_way.tolist()):
        now, at = numbers[:count], coordinate[:count]
        np.multiply(strides[axis, :count], plane, out=now)
        now += number[:count]
        for other in others:
            np.multiply(slope[other, :count], plane, out=at)
            at += beside[other, :count]
            np.minimum(at, last[other, :count], out=at)
            np.floor(at, out=at)
            at *= strides[other, :count]
            now += at
        crossed[now.astype(np.int64)] = True


def _centres(low: float, high: float, count: int) -> Float64:
    odd = 2 * np.arange(count, dtype=np.float64) + 1
    return (low * (2 * count - odd) + high * odd) / (2 * count)


def _check(origins_m: Float64, directions: Float64, ends: Float64) -> None:
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions: shape (N, 3) is needed; got {directions.shape}")
    count = len(directions)
    if origins_m.shape not in {(3,), (count, 3)}:
        raise ValueError(f"origins_m: shape (3,) or ({count}, 3) is needed; got {origins_m.shape}")
    if not np.isfinite(origins_m).all():
        raise ValueError("origins_m: finite coordinates in metres are needed; got NaN or infinite ones")
    if ends.shape not in {(), (count,)}:
        raise ValueError(f"ends: one number or shape ({count},) is needed; got {ends.shape}")
    if not (ends >= 0).all():
        raise ValueError("ends: lengths >= 0 are needed; got negative ones or NaN")
    if np.isinf(directions).any() or not (directions != 0).any(axis=1).all():
        raise ValueError("directions: finite vectors that are not 0 are needed, or NaN where there is no ray")


# 60 x 40 x 4 m about the vehicle, as Hu et al. 2022 and those after them.
REGION: BoundingBox = BoundingBox((-30.0, -20.0, -0.5), (30.0, 20.0, 3.5))


def create_voxel_grid(region: BoundingBox, voxel_m: float, bytes_per_voxel: int) -> VoxelGrid:
    """The voxels of a region, if this machine has the memory for what is kept of each.

    ValueError: it has not; or as `VoxelGrid`.
    """
    grid = VoxelGrid(region, float(voxel_m))
    what = f"{grid.num_voxels:,} voxels of {voxel_m:g} m in {' x '.join(f'{size:g}' for size in region.size_m)} m"
    check_memory_fits(what, bytes_per_voxel * grid.num_voxels, "take larger voxels, or a smaller region")
    return grid


def check_sensors(sensors: Sequence[Sensor]) -> None:
    """Refuse a rig without sensors: it would have no rays, which some metrics reward.

    ValueError: there is no sensor.
    """
    if not sensors:
        raise ValueError("sensors: the sensors of the rig, with their mounts and rays, are needed; got none")


def count_rays(sensors: Sequence[Sensor]) -> int:
    """How many rays they have, without the pixels that have none."""
    return sum(int((~np.isnan(sensor.compute_directions()[0])).sum()) for sensor in sensors)


def mark_crossed_by_rays(sensors: Sequence[Sensor], grid: VoxelGrid) -> Bools:
    """(X, Y, Z) whether any of their rays crosses a voxel, up to the wall of the region or the end of its range.

    Nothing hides anything.
    """
    crossed = np.zeros(grid.shape, dtype=bool)
    for sensor in sensors:
        vehicle_T_sensor = sensor.mount.to_matrix()
        directions = sensor.compute_directions().reshape(3, -1).T @ vehicle_T_sensor[:3, :3].T
        find_crossed_voxels(grid, vehicle_T_sensor[:3, 3], directions, sensor.max_range_m, output=crossed)
    return crossed


def mark_crossed_before_hits(sensors: Sequence[Sensor], frame: Frame, rig_name: str | None, grid: VoxelGrid) -> Bools:
    """(X, Y, Z) whether a voxel is crossed on the way from a sensor to a point that it measured.

    A ray that gave no point is not known to a frame, and crosses nothing: what it passed through the open sky, or with
    its drop-out, is left out.

    ValueError: which points are of which sensor is unknown, or a sensor is none of these.
    """
    mounts = {sensor.name: sensor.mount.to_matrix()[:3, 3] for sensor in sensors}
    crossed = np.zeros(grid.shape, dtype=bool)
    for name, points in frame.get_clouds_by_sensor(rig_name).items():
        if name not in mounts:
            raise ValueError(
                f"frame {frame.name!r} has points of a sensor {name!r}; the rig has {', '.join(mounts)}: give the "
                "sensors that made the frame"
            )
        ways = points.cpu().numpy().astype(np.float64) - mounts[name]
        find_crossed_voxels(grid, mounts[name], ways[ways.any(axis=1)], 1.0, output=crossed)
    return crossed
