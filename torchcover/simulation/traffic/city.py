"""What stands along the streets of a city: blocks 0.15 m up with buildings, trees, lamp posts; parked cars; verges."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import SAMPLE_EVERY_M, Territory
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import PAVEMENT_M, Scenery, block, box, few, ground, post, tree
from torchcover.simulation.traffic.site import Bounds, BuildingSite
from torchcover.simulation.traffic.streets import GUTTER_M, Streets

Numbers = NDArray[np.float64]

BLOCK_DEPTH_M = 95.0
FURNITURE_BEHIND_KERB_M = 0.55
# Crossings and the sight of those who wait there stay free of parked cars and of furniture.
FREE_AT_CORNERS_M = 9.0
PARKED_GAP_M = 0.9
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 3.0, "van": 1.0}
# The block between two streets that meet the main street where it turns.
CORNER_M, CORNER_DEPTH_M = 100.0, 40.0
VERGE_TREES_M = (2.0, 45.0)
VERGE_TREE_EVERY_M = (5.0, 22.0)
# Beyond a sensor's range the ground goes on a little.
GROUND_M = 320.0
WAY_EVERY_M = 40.0


class Frontage(NamedTuple):
    """A side of a street, the left (1) or the right (-1), from one station to another, behind the kerb.

    `turns_m` are stations between which the street turns, towards this side. `is_corner`: no cross street bounds it.
    """

    x_m: Bounds
    side: int
    kerb_m: float
    turns_m: tuple[Bounds, ...] = ()
    is_corner: bool = False


class Pieces(NamedTuple):
    """What stands along a street: blocks, houses and furniture on them, trees on the ground."""

    blocks: list[Mesh]
    houses: list[Mesh]
    furniture: list[Mesh]
    trees: list[Mesh]


class City:
    """Builds the part of a city that the ego gets to see, and parks cars in it."""

    def __init__(
        self,
        streets: Streets,
        territory: Territory,
        hills: Hills,
        fleet: Fleet,
        parked_share: float,
        built_share: float,
        generator: np.random.Generator,
        shapes: np.random.Generator,
    ) -> None:
        self._streets = streets
        self._section = streets.section
        self._territory = territory
        self._hills = hills
        self._fleet = fleet
        self._parked_share = parked_share
        self._built_share = built_share
        self._generator = generator
        self._shapes = shapes

    def static(self, seen_m: Bounds) -> Scenery:
        """The ground, the blocks, buildings and furniture; cars are parked among them."""
        site = BuildingSite(
            self._streets.main, self._territory, self._hills, self._streets.kerb_m + BLOCK_DEPTH_M + 10.0
        )
        found = [self._built(site, self._frontages(seen_m))]
        turns = (self._streets.course.turns != 0) & self._territory.covers(self._streets.junctions_m)
        found += [self._built(*self._corner(index)) for index in np.flatnonzero(turns).tolist()]
        kinds = [[mesh for pieces in found for mesh in pieces[kind]] for kind in range(len(Pieces._fields))]
        blocks, houses, furniture, trees = kinds
        pavements = few(blocks)
        static = (self._ground(seen_m), *pavements, *few(houses, furniture + trees))
        return Scenery(static, tuple(range(1 + len(pavements))))

    def _ground(self, seen_m: Bounds) -> Mesh:
        """Under everything: as far as lanes go, or as far as it can be seen."""
        if self._hills.are_flat:
            reach = self._streets.reach_m + 200.0
            return ground((-reach, -reach), (reach, reach))
        way_m = self._streets.main.poses(np.arange(*seen_m, WAY_EVERY_M), 0.0)[:, :2]
        return self._hills.mesh(way_m, GROUND_M)

    def _frontages(self, seen_m: Bounds) -> Iterator[Frontage]:
        """Both sides of the main street from kerb to kerb."""
        turns, middles, halves = self._streets.course.turns, self._streets.junctions_m, self._streets.cross_kerbs_m
        starts, ends = (middles - halves).tolist(), (middles + halves).tolist()
        for west in range(len(turns) - 1):
            for side in (1, -1):
                # No street comes from the inside of a turn: the block goes on.
                east = west + 1
                while turns[east] == side:
                    east += 1
                if turns[west] != side and starts[east] > seen_m[0] and ends[west] < seen_m[1]:
                    turns_m = tuple((starts[k], ends[k]) for k in range(west + 1, east))
                    yield Frontage((ends[west], starts[east]), side, self._streets.kerb_m, turns_m)

    def _corner(self, index: int) -> tuple[BuildingSite, list[Frontage]]:
        """The block between the two streets that meet the main street in a turn."""
        street, half_m = self._streets.crossing[index], float(self._streets.cross_kerbs_m[index])
        kerb_m = float(self._streets.cross_lanes_each_way[index]) * self._section.lane_m + GUTTER_M
        side, middle_m = int(self._streets.course.turns[index]), float(self._streets.junctions_m[index])
        span_m = (-half_m - CORNER_M, half_m + CORNER_M)
        deep_m, turn_m = (
            kerb_m + CORNER_DEPTH_M + 10.0,
            (middle_m - half_m - SAMPLE_EVERY_M, middle_m + half_m + SAMPLE_EVERY_M),
        )
        site = BuildingSite(street, Territory(street, span_m), self._hills, deep_m, self._territory, turn_m)
        # As far as it is opposite of the turn, and not of another one.
        x = np.arange(*span_m, 5.0)
        foreign = ~site.is_opposite(x, np.full(len(x), side * kerb_m))
        foreign |= ~site.is_opposite(x, np.full(len(x), side * (kerb_m + CORNER_DEPTH_M)))
        foreign &= np.abs(x) > half_m
        before, behind = x[foreign & (x < 0.0)], x[foreign & (x > 0.0)]
        x_m = max([span_m[0], *before.tolist()]) + 5.0, min([span_m[1], *behind.tolist()]) - 5.0
        return site, [Frontage(x_m, side, kerb_m, ((-half_m, half_m),), is_corner=True)]

    def _built(self, site: BuildingSite, fronts: Iterable[Frontage]) -> Pieces:
        """What stands along a street, in the world; cars are parked there."""
        made, parked = Pieces([], [], [], []), []
        for front in fronts:
            is_built = self._built_share == 1.0 or self._shapes.random() < self._built_share
            depth_m = CORNER_DEPTH_M if front.is_corner else BLOCK_DEPTH_M
            made.blocks.append(
                site.block(front.x_m, front.side, front.kerb_m, depth_m if is_built else self._section.sidewalk_m)
            )
            if is_built:
                made.houses.extend(self._facade(front, site))
                made.houses.extend([] if front.is_corner else self._side_streets(front))
            else:
                made.trees.extend(self._verge(front))
            if not front.is_corner:
                made.furniture.extend(self._furniture(front))
                parked += self._parked(front)
        self._park(site, parked)
        return Pieces(
            site.bent(made.blocks, 0.0),
            site.bent(site.owned(made.houses), PAVEMENT_M),
            site.bent(made.furniture, PAVEMENT_M),
            site.bent(site.owned(made.trees), 0.0),
        )

    def _facade(self, front: Frontage, site: BuildingSite) -> list[Mesh]:
        """A row of houses along the street, set back, with gaps between some."""
        buildings = []
        sidewalk = self._section.sidewalk_m
        x, end = front.x_m[0] + sidewalk, front.x_m[1] - sidewalk
        while end - x > 9.0:
            width = self._uniform(10.0, 26.0)
            width = width if end - x - width > 9.0 else end - x
            # Walls are straight: on the outside of a curve their middle comes nearer to the street.
            curvature = np.abs(site.street.curvatures(np.linspace(x, x + width, 5))).max()
            near = front.kerb_m + sidewalk + self._uniform(0.0, 2.0) + float(curvature) * width**2 / 8
            depth, height = self._uniform(10.0, 15.0), self._uniform(5.0, 26.0)
            if not any(x < last and x + width > first for first, last in front.turns_m):
                buildings.append(self._building((x, x + width), _sides(front.side, near, near + depth), height))
            x += width + (self._uniform(2.0, 6.0) if self._generator.random() < 0.4 else 0.05)
        return buildings

    def _side_streets(self, front: Frontage) -> list[Mesh]:
        """Houses along the two cross streets that bound a block."""
        buildings = []
        start = front.kerb_m + self._section.sidewalk_m + 18.0
        for corner, inwards in ((front.x_m[0], 1), (front.x_m[1], -1)):
            y = start
            while y < front.kerb_m + BLOCK_DEPTH_M - 20.0:
                width = self._uniform(12.0, 20.0)
                edge = self._section.sidewalk_m + self._uniform(0.0, 1.0)
                along_x = sorted((corner + inwards * edge, corner + inwards * (edge + self._uniform(9.0, 14.0))))
                height = self._uniform(5.0, 20.0)
                along_y = _sides(front.side, y, y + width)
                buildings.append(self._building((along_x[0], along_x[1]), along_y, height))
                y += width + self._uniform(0.1, 5.0)
        return buildings

    def _building(self, x_m: Bounds, y_m: Bounds, height_m: float) -> Mesh:
        return block(x_m, y_m, (PAVEMENT_M, PAVEMENT_M + height_m))

    def _furniture(self, front: Frontage) -> list[Mesh]:
        """Lights at the corners; trees, lamp posts and bins in turn along the kerb."""
        x_m, y = front.x_m, front.side * (front.kerb_m + FURNITURE_BEHIND_KERB_M)
        pieces = [post((corner, y), 0.09, PAVEMENT_M, 3.4) for corner in (x_m[0] + 5.2, x_m[1] - 5.2)]
        x, turn = x_m[0] + FREE_AT_CORNERS_M, int(self._generator.integers(3))
        while x < x_m[1] - FREE_AT_CORNERS_M:
            piece = self._piece(turn % 4, x, y, front.side)
            pieces += piece if self._is_free(front, (x, x)) else []
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

    def _verge(self, front: Frontage) -> list[Mesh]:
        """Trees in the open."""
        pieces: list[Mesh] = []
        behind_m = front.kerb_m + self._section.sidewalk_m
        x = front.x_m[0] + self._section.sidewalk_m
        while x < front.x_m[1] - self._section.sidewalk_m:
            foot = x, front.side * (behind_m + self._uniform(*VERGE_TREES_M))
            pieces += tree(foot, 0.0, self._uniform(1.0, 3.0), self._uniform(5.0, 11.0), self._uniform(1.0, 2.0))
            x += self._uniform(*VERGE_TREE_EVERY_M)
        return pieces

    def _parked(self, front: Frontage) -> list[tuple[str, float, float, float]]:
        """Cars at the kerb, in the direction of the traffic beside them: kind, x, y, and yaw in degrees."""
        cars: list[tuple[str, float, float, float]] = []
        x, end = front.x_m[0] + FREE_AT_CORNERS_M, front.x_m[1] - FREE_AT_CORNERS_M
        while x < end and self._section.bay_m:
            kind = self._fleet.draw_kind(PARKED)
            length = self._fleet.length_m(kind) + PARKED_GAP_M + self._uniform(0.0, 0.5)
            if self._generator.random() < self._parked_share and x + length < end:
                slack = max((self._section.bay_m - self._fleet.width_m(kind)) / 2 - 0.08, 0.0)
                y = front.side * (self._section.bays_m + self._uniform(0.0, slack))
                yaw = (0.0 if front.side == -1 else 180.0) + self._uniform(-0.4, 0.4)
                if self._is_free(front, (x, x + length)):
                    cars.append((kind, x + length / 2, y, yaw))
            x += length
        return cars

    def _park(self, site: BuildingSite, cars: list[tuple[str, float, float, float]]) -> None:
        if not cars:
            return
        kinds, x_m, y_m, yaw_deg = zip(*cars, strict=True)
        poses = site.street.poses(x_m, np.array(y_m))
        poses[:, 2] += yaw_deg
        stances = self._hills.stances(poses[:, :2], poses[:, 2])
        for kind, (x, y, yaw), (height_m, *tilt_deg) in zip(kinds, poses.tolist(), stances.tolist(), strict=True):
            self._fleet.park(kind, (x, y, yaw), height_m, (tilt_deg[0], tilt_deg[1]))

    def _is_free(self, front: Frontage, x_m: Bounds) -> bool:
        """Whether something may stand from one station to another."""
        return not any(
            x_m[0] < last + FREE_AT_CORNERS_M and x_m[1] > first - FREE_AT_CORNERS_M for first, last in front.turns_m
        )

    def _uniform(self, low: float, high: float) -> float:
        return float(self._generator.uniform(low, high))


def _sides(side: int, near_m: float, far_m: float) -> Bounds:
    """Bounds in y of what lies between two distances from the middle, on the left (1) or on the right (-1)."""
    return (near_m, far_m) if side == 1 else (-far_m, -near_m)
