"""What stands along the streets of a city: blocks 0.15 m up, what stands on and beside them, parked cars."""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely

from torchcover.geometry.arrays import Float64
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.traffic.alignment import Alignment, StreetCorridor
from torchcover.simulation.traffic.fleet import Fleet
from torchcover.simulation.traffic.frontage import RoadsideDensity, StreetSide, Zone, place_scenery
from torchcover.simulation.traffic.hills import BlockParams, Bounds, BuildingSite, Hills
from torchcover.simulation.traffic.scenery import Scenery, build_ground_plane, build_sidewalk, merge_by_kind
from torchcover.simulation.traffic.streets import STREETS, StreetPlan

BLOCK_DEPTH_M = 95.0
# Crossings and the sight of those who wait there stay free: of parked cars, and of furniture.
FREE_AT_CORNERS_M, FREE_AT_ENDS_M = 9.0, 5.0
PARKED_GAP_M = 0.9
LANE_SIDE_M = 2.2
PARKED = {"suv": 3.0, "sedan": 3.0, "hatchback": 3.0, "pickup": 0.8, "van": 1.0}
# The block between two streets that meet the main street where it turns.
CORNER_M, CORNER_DEPTH_M, LANES_M = 100.0, 70.0, 130.0
# Half of the width that a gap between pavements has at most.
WEDGE_M = 10.0
APART_M, SNAPPED_M = 1e-3, 1e-4
# Streets in plan: corners so far apart, and a little narrower than they are, for those are on their curves' chords.
STREET_EVERY_M, WITHIN_M = 4.0, 0.2
# Beyond a sensor's range the ground goes on a little.
GROUND_M = 320.0
WAY_EVERY_M = 40.0


class Frontage(NamedTuple):
    """One side of a street between two stations, behind the curb.

    `side` is 1 on the left and -1 on the right. The street turns towards this side within `turn_spans_m`.
    `junction_indices` are the junctions at both ends; empty for a block between two streets that meet in a turn.
    """

    span_m: Bounds
    side: int
    curb_offset_m: float
    turn_spans_m: tuple[Bounds, ...] = ()
    junction_indices: tuple[int, ...] = ()


