"""Builder of a city along a street plan: blocks with raised sidewalks, houses, roadside objects and parked cars."""

from collections.abc import Iterator
from dataclasses import dataclass
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

# Weights of the kinds of parked cars.
PARKED_KINDS = {"suv": 3.0, "sedan": 3.0, "hatchback": 3.0, "pickup": 0.8, "van": 1.0}


@dataclass(frozen=True)
class CityParams:
    """Dimensions of blocks and parking.

    Args:
        block_depth_m: Depth of a block behind the curb.
        corner_m: Length along each of the two streets of a block where the main street turns.
        corner_depth_m: Depth of such a block.
        cross_street_m: Length of these streets in the ground plane, from the junction.
        corner_clearance_m: Distance from junctions in which no car is parked, for the view of pedestrians.
        furniture_clearance_m: Distance from junctions in which no street furniture stands.
        parking_gap_m: Smallest gap between parked cars.
        parking_width_m: Width of parking on the lanes of streets without bays.
        max_gap_m: Half of the largest width of a gap between sidewalks that is filled.
        shrink_m: Reduction of outlines so that they do not touch themselves.
        grid_m: Precision of outlines.
        street_spacing_m: Distance of the vertices of streets in the ground plane.
        tolerance_m: Reduction of streets in the ground plane, since their vertices lie on chords of curves.
        ground_margin_m: Distance from the main street up to which hilly ground is built, beyond the range of sensors.
        ground_spacing_m: Distance of the stations from which this distance is measured.
    """

    block_depth_m: float = 95.0
    corner_m: float = 100.0
    corner_depth_m: float = 70.0
    cross_street_m: float = 130.0
    corner_clearance_m: float = 9.0
    furniture_clearance_m: float = 5.0
    parking_gap_m: float = 0.9
    parking_width_m: float = 2.2
    max_gap_m: float = 10.0
    shrink_m: float = 1e-3
    grid_m: float = 1e-4
    street_spacing_m: float = 4.0
    tolerance_m: float = 0.2
    ground_margin_m: float = 320.0
    ground_spacing_m: float = 40.0


CITY = CityParams()


class Frontage(NamedTuple):
    """Side of a street between two stations, behind the curb.

    Args:
        span_m: First and last station.
        side: 1 on the left, -1 on the right.
        curb_offset_m: Distance of the curb from the centerline.
        turn_spans_m: Stations between which the street turns towards this side.
        junction_indices: Junctions at both ends; empty for a block between two streets that meet in a turn.
    """

    span_m: Bounds
    side: int
    curb_offset_m: float
    turn_spans_m: tuple[Bounds, ...] = ()
    junction_indices: tuple[int, ...] = ()


class ParkedCar(NamedTuple):
    """Parked car along a street.

    Args:
        kind: Body.
        station_m: Station of its center.
        left_m: Offset of its center to the left of the centerline.
        yaw_deg: Heading relative to the street.
    """

    kind: str
    station_m: float
    left_m: float
    yaw_deg: float


