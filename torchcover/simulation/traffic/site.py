"""Where a city is built: beside a street as if it were straight and level, and then bent with it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.bodies import merge
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment, Territory
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import PAVEMENT_M, block, slab

Numbers = NDArray[np.float64]
Bounds = tuple[float, float]

# What bends is cut into such pieces, and on hills across the street, too.
PIECE_M, ACROSS_M = 6.0, 12.0
SURVEY_EVERY_M = 8.0
# There is so much room between blocks where two stretches of street are near; houses keep within their block.
BETWEEN_BLOCKS_M = 4.0
NARROWEST_M = 0.5
# What stands on a slope goes on below it.
FOOT_M = 0.5


class BuildingSite:
    """The places along a street: x is a station, y how far it lies to the left, z the height above the ground.

    Args:
        street: The street.
        territory: What belongs to it.
        hills: The ground.
        deep_m: How far from its middle it is built at most.
        main: What belongs to the main street, if this is another one.
        turn_m: Only what is nearest to the main street between these stations may be built, then.
    """

    def __init__(
        self,
        street: Alignment,
        territory: Territory,
        hills: Hills,
        deep_m: float,
        main: Territory | None = None,
        turn_m: Bounds = (0.0, 0.0),
    ) -> None:
        self.street = street
        self._territory = territory
        self._hills = hills
        self._deep_m = deep_m
        self._main = main
        self._turn_m = turn_m
        self.is_plain = street.is_straight and hills.are_flat
        self._reaches_m: dict[int, tuple[Numbers, Numbers]] = {}

    def owns(self, x_m: Numbers, y_m: Numbers) -> NDArray[np.bool_]:
        """(N,) whether places belong to it."""
        return self._territory.owns(x_m, y_m) & self.is_opposite(x_m, y_m)

    def is_opposite(self, x_m: Numbers, y_m: Numbers) -> NDArray[np.bool_]:
        """(N,) whether places are opposite of the turn; all are, if it is the main street's."""
        if self._main is None:
            return np.ones(len(x_m), dtype=bool)
        station = self._main.nearest(self.street.poses(x_m, y_m)[:, :2])
        return np.asarray((station >= self._turn_m[0]) & (station <= self._turn_m[1]))

    def owned(self, pieces: Sequence[Mesh]) -> list[Mesh]:
        """Those bodies that stand on it altogether, and not near its end."""
        if self.street.is_straight or not pieces:
            return list(pieces)
        lower, upper = (
            np.array([reduce(piece.vertices_m[:, :2], 0) for piece in pieces]) for reduce in (np.min, np.max)
        )
        x_m = np.stack([lower[:, 0], lower[:, 0], upper[:, 0], upper[:, 0]], axis=1).ravel()
        y_m = np.stack([lower[:, 1], upper[:, 1], lower[:, 1], upper[:, 1]], axis=1).ravel()
        owned: NDArray[np.bool_] = self.owns(x_m, y_m + 2 * BETWEEN_BLOCKS_M * np.sign(y_m)).reshape(-1, 4)
        return [piece for piece, own in zip(pieces, owned, strict=True) if own.all()]

    def block(self, x_m: Bounds, side: int, kerb_m: float, depth_m: float) -> Mesh:
        """Pavement from a kerb on, on the left (1) or the right (-1), as far as the site goes there."""
        if self.is_plain:
            near, far = sorted((side * kerb_m, side * (kerb_m + depth_m)))
            return block(x_m, (near, far), (0.0, PAVEMENT_M)).made_of("pavement")
        x = np.linspace(*x_m, int(np.ceil((x_m[1] - x_m[0]) / PIECE_M)) + 1)
        wide_m = np.minimum(self._reach_m(x, side, kerb_m) - kerb_m - BETWEEN_BLOCKS_M, depth_m)
        rows = 2 if self._hills.are_flat else int(np.ceil(depth_m / ACROSS_M)) + 1
        y = kerb_m + np.linspace(0.0, 1.0, rows) * np.maximum(wide_m, NARROWEST_M)[:, None]
        net = np.stack(np.broadcast_arrays(x[:, None], side * y), axis=-1)
        return slab(net if side == 1 else net[:, ::-1], (0.0, PAVEMENT_M)).made_of("pavement")

    def bent(self, pieces: Sequence[Mesh], bottom_m: float) -> list[Mesh]:
        """The bodies in the world, as one mesh.

        Args:
            pieces: The bodies.
            bottom_m: What of them is not higher than this stands on something, and goes on below.
        """
        if self.is_plain or not pieces:
            return list(pieces)
        merged = merge(list(pieces))
        x_m, y_m, height_m = merged.vertices_m.T
        places_m = self.street.poses(x_m, y_m)[:, :2]
        if not self._hills.are_flat:
            height_m = height_m + self._hills.heights_m(places_m) - np.where(height_m <= bottom_m, FOOT_M, 0.0)
        return [merged._replace(vertices_m=np.column_stack([places_m, height_m]))]

    def _reach_m(self, x_m: Numbers, side: int, kerb_m: float) -> Numbers:
        """(N,) how far from the middle it goes there."""
        if side not in self._reaches_m:
            stations_m = self._territory.stations_m(SURVEY_EVERY_M)
            self._reaches_m[side] = stations_m, self._territory.reaches_m(stations_m, side, kerb_m, self._deep_m)
        return np.asarray(np.interp(x_m, *self._reaches_m[side]))
