"""The sides of streets along which something stands: behind the outermost of their lanes."""

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.simulation.sumo.network import NetworkLane
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.frontage import Side
from torchcover.simulation.traffic.roads import Polyline

Numbers = NDArray[np.float64]

# Nothing stands nearer to a lane than this; furniture and houses keep off by more, so that no crown hangs over it.
CLEAR_M, KERB_M, BEHIND_M = 0.4, 1.0, 2.2
# What may be seen of a side is found out so often.
EVERY_M = 5.0


def sides_of(
    vicinity: Vicinity, built_share: float, generator: np.random.Generator
) -> tuple[list[Side], list[shapely.Geometry]]:
    """What can be seen of the sides of streets, and where nothing may stand."""
    taken = shapely.buffer(vicinity.covered, CLEAR_M)
    sides: list[Side] = []
    for edge in _edges(vicinity, shapely.STRtree(taken)):
        line = Polyline(edge.poses(np.linspace(0.0, edge.length_m, int(edge.length_m / EVERY_M) + 2))[:, :2])
        is_built = generator.random() < built_share
        seen = np.concatenate([[False], vicinity.sees(line.points_m), [False]]).astype(np.int8)
        for first, end in np.flatnonzero(np.diff(seen)).reshape(-1, 2).tolist():
            if end - first > 1:
                sides.append(Side("kerb", line.shifted(-KERB_M).points_m[first:end]))
                sides.append(Side("built" if is_built else "open", line.shifted(-BEHIND_M).points_m[first:end]))
    return sides, taken.tolist()


def _edges(vicinity: Vicinity, taken: shapely.STRtree) -> Iterator[Polyline]:
    """The outer edges of streets, which have the street on their left."""
    of_edge: dict[str, list[NetworkLane]] = {}
    for number, lane in enumerate(vicinity.lanes):
        if lane.use in ("road", "bay", "shoulder", "sidewalk") and number not in vicinity.decks:
            of_edge.setdefault(lane.edge, []).append(lane)
    inwards = -1 if vicinity.left_hand else 1
    for lanes in of_edge.values():
        for lane, left in ((lanes[0], -inwards), (lanes[-1], inwards)):
            side = Polyline(lane.line_m[:, :2]).shifted(left * lane.width_m / 2)
            side = side.reversed() if left > 0 else side
            # Next to the innermost lane there are those of the other direction, unless it is a one-way street.
            beside = side.shifted(-2 * CLEAR_M - 0.5).poses(side.length_m / 2)[:2]
            if lane is lanes[0] or len(taken.query(shapely.Point(beside), predicate="intersects")) == 0:
                yield side
