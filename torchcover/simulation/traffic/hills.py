"""Gentle hills, and the pavement of blocks along a street that bends with it and keeps off other stretches."""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from torchcover.geometry.arrays import Float32, Float64
from torchcover.simulation.bodies import merge_meshes
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment, StreetCorridor, compute_squared_distances_m2
from torchcover.simulation.traffic.scenery import PAVEMENT_M, build_slab

WAVELENGTHS_M = (250.0, 700.0)
WAVES = 3
# Between the corners of its squares the ground is nowhere farther from the hills than a centimetre or two; longer hills
# have larger ones.
SQUARE_M = 10.0


class Hills:
    """A few long waves with heights of a standard deviation, but nowhere steeper than a share; a plain if that is 0."""

    def __init__(
        self,
        height_std_m: float,
        generator: np.random.Generator,
        wavelengths_m: tuple[float, float] = WAVELENGTHS_M,
        max_slope: float = np.inf,
    ) -> None:
        towards, phase = generator.uniform(0.0, 2 * np.pi, (2, WAVES))
        waves = 2 * np.pi / generator.uniform(*wavelengths_m, WAVES)
        self._waves_per_m = waves * np.array([np.cos(towards), np.sin(towards)])
        self._phase = phase
        self._wave_m = min(height_std_m * np.sqrt(2 / WAVES), max_slope / waves.sum())

    @property
    def is_flat(self) -> bool:
        """Whether there are none."""
        return bool(self._wave_m == 0.0)

    def compute_heights_m(self, positions_m: Float64) -> Float64:
        """(...) at (..., 2) places, rounded to some micrometres."""
        if self.is_flat:
            return np.zeros(positions_m.shape[:-1])
        waves = sum((np.sin(phase) for phase in self._phases(positions_m)), start=np.float32(0.0))
        return np.asarray(self._wave_m * np.asarray(waves, dtype=np.float64))

    def compute_heights_and_tilts(self, positions_m: Float64, yaw_deg: Float64) -> Float64:
        """(..., 3) height in metres, and pitch and roll in degrees, of who stands at (..., 2) places with headings."""
        if self.is_flat:
            return np.zeros((*positions_m.shape[:-1], 3))
        stances = np.zeros((3, *positions_m.shape[:-1]), dtype=np.float32)
        height, pitch, roll = stances
        yaw = np.deg2rad(yaw_deg).astype(np.float32)
        cos, sin = np.cos(yaw), np.sin(yaw)
        for phase, (x_per_m, y_per_m) in zip(
            self._phases(positions_m), self._waves_per_m.T.astype(np.float32), strict=True
        ):
            height += np.sin(phase)
            slope = np.cos(phase)
            # Up at the front is a negative pitch; up at the left lowers the right side.
            pitch -= slope * (x_per_m * cos + y_per_m * sin)
            roll += slope * (y_per_m * cos - x_per_m * sin)
        stances *= np.float32(self._wave_m)
        # The arc tangent of what is small.
        stances[1:] *= np.float32(np.rad2deg(1.0)) * (1 - stances[1:] ** 2 / 3)
        return np.moveaxis(stances, 0, -1).astype(np.float64)

    def _phases(self, places_m: Float64) -> Iterator[Float32]:
        """(...) of each wave. They are reduced in float64: sines and cosines of float32 take a fraction of the time."""
        x_m, y_m = places_m[..., 0], places_m[..., 1]
        for x_per_m, y_per_m, phase in zip(*self._waves_per_m, self._phase, strict=True):
            yield (x_per_m * x_m + y_per_m * y_m + phase).astype(np.float32)

    def build_mesh(self, path_m: Float64, margin_m: float, cell_m: float = SQUARE_M) -> Mesh:
        """The ground near a way, (N, 2) places, as one sheet of squares."""
        lower = np.floor((path_m.min(axis=0) - margin_m) / cell_m)
        columns, rows = (np.ceil((path_m.max(axis=0) + margin_m) / cell_m) - lower).astype(np.int64).tolist()
        row, column = np.indices((rows, columns)).reshape(2, -1)
        middles_m = cell_m * (lower + 0.5 + np.stack([column, row], axis=1))
        near = compute_squared_distances_m2(middles_m, path_m).min(axis=1) < margin_m**2
        here = (row * (columns + 1) + column)[near]
        right, above = here + 1, here + columns + 1
        across = above + 1
        faces = np.concatenate([np.stack([here, right, across], axis=1), np.stack([here, across, above], axis=1)])
        wanted = np.zeros((rows + 1) * (columns + 1), dtype=bool)
        wanted[faces] = True
        used, number = np.flatnonzero(wanted), np.cumsum(wanted) - 1
        places_m = cell_m * (lower + np.stack([used % (columns + 1), used // (columns + 1)], axis=1))
        vertices_m, outward = (
            np.column_stack([places_m, self.compute_heights_m(places_m)]),
            np.zeros(len(faces), dtype=bool),
        )
        return Mesh(vertices_m, number[faces], is_outward=outward).assign_material("road")


Bounds = tuple[float, float]

# What bends is cut into such pieces, and on hills across the street, too.
PIECE_M, ACROSS_M = 6.0, 12.0
SURVEY_EVERY_M = 8.0
# There is so much room between blocks where two stretches of street are near.
BETWEEN_BLOCKS_M = 4.0
NARROWEST_M = 0.5
# What stands on a slope goes on below it.
FOOT_M = 0.5


def bend_along_street(street: Alignment, hills: Hills, meshes: Sequence[Mesh]) -> list[Mesh]:
    """Bodies that were built as if a street were straight and level (x is a station), in the world, as one mesh.

    What of them is not higher than 0 stands on the ground, and goes on below it on hills.
    """
    if (street.is_straight and hills.is_flat) or not meshes:
        return list(meshes)
    merged = merge_meshes(list(meshes))
    x_m, y_m, height_m = merged.vertices_m.T
    places_m = street.compute_poses(x_m, y_m)[:, :2]
    if not hills.is_flat:
        height_m = height_m + hills.compute_heights_m(places_m) - np.where(height_m <= 0.0, FOOT_M, 0.0)
    return [merged._replace(vertices_m=np.column_stack([places_m, height_m]))]


class BuildingSite:
    """The places along a street, up to `deep_m` from its middle: a station, and how far to the left."""

    def __init__(self, street: Alignment, corridor: StreetCorridor, hills: Hills, max_depth_m: float) -> None:
        self.street = street
        self._territory = corridor
        self._hills = hills
        self._deep_m = max_depth_m
        self._reaches_m: dict[int, tuple[Float64, Float64]] = {}

    def build_block(
        self, span_m: Bounds, side: int, curb_offset_m: float, depth_m: float
    ) -> tuple[Mesh, shapely.Geometry]:
        """Pavement from a kerb on, on the left (1) or the right (-1), as far as the site goes there; and in plan."""
        is_plain = self.street.is_straight and self._hills.is_flat
        x = np.linspace(*span_m, 2 if is_plain else int(np.ceil((span_m[1] - span_m[0]) / PIECE_M)) + 1)
        wide_m = self.compute_depths_m(x, side, curb_offset_m, depth_m)
        rows = 2 if self._hills.is_flat else int(np.ceil(depth_m / ACROSS_M)) + 1
        y = curb_offset_m + np.linspace(0.0, 1.0, rows) * wide_m[:, None]
        net = self.street.compute_poses(*np.broadcast_arrays(x[:, None], side * y))[..., :2]
        outline = shapely.make_valid(shapely.Polygon(np.concatenate([net[:, 0], net[::-1, -1]])))
        mesh = build_slab(net if side == 1 else net[:, ::-1], (0.0, PAVEMENT_M))
        if not self._hills.is_flat:
            below, above = mesh.vertices_m.reshape(2, -1, 3)
            ground_m = self._hills.compute_heights_m(above[:, :2])
            below[:, 2], above[:, 2] = ground_m - FOOT_M, ground_m + PAVEMENT_M
        return mesh.assign_material("pavement"), outline

    def compute_depths_m(
        self, query_stations_m: Float64, side: int, curb_offset_m: float, max_depth_m: float
    ) -> Float64:
        """(N,) how deep a block is there that is not deeper than given."""
        if self.street.is_straight:
            return np.full(len(query_stations_m), max_depth_m)
        if side not in self._reaches_m:
            stations_m = self._territory.sample_stations_m(SURVEY_EVERY_M)
            self._reaches_m[side] = (
                stations_m,
                self._territory.find_half_widths_m(stations_m, side, curb_offset_m, self._deep_m),
            )
        reach_m = np.interp(query_stations_m, *self._reaches_m[side])
        return np.asarray(np.clip(reach_m - curb_offset_m - BETWEEN_BLOCKS_M, NARROWEST_M, max_depth_m))
