"""What stands on a parking lot and around it: rows of cars, and the low things that one overlooks.

From the middle outwards, on both sides alike: a walkway between two rows that face each other, a row of stalls (with it
the island ends), an aisle, another row, a walkway along the edge.
"""

import numpy as np
import shapely

from torchcover.geometry.arrays import Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.frontage import Times, sides_around, stand
from torchcover.simulation.traffic.scenery import PAVEMENT_M, Scenery, block, box, few, ground, post, tree

STALL_WIDTH_M, STALL_DEPTH_M = 2.6, 5.0
STALLS = 24
STALLS_M = STALLS * STALL_WIDTH_M
MIDDLE_WALKWAY_M = 1.9
ISLAND_M = MIDDLE_WALKWAY_M / 2 + STALL_DEPTH_M
AISLE_M = 6.5
OUTER_HEAD_M = ISLAND_M + AISLE_M + STALL_DEPTH_M
# y of the tracks on the walkways, each for one person.
WALKWAYS_M = (-0.45, 0.45, OUTER_HEAD_M + 1.2, OUTER_HEAD_M + 2.1, -OUTER_HEAD_M - 1.2, -OUTER_HEAD_M - 2.1)
EDGE_M = OUTER_HEAD_M + 3.2

ISLAND_END_M = 3.0
BOLLARDS_AT_X_M = 48.0
BOLLARD_EVERY_M = 1.8
BUILDING_AT_Y_M = 36.0
# The lot with its lanes, as far as what stands around it keeps off; and what stands at its edge, and behind that.
LOT_M = shapely.box(-BOLLARDS_AT_X_M - 14.0, -EDGE_M - 8.0, BOLLARDS_AT_X_M + 14.0, BUILDING_AT_Y_M)
AROUND_M = (0.2, 2.5)
# Crowns keep off the market.
CROWN_M = 2.0
NOSE_OFF_HEAD_M = 0.35
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 4.0}
TROLLEY_M = (0.9, 0.55, 1.0)
TROLLEY_SHARE = 0.3


class Lot:
    """Draws a parking lot about the origin, with its aisles along x."""

    def __init__(
        self,
        fleet: Fleet,
        parked_share: float,
        crossings: int,
        built_share: float,
        roadside: Times,
        generator: np.random.Generator,
    ) -> None:
        self._fleet = fleet
        self._parked_share = parked_share
        self._built_share = built_share
        self._roadside = roadside
        self._generator = generator
        self._empty = {side: set(generator.choice(STALLS, size=crossings, replace=False).tolist()) for side in (1, -1)}

    @property
    def crossings(self) -> list[tuple[int, float]]:
        """Side (1 is the aisle at positive y) and x of each place where people cross."""
        return [(side, _stall_x(column)) for side in (1, -1) for column in sorted(self._empty[side])]

    def static(self) -> Scenery:
        """Everything but the cars, with ground for 300 m around; the cars are parked."""
        low = []
        for side in (1, -1):
            for head, inwards in ((MIDDLE_WALKWAY_M / 2, 1), (OUTER_HEAD_M, -1)):
                for column in range(STALLS):
                    wheel_stop = box((_stall_x(column), side * (head + inwards * 0.12)), (1.8, 0.15, 0.1))
                    low.append(wheel_stop)
                    if column not in self._empty[side]:
                        place = (_stall_x(column), side * head, side * inwards)
                        low += self._occupant(*place)
        islands, trees = self._islands()
        around, market = self._surroundings()
        level, kerbs = ground((-300.0, -300.0), (300.0, 300.0)), few(islands)

        def level_m(places_m: Float64) -> Float64:
            return np.zeros(len(places_m))

        sides = sides_around(LOT_M, AROUND_M, lambda _: np.array(True), self._built_share, self._generator)
        taken = [LOT_M, market.buffer(CROWN_M)]
        stood = stand(sides, taken, taken, (), level_m, self._roadside, self._generator)
        return Scenery((level, *few(low, self._bollards()), *kerbs, *few(trees, around, *stood)), (0, 3))

    def _occupant(self, x: float, head_y: float, inwards: int) -> list[Mesh]:
        """Park a car in a stall, nose or tail first; or return a trolley that somebody left there; or nothing."""
        if self._generator.random() < self._parked_share:
            kind = self._fleet.draw_kind(PARKED)
            y = head_y + inwards * (NOSE_OFF_HEAD_M + self._fleet.length_m(kind) / 2)
            yaw = self._generator.choice((90.0, -90.0)) + self._generator.uniform(-1.5, 1.5)
            x += self._generator.uniform(-0.1, 0.1)
            self._fleet.park(kind, (x, y, yaw))
            return []
        if self._generator.random() < TROLLEY_SHARE:
            x, y = x + self._generator.uniform(-0.6, 0.6), head_y + inwards * self._generator.uniform(1.0, 4.0)
            return [box((x, y), TROLLEY_M, yaw_deg=self._generator.uniform(0.0, 360.0))]
        return []

    def _islands(self) -> tuple[list[Mesh], list[Mesh]]:
        """Kerbed ends of the double row, each with trees."""
        kerbs, trees = [], []
        for side in (1, -1):
            ends = sorted((side * (STALLS_M / 2 + 0.3), side * (STALLS_M / 2 + 0.3 + ISLAND_END_M)))
            for half in (1, -1):
                across = sorted((half * MIDDLE_WALKWAY_M / 2, half * (ISLAND_M - 0.5)))
                kerbs.append(block((ends[0], ends[1]), (across[0], across[1]), (0.0, PAVEMENT_M)).made_of("pavement"))
                trees += tree((sum(ends) / 2, sum(across) / 2), PAVEMENT_M, 2.3, 5.5, 1.3)
        return kerbs, trees

    def _bollards(self) -> list[Mesh]:
        """Along both short sides, and in front of the building."""
        ends = [
            post((x, y), 0.08, 0.0, 0.9)
            for x in (-BOLLARDS_AT_X_M, BOLLARDS_AT_X_M)
            for y in np.arange(-EDGE_M + 1.0, EDGE_M, BOLLARD_EVERY_M)
        ]
        front = [
            post((x, BUILDING_AT_Y_M - 4.0), 0.1, 0.0, 0.9)
            for x in np.arange(-STALLS_M / 2, STALLS_M / 2, BOLLARD_EVERY_M)
        ]
        return ends + front

    def _surroundings(self) -> tuple[list[Mesh], shapely.Geometry]:
        """Low walls along the edges, planters, and the market; and the market in plan."""
        half = STALLS_M / 2
        market = (-half - 5.0, half + 5.0), (BUILDING_AT_Y_M, BUILDING_AT_Y_M + 40.0)
        pieces = [
            block((-half - 12.0, half + 12.0), (-EDGE_M - 0.2, -EDGE_M), (0.0, 0.6)),
            block((-half - 12.0, -6.0), (EDGE_M, EDGE_M + 0.2), (0.0, 0.6)),
            block((6.0, half + 12.0), (EDGE_M, EDGE_M + 0.2), (0.0, 0.6)),
            block(*market, (0.0, 7.5)),
        ]
        for x in np.linspace(-half, half, 5):
            pieces.append(post((x, EDGE_M + 1.0), 0.1, 0.0, 7.0))
            pieces.append(box((x + 5.0, BUILDING_AT_Y_M - 7.0), (1.6, 0.6, 0.5)))
        return pieces, shapely.box(market[0][0], market[1][0], market[0][1], market[1][1])


def _stall_x(column: int) -> float:
    return (column + 0.5 - STALLS / 2) * STALL_WIDTH_M
