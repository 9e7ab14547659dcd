"""The ground of a world: what one drives or walks on, and how high above it something is."""

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.geometry import transform_points
from torchcover.geometry.arrays import Bools, Float32, Float64, Int64
from torchcover.simulation.patches import find_face_edges, find_outward_faces, label_connected_faces
from torchcover.simulation.raycaster import RayCaster
from torchcover.simulation.shapes import Mesh, iterate_mesh_parts

# Nothing steeper is driven or walked on, but for what rounding makes of it.
STEEPEST_DEG = 45.0 + 1e-6
# Ground that is so little above a point counts as the ground below it: for rounding, and where wheels sink in.
TOLERANCE_M = 0.05
# A place so little below the ground lies on it.
ON_GROUND_M = 1e-4
# The step of stairs and a high kerb: level surfaces next to each other are connected if they are no farther apart.
STEP_M = 0.3
# So far beyond its border the neighbours of a surface are looked for, and at these shares of each edge.
BEYOND_M = 0.02
PROBES = np.array([0.1, 0.5, 0.9])
# Whoever stands on the ground has it so near above or below.
NEAR_M = 1.0
# Ground that is nowhere higher or lower than that is looked at as a whole, and not square by square.
LEVEL_M = 0.3
# Side of the smallest squares in which the height of the ground is known roughly, of how many at most. Those that the
# ground of own cities is made of lie like them: at multiples of 10 m.
SQUARE_M = 10.0
MOST_SQUARES = 65_536
# Points are rounded to float32, and so are their heights: so little above or below the ground they lie on it.
ROUNDING_M = 5e-4
# What reaches so little into a square, as a share of it, is next to it.
ROUNDING = 1e-6
# Bounds of heights are so much wider.
SLACK_M = 1e-3


def find_level_faces(mesh: Mesh, outward_mask: Bools | None = None) -> Bools:
    """(F,) whether one could stand on each face: it is not too steep, and of a closed body it is an upper side."""
    level, down = _looks(mesh, 1.0), find_downward_faces(mesh)
    if down.any():
        level |= down & ~(find_outward_faces(mesh) if outward_mask is None else outward_mask)
    return level


def find_downward_faces(mesh: Mesh) -> Bools:
    """(F,) whether the normal of each face points downwards, and the face is not too steep to stand on."""
    return _looks(mesh, -1.0)


def _looks(mesh: Mesh, way: float) -> Bools:
    looks = np.empty(len(mesh.faces), dtype=bool)
    for part, (first, second, third) in mesh.iterate_parts():
        normals = np.cross(second - first, third - first, axis=0)
        least = np.cos(np.deg2rad(STEEPEST_DEG)) * np.linalg.norm(normals, axis=0)
        looks[part] = (way * normals[2] >= least) & (least > 0)
    return looks


def find_ground_faces(meshes: Sequence[Mesh], positions_m: Float64) -> list[Bools]:
    """Which faces of some meshes are ground: the level ones below some places, and all connected with them by steps.

    Two level surfaces are connected that share an edge, or of which one goes on where the other ends, at most 0.3 m
    higher or lower. If no place has any within a metre, a level face below counts, however far; else a sheet above.

    Returns one (F,) mask for each mesh.
    """
    outward = [find_outward_faces(mesh) for mesh in meshes]
    level = [find_level_faces(mesh, known) for mesh, known in zip(meshes, outward, strict=True)]
    if not any(mask.any() for mask in level):
        return level
    corners_m = np.concatenate([mesh.vertices_m[mesh.faces[mask]] for mesh, mask in zip(meshes, level, strict=True)])
    together = Mesh(corners_m.reshape(-1, 3), np.arange(3 * len(corners_m)).reshape(-1, 3))
    edge, face = find_face_edges(together)[0], np.repeat(np.arange(len(corners_m)), 3)
    _, surface = np.unique(label_connected_faces(edge, face, len(corners_m)), return_inverse=True)
    parts = np.split(np.argsort(surface, kind="stable"), np.cumsum(np.bincount(surface))[:-1])
    caster = RayCaster([Mesh(corners_m[part].reshape(-1, 3), together.faces[: len(part)]) for part in parts])
    border = np.flatnonzero(np.bincount(edge)[edge] == 1)
    one, other = surface[face[border]].repeat(len(PROBES)), _met(caster, _probes_m(corners_m, border), STEP_M)
    joined = np.stack([one, other])[:, other >= 0]
    root = label_connected_faces(np.tile(np.arange(joined.shape[1]), 2), joined.ravel(), surface.max() + 1)
    of_level = np.concatenate([known[mask] for known, mask in zip(outward, level, strict=True)])
    is_sheet = np.bincount(surface, weights=of_level) == 0
    is_ground = np.isin(root, root[_stood_on(caster, positions_m, is_sheet)])[surface]
    ends = np.cumsum([np.count_nonzero(mask) for mask in level])[:-1]
    for mask, found in zip(level, np.split(is_ground, ends), strict=True):
        mask[mask] = found
    return level


