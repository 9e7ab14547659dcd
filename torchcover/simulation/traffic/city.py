"""What stands along the streets of a city: blocks 0.15 m up with buildings, trees, lamp posts; parked cars."""

from collections.abc import Iterator

import numpy as np

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.scenery import PAVEMENT_M, block, box, few, ground, post, tree
from torchcover.simulation.traffic.streets import PARKING_BAY_M, SIDEWALK_M, Streets

BLOCK_DEPTH_M = 95.0
FURNITURE_BEHIND_KERB_M = 0.55
# Crossings and the sight of those who wait there stay free of parked cars and of furniture.
FREE_AT_CORNERS_M = 9.0
PARKED_GAP_M = 0.9
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 3.0, "van": 1.0}

Bounds = tuple[float, float]


class City:
    """Builds the part of a city that the ego gets to see, and parks cars in it.

    Args:
        streets: The plan.
        fleet: The bodies of parked cars.
        parked_share: Share of the parking bays that are taken.
        generator: Draws everything.
    """

    def __init__(self, streets: Streets, fleet: Fleet, parked_share: float, generator: np.random.Generator) -> None:
        self._streets = streets
        self._fleet = fleet
        self._parked_share = parked_share
        self._generator = generator

    def static(self, seen_m: Bounds) -> tuple[Mesh, ...]:
        """The ground, the blocks, buildings and furniture; cars are parked among them.

        Args:
            seen_m: Smallest and largest x that matter; the ground goes on to the ends of all lanes.
        """
        reach = self._streets.reach_m + 200.0
        blocks, buildings, furniture = [], [], []
        for x_m in self._blocks(seen_m):
            for side in (1, -1):
                kerb = self._streets.kerb_m
                blocks.append(block(x_m, _sides(side, kerb, kerb + BLOCK_DEPTH_M), (0.0, PAVEMENT_M)))
                buildings += self._facade(x_m, side) + self._side_streets(x_m, side)
                furniture += self._furniture(x_m, side)
                self._park(x_m, side)
        return (ground((-reach, -reach), (reach, reach)), *few(blocks, buildings, furniture))

    def _blocks(self, seen_m: Bounds) -> Iterator[Bounds]:
        """The blocks between junctions, from kerb to kerb."""
        middles, kerbs = self._streets.junctions_m, self._streets.cross_kerbs_m
        for west, east in zip((middles + kerbs)[:-1], (middles - kerbs)[1:], strict=True):
            if east > seen_m[0] and west < seen_m[1]:
                yield float(west), float(east)

    def _facade(self, x_m: Bounds, side: int) -> list[Mesh]:
        """A row of houses along the main street, set back, with gaps between some."""
        buildings = []
        x, end = x_m[0] + SIDEWALK_M, x_m[1] - SIDEWALK_M
        while end - x > 9.0:
            width = self._uniform(10.0, 26.0)
            width = width if end - x - width > 9.0 else end - x
            front = self._streets.kerb_m + SIDEWALK_M + self._uniform(0.0, 2.0)
            depth, height = self._uniform(10.0, 15.0), self._uniform(5.0, 26.0)
            buildings.append(self._building((x, x + width), _sides(side, front, front + depth), height))
            x += width + (self._uniform(2.0, 6.0) if self._generator.random() < 0.4 else 0.05)
        return buildings

    def _side_streets(self, x_m: Bounds, side: int) -> list[Mesh]:
        """Houses along the two cross streets that bound a block."""
        buildings = []
        start = self._streets.kerb_m + SIDEWALK_M + 18.0
        for corner, inwards in ((x_m[0], 1), (x_m[1], -1)):
            y = start
            while y < self._streets.kerb_m + BLOCK_DEPTH_M - 20.0:
                width = self._uniform(12.0, 20.0)
                edge = SIDEWALK_M + self._uniform(0.0, 1.0)
                along_x = sorted((corner + inwards * edge, corner + inwards * (edge + self._uniform(9.0, 14.0))))
                height = self._uniform(5.0, 20.0)
                buildings.append(self._building((along_x[0], along_x[1]), _sides(side, y, y + width), height))
                y += width + self._uniform(0.1, 5.0)
        return buildings

    def _building(self, x_m: Bounds, y_m: Bounds, height_m: float) -> Mesh:
        return block(x_m, y_m, (PAVEMENT_M, PAVEMENT_M + height_m))

    def _furniture(self, x_m: Bounds, side: int) -> list[Mesh]:
        """Lights at the corners; trees, lamp posts and bins in turn along the kerb."""
        y = side * (self._streets.kerb_m + FURNITURE_BEHIND_KERB_M)
        pieces = [post((corner, y), 0.09, PAVEMENT_M, 3.4) for corner in (x_m[0] + 5.2, x_m[1] - 5.2)]
        x, turn = x_m[0] + FREE_AT_CORNERS_M, int(self._generator.integers(3))
        while x < x_m[1] - FREE_AT_CORNERS_M:
            pieces += self._piece(turn % 4, x, y, side)
            turn += 1
            x += self._uniform(4.5, 9.0)
        return pieces

    def _piece(self, turn: int, x: float, y: float, side: int) -> list[Mesh]:
        if turn == 0:
            arm = block((x - 0.06, x + 0.06), _sides(side, abs(y) - 2.0, abs(y) + 0.1), (7.15, 7.3))
            return [post((x, y), 0.09, PAVEMENT_M, 7.0), arm]
        if turn == 2:
            return [box((x, y), (0.5, 0.45, 0.9), PAVEMENT_M)]
        radius, height = self._uniform(1.0, 1.6), self._uniform(5.0, 8.5)
        return tree((x, y), PAVEMENT_M, self._uniform(2.8, 3.4), height, radius)

    def _park(self, x_m: Bounds, side: int) -> None:
        """Cars at the kerb, in the direction of the traffic beside them."""
        x, end = x_m[0] + FREE_AT_CORNERS_M, x_m[1] - FREE_AT_CORNERS_M
        while x < end:
            kind = self._fleet.draw_kind(PARKED)
            length = self._fleet.length_m(kind) + PARKED_GAP_M + self._uniform(0.0, 0.5)
            if self._generator.random() < self._parked_share and x + length < end:
                slack = max((PARKING_BAY_M - self._fleet.width_m(kind)) / 2 - 0.08, 0.0)
                y = -side * (self._streets.bay_m + self._uniform(0.0, slack))
                yaw = (0.0 if side == 1 else 180.0) + self._uniform(-0.4, 0.4)
                self._fleet.park(kind, (x + length / 2, y, yaw))
            x += length

    def _uniform(self, low: float, high: float) -> float:
        return float(self._generator.uniform(low, high))


def _sides(side: int, near_m: float, far_m: float) -> Bounds:
    """Bounds in y of what lies between two distances from the middle, on the left (1) or on the right (-1)."""
    return (near_m, far_m) if side == 1 else (-far_m, -near_m)
