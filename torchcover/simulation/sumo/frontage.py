"""The sides of streets along which something stands."""

import numpy as np
import shapely

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.frontage import Side, sides_around

# Nothing stands nearer to a lane than this; furniture and houses keep off by more, so that no crown hangs over it.
CLEAR_M, KERB_M, BEHIND_M = 0.4, 1.0, 2.2
# Gaps that the drawing of a network left are street, too; and beside bridges nothing stands.
GAP_M, BRIDGE_M = 1.0, 12.0


def sides_of(
    vicinity: Vicinity, built_share: float, generator: np.random.Generator
) -> tuple[list[Side], list[shapely.Geometry]]:
    """What can be seen of the sides of streets, and where nothing may stand."""
    street = shapely.union_all(shapely.buffer(vicinity.covered, GAP_M, join_style="mitre")).buffer(-GAP_M)
    bridges = vicinity.bridges(BRIDGE_M)
    shapely.prepare(bridges)

    def sees(places_m: Float64) -> Bools:
        return np.asarray(vicinity.sees(places_m) & ~shapely.contains_xy(bridges, *places_m.T))

    taken = shapely.buffer(vicinity.covered, CLEAR_M).tolist()
    return sides_around(street, (KERB_M, BEHIND_M), sees, built_share, generator), taken