def _stood_on(caster: RayCaster, places_m: Float64, is_sheet: Bools) -> Int64:
    """Numbers of the bodies that places stand on; if none is near, of those far below, or of sheets above them."""
    near = _met(caster, places_m, NEAR_M)
    if (near >= 0).any():
        return near[near >= 0]
    for up in (-1.0, 1.0):
        limit_m = np.full(len(places_m), np.inf, dtype=np.float32)
        met = caster.cast_from_each(places_m.astype(np.float32), _vertical(len(places_m), up), limit_m).body_indices
        met = met[(met >= 0) & ((up < 0) | is_sheet[np.maximum(met, 0)])]
        if len(met):
            return met.astype(np.int64)
    return np.empty(0, dtype=np.int64)


def _probes_m(corners_m: Float64, border: Int64) -> Float64:
    """(edges x 3, 3) places a little beyond some edges, which are counted through all faces."""
    face, side = np.divmod(border, 3)
    start_m, end_m, apex_m = (corners_m[face, (side + k) % 3] for k in range(3))
    along, away = (end_m - start_m)[:, :2], ((start_m + end_m) / 2 - apex_m)[:, :2]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    across *= np.sign((across * away).sum(axis=1, keepdims=True))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    probes_m = start_m[:, None] + PROBES[:, None] * (end_m - start_m)[:, None]
    probes_m[..., :2] += BEYOND_M * across[:, None]
    return np.asarray(probes_m.reshape(-1, 3))


def _met(caster: RayCaster, places_m: Float64, near_m: float) -> Int64:
    """(N,) number of the highest body no farther above or below each place than this, -1 for none."""
    near_m += ROUNDING_M
    starts_m = (places_m + np.array([0.0, 0.0, near_m])).astype(np.float32)
    limit_m = np.full(len(starts_m), 2 * near_m, dtype=np.float32)
    return caster.cast_from_each(starts_m, _vertical(len(starts_m), -1.0), limit_m).body_indices.astype(np.int64)


def _vertical(count: int, up: float) -> Float32:
    directions = np.zeros((3, count), dtype=np.float32)
    directions[2] = up
    return directions


class LocalGround:
    """The ground below each place: the highest surface of it at or below the place, a few centimetres above included.

    Heights are measured along the world's vertical, not along the z axis of a vehicle that pitches. Meshes are of
    ground alone, in the world frame; `origin_m` (3,) is subtracted in float64: coordinates become float32.
    """

    def __init__(self, meshes: Sequence[Mesh], origin_m: Float64) -> None:
        self.origin_m = origin_m
        self._meshes = [Mesh(mesh.vertices_m - origin_m, mesh.faces) for mesh in meshes if len(mesh.faces)]

    @property
    def num_faces(self) -> int:
        """How many it has."""
        return sum(len(mesh.faces) for mesh in self._meshes)

    def compute_heights_m(self, points_m: NDArray[np.floating], world_T_points: Float64 | None = None) -> Float32:
        """(N,) how high above the ground (N, 3) points are, in metres; NaN where there is none at or below.

        Not less than -0.05, and 0 where rounding alone tells. `world_T_points` is where their frame lies in the world;
        they are in its own frame if it is not given.
        """
        places_m = self._local(points_m, world_T_points)
        places_m[:, 2] += TOLERANCE_M
        range_m = self._cast(places_m, -1.0)
        range_m -= np.float32(TOLERANCE_M)
        range_m[np.abs(range_m) < ROUNDING_M] = 0.0
        return range_m

    def is_below_ground(self, position_m: Float64, world_T_position: Float64 | None = None) -> bool:
        """Whether a (3,) place lies below the ground: some of it above, and none at or below."""
        (local_m,) = self._local(position_m[None], world_T_position)
        starts_m = local_m + np.array([[0.0, 0.0, ON_GROUND_M], [0.0, 0.0, -ON_GROUND_M]])
        return bool(np.isnan(self._cast(starts_m[:1], -1.0)[0]) and np.isfinite(self._cast(starts_m[1:], 1.0)[0]))

    def _local(self, points_m: NDArray[np.floating], world_T_points: Float64 | None) -> Float64:
        local_T_points = np.eye(4) if world_T_points is None else world_T_points.copy()
        local_T_points[:3, 3] -= self.origin_m
        return transform_points(local_T_points, points_m)

    def _cast(self, places_m: Float64, up: float) -> Float32:
        """(N,) how far the ground is above or below places, NaN where there is none."""
        count = len(places_m)
        if not self._meshes:
            return np.full(count, np.nan, dtype=np.float32)
        limit_m = np.full(count, np.inf, dtype=np.float32)
        hits = self._caster.cast_from_each(places_m.astype(np.float32), _vertical(count, up), limit_m)
        hits.range_m[hits.body_indices < 0] = np.nan
        return hits.range_m

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self._meshes)

    @cached_property
    def height_pyramid(self) -> "GroundHeightPyramid":
        """Between which heights it lies, roughly, in its own frame: that of the world less the origin."""
        return GroundHeightPyramid.from_meshes(self._meshes, self.origin_m)