class CityBuilder(NamedTuple):
    """Builder of the part of a city around the path of the ego vehicle.

    Args:
        streets: Street plan.
        corridor: Area around the main street.
        hills: Ground heights.
        fleet: Bodies; receives the parked cars.
        built_share: Share of the block sides that have houses.
        parked_share: Share of the parking bays that are occupied.
        roadside_density: Factor on the density of roadside objects, or factors for some kinds.
        generator: Random generator of objects and parked cars.
        layout_generator: Random generator of blocks.
    """

    streets: StreetPlan
    corridor: StreetCorridor
    hills: Hills
    fleet: Fleet
    built_share: float
    parked_share: float
    roadside_density: RoadsideDensity
    generator: np.random.Generator
    layout_generator: np.random.Generator

    def build_static_scenery(self, visible_span_m: Bounds) -> Scenery:
        """Build ground, blocks, houses and roadside objects, and park the cars.

        Args:
            visible_span_m: First and last visible station of the main street.
        """
        sidewalk_m = self.streets.cross_section.sidewalk_width_m
        blocks, outlines = [], []
        aprons: list[shapely.Geometry] = []
        sides: list[StreetSide] = []
        frontages = self._list_frontages(visible_span_m)
        for site, frontage in frontages:
            is_built = self.built_share == 1.0 or self.layout_generator.random() < self.built_share
            depth_m = CITY.block_depth_m if frontage.junction_indices else CITY.corner_depth_m
            depth_m = depth_m if is_built else sidewalk_m
            block, outline = site.build_block(frontage.span_m, frontage.side, frontage.curb_offset_m, depth_m)
            blocks.append(block)
            outlines.append(outline)
            zone: Zone = "built" if is_built else "open"
            sides += self._iterate_street_sides(site.street, frontage, zone)
            for end in range(len(frontage.junction_indices)):
                curb_m, end_aprons = self._build_end(site, frontage, end, is_built)
                aprons += end_aprons
                curb_m = curb_m if frontage.side == 1 - 2 * end else curb_m[::-1]
                sides += build_cross_street_sides(curb_m, sidewalk_m, zone)
        # Aprons fill the areas between blocks and cross streets, and narrow gaps.
        streets, streets_with_sidewalks = self._build_street_areas()
        blocks_area = shapely.union_all(outlines)
        sidewalks = shapely.union_all([*outlines, *aprons], grid_size=CITY.grid_m)
        if not self.streets.main_alignment.is_straight:
            aprons.append(find_narrow_gaps(sidewalks, shapely.union_all(streets)))
            sidewalks = shapely.union_all([sidewalks, aprons[-1]], grid_size=CITY.grid_m)
        apron_area = shapely.union_all(aprons, grid_size=CITY.grid_m).difference(blocks_area)
        apron_area = apron_area.buffer(-CITY.shrink_m, join_style="bevel")
        apron_areas = shapely.get_parts(shapely.set_precision(apron_area, CITY.grid_m))
        apron_outlines = shapely.segmentize(apron_areas, BlockParams().segment_m)
        blocks.append(build_sidewalk(apron_outlines, self.hills.compute_heights_m))
        self._park_cars(frontages)
        areas = (streets, streets_with_sidewalks, shapely.get_parts(sidewalks))
        heights = self.hills.compute_heights_m
        roadside = place_scenery(sides, *areas, heights, self.roadside_density, self.generator)
        ground_meshes = (self._build_ground(visible_span_m), *merge_by_kind(blocks))
        return Scenery((*ground_meshes, *merge_by_kind(*roadside)), tuple(range(len(ground_meshes))))

    def _list_frontages(self, visible_span_m: Bounds) -> list[tuple[BuildingSite, Frontage]]:
        """List both sides of the main street from curb to curb, and the blocks opposite of its turns."""
        curb_offset_m = self.streets.cross_section.curb_offset_m
        max_depth_m = curb_offset_m + CITY.block_depth_m + 10.0
        main_site = BuildingSite(self.streets.main_alignment, self.corridor, self.hills, max_depth_m)
        turns, stations_m = self.streets.main_street.turn_directions, self.streets.junction_stations_m
        half_lengths_m = self.streets.main_street.junction_half_lengths_m
        starts_m, ends_m = (stations_m - half_lengths_m).tolist(), (stations_m + half_lengths_m).tolist()
        frontages = []
        for west in range(len(turns) - 1):
            for side in (1, -1):
                # On the inside of a turn no street joins: the block continues.
                east = west + 1
                while turns[east] == side:
                    east += 1
                if turns[west] != side and starts_m[east] > visible_span_m[0] and ends_m[west] < visible_span_m[1]:
                    turn_spans_m = tuple((starts_m[index], ends_m[index]) for index in range(west + 1, east))
                    span_m = (ends_m[west], starts_m[east])
                    frontages.append((main_site, Frontage(span_m, side, curb_offset_m, turn_spans_m, (west, east))))
        is_visible = np.abs(stations_m - np.mean(visible_span_m)) < np.ptp(visible_span_m) / 2
        for index in np.flatnonzero(~self.streets.has_lights & is_visible).tolist():
            frontages.append(self._build_corner(index))
        return frontages

    def _build_corner(self, index: int) -> tuple[BuildingSite, Frontage]:
        """Build the frontage of the block between the two streets that meet the main street in a turn."""
        street = self.streets.cross_streets[index]
        half_m = float(self.streets.main_street.junction_half_lengths_m[index])
        curb_m = float(self.streets.cross_curb_offsets_m[index])
        side = int(self.streets.main_street.turn_directions[index])
        station_m = float(self.streets.junction_stations_m[index])
        first_m, last_m = -half_m - CITY.corner_m, half_m + CITY.corner_m
        corridor = StreetCorridor(street, (first_m, last_m))
        site = BuildingSite(street, corridor, self.hills, curb_m + CITY.corner_depth_m + 10.0)
        # The block ends where another stretch of the main street is nearer than this turn.
        x_m = np.arange(first_m, last_m, 5.0)
        is_elsewhere = np.zeros(len(x_m), dtype=bool)
        for y_m in (curb_m, curb_m + CITY.corner_depth_m):
            nearest_m = self.corridor.find_nearest_stations_m(street.compute_poses(x_m, side * y_m)[:, :2])
            is_elsewhere |= np.abs(nearest_m - station_m) > half_m + self.corridor.sample_spacing_m
        is_elsewhere &= np.abs(x_m) > half_m
        first_m = max([first_m, *x_m[is_elsewhere & (x_m < 0.0)].tolist()])
        last_m = min([last_m, *x_m[is_elsewhere & (x_m > 0.0)].tolist()])
        return site, Frontage((first_m + 5.0, last_m - 5.0), side, curb_m, ((-half_m, half_m),))

    def _build_street_areas(self) -> tuple[list[shapely.Geometry], list[shapely.Geometry]]:
        """Build the outlines of all streets, without and with their sidewalks."""
        spacing_m, length_m = CITY.street_spacing_m, CITY.cross_street_m
        main_stations_m = self.corridor.sample_stations_m(spacing_m)
        centerlines_m = [self.streets.main_alignment.compute_poses(main_stations_m, 0.0)[:, :2]]
        spans_m = self.streets.cross_street_spans_m + np.array([-STREETS.half_vehicle_m, STREETS.half_vehicle_m])
        for street, span_m in zip(self.streets.cross_streets, spans_m, strict=True):
            stations_m = span_m if street.is_straight else np.arange(-length_m, length_m, spacing_m)
            centerlines_m.append(street.compute_poses(stations_m, 0.0)[:, :2])
        # The curb offsets are in the same order: main street, cross streets.
        lines = [shapely.LineString(line_m) for line_m in centerlines_m]
        lines = shapely.simplify(lines, CITY.tolerance_m / 4)
        curb_offsets_m = [self.streets.cross_section.curb_offset_m, *self.streets.cross_curb_offsets_m.tolist()]
        half_widths_m = np.array(curb_offsets_m) - CITY.tolerance_m
        sidewalk_m = self.streets.cross_section.sidewalk_width_m
        streets = shapely.buffer(lines, half_widths_m, cap_style="flat")
        return streets.tolist(), shapely.buffer(lines, half_widths_m + sidewalk_m, cap_style="flat").tolist()

    def _iterate_street_sides(self, street: Alignment, frontage: Frontage, zone: Zone) -> Iterator[StreetSide]:
        """Iterate over the lines at the curb and behind the sidewalk of a frontage."""
        (first_m, last_m), sidewalk_m = frontage.span_m, self.streets.cross_section.sidewalk_width_m
        clearance_m = CITY.furniture_clearance_m
        curb_m = frontage.side * frontage.curb_offset_m
        yield StreetSide("curb", sample_street_side_m(street, (first_m + clearance_m, last_m - clearance_m), curb_m))
        edges_m = [first_m + sidewalk_m]
        for turn_span_m in frontage.turn_spans_m:
            edges_m += turn_span_m
        edges_m.append(last_m - sidewalk_m)
        facade_m = frontage.side * (frontage.curb_offset_m + sidewalk_m)
        for index, (start_m, end_m) in enumerate(pairwise(edges_m)):
            is_in_turn = index % 2 == 1
            # The main street has nothing behind the sidewalk in a turn, other streets have no room for houses there.
            if end_m > start_m and not (is_in_turn and frontage.junction_indices):
                line_m = sample_street_side_m(street, (start_m, end_m), facade_m)
                yield StreetSide("open" if is_in_turn else zone, line_m)

    def _build_end(
        self, site: BuildingSite, frontage: Frontage, end: int, is_built: bool
    ) -> tuple[Float64, list[shapely.Geometry]]:
        """Build the end of a block at a cross street.

        Where the main street turns away, its sidewalk continues around the turn, and the block continues up to the
        street that goes straight on.

        Args:
            site: Land along the street.
            frontage: The block.
            end: 0 for the beginning, 1 for the end.
            is_built: False if the block is a sidewalk only.

        Returns:
            (2, 2) curb of the cross street, and areas of sidewalk along it.
        """
        index, corner_m, inwards = frontage.junction_indices[end], frontage.span_m[end], 1 - 2 * end
        sidewalk_m = self.streets.cross_section.sidewalk_width_m
        clearance_m, curb_offset_m = CITY.corner_clearance_m, frontage.curb_offset_m
        (depth_m,) = site.compute_depths_m(np.array([corner_m]), frontage.side, curb_offset_m, CITY.block_depth_m)
        depths_m = np.array([0.0, clearance_m, max(float(depth_m), 2 * clearance_m)])
        face_m = site.street.compute_poses(corner_m, frontage.side * (curb_offset_m + depths_m))[:, :2]
        inside_m = -inwards * frontage.side * sidewalk_m
        turn_direction = int(self.streets.main_street.turn_directions[index])
        if not turn_direction:
            return face_m[1:], [] if is_built else [build_strip(face_m, inside_m)]
        middle_m = float(self.streets.junction_stations_m[index])
        half_m = float(self.streets.main_street.junction_half_lengths_m[index])
        # From the corner of the block along the turn, back along the street that goes straight on, to the face.
        turn_stations_m = np.linspace(corner_m, middle_m, 17)
        turn_curb_m = site.street.compute_poses(turn_stations_m, frontage.side * curb_offset_m)[:, :2]
        stations_m = np.linspace(-half_m, half_m + CITY.corner_m, 97)
        street_curb_m = float(self.streets.cross_curb_offsets_m[index])
        line_m = self.streets.cross_streets[index].compute_poses(-inwards * stations_m, 0.0)[:, :2]
        direction = (line_m[-1] - line_m[-2]) / np.linalg.norm(line_m[-1] - line_m[-2])
        projected_m = line_m[-1] + ((face_m[1:] - line_m[-1]) @ direction)[:, None] * direction
        opposite_m = line_m[(stations_m >= 0.0) & ((line_m - projected_m[-1]) @ direction < 0.0)]
        corners_m = np.concatenate([face_m[::-1], turn_curb_m, opposite_m, projected_m[1:]])
        street = shapely.LineString(line_m)
        area = shapely.Polygon(corners_m).buffer(0).difference(street.buffer(street_curb_m, cap_style="flat"))
        if not is_built:
            area = area.intersection(street.buffer(street_curb_m + sidewalk_m))
        left_m = inwards * turn_direction * street_curb_m
        curb_m = projected_m + left_m * np.array([-direction[1], direction[0]])
        return curb_m, [area, build_strip(turn_curb_m, inside_m)]

    def _build_ground(self, visible_span_m: Bounds) -> Mesh:
        """Build the ground as far as lanes go on a plane, or as far as it is visible on hills."""
        if self.hills.is_flat:
            half_m = self.streets.half_length_m + 200.0
            return build_ground_plane((-half_m, -half_m), (half_m, half_m))
        stations_m = np.arange(*visible_span_m, CITY.ground_spacing_m)
        path_m = self.streets.main_alignment.compute_poses(stations_m, 0.0)[:, :2]
        return self.hills.build_mesh(path_m, CITY.ground_margin_m)

    def _sample_parked_cars(self, frontage: Frontage) -> list[ParkedCar]:
        """Sample cars at the curb, in the direction of traffic.

        Streets that meet the main street in a turn have no traffic: there, cars are parked on the lanes.
        """
        cars: list[ParkedCar] = []
        uniform, clearance_m = self.generator.uniform, CITY.corner_clearance_m
        bay_m = self.streets.cross_section.bay_width_m if frontage.junction_indices else CITY.parking_width_m
        start_m, last_m = frontage.span_m[0] + clearance_m, frontage.span_m[1] - clearance_m
        while start_m < last_m and bay_m:
            kind = self.fleet.sample_kind(PARKED_KINDS)
            length_m = self.fleet.get_length_m(kind) + CITY.parking_gap_m + uniform(0.0, 0.5)
            end_m = start_m + length_m
            if self.generator.random() < self.parked_share and end_m < last_m:
                slack_m = max((bay_m - self.fleet.get_width_m(kind)) / 2 - 0.08, 0.0)
                left_m = frontage.side * (frontage.curb_offset_m - bay_m / 2 + uniform(0.0, slack_m))
                yaw_deg = (0.0 if frontage.side == -1 else 180.0) + uniform(-0.4, 0.4)
                is_off_turns = [
                    start_m >= turn_end_m + clearance_m or end_m <= turn_start_m - clearance_m
                    for turn_start_m, turn_end_m in frontage.turn_spans_m
                ]
                if all(is_off_turns):
                    cars.append(ParkedCar(kind, start_m + length_m / 2, left_m, yaw_deg))
            start_m = end_m
        return cars

    def _park_cars(self, frontages: list[tuple[BuildingSite, Frontage]]) -> None:
        """Park cars along all frontages."""
        # Heights and tilts are computed for all cars together.
        kinds: list[str] = []
        poses: list[Float64] = []
        for site, frontage in frontages:
            for car in self._sample_parked_cars(frontage):
                kinds.append(car.kind)
                street_pose = site.street.compute_poses(car.station_m, car.left_m)
                poses.append(street_pose + np.array([0.0, 0.0, car.yaw_deg]))
        if not kinds:
            return
        street_poses = np.array(poses)
        heights_and_tilts = self.hills.compute_heights_and_tilts(street_poses[:, :2], street_poses[:, 2])
        for kind, (x_m, y_m, yaw_deg), (height_m, pitch_deg, roll_deg) in zip(
            kinds, street_poses.tolist(), heights_and_tilts.tolist(), strict=True
        ):
            self.fleet.add_parked_vehicle(kind, (x_m, y_m, yaw_deg), height_m, (pitch_deg, roll_deg))


