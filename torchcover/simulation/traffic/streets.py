"""The plan of a city: a main street with bends and turns, and streets that cross it at lights."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from torchcover.geometry.arrays import Bools, Float64, Int64
from torchcover.simulation.traffic.alignment import Alignment, OffsetPath, StreetCorridor, compute_squared_distances_m2
from torchcover.simulation.traffic.flow import CROSS, MAIN, SPEED_LIMIT_SPACING_M, JunctionPassage, Lane, TrafficSignals

# Between junctions no curve is tighter; crossings and stop lines lie on straights.
SMALLEST_RADIUS_M = 110.0
STRAIGHT_BESIDE_M = 8.0
SHORTEST_BEND_M = 20.0
TURN_DEG = (82.0, 98.0)
# At the beginning and the end of a turn, over which the steering wheel is turned.
RAMP_M = 8.0
# At least so many blocks between two turns.
TURNS_APART = 2
# Stretches that are not neighbours keep apart; what is nearer along the street is one.
APART_M, NEIGHBOURS_M = 70.0, 200.0
DRAWS = 30


class MainStreet(NamedTuple):
    """`alignment` has station 0 at the origin, along x; `turn_directions` (J,) 1 to the left, -1 to the right, 0: straight on.

    `junction_half_lengths_m` (J,) is how far from its middle each junction ends.
    """

    alignment: Alignment
    turn_directions: Int64
    junction_half_lengths_m: Float64


def sample_main_street(
    junction_stations_m: Float64,
    junction_half_lengths_m: Float64,
    max_bend_deg: float,
    turn_share: float,
    turn_radius_m: float,
    half_length_m: float,
    generator: np.random.Generator,
) -> MainStreet:
    """Draw one that never comes near itself, and that begins and ends `half_length_m` from the origin.

    Each of the junctions, at (J,) stations, ends `junction_half_lengths_m` from its middle where the street goes straight on. It bends
    by `max_bend_deg` at most between two of them, and from its first direction. Of those that may have a turn, which is
    neither the first nor the last, `turn_share` have one.
    """
    for _ in range(DRAWS):
        found = _draw(
            junction_stations_m, junction_half_lengths_m, np.deg2rad(max_bend_deg), turn_share, turn_radius_m, generator
        )
        if found.alignment.is_straight or _keeps_apart(found.alignment, half_length_m):
            return found
    return MainStreet(
        Alignment([0.0], [0.0]), np.zeros(len(junction_stations_m), dtype=np.int64), junction_half_lengths_m
    )


def _draw(
    junctions_m: Float64,
    halves_m: Float64,
    bend: float,
    turn_share: float,
    radius_m: float,
    generator: np.random.Generator,
) -> MainStreet:
    turns, halves_m = np.zeros(len(junctions_m), dtype=np.int64), halves_m.copy()
    angles, quarter, last = np.zeros(len(junctions_m)), 0, -TURNS_APART
    for index in range(1, len(junctions_m) - 1):
        if index - last >= TURNS_APART and generator.random() < turn_share:
            turns[index] = -quarter if quarter else generator.choice([-1, 1])
            quarter, last = quarter + int(turns[index]), index
            angles[index] = np.deg2rad(generator.uniform(*TURN_DEG))
            halves_m[index] = (angles[index] * radius_m + RAMP_M) / 2
    stations, curvatures = [0.0], [0.0]
    aside = 0.0
    ends_m = junctions_m + halves_m + STRAIGHT_BESIDE_M
    following_m = junctions_m[1:] - halves_m[1:] - STRAIGHT_BESIDE_M
    for index, middle_m in enumerate(junctions_m.tolist()):
        if turns[index]:
            half_m = float(halves_m[index])
            _append(stations, curvatures, middle_m - half_m, 2 * half_m, RAMP_M, turns[index] / radius_m)
        angle = generator.uniform(-bend, bend)
        length_m = float(following_m[index] - ends_m[index]) if index < len(following_m) else 0.0
        if length_m > SHORTEST_BEND_M and angle:
            # A curve turns by its curvature times three quarters of its length.
            most = 0.75 * length_m / SMALLEST_RADIUS_M
            angle = float(np.clip(-angle if abs(aside + angle) > bend else angle, -most, most))
            _append(stations, curvatures, float(ends_m[index]), length_m, length_m / 4, angle / (0.75 * length_m))
            aside += angle
    if len(stations) == 1:
        return MainStreet(Alignment([0.0], [0.0]), turns, halves_m)
    stations, curvatures = stations[1:], curvatures[1:]
    # Begun anywhere, and then moved: the origin is where station 0 is.
    x, y, yaw_deg = Alignment(stations, curvatures).compute_poses(0.0, 0.0)
    yaw = np.deg2rad(yaw_deg)
    start = (-x * np.cos(yaw) - y * np.sin(yaw), x * np.sin(yaw) - y * np.cos(yaw), -yaw)
    return MainStreet(Alignment(stations, curvatures, start), turns, halves_m)


def _append(
    stations: list[float], curvatures: list[float], start: float, length: float, ramp: float, curvature: float
) -> None:
    """A curve: in, round, out."""
    stations += [start, start + ramp, start + length - ramp, start + length]
    curvatures += [0.0, curvature, curvature, 0.0]


def _keeps_apart(street: Alignment, reach_m: float) -> bool:
    stations = np.arange(-reach_m, reach_m, 20.0)
    places_m = street.compute_poses(stations, 0.0)[:, :2]
    far = np.abs(stations[:, None] - stations) > NEIGHBOURS_M
    return bool((compute_squared_distances_m2(places_m, places_m)[far] > APART_M**2).all())


BICYCLE_LANE_M = 1.8
GUTTER_M = 0.5
MIN_BLOCK_M, MAX_BLOCK_M = 80.0, 130.0

# Along the way of whoever drives: stop line, crossing, carriageway of the other street, crossing.
CROSSING_ENDS_M = 4.0
STOP_LINE_M = 5.0
# People walk at these distances from the kerb, each way on its own, between the posts and the facades.
TRACKS_M = (1.35, 2.25)
WAITING_BEHIND_KERB_M = 0.5
# A crossing of the main street holds one person on each of these paths.
FOOTPATHS_M = (1.6, 2.5, 3.4)
WALKED_METRES_PER_GREEN_SECOND = 1.2

# A wave of green that a car with 40 km/h would ride, with a good deal of disorder.
GREEN_WAVE_MPS = 11.0
WAVE_DISORDER_S = 9.0

# What is farther away along a cross street than this is not seen from the main street.
SIGHT_M = 270.0
# Half of the longest vehicle, and a little more.
LONGEST_HALF_M = 9.0

# Across a curve, and before it.
COMFORTABLE_MPS2, BRAKING_MPS2 = 2.0, 1.2
# Two buses of 12 x 2.55 m, and a little air, pass each other in a turn.
BUS_HALF_M, BUS_M = 6.0, 2.65


@dataclass(frozen=True)
class CrossSection:
    """The main street from its middle to the houses: lanes of one width, as all streets have, bays (or 0), sidewalk."""

    lanes_per_direction: int
    lane_width_m: float = 3.25
    bay_width_m: float = 2.3
    sidewalk_width_m: float = 3.2

    @property
    def bay_center_offset_m(self) -> float:
        """From the middle of the street to that of its parking bays."""
        return self.lanes_per_direction * self.lane_width_m + BICYCLE_LANE_M + self.bay_width_m / 2

    @property
    def curb_offset_m(self) -> float:
        """From the middle of the street to its kerb."""
        return self.bay_center_offset_m + self.bay_width_m / 2

    @property
    def min_turn_radius_m(self) -> float:
        """The smallest radius of the middle of a turn in which a bus keeps off the bus on the lane outside its own."""
        inner, outer = BUS_M / 2, self.lane_width_m - BUS_M / 2
        innermost_m = (BUS_HALF_M**2 + inner**2 - outer**2) / (2 * (outer - inner))
        return innermost_m + (self.lanes_per_direction - 0.5) * self.lane_width_m


@dataclass(frozen=True, eq=False)
class StreetPlan:
    """Where the streets are: the course of the main street, and (J,) stations at which others of 1 or 2 lanes cross it.

    Lanes begin and end `half_length_m` from the origin: beyond what is driven in the run.
    """

    cross_section: CrossSection
    junction_stations_m: Float64
    cross_lanes_per_direction: Int64
    signals: TrafficSignals
    half_length_m: float
    main_street: MainStreet

    @property
    def main_alignment(self) -> Alignment:
        """The main street."""
        return self.main_street.alignment

    @property
    def has_lights(self) -> Bools:
        """(J,) whether somebody crosses the main street there: not where it turns, and others give way."""
        return np.asarray(self.main_street.turn_directions == 0)

    @cached_property
    def cross_streets(self) -> list[Alignment]:
        """J streets that cross the main street, at right angles; where it turns, the two that meet it go on straight.

        They have station 0 on the junction, to which a straight one comes from the right of the main street.
        """
        streets, middles = [], self.main_alignment.compute_poses(self.junction_stations_m, 0.0)
        for index, (station, half) in enumerate(
            zip(self.junction_stations_m, self.main_street.junction_half_lengths_m, strict=True)
        ):
            if self.main_street.turn_directions[index] == 0:
                x, y, yaw_deg = middles[index]
                streets.append(Alignment([0.0], [0.0], (x, y, np.deg2rad(yaw_deg + 90.0))))
                continue
            # The same turn, opposite of where the main street would go on to and come from.
            (x, y, yaw_deg), (end_x, end_y, end_yaw_deg) = self.main_alignment.compute_poses(
                [station - half, station + half], 0.0
            )
            yaw, angle = np.deg2rad([yaw_deg, end_yaw_deg - yaw_deg])
            to_corner = np.hypot(end_x - x, end_y - y) / 2 / np.cos(angle / 2)
            start = x + 2 * to_corner * np.cos(yaw), y + 2 * to_corner * np.sin(yaw), yaw + np.pi
            knots = self.main_alignment.stations_m
            of_turn = (knots >= station - half - 1e-6) & (knots <= station + half + 1e-6)
            streets.append(Alignment(knots[of_turn] - station, self.main_alignment.curvatures_per_m[of_turn], start))
        return streets

    @property
    def cross_curb_offsets_m(self) -> Float64:
        """(J,) from the middle of each cross street to its kerb, of those that meet in a turn, too."""
        return np.asarray(self.cross_lanes_per_direction * self.cross_section.lane_width_m + GUTTER_M)

    @cached_property
    def cross_street_spans_m(self) -> Float64:
        """(J, 2) stations between which a cross street, in all its width, is far from all others of its kind."""
        whole = StreetCorridor(self.main_alignment, (-self.half_length_m, self.half_length_m))
        edges_m = self.junction_stations_m + np.array([[-1.0], [1.0]]) * (
            self.main_street.junction_half_lengths_m + 1.0
        )
        ends_m = np.empty((len(self.junction_stations_m), 2))
        for column, side in enumerate((-1, 1)):
            reach_m = (
                whole.find_half_widths_m(edges_m.ravel(), side, self.cross_section.curb_offset_m, SIGHT_M)
                .reshape(2, -1)
                .min(axis=0)
            )
            ends_m[:, column] = side * (
                2 * self.half_length_m if self.main_alignment.is_straight else reach_m - LONGEST_HALF_M
            )
        return ends_m

    def build_traffic_lanes(self) -> list[Lane]:
        """The lanes for motor traffic of the main street: eastbound from the median outwards, then westbound."""
        offsets = [
            (lane + 0.5) * self.cross_section.lane_width_m for lane in range(self.cross_section.lanes_per_direction)
        ]
        return [self._main_lane(offset, way, STOP_LINE_M) for way in (1, -1) for offset in offsets]

    def build_bicycle_lanes(self) -> list[Lane]:
        """One eastbound, one westbound."""
        left_m = self.cross_section.lanes_per_direction * self.cross_section.lane_width_m + BICYCLE_LANE_M / 2
        return [self._main_lane(left_m, way, STOP_LINE_M) for way in (1, -1)]

    def build_sidewalk_lanes(self) -> list[Lane]:
        """Tracks of the people who walk along the main street: each way on both sides."""
        tracks = [
            (self.cross_section.curb_offset_m + TRACKS_M[0], 1),
            (self.cross_section.curb_offset_m + TRACKS_M[1], -1),
        ]
        return [self._main_lane(side * offset, way, 0.0) for side in (1, -1) for offset, way in tracks]

    def build_cross_lanes(self) -> list[Lane]:
        """The lanes of all cross streets: northbound ones on the east side, southbound ones on the west side."""
        lanes = []
        for index in np.flatnonzero(self.has_lights).tolist():
            middle, half = self.half_length_m, self.cross_section.curb_offset_m
            gate = JunctionPassage(middle - half - STOP_LINE_M, middle + half + CROSSING_ENDS_M, index, CROSS)
            for way in (1, -1):
                for lane in range(self.cross_lanes_per_direction[index]):
                    left_m = -way * (lane + 0.5) * self.cross_section.lane_width_m
                    lanes.append(Lane(OffsetPath(self.cross_streets[index], left_m, way, self.half_length_m), (gate,)))
        return lanes

    def _main_lane(self, right_m: float, way: int, stop_line_m: float) -> Lane:
        """A lane of the main street to the right of its middle, eastbound (1) or westbound (-1).

        Whoever stops right at the kerb of the cross street (`stop_line_m` of 0) walks.
        """
        line = OffsetPath(self.main_alignment, -way * right_m, way, self.half_length_m)
        walks = stop_line_m == 0.0
        before = WAITING_BEHIND_KERB_M if walks else stop_line_m
        behind = WAITING_BEHIND_KERB_M if walks else CROSSING_ENDS_M
        gates = []
        for index in np.argsort(way * self.junction_stations_m):
            if self.has_lights[index]:
                middle, half = (
                    float(line.convert_stations_to_distances_m(self.junction_stations_m[index])),
                    self.main_street.junction_half_lengths_m[index],
                )
                enter, leave = middle - half - before, middle + half + behind
                needed = (leave - enter) / WALKED_METRES_PER_GREEN_SECOND if walks else 0.0
                gates.append(JunctionPassage(float(enter), float(leave), int(index), MAIN, float(needed)))
        return Lane(line, tuple(gates), None if walks or self.main_alignment.is_straight else _limits_mps(line))


def _limits_mps(line: OffsetPath) -> Float64:
    """(K,) how fast a lane may be driven, at each `SPEED_LIMIT_SPACING_M`: in curves, and before them."""
    places = np.arange(0.0, line.length_m, SPEED_LIMIT_SPACING_M)
    curvature = line.street.compute_curvatures_per_m(line.convert_distances_to_stations_m(places))
    curvature = np.abs(curvature / (1.0 - curvature * line.left_m))
    square = COMFORTABLE_MPS2 / np.maximum(curvature, 1e-6)
    # Whoever brakes gently from here is slow enough wherever it is needed ahead.
    braked = 2 * BRAKING_MPS2 * places
    return np.asarray(np.sqrt(np.minimum.accumulate((square + braked)[::-1])[::-1] - braked))


def sample_street_plan(
    cross_section: CrossSection,
    max_bend_deg: float,
    turn_share: float,
    span_m: tuple[float, float],
    half_length_m: float,
    generator: np.random.Generator,
    layout_generator: np.random.Generator,
) -> StreetPlan:
    """Draw the cross streets and their lights. The origin lies halfway between two junctions."""
    middle = generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M) / 2
    east, west = [middle], [-middle]
    while east[-1] < span_m[1]:
        east.append(east[-1] + generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M))
    while west[-1] > span_m[0]:
        west.append(west[-1] - generator.uniform(MIN_BLOCK_M, MAX_BLOCK_M))
    junctions = np.array(west[::-1] + east)
    # Two-lane and four-lane streets in turn.
    cross_lanes = 1 + (np.arange(len(junctions)) + generator.integers(2)) % 2
    disorder = generator.uniform(-WAVE_DISORDER_S, WAVE_DISORDER_S, size=len(junctions))
    signals = TrafficSignals(disorder - junctions / GREEN_WAVE_MPS + generator.uniform(0.0, 60.0))
    halves = np.asarray(cross_lanes * cross_section.lane_width_m + GUTTER_M)
    drawn = sample_main_street(
        junctions, halves, max_bend_deg, turn_share, cross_section.min_turn_radius_m, half_length_m, layout_generator
    )
    return StreetPlan(cross_section, junctions, cross_lanes, signals, half_length_m, drawn)