class GroundHeightPyramid(NamedTuple):
    """The lowest and the highest ground in the squares of a raster, and of rasters with squares twice as large.

    `origin_m` (2,) the first corner; `cell_m` the side of a square, infinite if there is but one; `levels` for each
    raster (2, columns, rows) of the lowest and the highest, infinite and minus infinite where there is none.
    """

    origin_m: Float64
    cell_m: float
    levels: Sequence[Float32]

    @classmethod
    def from_meshes(cls, meshes: Sequence[Mesh], origin_m: Float64) -> "GroundHeightPyramid":
        """Those of triangles, of whose bounding boxes all squares are taken, lest one be overlooked."""
        parts = [
            (corners_m.min(axis=(0, 2)), corners_m.max(axis=(0, 2))) for _, corners_m in iterate_mesh_parts(meshes)
        ]
        if not parts:
            return cls(np.zeros(2), math.inf, [np.array([[[np.inf]], [[-np.inf]]], dtype=np.float32)])
        least_m, most_m = np.min([low for low, _ in parts], axis=0), np.max([high for _, high in parts], axis=0)
        lowest_m, highest_m = float(least_m[2]), float(most_m[2])
        if highest_m - lowest_m <= LEVEL_M:
            everywhere = np.array([lowest_m - SLACK_M, highest_m + SLACK_M], dtype=np.float32)
            return cls(np.zeros(2), math.inf, [everywhere.reshape(2, 1, 1)])
        size_m = (most_m - least_m)[:2]
        square_m = max(SQUARE_M, float(np.sqrt(size_m.prod() / MOST_SQUARES)), float(size_m.max()) / MOST_SQUARES)
        first_m = np.floor((least_m[:2] + origin_m[:2]) / square_m) * square_m - origin_m[:2]
        columns, rows = (np.floor((most_m[:2] - first_m) / square_m + ROUNDING).astype(np.int64) + 1).tolist()
        lowest, highest = np.full(columns * rows, np.inf), np.full(columns * rows, -np.inf)
        for _, corners_m in iterate_mesh_parts(meshes):
            lower_m, upper_m = corners_m.min(axis=0), corners_m.max(axis=0)
            from_square = np.floor((lower_m[:2] - first_m[:, None]) / square_m + ROUNDING).astype(np.int64)
            to_square = np.ceil((upper_m[:2] - first_m[:, None]) / square_m - ROUNDING).astype(np.int64) - 1
            to_square = np.maximum(to_square, from_square)
            slopes, at_zero_m = _planes(corners_m - np.append(first_m, 0.0)[None, :, None])
            # The plane of a triangle in a square, but nowhere beyond the triangle.
            reach_m = square_m / 2 * np.abs(slopes).sum(axis=0)
            for triangle, column, row in _squares_of(from_square, to_square - from_square + 1):
                x_slope, y_slope = slopes.take(triangle, axis=1) * square_m
                at_middle_m = at_zero_m[triangle] + x_slope * (column + 0.5) + y_slope * (row + 0.5)
                square, reach = column * rows + row, reach_m[triangle]
                np.minimum.at(lowest, square, np.maximum(at_middle_m - reach, lower_m[2].take(triangle)))
                np.maximum.at(highest, square, np.minimum(at_middle_m + reach, upper_m[2].take(triangle)))
        raster = np.stack([lowest - SLACK_M, highest + SLACK_M]).astype(np.float32)
        levels = [raster.reshape(2, columns, rows)]
        while max(levels[-1].shape) > 2:
            levels.append(_halved(levels[-1]))
        return cls(first_m, square_m, levels)

    def compute_ground_bounds_m(
        self, lower_m: NDArray[np.floating], upper_m: NDArray[np.floating]
    ) -> tuple[Float32, Float32]:
        """(N,) lowest and (N,) highest ground in rectangles between (2, N) corners; inf, -inf where there is none."""
        if math.isinf(self.cell_m):
            lowest_m, highest_m = (np.full(lower_m.shape[1], bound) for bound in self.levels[0].ravel())
            return lowest_m, highest_m
        extent = np.max(upper_m - lower_m, axis=0) / self.cell_m
        level = np.clip(np.ceil(np.log2(np.maximum(extent, 1.0))), 0, len(self.levels) - 1).astype(np.int64)
        lowest_m, highest_m = np.full(len(level), np.inf, np.float32), np.full(len(level), -np.inf, np.float32)
        for number in np.unique(level).tolist():
            raster, some = self.levels[number], np.flatnonzero(level == number)
            sides = np.array(raster.shape[1:])[:, None]
            ends = [
                (side_m.take(some, axis=1) - self.origin_m[:, None]) / (self.cell_m * 2**number)
                for side_m in (lower_m, upper_m)
            ]
            outside = ((ends[1] < 0) | (ends[0] >= sides)).any(axis=0)
            (from_x, from_y), (to_x, to_y) = (np.clip(end, 0, sides - 1).astype(np.int64) for end in ends)
            squares, rows = raster.reshape(2, -1), raster.shape[2]
            at = [squares.take(x * rows + y, axis=1) for x in (from_x, to_x) for y in (from_y, to_y)]
            low_m = np.minimum(np.minimum(at[0][0], at[1][0]), np.minimum(at[2][0], at[3][0]))
            high_m = np.maximum(np.maximum(at[0][1], at[1][1]), np.maximum(at[2][1], at[3][1]))
            lowest_m[some], highest_m[some] = np.where(outside, np.inf, low_m), np.where(outside, -np.inf, high_m)
        return lowest_m, highest_m

    def compute_height_bounds_m(self, triangles_m: NDArray[np.floating]) -> Float32:
        """(2, N) between which heights above ground points of (3, 3, N) triangles lie that have ground below them.

        Triangles are corners, coordinates, triangles, in the frame of the squares; inf and -inf where there is no
        ground.
        """
        lower_m, upper_m = triangles_m.min(axis=0), triangles_m.max(axis=0)
        lowest_m, highest_m = self.compute_ground_bounds_m(lower_m[:2], upper_m[:2])
        return round_height_bounds_m(lower_m[2] - highest_m, upper_m[2] - lowest_m)


