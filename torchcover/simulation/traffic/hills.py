"""Hilly ground, and building blocks along a street that follow its bends and slopes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from torchcover.geometry.arrays import Float32, Float64
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment, StreetCorridor, compute_squared_distances_m2
from torchcover.simulation.traffic.scenery import CURB_HEIGHT_M, build_slab

NUM_WAVES = 3


class Hills:
    """Height field of the ground: a sum of a few long sine waves with random directions and phases.

    Args:
        height_std_m: Standard deviation of the height; 0 is a plane.
        rng: Random generator of directions, phases and wavelengths.
        wavelengths_m: Shortest and longest wavelength.
        max_slope: Upper bound of the slope (rise over run), which lowers the hills if necessary.
    """

    def __init__(
        self,
        height_std_m: float,
        rng: np.random.Generator,
        wavelengths_m: tuple[float, float] = (250.0, 700.0),
        max_slope: float = np.inf,
    ) -> None:
        directions, phases = rng.uniform(0.0, 2 * np.pi, (2, NUM_WAVES))
        wave_numbers = 2 * np.pi / rng.uniform(*wavelengths_m, NUM_WAVES)
        self._wave_vectors_per_m = wave_numbers * np.array([np.cos(directions), np.sin(directions)])
        self._phases = phases
        self._amplitude_m = min(height_std_m * np.sqrt(2 / NUM_WAVES), max_slope / wave_numbers.sum())

    @property
    def is_flat(self) -> bool:
        """True if the ground is a plane."""
        return bool(self._amplitude_m == 0.0)

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """Compute heights (...) in meters at positions (..., 2), rounded to a few micrometers."""
        if self.is_flat:
            return np.zeros(positions_m.shape[:-1])
        waves = sum(map(np.sin, self._iterate_phases(positions_m)), start=np.float32(0.0))
        return np.asarray(self._amplitude_m * np.asarray(waves, dtype=np.float64))

    def compute_heights_and_tilts(self, positions_m: Float64, yaw_deg: Float64) -> Float64:
        """Compute the height and the tilt of bodies that stand on the ground.

        Args:
            positions_m: (..., 2) positions.
            yaw_deg: (...) headings.

        Returns:
            (..., 3) height in meters, pitch and roll in degrees.
        """
        if self.is_flat:
            return np.zeros((*positions_m.shape[:-1], 3))
        tilts = np.zeros((3, *positions_m.shape[:-1]), dtype=np.float32)
        height, pitch, roll = tilts
        yaw = np.deg2rad(yaw_deg).astype(np.float32)
        cos, sin = np.cos(yaw), np.sin(yaw)
        for phase, (x_per_m, y_per_m) in zip(
            self._iterate_phases(positions_m), self._wave_vectors_per_m.T.astype(np.float32), strict=True
        ):
            height += np.sin(phase)
            slope = np.cos(phase)
            # A raised front is a negative pitch; a raised left side is a positive roll.
            pitch -= slope * (x_per_m * cos + y_per_m * sin)
            roll += slope * (y_per_m * cos - x_per_m * sin)
        tilts *= np.float32(self._amplitude_m)
        # Series of the arc tangent for small slopes.
        tilts[1:] *= np.float32(np.rad2deg(1.0)) * (1 - tilts[1:] ** 2 / 3)
        return np.moveaxis(tilts, 0, -1).astype(np.float64)

    def _iterate_phases(self, positions_m: Float64) -> Iterator[Float32]:
        """Compute the phase (...) of each wave in float64, rounded to float32 for fast sines."""
        x_m, y_m = positions_m[..., 0], positions_m[..., 1]
        for x_per_m, y_per_m, phase in zip(*self._wave_vectors_per_m, self._phases, strict=True):
            yield (x_per_m * x_m + y_per_m * y_m + phase).astype(np.float32)

    def build_mesh(self, path_m: Float64, margin_m: float, cell_m: float = 10.0) -> Mesh:
        """Build the ground near a path as one sheet of squares.

        Args:
            path_m: (N, 2) positions on the path.
            margin_m: Distance from the path up to which the ground is built.
            cell_m: Side of the squares; 10 m keep the mesh within 1 to 2 cm of the usual hills.

        Returns:
            Mesh of material "road".
        """
        lower = np.floor((path_m.min(axis=0) - margin_m) / cell_m)
        columns, rows = (np.ceil((path_m.max(axis=0) + margin_m) / cell_m) - lower).astype(np.int64).tolist()
        row, column = np.indices((rows, columns)).reshape(2, -1)
        centers_m = cell_m * (lower + 0.5 + np.stack([column, row], axis=1))
        is_near = compute_squared_distances_m2(centers_m, path_m).min(axis=1) < margin_m**2
        corner = (row * (columns + 1) + column)[is_near]
        right, above = corner + 1, corner + columns + 1
        opposite = above + 1
        lower_triangles, upper_triangles = [corner, right, opposite], [corner, opposite, above]
        faces = np.concatenate([np.stack(lower_triangles, axis=1), np.stack(upper_triangles, axis=1)])
        is_used = np.zeros((rows + 1) * (columns + 1), dtype=bool)
        is_used[faces] = True
        used, vertex_indices = np.flatnonzero(is_used), np.cumsum(is_used) - 1
        positions_m = cell_m * (lower + np.stack([used % (columns + 1), used // (columns + 1)], axis=1))
        vertices_m = np.column_stack([positions_m, self.compute_heights_m(positions_m)])
        is_outward = np.zeros(len(faces), dtype=bool)
        return Mesh(vertices_m, vertex_indices[faces], is_outward=is_outward).assign_material("road")


Bounds = tuple[float, float]

FOUNDATION_M = 0.5  # depth to which bodies on a slope continue below the ground


@dataclass(frozen=True)
class BlockParams:
    """Resolution and limits of building blocks along a street.

    Args:
        segment_m: Length of the straight segments that approximate a bend.
        row_m: Distance of the vertices across a block on hills.
        depth_spacing_m: Distance of the stations at which the depth of a block is determined.
        clearance_m: Gap to the corridor of another stretch of street.
        min_depth_m: Depth of a block where the corridor leaves no room.
    """

    segment_m: float = 6.0
    row_m: float = 12.0
    depth_spacing_m: float = 8.0
    clearance_m: float = 4.0
    min_depth_m: float = 0.5


def bend_along_street(street: Alignment, hills: Hills, meshes: Sequence[Mesh]) -> list[Mesh]:
    """Bend meshes that were built along a straight, level street (x is the station) onto the real street.

    Args:
        street: Alignment of the street.
        hills: Ground heights.
        meshes: Meshes with z = 0 on the ground; vertices at or below it continue below the ground on hills.

    Returns:
        The unchanged meshes on a straight, level street, else one merged mesh in the world frame.
    """
    if (street.is_straight and hills.is_flat) or not meshes:
        return list(meshes)
    merged = merge_meshes(list(meshes))
    x_m, y_m, height_m = merged.vertices_m.T
    positions_m = street.compute_poses(x_m, y_m)[:, :2]
    if not hills.is_flat:
        height_m = height_m + hills.compute_heights_m(positions_m) - np.where(height_m <= 0.0, FOUNDATION_M, 0.0)
    return [merged._replace(vertices_m=np.column_stack([positions_m, height_m]))]


class BuildingSite:
    """Land along both sides of a street on which blocks are built.

    Args:
        street: Alignment of the street.
        corridor: Area that belongs to the street.
        hills: Ground heights.
        max_depth_m: Largest distance from the centerline.
        params: Resolution and limits of the blocks.
    """

    def __init__(
        self,
        street: Alignment,
        corridor: StreetCorridor,
        hills: Hills,
        max_depth_m: float,
        params: BlockParams = BlockParams(),
    ) -> None:
        self.street = street
        self._corridor = corridor
        self._hills = hills
        self._max_depth_m = max_depth_m
        self._params = params
        self._half_widths_m: dict[int, tuple[Float64, Float64]] = {}

    def build_block(
        self, span_m: Bounds, side: int, curb_offset_m: float, depth_m: float
    ) -> tuple[Mesh, shapely.Geometry]:
        """Build the raised surface of a block.

        Args:
            span_m: First and last station.
            side: 1 for the left side, -1 for the right side.
            curb_offset_m: Distance of the curb from the centerline.
            depth_m: Depth of the block behind the curb, where the corridor has room for it.

        Returns:
            Mesh of material "pavement", and its outline in the ground plane.
        """
        params, is_flat = self._params, self._hills.is_flat
        num_segments = int(np.ceil((span_m[1] - span_m[0]) / params.segment_m))
        stations_m = np.linspace(*span_m, 2 if self.street.is_straight and is_flat else num_segments + 1)
        depths_m = self.compute_depths_m(stations_m, side, curb_offset_m, depth_m)
        num_rows = 2 if is_flat else int(np.ceil(depth_m / params.row_m)) + 1
        offsets_m = curb_offset_m + np.linspace(0.0, 1.0, num_rows) * depths_m[:, None]
        grid_m = self.street.compute_poses(*np.broadcast_arrays(stations_m[:, None], side * offsets_m))[..., :2]
        outline = shapely.make_valid(shapely.Polygon(np.concatenate([grid_m[:, 0], grid_m[::-1, -1]])))
        mesh = build_slab(grid_m if side == 1 else grid_m[:, ::-1], (0.0, CURB_HEIGHT_M))
        if not is_flat:
            bottom, top = mesh.vertices_m.reshape(2, -1, 3)
            ground_m = self._hills.compute_heights_m(top[:, :2])
            bottom[:, 2], top[:, 2] = ground_m - FOUNDATION_M, ground_m + CURB_HEIGHT_M
        return mesh.assign_material("pavement"), outline

    def compute_depths_m(
        self, query_stations_m: Float64, side: int, curb_offset_m: float, max_depth_m: float
    ) -> Float64:
        """Compute how deep a block of buildings is behind the curb; on bends it stays off the rest of the street.

        Args:
            query_stations_m: (N,) arc lengths along the centerline of the street.
            side: 1 for the left side, -1 for the right side.
            curb_offset_m: Distance of the curb from the centerline.
            max_depth_m: Largest depth, perpendicular to the street.

        Returns:
            (N,) depths in meters.
        """
        if self.street.is_straight:
            return np.full(len(query_stations_m), max_depth_m)
        params = self._params
        if side not in self._half_widths_m:
            stations_m = self._corridor.sample_stations_m(params.depth_spacing_m)
            half_widths_m = self._corridor.find_half_widths_m(stations_m, side, curb_offset_m, self._max_depth_m)
            self._half_widths_m[side] = (stations_m, half_widths_m)
        half_widths_m = np.interp(query_stations_m, *self._half_widths_m[side])
        return np.asarray(np.clip(half_widths_m - curb_offset_m - params.clearance_m, params.min_depth_m, max_depth_m))
