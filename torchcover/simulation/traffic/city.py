"""What stands along the streets of a city: blocks 0.15 m up with buildings, trees, lamp posts; parked cars; verges."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.scenery import PAVEMENT_M, block, box, few, ground, post, slab, tree
from torchcover.simulation.traffic.streets import GUTTER_M, Streets
from torchcover.simulation.traffic.territory import Territory

Numbers = NDArray[np.float64]

BLOCK_DEPTH_M = 95.0
FURNITURE_BEHIND_KERB_M = 0.55
# Crossings and the sight of those who wait there stay free of parked cars and of furniture.
FREE_AT_CORNERS_M = 9.0
PARKED_GAP_M = 0.9
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 3.0, "van": 1.0}
# What bends is cut into such pieces; between blocks of one side there is so much room where streets come near.
PIECE_M = 6.0
BETWEEN_BLOCKS_M = 4.0
NARROWEST_M = 0.5
# Depth of the block between two streets that meet the main street where it turns.
CORNER_M = 40.0
# What stands on a slope goes on below it.
FOOT_M = 0.5
VERGE_TREES_M = (2.0, 45.0)
VERGE_TREE_EVERY_M = (5.0, 22.0)
# Beyond a sensor's range the ground goes on a little.
GROUND_M = 320.0

Bounds = tuple[float, float]


class Frontage(NamedTuple):
    """A side of a street, from one station to another; `kerb_m` from its middle the pavement begins.

    `side` is 1 on the left and -1 on the right; `free_m` are stations around which nothing stands. `opposite` is the
    number of the junction with a turn opposite of which it lies, if it does not belong to the main street.
    """

    street: Alignment
    territory: Territory
    x_m: Bounds
    side: int
    kerb_m: float
    free_m: tuple[Bounds, ...] = ()
    opposite: int | None = None


class City:
    """Builds the part of a city that the ego gets to see, and parks cars in it.

    All is made beside straight streets, (x, y) being a station and how far it lies to the left, and then bent with them.

    Args:
        streets: The plan.
        hills: What it stands on.
        fleet: The bodies of parked cars.
        parked_share: Share of the parking bays that are taken.
        built_share: Share of the blocks' sides that have houses.
        generator: Draws everything.
        shapes: Draws which blocks have houses.
    """

    def __init__(
        self,
        streets: Streets,
        hills: Hills,
        fleet: Fleet,
        parked_share: float,
        built_share: float,
        generator: np.random.Generator,
        shapes: np.random.Generator,
    ) -> None:
        self._streets = streets
        self._section = streets.section
        self._hills = hills
        self._fleet = fleet
        self._parked_share = parked_share
        self._built_share = built_share
        self._generator = generator
        self._shapes = shapes

    def static(self, seen_m: Bounds) -> tuple[Mesh, ...]:
        """The ground, the blocks, buildings and furniture; cars are parked among them.

        Args:
            seen_m: First and last station of the main street that matter.
        """
        blocks: list[Mesh] = []
        buildings: list[Mesh] = []
        furniture: list[Mesh] = []
        for front in self._frontages(seen_m):
            built = self._built_share == 1.0 or self._shapes.random() < self._built_share
            depth_m = self._section.sidewalk_m if not built else BLOCK_DEPTH_M if front.opposite is None else CORNER_M
            blocks += self._bent(front, [self._block(front, depth_m)], bottom_m=0.0)
            if built:
                houses = self._facade(front) + (self._side_streets(front) if front.opposite is None else [])
                buildings += self._bent(front, self._owned(front, houses), bottom_m=PAVEMENT_M)
            else:
                furniture += self._bent(front, self._owned(front, self._verge(front)), bottom_m=0.0)
            if front.opposite is None:
                furniture += self._bent(front, self._furniture(front), bottom_m=PAVEMENT_M)
                self._park(front)
        return (self._ground(seen_m), *few(blocks, buildings, furniture))

    def _ground(self, seen_m: Bounds) -> Mesh:
        """Under everything: as far as lanes go, or as far as it can be seen."""
        if self._hills.are_flat:
            reach = self._streets.reach_m + 200.0
            return ground((-reach, -reach), (reach, reach))
        stations_m = np.arange(*seen_m, 40.0)
        return self._hills.mesh(self._streets.main.poses(stations_m, 0.0)[:, :2], GROUND_M)

    def _frontages(self, seen_m: Bounds) -> Iterator[Frontage]:
        """Both sides of the main street from kerb to kerb; and the corners opposite of its turns."""
        streets, turns = self._streets, self._streets.course.turns
        starts, ends = streets.junctions_m - streets.cross_kerbs_m, streets.junctions_m + streets.cross_kerbs_m
        for west in range(len(turns) - 1):
            for side in (1, -1):
                # No street comes from the inside of a turn: the block goes on.
                east = west + 1
                while turns[east] == side:
                    east += 1
                x_m = float(ends[west]), float(starts[east])
                if turns[west] != side and x_m[1] > seen_m[0] and x_m[0] < seen_m[1]:
                    free_m = tuple((float(starts[k]), float(ends[k])) for k in range(west + 1, east))
                    yield Frontage(streets.main, streets.territory, x_m, side, streets.kerb_m, free_m)
        for index in np.flatnonzero(turns).tolist():
            if seen_m[0] < streets.junctions_m[index] < seen_m[1]:
                yield self._corner(index)

    def _corner(self, index: int) -> Frontage:
        """The block between the two streets that meet the main street in a turn."""
        street, half_m = self._streets.crossing[index], float(self._streets.cross_kerbs_m[index])
        kerb_m = float(self._streets.cross_lanes_each_way[index]) * self._section.lane_m + GUTTER_M
        side = int(self._streets.course.turns[index])
        x = np.arange(-half_m - BLOCK_DEPTH_M, half_m + BLOCK_DEPTH_M, PIECE_M)
        ours = np.all([self._is_opposite(index, x, side * (kerb_m + y)) for y in (0.0, CORNER_M)], axis=0)
        before, behind = x[~ours & (x < 0.0)], x[~ours & (x > 0.0)]
        x_m = float(np.append(before, x[0]).max()) + PIECE_M, float(np.append(behind, x[-1]).min()) - PIECE_M
        territory = Territory(street, (x_m[0] - GROUND_M, x_m[1] + GROUND_M))
        return Frontage(street, territory, x_m, side, kerb_m, ((-half_m, half_m),), index)

    def _is_opposite(self, index: int, x: Numbers, y: float | Numbers) -> NDArray[np.bool_]:
        """(N,) whether places beside the streets that meet the main street in a turn are nearest to that turn."""
        nearest = self._streets.territory.nearest(self._streets.crossing[index].poses(x, y)[:, :2])
        return np.asarray(np.abs(nearest - self._streets.junctions_m[index]) <= self._streets.cross_kerbs_m[index])

    def _block(self, front: Frontage, depth_m: float) -> Mesh:
        near, far = front.kerb_m, front.kerb_m + depth_m
        if front.street.is_straight and self._hills.are_flat:
            return block(front.x_m, _sides(front.side, near, far), (0.0, PAVEMENT_M))
        x = np.linspace(*front.x_m, int(np.ceil((front.x_m[1] - front.x_m[0]) / PIECE_M)) + 1)
        wide_m = front.territory.reaches_m(x, front.side, near, far + BETWEEN_BLOCKS_M) - BETWEEN_BLOCKS_M - near
        rows = 2 if self._hills.are_flat else int(np.ceil(depth_m / (2 * PIECE_M))) + 1
        y = near + np.linspace(0.0, 1.0, rows) * np.maximum(wide_m, NARROWEST_M)[:, None]
        net = np.stack(np.broadcast_arrays(x[:, None], front.side * y), axis=-1)
        return slab(net if front.side == 1 else net[:, ::-1], (0.0, PAVEMENT_M))

    def _owned(self, front: Frontage, pieces: list[Mesh]) -> list[Mesh]:
        """Those that do not stand on what belongs to another stretch of street."""
        if front.street.is_straight or not pieces:
            return pieces
        corners = np.array([_corners(piece) for piece in pieces]).reshape(-1, 2)
        owned = front.territory.owns(*corners.T)
        if front.opposite is not None:
            owned &= self._is_opposite(front.opposite, *corners.T)
        return [piece for piece, own in zip(pieces, owned.reshape(-1, 4).all(axis=1), strict=True) if own]

    def _bent(self, front: Frontage, pieces: list[Mesh], bottom_m: float) -> list[Mesh]:
        """Bodies that were made beside a straight street, where they belong.

        Args:
            front: Where they stand.
            pieces: The bodies.
            bottom_m: What of them is not higher than this stands on something, and goes on below.
        """
        if (front.street.is_straight and self._hills.are_flat) or not pieces:
            return pieces
        (merged,) = few(pieces)
        station, left, height = merged.vertices_m.T
        places_m = front.street.poses(station, left)[:, :2]
        foot_m = 0.0 if self._hills.are_flat else FOOT_M
        height = height + self._hills.heights_m(places_m) - np.where(height <= bottom_m, foot_m, 0.0)
        return [Mesh(np.column_stack([places_m, height]), merged.faces)]

    def _facade(self, front: Frontage) -> list[Mesh]:
        """A row of houses along the street, set back, with gaps between some."""
        buildings = []
        sidewalk = self._section.sidewalk_m
        x, end = front.x_m[0] + sidewalk, front.x_m[1] - sidewalk
        while end - x > 9.0:
            width = self._uniform(10.0, 26.0)
            width = width if end - x - width > 9.0 else end - x
            # Walls are straight: on the outside of a curve their middle comes nearer to the street.
            curvature = np.abs(front.street.curvatures(np.linspace(x, x + width, 5))).max()
            near = front.kerb_m + sidewalk + self._uniform(0.0, 2.0) + float(curvature) * width**2 / 8
            depth, height = self._uniform(10.0, 15.0), self._uniform(5.0, 26.0)
            if not any(x < last and x + width > first for first, last in front.free_m):
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
        x = front.x_m[0]
        while x < front.x_m[1]:
            foot = x, front.side * (behind_m + self._uniform(*VERGE_TREES_M))
            pieces += tree(foot, 0.0, self._uniform(1.0, 3.0), self._uniform(5.0, 11.0), self._uniform(1.0, 2.0))
            x += self._uniform(*VERGE_TREE_EVERY_M)
        return pieces

    def _park(self, front: Frontage) -> None:
        """Cars at the kerb, in the direction of the traffic beside them."""
        if not self._section.bay_m:
            return
        x, end = front.x_m[0] + FREE_AT_CORNERS_M, front.x_m[1] - FREE_AT_CORNERS_M
        while x < end:
            kind = self._fleet.draw_kind(PARKED)
            length = self._fleet.length_m(kind) + PARKED_GAP_M + self._uniform(0.0, 0.5)
            if self._generator.random() < self._parked_share and x + length < end:
                slack = max((self._section.bay_m - self._fleet.width_m(kind)) / 2 - 0.08, 0.0)
                y = front.side * (self._section.bays_m + self._uniform(0.0, slack))
                yaw = (0.0 if front.side == -1 else 180.0) + self._uniform(-0.4, 0.4)
                if self._is_free(front, (x, x + length)):
                    self._place(kind, front.street.poses(x + length / 2, y), yaw)
            x += length

    def _place(self, kind: str, pose: Numbers, yaw_deg: float) -> None:
        yaw_deg += float(pose[2])
        tilts_deg = self._hills.tilts_deg(pose[:2], np.array(yaw_deg))
        height_m = float(self._hills.heights_m(pose[:2]))
        place = (float(pose[0]), float(pose[1]), yaw_deg)
        self._fleet.park(kind, place, height_m, (float(tilts_deg[0]), float(tilts_deg[1])))

    def _is_free(self, front: Frontage, x_m: Bounds) -> bool:
        """Whether something may stand from one station to another."""
        return not any(
            x_m[0] < last + FREE_AT_CORNERS_M and x_m[1] > first - FREE_AT_CORNERS_M for first, last in front.free_m
        )

    def _uniform(self, low: float, high: float) -> float:
        return float(self._generator.uniform(low, high))


def _corners(piece: Mesh) -> Numbers:
    """(4, 2) of the rectangle around a body in plan."""
    (x0, y0), (x1, y1) = piece.vertices_m[:, :2].min(axis=0), piece.vertices_m[:, :2].max(axis=0)
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _sides(side: int, near_m: float, far_m: float) -> Bounds:
    """Bounds in y of what lies between two distances from the middle, on the left (1) or on the right (-1)."""
    return (near_m, far_m) if side == 1 else (-far_m, -near_m)