def find_narrow_gaps(sidewalks: shapely.Geometry, streets: shapely.Geometry) -> shapely.Geometry:
    """Find narrow gaps between sidewalks that are not streets: wedges, and where the main street comes near itself."""
    with np.errstate(all="ignore"):  # divisions by zero inside GEOS leave no trace in the result
        closed = sidewalks.buffer(CITY.max_gap_m, join_style="mitre").buffer(-CITY.max_gap_m, join_style="mitre")
    gaps = closed.difference(streets.buffer(2 * CITY.tolerance_m, join_style="bevel")).difference(sidewalks)
    return gaps.buffer(-CITY.tolerance_m, join_style="bevel").buffer(CITY.tolerance_m, join_style="bevel")


def build_strip(line_m: Float64, left_m: float) -> shapely.Geometry:
    """Build the area between a line and its parallel.

    Args:
        line_m: (K, 2) line.
        left_m: Offset of the parallel to the left.
    """
    return shapely.buffer(shapely.LineString(line_m), left_m, single_sided=True, join_style="mitre")


def build_cross_street_sides(curb_m: Float64, sidewalk_width_m: float, zone: Zone) -> list[StreetSide]:
    """Build the lines at the curb and behind the sidewalk of a cross street.

    Args:
        curb_m: (2, 2) curb, with the street on its left.
        sidewalk_width_m: Width of the sidewalk.
        zone: Zone behind the sidewalk.
    """
    ahead = (curb_m[1] - curb_m[0]) / np.linalg.norm(curb_m[1] - curb_m[0])
    facade_m = curb_m + sidewalk_width_m * np.array([ahead[1], -ahead[0]])
    return [StreetSide("curb", curb_m), StreetSide(zone, facade_m)]


def sample_street_side_m(street: Alignment, span_m: Bounds, left_m: float) -> Float64:
    """Sample a line parallel to a street, in the direction that has the street on the left.

    Args:
        street: Alignment of the street.
        span_m: First and last station.
        left_m: Offset to the left of the street.

    Returns:
        (K, 2) positions in meters.
    """
    num_segments = 1 if street.is_straight else int(np.ceil((span_m[1] - span_m[0]) / CITY.street_spacing_m))
    line_m: Float64 = street.compute_poses(np.linspace(*span_m, num_segments + 1), left_m)[:, :2]
    return line_m if left_m < 0 else line_m[::-1]
