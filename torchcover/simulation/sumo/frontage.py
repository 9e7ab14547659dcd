"""What stands along streets: houses, trees, lamp posts; and the cars in the bays."""

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.ground import Ground, tilts_deg
from torchcover.simulation.sumo.network import Lane
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.city import FREE_AT_CORNERS_M, PARKED, PARKED_GAP_M
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.scenery import few, post, prism, tree

Numbers = NDArray[np.float64]

WIDTH_M, DEPTH_M, HEIGHT_M = (9.0, 24.0), (9.0, 15.0), (5.0, 24.0)
SET_BACK_M, GAP_M = (0.8, 6.0), (0.3, 6.0)
PIECE_EVERY_M = (9.0, 20.0)
# Nothing stands nearer to a lane than this.
CLEAR_M = 0.4
SUNK_M = 1.0
LAMP_SHARE = 0.35
CROWN_M = (1.0, 1.6)


class Frontage:
    """Draws what stands along the streets.

    Args:
        vicinity: The streets.
        ground: What it stands on.
        built_share: Share of the frontage that has houses; 0 is open country.
        generator: Draws everything.
    """

    def __init__(self, vicinity: Vicinity, ground: Ground, built_share: float, generator: np.random.Generator) -> None:
        self._vicinity = vicinity
        self._ground = ground
        self._built_share = built_share
        self._generator = generator
        self._taken = shapely.STRtree(shapely.buffer(vicinity.covered, CLEAR_M))

    def meshes(self) -> tuple[Mesh, ...]:
        """Houses in one mesh, trees and lamp posts in another."""
        edges = list(self._edges())
        lots = [lot for edge in edges for lot in self._lots(*edge)]
        houses_m = self._free(np.array(lots).reshape(-1, 4, 2))
        walls = shapely.STRtree(shapely.polygons(houses_m))
        pieces = [piece for edge in edges for piece in self._pieces(*edge, walls)]
        return few([self._house(outline_m) for outline_m in houses_m], pieces)

    def _edges(self) -> Iterator[tuple[Numbers, Numbers]]:
        """(K, 2) the outer edges of the outermost lanes, on both sides of each street, and (K,) ways along them."""
        outer: dict[str, tuple[Lane, float]] = {}
        for number, lane in enumerate(self._vicinity.lanes):
            if lane.use in ("road", "bay", "sidewalk") and number not in self._vicinity.decks:
                outer.setdefault(lane.edge, (lane, -1.0 if not self._vicinity.left_hand else 1.0))
        for lane, side in outer.values():
            line_m = lane.line_m[:, :2]
            steps = np.gradient(line_m, axis=0)
            left = np.stack([-steps[:, 1], steps[:, 0]], axis=1) / np.linalg.norm(steps, axis=1, keepdims=True)
            edge_m = line_m + side * lane.width_m / 2 * left
            # Houses are on the right side of what is drawn here.
            edge_m = edge_m if side < 0 else edge_m[::-1]
            ways_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(edge_m, axis=0), axis=1))])
            yield edge_m, ways_m

    def _lots(self, edge_m: Numbers, ways_m: Numbers) -> Iterator[Numbers]:
        """(4, 2) outlines of houses along an edge, counter-clockwise."""
        way_m = self._drawn((0.0, 5.0))
        while way_m < ways_m[-1]:
            width_m = self._drawn(WIDTH_M)
            start_m, end_m = (_at(edge_m, ways_m, at_m) for at_m in (way_m, way_m + width_m))
            front_m, back_m = (set_back := self._drawn(SET_BACK_M)), set_back + self._drawn(DEPTH_M)
            built = self._generator.random() < self._built_share
            along = end_m - start_m
            if built and np.linalg.norm(along) > WIDTH_M[0] / 2:
                along /= np.linalg.norm(along)
                right = np.array([along[1], -along[0]])
                yield np.stack([
                    start_m + back_m * right, end_m + back_m * right, end_m + front_m * right, start_m + front_m * right
                ])  # fmt: skip
            way_m += width_m + self._drawn(GAP_M)

    def _free(self, outlines_m: Numbers) -> Numbers:
        """Those that stand neither on a street nor in one that came before."""
        polygons = shapely.polygons(outlines_m)
        free = np.ones(len(polygons), dtype=bool)
        free[self._taken.query(polygons, predicate="intersects")[0]] = False
        later, earlier = shapely.STRtree(polygons).query(polygons, predicate="intersects")
        for one, other in sorted(zip(later.tolist(), earlier.tolist(), strict=True)):
            if other < one and free[other]:
                free[one] = False
        return outlines_m[free]

    def _house(self, outline_m: Numbers) -> Mesh:
        heights_m = self._ground.heights_m(outline_m)
        top_m = float(heights_m.max()) + self._drawn(HEIGHT_M)
        return prism([outline_m, outline_m], [float(heights_m.min()) - SUNK_M, top_m])

    def _pieces(self, edge_m: Numbers, ways_m: Numbers, walls: shapely.STRtree) -> Iterator[Mesh]:
        """Trees and lamp posts between the street and the houses."""
        way_m = self._drawn(PIECE_EVERY_M)
        while way_m < ways_m[-1]:
            is_lamp = self._generator.random() < LAMP_SHARE
            radius_m = 0.1 if is_lamp else self._drawn(CROWN_M)
            place_m, ahead_m = (_at(edge_m, ways_m, at_m) for at_m in (way_m, way_m + 0.5))
            along = (ahead_m - place_m) / max(float(np.linalg.norm(ahead_m - place_m)), 1e-9)
            foot_m = place_m + (CLEAR_M + 0.1 + radius_m) * np.array([along[1], -along[0]])
            way_m += self._drawn(PIECE_EVERY_M)
            around = shapely.Point(foot_m).buffer(radius_m, quad_segs=2)
            wanted = self._built_share > 0 or not is_lamp
            if wanted and not any(len(tree.query(around, predicate="intersects")) for tree in (self._taken, walls)):
                yield from self._piece(foot_m, along, None if is_lamp else radius_m)

    def _piece(self, foot_m: Numbers, along: Numbers, crown_m: float | None) -> list[Mesh]:
        height_m = float(self._ground.heights_m(foot_m[None])[0])
        if crown_m is not None:
            clear_m, top_m = self._drawn((2.8, 3.4)), self._drawn((5.0, 8.5))
            return tree(foot_m, height_m, clear_m, top_m, crown_m)
        left, half = np.array([-along[1], along[0]]), 0.06 * along
        ends = [foot_m - half - 0.1 * left, foot_m + half - 0.1 * left]
        arm = [*ends, *(end + 2.1 * left for end in ends[::-1])]
        return [post(foot_m, 0.09, height_m, 7.0), prism([arm, arm], [height_m + 7.05, height_m + 7.2])]

    def park(self, fleet: Fleet, share: float) -> None:
        """Put cars into a share of the room of the bays."""
        for lane in self._vicinity.lanes:
            if lane.use != "bay":
                continue
            line_m = lane.line_m[:, :2]
            ways_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
            way_m, end_m = FREE_AT_CORNERS_M, float(ways_m[-1]) - FREE_AT_CORNERS_M
            while way_m < end_m:
                kind = fleet.draw_kind(PARKED)
                size_m = fleet.length_m(kind), fleet.width_m(kind)
                length_m = size_m[0] + PARKED_GAP_M + self._drawn((0.0, 0.5))
                if self._generator.random() < share and way_m + length_m < end_m and size_m[1] < lane.width_m:
                    tail_m, nose_m = (_at(line_m, ways_m, at_m) for at_m in (way_m, way_m + size_m[0]))
                    place_m, along = (tail_m + nose_m)[None] / 2, nose_m - tail_m
                    yaw_deg = np.rad2deg(np.arctan2(along[1:], along[:1]))
                    tilt_deg = tilts_deg(self._ground, place_m, yaw_deg, size_m)[0]
                    height_m = float(self._ground.heights_m(place_m)[0])
                    fleet.park(kind, (*place_m[0].tolist(), float(yaw_deg[0])), height_m, (tilt_deg[0], tilt_deg[1]))
                way_m += length_m

    def _drawn(self, bounds: tuple[float, float]) -> float:
        return float(self._generator.uniform(*bounds))


def _at(line_m: Numbers, ways_m: Numbers, way_m: float) -> Numbers:
    """(2,) the place on a line after a way; beyond the end, the end."""
    return np.array([np.interp(way_m, ways_m, line_m[:, 0]), np.interp(way_m, ways_m, line_m[:, 1])])