class CityBuilder(NamedTuple):
    """Builder of the part of a city around the path of the ego vehicle, with parked cars."""

    streets: StreetPlan
    corridor: StreetCorridor
    hills: Hills
    fleet: Fleet
    parked_share: float
    built_share: float
    roadside_density: RoadsideDensity
    generator: np.random.Generator
    layout_generator: np.random.Generator

    def build_static_scenery(self, visible_span_m: Bounds) -> Scenery:
        """The ground, the blocks, buildings and furniture; cars are parked among them."""
        main = BuildingSite(
            self.streets.main_alignment,
            self.corridor,
            self.hills,
            self.streets.cross_section.curb_offset_m + BLOCK_DEPTH_M + 10.0,
        )
        fronts = [(main, front) for front in self._frontages(visible_span_m)]
        turns = ~self.streets.has_lights & (
            np.abs(self.streets.junction_stations_m - np.mean(visible_span_m)) < np.ptp(visible_span_m) / 2
        )
        fronts += [self._corner(index) for index in np.flatnonzero(turns).tolist()]
        blocks, outlines, aprons, sides = [], [], list[shapely.Geometry](), list[StreetSide]()
        for site, front in fronts:
            is_built = self.built_share == 1.0 or self.layout_generator.random() < self.built_share
            depth_m = BLOCK_DEPTH_M if front.junction_indices else CORNER_DEPTH_M
            depth_m = depth_m if is_built else self.streets.cross_section.sidewalk_width_m
            block, outline = site.build_block(front.span_m, front.side, front.curb_offset_m, depth_m)
            blocks.append(block)
            outlines.append(outline)
            zone: Zone = "built" if is_built else "open"
            sides += self._sides(site.street, front, zone)
            for end in range(len(front.junction_indices)):
                edge_m, apron = self._end(site, front, end, is_built)
                aprons += apron
                sides += _across(
                    edge_m if front.side == 1 - 2 * end else edge_m[::-1],
                    self.streets.cross_section.sidewalk_width_m,
                    zone,
                )
        driven, walked = self._in_plan()
        nets, whole = shapely.union_all(outlines), shapely.union_all([*outlines, *aprons], grid_size=SNAPPED_M)
        if not self.streets.main_alignment.is_straight:
            aprons.append(self._between(whole, shapely.union_all(driven)))
            whole = shapely.union_all([whole, aprons[-1]], grid_size=SNAPPED_M)
        # A little apart, so that no outline meets itself.
        rest = shapely.union_all(aprons, grid_size=SNAPPED_M).difference(nets).buffer(-APART_M, join_style="bevel")
        rest = shapely.get_parts(shapely.set_precision(rest, SNAPPED_M))
        blocks.append(build_sidewalk(shapely.segmentize(rest, BlockParams().segment_m), self.hills.compute_heights_m))
        self._park([(site, self._parked(front)) for site, front in fronts])
        stood = place_scenery(
            sides,
            driven,
            walked,
            shapely.get_parts(whole),
            self.hills.compute_heights_m,
            self.roadside_density,
            self.generator,
        )
        pavements = merge_by_kind(blocks)
        return Scenery(
            (self._ground(visible_span_m), *pavements, *merge_by_kind(*stood)), tuple(range(1 + len(pavements)))
        )

    def _in_plan(self) -> tuple[list[shapely.Geometry], list[shapely.Geometry]]:
        """All streets, without and with the sidewalks along them."""
        stations_m = [self.corridor.sample_stations_m(STREET_EVERY_M)]
        bodies_m = self.streets.cross_street_spans_m + np.array([-STREETS.half_vehicle_m, STREETS.half_vehicle_m])
        for street, ends_m in zip(self.streets.cross_streets, bodies_m, strict=True):
            stations_m.append(ends_m if street.is_straight else np.arange(-LANES_M, LANES_M, STREET_EVERY_M))
        streets = zip([self.streets.main_alignment, *self.streets.cross_streets], stations_m, strict=True)
        lines = [shapely.LineString(street.compute_poses(along_m, 0.0)[:, :2]) for street, along_m in streets]
        lines = shapely.simplify(lines, WITHIN_M / 4)
        half_m = [self.streets.cross_section.curb_offset_m, *self.streets.cross_curb_offsets_m.tolist()]
        driven, walked = (
            shapely.buffer(lines, np.array(half_m) - WITHIN_M + wider_m, cap_style="flat").tolist()
            for wider_m in (0.0, self.streets.cross_section.sidewalk_width_m)
        )
        return driven, walked

    def _sides(self, street: Alignment, front: Frontage, zone: Zone) -> Iterator[StreetSide]:
        """Along its street: at the kerb, and behind the sidewalk."""
        (first, last), sidewalk_m = front.span_m, self.streets.cross_section.sidewalk_width_m
        yield StreetSide(
            "kerb", _beside(street, (first + FREE_AT_ENDS_M, last - FREE_AT_ENDS_M), front.side * front.curb_offset_m)
        )
        edges = [first + sidewalk_m, *(edge for turn_m in front.turn_spans_m for edge in turn_m), last - sidewalk_m]
        for number, x_m in enumerate(pairwise(edges)):
            if x_m[1] > x_m[0] and not (number % 2 and front.junction_indices):
                # In a turn there is no room for houses.
                yield StreetSide(
                    "open" if number % 2 else zone,
                    _beside(street, x_m, front.side * (front.curb_offset_m + sidewalk_m)),
                )

    def _end(
        self, site: BuildingSite, front: Frontage, end: int, is_built: bool
    ) -> tuple[Float64, list[shapely.Geometry]]:
        """(2, 2) the kerb of the cross street at the beginning (0) or the end (1) of a block, and pavement along it.

        Where the main street turns away, its sidewalk goes on around the turn, and the block as far as the street that
        goes straight on.
        """
        index, corner_m, inwards = front.junction_indices[end], front.span_m[end], 1 - 2 * end
        deep_m = float(site.compute_depths_m(np.array([corner_m]), front.side, front.curb_offset_m, BLOCK_DEPTH_M)[0])
        y_m = front.side * (
            front.curb_offset_m + np.array([0.0, FREE_AT_CORNERS_M, max(deep_m, 2 * FREE_AT_CORNERS_M)])
        )
        face_m, sidewalk_m = (
            site.street.compute_poses(corner_m, y_m)[:, :2],
            self.streets.cross_section.sidewalk_width_m,
        )
        inside_m = -inwards * front.side * sidewalk_m
        if not self.streets.main_street.turn_directions[index]:
            return face_m[1:], [] if is_built else [_strip(face_m, inside_m)]
        middle_m, half_m = (
            float(self.streets.junction_stations_m[index]),
            float(self.streets.main_street.junction_half_lengths_m[index]),
        )
        around_m = site.street.compute_poses(np.linspace(corner_m, middle_m, 17), front.side * front.curb_offset_m)[
            :, :2
        ]
        way_m, kerb_m = np.linspace(-half_m, half_m + CORNER_M, 97), float(self.streets.cross_curb_offsets_m[index])
        line_m = self.streets.cross_streets[index].compute_poses(-inwards * way_m, 0.0)[:, :2]
        ahead = (line_m[-1] - line_m[-2]) / np.linalg.norm(line_m[-1] - line_m[-2])
        onto_m = line_m[-1] + ((face_m[1:] - line_m[-1]) @ ahead)[:, None] * ahead
        opposite_m = line_m[(way_m >= 0.0) & ((line_m - onto_m[-1]) @ ahead < 0.0)]
        area = shapely.Polygon(np.concatenate([face_m[::-1], around_m, opposite_m, onto_m[1:]])).buffer(0)
        street = shapely.LineString(line_m)
        area = area.difference(street.buffer(kerb_m, cap_style="flat"))
        if not is_built:
            area = area.intersection(street.buffer(kerb_m + sidewalk_m))
        left_m = inwards * int(self.streets.main_street.turn_directions[index]) * kerb_m
        return onto_m + left_m * np.array([-ahead[1], ahead[0]]), [area, _strip(around_m, inside_m)]

    def _between(self, whole: shapely.Geometry, streets: shapely.Geometry) -> shapely.Geometry:
        """In plan, what is narrow between pavements but no street: wedges, and where the main street comes back."""
        with np.errstate(all="ignore"):  # of what GEOS divides by zero in passing, nothing remains
            closed = whole.buffer(WEDGE_M, join_style="mitre").buffer(-WEDGE_M, join_style="mitre")
        between = closed.difference(streets.buffer(2 * WITHIN_M, join_style="bevel")).difference(whole)
        return between.buffer(-WITHIN_M, join_style="bevel").buffer(WITHIN_M, join_style="bevel")

    def _ground(self, seen_m: Bounds) -> Mesh:
        """Under everything: as far as lanes go, or as far as it can be seen."""
        if self.hills.is_flat:
            reach = self.streets.half_length_m + 200.0
            return build_ground_plane((-reach, -reach), (reach, reach))
        way_m = self.streets.main_alignment.compute_poses(np.arange(*seen_m, WAY_EVERY_M), 0.0)[:, :2]
        return self.hills.build_mesh(way_m, GROUND_M)

    def _frontages(self, seen_m: Bounds) -> Iterator[Frontage]:
        """Both sides of the main street from kerb to kerb."""
        turns, middles, halves = (
            self.streets.main_street.turn_directions,
            self.streets.junction_stations_m,
            self.streets.main_street.junction_half_lengths_m,
        )
        starts, ends = (middles - halves).tolist(), (middles + halves).tolist()
        for west in range(len(turns) - 1):
            for side in (1, -1):
                # No street comes from the inside of a turn: the block goes on.
                east = west + 1
                while turns[east] == side:
                    east += 1
                if turns[west] != side and starts[east] > seen_m[0] and ends[west] < seen_m[1]:
                    turns_m = tuple((starts[k], ends[k]) for k in range(west + 1, east))
                    yield Frontage(
                        (ends[west], starts[east]),
                        side,
                        self.streets.cross_section.curb_offset_m,
                        turns_m,
                        (west, east),
                    )

    def _corner(self, index: int) -> tuple[BuildingSite, Frontage]:
        """The block between the two streets that meet the main street in a turn."""
        street, half_m = (
            self.streets.cross_streets[index],
            float(self.streets.main_street.junction_half_lengths_m[index]),
        )
        kerb_m = float(self.streets.cross_curb_offsets_m[index])
        side, middle_m = (
            int(self.streets.main_street.turn_directions[index]),
            float(self.streets.junction_stations_m[index]),
        )
        span_m = (-half_m - CORNER_M, half_m + CORNER_M)
        site = BuildingSite(street, StreetCorridor(street, span_m), self.hills, kerb_m + CORNER_DEPTH_M + 10.0)
        # As far as it is opposite of the turn, and not of another one.
        x = np.arange(*span_m, 5.0)
        foreign = np.zeros(len(x), dtype=bool)
        for y in (kerb_m, kerb_m + CORNER_DEPTH_M):
            nearest_m = self.corridor.find_nearest_stations_m(street.compute_poses(x, side * y)[:, :2])
            foreign |= np.abs(nearest_m - middle_m) > half_m + self.corridor.sample_spacing_m
        foreign &= np.abs(x) > half_m
        before, behind = x[foreign & (x < 0.0)], x[foreign & (x > 0.0)]
        x_m = max([span_m[0], *before.tolist()]) + 5.0, min([span_m[1], *behind.tolist()]) - 5.0
        return site, Frontage(x_m, side, kerb_m, ((-half_m, half_m),))

    def _parked(self, front: Frontage) -> list[tuple[str, float, float, float]]:
        """Cars at the kerb, in the direction of the traffic beside them: kind, x, y, and yaw in degrees.

        Nobody drives along the streets that meet the main street in a turn: there they are parked on the lanes.
        """
        cars: list[tuple[str, float, float, float]] = []
        uniform, free_m = self.generator.uniform, FREE_AT_CORNERS_M
        bay_m = self.streets.cross_section.bay_width_m if front.junction_indices else LANE_SIDE_M
        x, end = front.span_m[0] + FREE_AT_CORNERS_M, front.span_m[1] - FREE_AT_CORNERS_M
        while x < end and bay_m:
            kind = self.fleet.sample_kind(PARKED)
            length = self.fleet.get_length_m(kind) + PARKED_GAP_M + uniform(0.0, 0.5)
            if self.generator.random() < self.parked_share and x + length < end:
                slack = max((bay_m - self.fleet.get_width_m(kind)) / 2 - 0.08, 0.0)
                y = front.side * (front.curb_offset_m - bay_m / 2 + uniform(0.0, slack))
                yaw = (0.0 if front.side == -1 else 180.0) + uniform(-0.4, 0.4)
                if all(x >= last + free_m or x + length <= first - free_m for first, last in front.turn_spans_m):
                    cars.append((kind, x + length / 2, y, yaw))
            x += length
        return cars

    def _park(self, cars: list[tuple[BuildingSite, list[tuple[str, float, float, float]]]]) -> None:
        kinds: list[str] = []
        found: list[Float64] = []
        for site, of_front in cars:
            if of_front:
                names, x_m, y_m, yaw_deg = zip(*of_front, strict=True)
                kinds += names
                found.append(site.street.compute_poses(x_m, np.array(y_m)) + np.outer(yaw_deg, (0.0, 0.0, 1.0)))
        if not kinds:
            return
        poses = np.concatenate(found)
        stances = self.hills.compute_heights_and_tilts(poses[:, :2], poses[:, 2])
        for kind, (x, y, yaw), (height_m, *tilt_deg) in zip(kinds, poses.tolist(), stances.tolist(), strict=True):
            self.fleet.add_parked_vehicle(kind, (x, y, yaw), height_m, (tilt_deg[0], tilt_deg[1]))


def _strip(line_m: Float64, left_m: float) -> shapely.Geometry:
    """What lies on the left of a line, up to so far."""
    return shapely.buffer(shapely.LineString(line_m), left_m, single_sided=True, join_style="mitre")


def _across(kerb_m: Float64, sidewalk_m: float, zone: Zone) -> Iterator[StreetSide]:
    """Along a cross street, whose kerb has the street on its left: at the kerb, and behind the sidewalk."""
    ahead = (kerb_m[1] - kerb_m[0]) / np.linalg.norm(kerb_m[1] - kerb_m[0])
    yield StreetSide("kerb", kerb_m)
    yield StreetSide(zone, kerb_m + sidewalk_m * np.array([ahead[1], -ahead[0]]))


def _beside(street: Alignment, x_m: Bounds, left_m: float) -> Float64:
    """(K, 2) places beside a street, with the street on their left."""
    pieces = 1 if street.is_straight else int(np.ceil((x_m[1] - x_m[0]) / STREET_EVERY_M))
    points_m: Float64 = street.compute_poses(np.linspace(*x_m, pieces + 1), left_m)[:, :2]
    return points_m if left_m < 0 else points_m[::-1]