def round_height_bounds_m(min_height_m: Float64, max_height_m: Float64) -> Float32:
    """(2, N) bounds of heights that float32 does not break; none is less than what counts as the ground below."""
    return np.asarray(
        np.stack([np.maximum(min_height_m, -TOLERANCE_M) - SLACK_M, max_height_m + SLACK_M]).astype(np.float32)
    )


def _squares_of(first: Int64, count: Int64, at_once: int = 2_000_000) -> list[tuple[Int64, Int64, Int64]]:
    """Pairs of a triangle and a square: (K,) triangles, columns and rows, a few million at a time."""
    total = count.prod(axis=0)
    found = []
    for some in np.split(np.arange(len(total)), np.flatnonzero(np.diff(np.cumsum(total) // at_once)) + 1):
        triangle = some.repeat(total[some])
        within = np.arange(len(triangle)) - (np.cumsum(total[some]) - total[some]).repeat(total[some])
        column, row = np.divmod(within, count[1, triangle])
        found.append((triangle, first[0, triangle] + column, first[1, triangle] + row))
    return found


def _planes(triangles_m: Float64) -> tuple[Float64, Float64]:
    """(2, N) slopes along x and y of (3, 3, N) triangles that are not upright; (N,) heights of their planes at 0."""
    first, second, third = triangles_m
    normals = np.cross(second - first, third - first, axis=0)
    slopes = -normals[:2] / normals[2]
    return slopes, first[2] - (slopes * first[:2]).sum(axis=0)


def _halved(raster: Float32) -> Float32:
    columns, rows = (side + side % 2 for side in raster.shape[1:])
    even = np.empty((2, columns, rows), dtype=np.float32)
    even[0], even[1] = np.inf, -np.inf
    even[:, : raster.shape[1], : raster.shape[2]] = raster
    blocks = even.reshape(2, columns // 2, 2, rows // 2, 2)
    return np.stack([blocks[0].min(axis=(1, 3)), blocks[1].max(axis=(1, 3))])
