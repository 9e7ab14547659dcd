"""What stands along streets: houses, fences, trees and lamp posts."""

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from torchcover.simulation.height_field import Ground
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sumo.network import NetworkLane
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.roads import Polyline
from torchcover.simulation.traffic.scenery import few, post, prism, tree

Numbers = NDArray[np.float64]

WIDTH_M, DEPTH_M, HEIGHT_M = (9.0, 24.0), (9.0, 15.0), (5.0, 24.0)
SET_BACK_M, GAP_M = (0.8, 6.0), (0.3, 6.0)
PIECE_EVERY_M = (9.0, 20.0)
LAMP_SHARE = 0.35
LAMP_RADIUS_M, CROWN_M = 0.1, (1.0, 1.6)
FENCE_SHARE, FENCE_AT_M, FENCE_M, FENCE_PIECE_M = 0.6, 2.5, (0.9, 1.8), 3.0
FENCE_THICK_M = 0.08
CLEAR_BELOW_CROWN_M, TREE_M = (2.8, 3.4), (5.0, 8.5)
# Nothing stands nearer to a lane than this.
CLEAR_M = 0.4
SUNK_M = 1.0


class StreetScenery:
    """Draws what stands along the streets."""

    def __init__(self, vicinity: Vicinity, ground: Ground, built_share: float, generator: np.random.Generator) -> None:
        self._vicinity = vicinity
        self._ground = ground
        self._built_share = built_share
        self._generator = generator
        self._taken = shapely.STRtree(shapely.buffer(vicinity.covered, CLEAR_M))

    def meshes(self) -> tuple[Mesh, ...]:
        """Houses in one mesh, fences, trees and lamp posts in another."""
        sides = list(self._sides())
        lots = [self._lots(side) for side in sides]
        houses_m = self._free(np.concatenate([np.empty((0, 4, 2)), *(built for built, _ in lots)]))
        gaps = [(side, *gap) for side, (_, open_m) in zip(sides, lots, strict=True) for gap in open_m]
        return few(self._houses(houses_m), [*self._fences(gaps, houses_m), *self._trees_and_lamps(sides, houses_m)])

    def _sides(self) -> Iterator[Polyline]:
        """The outer edges of streets, so that what stands along them is on the right."""
        of_edge: dict[str, list[NetworkLane]] = {}
        for number, lane in enumerate(self._vicinity.lanes):
            if lane.use in ("road", "bay", "shoulder", "sidewalk") and number not in self._vicinity.decks:
                of_edge.setdefault(lane.edge, []).append(lane)
        inwards = -1 if self._vicinity.left_hand else 1
        for lanes in of_edge.values():
            for lane, left in ((lanes[0], -inwards), (lanes[-1], inwards)):
                side = Polyline(lane.line_m[:, :2]).shifted(left * lane.width_m / 2)
                side = side.reversed() if left > 0 else side
                # Next to the innermost lane there are those of the other direction, unless it is a one-way street.
                beside = _right_of(side.poses(side.length_m / 2), 2 * CLEAR_M + 0.5)
                if lane is lanes[0] or len(self._taken.query(shapely.Point(beside), predicate="intersects")) == 0:
                    yield side

    def _lots(self, side: Polyline) -> tuple[Numbers, list[tuple[float, float]]]:
        """(N, 4, 2) outlines of houses along a side, counter-clockwise; from where to where there is none."""
        lots, open_m, way_m = [], [], self._drawn((0.0, 5.0))
        while way_m < side.length_m:
            end_m, front_m = way_m + self._drawn(WIDTH_M), self._drawn(SET_BACK_M)
            if self._generator.random() < self._built_share and end_m < side.length_m:
                lots.append((way_m, end_m, front_m, front_m + self._drawn(DEPTH_M)))
            elif end_m < side.length_m:
                open_m.append((way_m, end_m))
            way_m = end_m + self._drawn(GAP_M)
        start_m, end, front, back = np.array(lots).reshape(-1, 4).T
        corner_m, other_m = side.poses(start_m), side.poses(end)
        # A house has straight walls, whatever the street does.
        corner_m[:, 2] = other_m[:, 2] = np.rad2deg(np.arctan2(*(other_m - corner_m)[:, 1::-1].T))
        corners = ((corner_m, back), (other_m, back), (other_m, front), (corner_m, front))
        return np.stack([_right_of(poses, right_m[:, None]) for poses, right_m in corners], axis=1), open_m

    def _free(self, outlines_m: Numbers) -> Numbers:
        """Those that stand neither on a street nor in one that came before."""
        # Farther away there may be streets that are unknown here.
        outlines_m = outlines_m[self._vicinity.sees(outlines_m.reshape(-1, 2)).reshape(-1, 4).all(axis=1)]
        polygons = shapely.polygons(outlines_m)
        free = np.ones(len(polygons), dtype=bool)
        free[self._taken.query(polygons, predicate="intersects")[0]] = False
        later, earlier = shapely.STRtree(polygons).query(polygons, predicate="intersects")
        for one, other in sorted(zip(later.tolist(), earlier.tolist(), strict=True)):
            if other < one and free[other]:
                free[one] = False
        return outlines_m[free]

    def _houses(self, outlines_m: Numbers) -> list[Mesh]:
        heights_m = self._ground.heights_m(outlines_m.reshape(-1, 2)).reshape(-1, 4)
        tops_m = heights_m.max(axis=1) + self._generator.uniform(*HEIGHT_M, len(heights_m))
        bottoms_m = heights_m.min(axis=1) - SUNK_M
        levels = zip(bottoms_m.tolist(), tops_m.tolist(), strict=True)
        return [prism([outline, outline], level) for outline, level in zip(outlines_m, levels, strict=True)]

    def _fences(self, gaps: list[tuple[Polyline, float, float]], houses_m: Numbers) -> list[Mesh]:
        """Where nobody built, in a town: straight pieces that follow the street."""
        outlines_m, heights_m = [np.empty((0, 4, 2))], []
        for side, from_m, to_m in gaps:
            if self._built_share == 0 or self._generator.random() >= FENCE_SHARE:
                continue
            poses = side.poses(np.linspace(from_m, to_m, 1 + max(round((to_m - from_m) / FENCE_PIECE_M), 1)))
            near_m, far_m = (_right_of(poses, FENCE_AT_M + thick_m) for thick_m in (0.0, FENCE_THICK_M))
            outlines_m.append(np.stack([far_m[:-1], far_m[1:], near_m[1:], near_m[:-1]], axis=1))
            heights_m += [self._drawn(FENCE_M)] * (len(poses) - 1)
        outlines = np.concatenate(outlines_m)
        polygons = shapely.polygons(outlines)
        free = np.all(self._vicinity.sees(outlines.reshape(-1, 2)).reshape(-1, 4), axis=1)
        for others in (self._taken, shapely.STRtree(shapely.polygons(houses_m))):
            free[others.query(polygons, predicate="intersects")[0]] = False
        on_m = self._ground.heights_m(outlines.reshape(-1, 2)).reshape(-1, 4)
        levels = np.stack([on_m.min(axis=1) - SUNK_M, on_m.max(axis=1) + np.array(heights_m)], axis=1)
        return [prism([outlines[k], outlines[k]], levels[k].tolist()) for k in np.flatnonzero(free).tolist()]

    def _trees_and_lamps(self, sides: list[Polyline], houses_m: Numbers) -> list[Mesh]:
        """Between the streets and the houses, where there is room."""
        poses, radii = [np.empty((0, 3))], []
        for side in sides:
            ways_m = np.cumsum(self._generator.uniform(*PIECE_EVERY_M, int(side.length_m / PIECE_EVERY_M[0])))
            ways_m = ways_m[ways_m < side.length_m]
            is_lamp = self._generator.random(len(ways_m)) < LAMP_SHARE
            own = np.where(is_lamp, LAMP_RADIUS_M, self._generator.uniform(*CROWN_M, len(ways_m)))
            there = side.poses(ways_m)
            there[:, :2] = _right_of(there, (CLEAR_M + 0.1 + own)[:, None])
            keep = ~is_lamp | (self._built_share > 0)
            poses.append(there[keep])
            radii.append(own[keep])
        feet = np.concatenate(poses)
        radius_m = np.concatenate([np.empty(0), *radii])
        around = shapely.buffer(shapely.points(feet[:, :2]), radius_m, quad_segs=2)
        free = np.ones(len(feet), dtype=bool)
        for others in (self._taken, shapely.STRtree(shapely.polygons(houses_m))):
            free[others.query(around, predicate="intersects")[0]] = False
        feet, radius_m = feet[free], radius_m[free]
        heights_m = self._ground.heights_m(feet[:, :2])
        pieces: list[Mesh] = []
        for foot, radius, height in zip(feet, radius_m.tolist(), heights_m.tolist(), strict=True):
            if radius == LAMP_RADIUS_M:
                pieces += _lamp(foot, height)
            else:
                clear_m, top_m = self._drawn(CLEAR_BELOW_CROWN_M), self._drawn(TREE_M)
                pieces += tree(foot[:2], height, clear_m, top_m, radius)
        return pieces

    def _drawn(self, bounds: tuple[float, float]) -> float:
        return float(self._generator.uniform(*bounds))


def _lamp(pose: Numbers, height_m: float) -> list[Mesh]:
    """A post with an arm over the street, which is on its left."""
    yaw = np.deg2rad(pose[2])
    along, left = 0.06 * np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    ends = [pose[:2] - along - 0.1 * left, pose[:2] + along - 0.1 * left]
    arm = [*ends, *(end + 2.1 * left for end in ends[::-1])]
    return [post(pose[:2], 0.09, height_m, 7.0), prism([arm, arm], [height_m + 7.05, height_m + 7.2])]


def _right_of(poses: Numbers, right_m: float | Numbers) -> Numbers:
    """(..., 2) places to the right of (..., 3) poses x, y, yaw."""
    yaw = np.deg2rad(poses[..., 2])
    there: Numbers = poses[..., :2] + right_m * np.stack([np.sin(yaw), -np.cos(yaw)], axis=-1)
    return there
