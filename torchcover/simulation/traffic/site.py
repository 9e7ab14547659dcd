"""The pavement of blocks along a street, which bends with it and keeps off other stretches."""

from collections.abc import Sequence

import numpy as np
import shapely

from torchcover.geometry.arrays import Float64
from torchcover.simulation.bodies import merge
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment, Territory
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import PAVEMENT_M, slab

Bounds = tuple[float, float]

# What bends is cut into such pieces, and on hills across the street, too.
PIECE_M, ACROSS_M = 6.0, 12.0
SURVEY_EVERY_M = 8.0
# There is so much room between blocks where two stretches of street are near.
BETWEEN_BLOCKS_M = 4.0
NARROWEST_M = 0.5
# What stands on a slope goes on below it.
FOOT_M = 0.5


def bent(street: Alignment, hills: Hills, pieces: Sequence[Mesh]) -> list[Mesh]:
    """Bodies that were built as if a street were straight and level (x is a station), in the world, as one mesh.

    What of them is not higher than 0 stands on the ground, and goes on below it on hills.
    """
    if (street.is_straight and hills.are_flat) or not pieces:
        return list(pieces)
    merged = merge(list(pieces))
    x_m, y_m, height_m = merged.vertices_m.T
    places_m = street.poses(x_m, y_m)[:, :2]
    if not hills.are_flat:
        height_m = height_m + hills.heights_m(places_m) - np.where(height_m <= 0.0, FOOT_M, 0.0)
    return [merged._replace(vertices_m=np.column_stack([places_m, height_m]))]


class BuildingSite:
    """The places along a street, up to `deep_m` from its middle: a station, and how far to the left."""

    def __init__(self, street: Alignment, territory: Territory, hills: Hills, deep_m: float) -> None:
        self.street = street
        self._territory = territory
        self._hills = hills
        self._deep_m = deep_m
        self._reaches_m: dict[int, tuple[Float64, Float64]] = {}

    def block(self, x_m: Bounds, side: int, kerb_m: float, depth_m: float) -> tuple[Mesh, shapely.Geometry]:
        """Pavement from a kerb on, on the left (1) or the right (-1), as far as the site goes there; and in plan."""
        is_plain = self.street.is_straight and self._hills.are_flat
        x = np.linspace(*x_m, 2 if is_plain else int(np.ceil((x_m[1] - x_m[0]) / PIECE_M)) + 1)
        wide_m = self.depth_m(x, side, kerb_m, depth_m)
        rows = 2 if self._hills.are_flat else int(np.ceil(depth_m / ACROSS_M)) + 1
        y = kerb_m + np.linspace(0.0, 1.0, rows) * wide_m[:, None]
        net = self.street.poses(*np.broadcast_arrays(x[:, None], side * y))[..., :2]
        outline = shapely.make_valid(shapely.Polygon(np.concatenate([net[:, 0], net[::-1, -1]])))
        mesh = slab(net if side == 1 else net[:, ::-1], (0.0, PAVEMENT_M))
        if not self._hills.are_flat:
            below, above = mesh.vertices_m.reshape(2, -1, 3)
            ground_m = self._hills.heights_m(above[:, :2])
            below[:, 2], above[:, 2] = ground_m - FOOT_M, ground_m + PAVEMENT_M
        return mesh.made_of("pavement"), outline

    def depth_m(self, x_m: Float64, side: int, kerb_m: float, depth_m: float) -> Float64:
        """(N,) how deep a block is there that is not deeper than given."""
        if self.street.is_straight:
            return np.full(len(x_m), depth_m)
        if side not in self._reaches_m:
            stations_m = self._territory.stations_m(SURVEY_EVERY_M)
            self._reaches_m[side] = stations_m, self._territory.reaches_m(stations_m, side, kerb_m, self._deep_m)
        reach_m = np.interp(x_m, *self._reaches_m[side])
        return np.asarray(np.clip(reach_m - kerb_m - BETWEEN_BLOCKS_M, NARROWEST_M, depth_m))
